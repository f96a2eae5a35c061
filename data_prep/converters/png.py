"""PNG files whose every chunk is checked before a decoder sees them.

A decoder fills what is cut off with black and only warns, and believes the size in the header; a
PNG carries a checksum in every chunk, so damage need not get that far.
"""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from l3r.errors import DataError

MAX_PIXELS = 2**26
"""Images larger than this are refused unread: no data set here has them."""

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEADER = len(_SIGNATURE) + 25
"""Bytes up to the end of the first chunk, which holds the size."""


def read_png_size(path: Path) -> tuple[int, int]:
    """Read (height, width) from the header alone.

    Raises:
        DataError: It is no PNG, its header is damaged, or it has more than 2^26 pixels.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEADER)
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; check the file and its permissions") from error
    return _parse_header(head, path)


def read_png(path: Path, image_size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Read a PNG as RGB.

    Args:
        path: The file.
        image_size: (height, width) it must have.

    Raises:
        DataError: It is cut off, damaged, no image or of another size.
    """
    image = _decode(path, image_size, cv2.IMREAD_COLOR)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def read_png_bgra(path: Path, image_size: tuple[int, int]) -> UInt8[np.ndarray, "h w 4"]:
    """Read the four bytes of each pixel of a PNG with alpha, in the order blue, green, red, alpha.

    Args:
        path: The file.
        image_size: (height, width) it must have.

    Raises:
        DataError: It is cut off, damaged, of another size or not of four 8-bit channels.
    """
    image = _decode(path, image_size, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 4:
        raise DataError(
            f"{path}: {image.dtype} of shape {image.shape}, expected 4 channels of 8 bits; unpack"
            " the archive again"
        )
    return image


def _decode(path: Path, image_size: tuple[int, int], mode: int) -> np.ndarray:
    try:
        # Eight bytes a pixel and some text is all a PNG of this size can need.
        most = 9 * image_size[0] * image_size[1] + 2**20
        if path.stat().st_size > most:
            raise DataError(
                f"{path}: {path.stat().st_size} bytes, expected {most} or less for"
                f" {image_size}; unpack the archive again"
            )
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; check the file and its permissions") from error
    if (found := _parse_header(data[:_HEADER], path)) != image_size:
        raise DataError(
            f"{path}: (height, width) {found}, expected {image_size}; unpack the archive again"
        )
    fault = _find_fault(data)
    image = None if fault else cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    if image is None:
        raise DataError(
            f"{path}: no whole PNG ({len(data)} bytes, {fault or 'undecodable'}); unpack the"
            " archive again"
        )
    return np.asarray(image)


def _parse_header(head: bytes, path: Path) -> tuple[int, int]:
    start = len(_SIGNATURE)
    whole = len(head) == _HEADER and head[: start + 8] == _SIGNATURE + b"\0\0\0\rIHDR"
    if not whole or zlib.crc32(head[start + 4 : -4]) != struct.unpack(">I", head[-4:])[0]:
        raise DataError(f"{path}: no PNG or its header is damaged; unpack the archive again")
    width, height = struct.unpack(">II", head[16:24])
    if not 0 < width * height <= MAX_PIXELS:
        raise DataError(
            f"{path}: {width}x{height} pixels, expected at most {MAX_PIXELS}; unpack the archive"
            " again"
        )
    return height, width


def _find_fault(data: bytes) -> str:
    """Say what is wrong with the chunks; empty where nothing is."""
    at = len(_SIGNATURE)
    while at + 12 <= len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        end = at + 12 + length
        if end > len(data):
            return "cut off"
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return "wrong checksum"
        if kind == b"IEND":
            return "" if end == len(data) else "bytes after its end"
        at = end
    return "cut off"
