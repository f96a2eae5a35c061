"""Pixels of CO3D beyond its images: half floats in 16-bit PNG, and 8-bit masks.

Sizes are compared with the annotation's before anything is unpacked, and every chunk of a PNG with
its checksum.
"""

import struct
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt
from PIL import Image

from data_prep.converters.photos import check_png, photo_size
from l3r.errors import DataError

Depth = Float32[np.ndarray, "_h _w"]
"""z, 0 where unknown."""

_PNG_ERRORS = (OSError, SyntaxError, ValueError, struct.error, Image.DecompressionBombError)
_BITS_AT = 24
"""Where a PNG says how many bits a channel has."""
_EMPTY_DEPTH = 0.01
"""Bytes per pixel: a depth map of zeros compresses to 0.002."""
_BLACK_IMAGE = 0.05
"""Bytes per pixel: black JPEGs take 0.02 to 0.04, genuine frames 0.06 and more."""
_BLACK = 16
"""No sample of a black JPEG is brighter."""


def read_depth(
    path: Path,
    image_size: tuple[int, int],
    *,
    scale: float,
    valid_path: Path | None,
    foreground: tuple[Path, float] | None = None,
) -> Depth:
    """Read z: the 16 bits are a half float, times ``scale``.

    Args:
        path: 16-bit PNG.
        image_size: (height, width) of the annotation.
        scale: ``scale_adjustment``.
        valid_path: Depth mask, above 0 where depth is valid; None: valid everywhere.
        foreground: Mask of foreground probability, and the share that must be exceeded.

    Returns:
        Depth in the sequence's unit; 0 where it is not finite, not positive or masked out.

    Raises:
        DataError: A file is missing, damaged, or of another size or type.
    """
    bits = _read_png(path, image_size, bits=16)
    with np.errstate(over="ignore", invalid="ignore"):
        z = bits.view(np.float16).astype(np.float32) * np.float32(scale)
    known = np.isfinite(z) & (z > 0)
    if valid_path is not None:
        known &= read_mask(valid_path, image_size, 0.0)
    if foreground is not None:
        known &= read_mask(foreground[0], image_size, foreground[1])
    return np.where(known, z, np.float32(0))


def read_mask(path: Path, image_size: tuple[int, int], above: float) -> Bool[np.ndarray, "_h _w"]:
    """Tell where a mask's grey level, as a share of white, is above a threshold.

    Args:
        path: PNG of 8 bits or fewer.
        image_size: (height, width) of the annotation.
        above: In [0, 1].

    Raises:
        DataError: It is missing, damaged, or of another size or type.
    """
    return np.asarray(_read_png(path, image_size, bits=8) > 255 * above)


def no_depth(image_size: tuple[int, int]) -> Depth:
    """Give depth that is unknown everywhere."""
    return np.zeros(image_size, np.float32)


def is_black(path: Path, image_size: tuple[int, int]) -> bool:
    """Tell whether a frame was redacted: hidden test frames are black.

    Black compresses so well that a file's size clears nearly every frame without decoding it.

    Args:
        path: An image whose header was found good.
        image_size: (height, width).
    """
    if path.stat().st_size > _BLACK_IMAGE * image_size[0] * image_size[1] + 4096:
        return False
    image = _decode(path.read_bytes(), cv2.IMREAD_REDUCED_GRAYSCALE_8)
    return image is not None and int(image.max()) <= _BLACK


def is_empty(path: Path, image_size: tuple[int, int]) -> bool:
    """Tell whether a depth map holds nothing but zeros.

    Args:
        path: 16-bit PNG whose header was found good.
        image_size: (height, width).

    Raises:
        DataError: It is so small that it was looked into, and damaged.
    """
    if path.stat().st_size > _EMPTY_DEPTH * image_size[0] * image_size[1] + 512:
        return False
    return not _read_png(path, image_size, bits=16).any()


def _read_png(path: Path, image_size: tuple[int, int], *, bits: int) -> UInt[np.ndarray, "_h _w"]:
    """Read one channel of 16 bits, or of 8 and fewer."""
    found = photo_size(path)
    if found != image_size:
        raise DataError(
            f"{path}: {found[1]}x{found[0]}, its annotation says {image_size[1]}x{image_size[0]};"
            " unpack the archive again"
        )
    try:
        data = path.read_bytes()
        check_png(data)
    except _PNG_ERRORS as error:
        raise DataError(f"{path}: no whole PNG ({error}); unpack the archive again") from error
    image = None
    if (data[_BITS_AT] == 16) == (bits == 16):
        image = _decode(data, cv2.IMREAD_UNCHANGED if bits == 16 else cv2.IMREAD_GRAYSCALE)
    if image is None or image.itemsize * 8 != bits or image.shape != image_size:
        raise DataError(f"{path}: expected one channel of {bits} bits; unpack the archive again")
    return image


def _decode(data: bytes, mode: int) -> UInt[np.ndarray, "..."] | None:
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except cv2.error:
        return None
