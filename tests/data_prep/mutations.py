"""Damaged copies of a file: what a broken download or disk makes of it.

The default suite tries the first few; the slow one tries a thousand of every format.
"""

import random

NUM_QUICK = 50
NUM_ALL = 1000


def mutate(data: bytes, seed: int) -> bytes:
    """Damage a file once: flip bytes, cut it, cut a piece out or put a run in."""
    draw = random.Random(seed)
    at = draw.randrange(max(1, len(data)))
    length = draw.choice([1, 2, 4, 16, 200, 4096])
    match draw.choice(["flip", "flip", "cut", "remove", "insert", "zero"]):
        case "flip":
            flipped = bytes(byte ^ draw.randrange(1, 256) for byte in data[at : at + length])
            return data[:at] + flipped + data[at + length :]
        case "cut":
            return data[:at]
        case "remove":
            return data[:at] + data[at + length :]
        case "insert":
            return data[:at] + draw.randbytes(length) + data[at:]
        case _:
            return data[:at] + bytes(min(length, len(data) - at)) + data[at + length :]


def seeds(count: int) -> range:
    """Seeds of the damages to try: ``NUM_QUICK`` by default, ``NUM_ALL`` in the slow suite."""
    return range(count)
