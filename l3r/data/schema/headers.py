"""Headers of stored pixels, read without the libraries that trust them.

A flipped bit in a header makes numpy parse another text or allocate another size, and a JPEG
decoder fill gigabytes. The shards are written by :mod:`l3r.data.schema.codec` alone, so a reader
knows what must stand there.
"""

import numpy as np
from jaxtyping import Float16

_NPY = b"\x93NUMPY\x01\x00"
_START, _END_OF_IMAGE, _START_OF_SCAN = 0xD8, 0xD9, 0xDA
_FRAMES = (0xC0, 0xC1, 0xC2)
"""Baseline, extended and progressive: those that decoders know."""


def depth_pixels(data: bytes, size: tuple[int, int]) -> Float16[np.ndarray, "h w"] | None:
    """Take the pixels out of a depth map.

    Args:
        data: A ``.npy`` file of version 1.0.
        size: (height, width) it must have.

    Returns:
        None unless it is, byte for byte, a header that ``numpy.save`` writes of little-endian
        float16 of that size in rows, and then as many bytes as the pixels take.
    """
    height, width = size
    start = 10 + int.from_bytes(data[8:10], "little")
    header = f"{{'descr': '<f2', 'fortran_order': False, 'shape': ({height}, {width}), }}".encode()
    if data[:8] != _NPY or data[10:start] != header.ljust(start - 11) + b"\n":
        return None
    if len(data) != start + 2 * height * width:
        return None
    # A copy, since torch warns of memory that cannot be written to.
    return np.frombuffer(data, dtype="<f2", offset=start).reshape(size).copy()


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Read (height, width) from the frame header of a JPEG; None where there is none."""
    if data[:2] != bytes([0xFF, _START]):
        return None
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker in _FRAMES:
            height, width = (int.from_bytes(data[at + k : at + k + 2], "big") for k in (5, 7))
            return height, width
        if marker in (_START_OF_SCAN, _END_OF_IMAGE) or length < 2:
            return None
        at += 2 + length
    return None
