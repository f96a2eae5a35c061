"""Photos of any camera: JPEG, PNG and WebP, checked before their pixels are unpacked.

Orientation noted in the file is ignored: cameras refer to the rows and columns as stored.
"""

import io
import struct
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from l3r.errors import DataError

MAX_PIXELS = 2**27
"""Larger images are refused before they are unpacked."""
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
"""Endings of photos, in small letters."""

_MAX_BYTES = 2**29
_MAX_SCANS = 100
"""Progressive JPEGs have about ten; thousands would keep the decoder busy for minutes."""
_START_OF_SCAN = b"\xff\xda"
_FORMATS = ("JPEG", "PNG", "WEBP")
# What Pillow's readers raise on damaged files; DecompressionBombError is no OSError.
_DAMAGE = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    EOFError,
    OverflowError,
    struct.error,
    zlib.error,
    UnidentifiedImageError,
    Image.DecompressionBombError,
)


def photo_size(path: Path) -> tuple[int, int]:
    """Read (height, width) from the header.

    Raises:
        DataError: It is missing, no photo, or too large.
    """
    with _open(path) as image:
        return image.height, image.width


def read_photo(path: Path, image_size: tuple[int, int]) -> UInt8[np.ndarray, "_h _w 3"]:
    """Read a photo as RGB; grey, CMYK and images with alpha become RGB, 16 bits become 8.

    Args:
        path: The file.
        image_size: (height, width) it must have.

    Raises:
        DataError: It is missing, damaged, cut off or of another size.
    """
    with _open(path) as image:
        if (image.height, image.width) != image_size:
            raise DataError(
                f"{path}: {image.width}x{image.height} pixels, its camera says {image_size[1]}x"
                f"{image_size[0]}; use the photo the camera was found with"
            )
        try:
            pixels = _read_png(path) if image.format == "PNG" else _convert(image, path)
        except (*_DAMAGE, MemoryError) as error:
            raise _damaged(path, error) from error
    if pixels.shape != (*image_size, 3):
        raise _damaged(path, f"{pixels.shape}")
    return pixels


def check_png(data: bytes) -> None:
    """Compare every chunk of a PNG with its checksum; a decoder would fill gaps and only warn.

    Raises:
        OSError: A chunk is damaged or the end is missing.
        SyntaxError: A chunk is no chunk.
    """
    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        image.verify()


def _open(path: Path) -> Image.Image:
    """Open a photo, its pixels unread, after looking at its sizes."""
    try:
        if (size := path.stat().st_size) > _MAX_BYTES:
            raise DataError(f"{path}: {size:,} bytes, expected {_MAX_BYTES:,} or less")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(path, formats=_FORMATS)
    except _DAMAGE as error:
        raise _damaged(path, error) from error
    if not 0 < image.width * image.height <= MAX_PIXELS:
        image.close()
        raise DataError(
            f"{path}: {image.width}x{image.height} pixels, expected {MAX_PIXELS:,} or fewer"
        )
    return image


def _convert(image: Image.Image, path: Path) -> UInt8[np.ndarray, "_h _w 3"]:
    is_jpeg = image.format in ("JPEG", "MPO")
    if is_jpeg and path.read_bytes().count(_START_OF_SCAN) > _MAX_SCANS:
        raise ValueError(f"more than {_MAX_SCANS} scans")
    return np.asarray(image.convert("RGB"))


def _read_png(path: Path) -> UInt8[np.ndarray, "_h _w 3"]:
    # Pillow looks at no checksum of pixels while decoding, and saturates 16 bits.
    data = path.read_bytes()
    check_png(data)
    mode = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    if image is None:
        raise ValueError("undecodable")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def _damaged(path: Path, error: object) -> DataError:
    reason = str(error).split("\n")[0][:120]
    return DataError(f"{path}: no whole photo ({reason}); copy the file again")
