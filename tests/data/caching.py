"""What a process of its own does to a shared cache."""

import sys
from pathlib import Path

import numpy as np

from l3r.data.cache import GraphCache


def payload(number):
    """Bytes that tell their number, of a size that varies."""
    return number.to_bytes(4, "big") * (200 + 37 * (number % 11))


def hammer(folder, limit, seed):
    """Write and read at random; every hit must be whole."""
    rng = np.random.default_rng(seed)
    cache = GraphCache(folder, limit)
    hits = 0
    for number in map(int, rng.integers(0, 60, 400)):
        found = cache.read(str(number))
        if found is None:
            cache.write(str(number), payload(number))
        else:
            assert found == payload(number)
            hits += 1
    assert cache.is_on
    assert hits


if __name__ == "__main__":
    hammer(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
