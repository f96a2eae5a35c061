"""Scene indices of D2-Net and LoFTR: paths, intrinsics and cameras of a scene's images.

Either an npz archive of object arrays, or the dictionary of these arrays as a bare pickle under the
same ending. Intrinsics are those of the undistorted image with COLMAP's pixel centres, which are
the project's; ``poses`` are cam-from-world.
"""

import io
import math
import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from data_prep.converters.megadepth.object_arrays import read_pickle
from data_prep.converters.npy_header import read_npy_header
from data_prep.problems import Problems
from l3r.errors import DataError

KEYS = ("image_paths", "depth_paths", "intrinsics", "poses")
"""Arrays of one entry an image; None where there is no such image."""

_MAX_BYTES = 2**28
"""Genuine indices take 0.3 MB, their arrays 0.2 MB."""
_DENSE = re.compile(r"(?:^|/)(\d{4}/dense\d{1,4})/depths/")


@dataclass(frozen=True, kw_only=True)
class InfoImage:
    """One image of an index."""

    image_path: str
    """Relative to the index' own root."""
    depth_path: str
    """Relative to the same root."""
    K: Float64[np.ndarray, "3 3"]
    """Intrinsics [px] as stored."""
    cam_from_world: Float64[np.ndarray, "4 4"]
    """As stored."""

    @property
    def part(self) -> str:
        """``0001/dense0``; empty where the path does not say it."""
        found = _DENSE.search(self.depth_path)
        return found.group(1) if found else ""


def read_scene_info(path: Path, problems: Problems) -> list[InfoImage]:
    """Read an index; images whose slots are empty are left out, as the index has them.

    Args:
        path: The index.
        problems: Told about images with damaged entries.

    Raises:
        DataError: It is damaged, too large, or holds anything but the arrays expected.
    """
    try:
        table = _read_table(path)
    except (OSError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError) as error:
        raise DataError(f"{path}: no whole archive ({error}); copy it again") from error
    except (DataError, ValueError) as error:
        raise DataError(f"{path}: {str(error)[:160]}; expected a scene index") from error
    columns = [table[key] for key in KEYS if key in table]
    are_columns = all(isinstance(column, np.ndarray) and column.ndim == 1 for column in columns)
    if len(columns) < len(KEYS) or not are_columns or len({len(column) for column in columns}) > 1:
        raise DataError(f"{path}: holds {sorted(table)}, expected {', '.join(KEYS)} of one length")
    images = []
    for number, entry in enumerate(zip(*columns, strict=True)):
        if all(value is not None for value in entry):
            try:
                images.append(_build(*entry))
            except DataError as error:
                problems.add("bad_scene_info", f"{path}: image {number}", str(error))
    return images


def _build(image_path: Any, depth_path: Any, K: Any, cam_from_world: Any) -> InfoImage:
    if not (isinstance(image_path, str) and isinstance(depth_path, str)):
        raise DataError("no paths, expected text")
    return InfoImage(
        image_path=image_path,
        depth_path=depth_path,
        K=_matrix(K, 3),
        cam_from_world=_matrix(cam_from_world, 4),
    )


def _matrix(value: Any, side: int) -> Float64[np.ndarray, "_s _s"]:
    if isinstance(value, np.ndarray) and value.shape == (side, side) and value.dtype.kind in "fiu":
        return value.astype(np.float64)
    raise DataError(f"no {side}x{side} matrix, expected numbers")


def _read_table(path: Path) -> dict[str, Any]:
    with path.open("rb") as stream:
        if stream.read(2) != b"PK":
            return _read_bare(path)
    with zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        chosen = {key: members[key] for key in KEYS if key in members}
        for info in chosen.values():
            if info.file_size > _MAX_BYTES:
                raise DataError(f"{info.filename} unpacks to {info.file_size:,} bytes")
        return {key: _read_npy(archive.read(info)) for key, info in chosen.items()}


def _read_bare(path: Path) -> dict[str, Any]:
    if (size := path.stat().st_size) > _MAX_BYTES:
        raise DataError(f"{size:,} bytes")
    table = read_pickle(path.read_bytes())
    if not isinstance(table, dict):
        raise DataError("no dictionary of arrays")
    return table


def _read_npy(data: bytes) -> Any:
    """Read a NumPy file; NumPy's own reader would unpickle object arrays."""
    stream = io.BytesIO(data)
    header = read_npy_header(stream)
    rest = data[stream.tell() :]
    if header.dtype.hasobject:
        value = read_pickle(rest)
    else:
        count = math.prod(header.shape)
        value = np.frombuffer(rest, header.dtype, count).reshape(header.shape, order=header.order)
    if not isinstance(value, np.ndarray) or value.shape != header.shape:
        raise DataError(f"NumPy file with content that is not of shape {header.shape}")
    return value
