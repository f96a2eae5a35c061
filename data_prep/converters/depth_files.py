"""Depth maps in one file each: 16-bit PNG, NumPy arrays, and HDF5 with a data set ``depth``.

Shapes are compared with the image's before anything is allocated.
"""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import h5py
import numpy as np
from jaxtyping import Float32
from PIL import Image

from data_prep.converters.npy_header import NpyHeader, read_npy_header
from data_prep.converters.photos import MAX_PIXELS, check_png
from l3r.errors import DataError

SUFFIXES = (".png", ".npy", ".h5")
"""Endings of depth maps."""

_HDF5_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError)
_PNG_ERRORS = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)
_FILTERS = (None, "gzip", "lzf")
_HEAD = 2**14
"""Bytes a NumPy header and a small file may take beyond the numbers."""


def depth_size(path: Path) -> tuple[int, int]:
    """Read (height, width) of a depth map from its header.

    Raises:
        DataError: It is missing, damaged, or no depth map.
    """
    match path.suffix:
        case ".png":
            size = _png_size(path)
        case ".npy":
            with _refuse(path, (OSError, ValueError)), path.open("rb") as stream:
                height, width = _npy_header(io.BytesIO(stream.read(_HEAD))).shape
                size = height, width
        case _:
            with open_h5_depth(path) as stored:
                size = stored.shape
    if not 0 < size[0] * size[1] <= MAX_PIXELS:
        raise DataError(f"{path}: depth of shape {size}, expected {MAX_PIXELS:,} pixels or fewer")
    return size


def read_depth_file(
    path: Path, scale: float, image_size: tuple[int, int]
) -> Float32[np.ndarray, "_h _w"]:
    """Read z; what is not finite or not positive becomes 0.

    Args:
        path: PNG, npy or h5.
        scale: What to multiply the stored numbers by.
        image_size: (height, width) it must have.

    Raises:
        DataError: It is missing, damaged, or of another size or type.
    """
    match path.suffix:
        case ".png":
            stored = _read_png(path, image_size)
        case ".npy":
            stored = _read_npy(path, image_size)
        case _:
            stored = read_h5_depth(path, image_size)
    with np.errstate(over="ignore", invalid="ignore"):
        depth = (stored * scale).astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def read_h5_depth(path: Path, image_size: tuple[int, int]) -> np.ndarray:
    """Read the data set ``depth`` of an HDF5 file as it is stored.

    Args:
        path: The file.
        image_size: (height, width) it must have.

    Raises:
        DataError: It is missing, damaged, or of another size or type.
    """
    with open_h5_depth(path) as stored:
        _check_size(path, stored.shape, image_size)
        with _refuse(path, (*_HDF5_ERRORS, MemoryError)):
            return np.asarray(stored[()])


@contextmanager
def open_h5_depth(path: Path) -> Iterator[h5py.Dataset]:
    """Open the data set ``depth`` of an HDF5 file, its numbers unread.

    Raises:
        DataError: It is missing, damaged, or holds no plain two-dimensional numbers.
    """
    with _refuse(path, _HDF5_ERRORS):
        # Network file systems refuse locks, and nobody writes here.
        file = h5py.File(path, "r", locking=False)
    with file:
        with _refuse(path, _HDF5_ERRORS):
            fault = _find_h5_fault(file)
            stored = None if fault else file["depth"]
        if stored is None:
            raise DataError(f"{path}: {fault}; unpack the file again")
        yield stored


def _find_h5_fault(file: h5py.File) -> str:
    """Say why the file is not to be read; links and outside storage could name any other file."""
    if not isinstance(file.get("depth", getlink=True), h5py.HardLink):
        return "no data set 'depth' of its own"
    stored = file["depth"]
    if not isinstance(stored, h5py.Dataset) or stored.ndim != 2 or stored.dtype.kind not in "fiu":
        return "'depth' is no two-dimensional array of numbers"
    if stored.external or stored.is_virtual or stored.compression not in _FILTERS:
        return "'depth' is stored elsewhere or by a filter that is not gzip"
    chunk = stored.chunks or stored.shape
    if np.prod(chunk, dtype=np.float64) > MAX_PIXELS:
        return f"'depth' has chunks of {chunk}"
    return ""


def _png_size(path: Path) -> tuple[int, int]:
    with _refuse(path, _PNG_ERRORS), warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        with Image.open(path, formats=("PNG",)) as image:
            return image.height, image.width


def _read_png(path: Path, image_size: tuple[int, int]) -> np.ndarray:
    _check_size(path, _png_size(path), image_size)
    with _refuse(path, _PNG_ERRORS):
        data = path.read_bytes()
        check_png(data)
    stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.dtype != np.uint16 or stored.shape != image_size:
        found = "undecodable" if stored is None else f"{stored.dtype} of shape {stored.shape}"
        raise DataError(f"{path}: {found}, expected 16 bits in one channel")
    return np.asarray(stored)


def _npy_header(stream: io.BytesIO) -> NpyHeader:
    """Read the header of a two-dimensional array of numbers.

    Raises:
        ValueError: It is none.
    """
    header = read_npy_header(stream)
    if len(header.shape) != 2 or header.dtype.kind not in "fiu":
        raise ValueError(f"{header.dtype} of shape {header.shape}, expected numbers in two axes")
    return header


def _read_npy(path: Path, image_size: tuple[int, int]) -> np.ndarray:
    with _refuse(path, (OSError, ValueError)):
        with path.open("rb") as file:
            data = file.read(8 * image_size[0] * image_size[1] + _HEAD)
        stream = io.BytesIO(data)
        header = _npy_header(stream)
        _check_size(path, header.shape, image_size)
        count = image_size[0] * image_size[1]
        stored = np.frombuffer(data, header.dtype, count, offset=stream.tell())
    return stored.reshape(image_size, order=header.order)


def _check_size(path: Path, found: tuple[int, ...], image_size: tuple[int, int]) -> None:
    if tuple(found) != image_size:
        raise DataError(
            f"{path}: depth of (height, width) {tuple(found)}, its image has {image_size}; make"
            " both of one size"
        )


@contextmanager
def _refuse(path: Path, errors: tuple[type[Exception], ...]) -> Iterator[None]:
    """Turn what a reader raises on a damaged file into one line."""
    try:
        yield
    except DataError:
        raise
    except errors as error:
        reason = str(error).split("\n")[0][:120]
        raise DataError(f"{path}: no whole depth map ({reason}); copy the file again") from error
