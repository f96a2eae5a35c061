"""nerfstudio's and instant-ngp's ``transforms.json``.

``transform_matrix`` is world-from-camera with OpenGL axes (x right, y up, z backwards), which
become OpenCV's here. Intrinsics stand in the file, in a frame, or both, the frame's first; they
are COLMAP's, whose pixel centres are the project's.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from data_prep.converters.folder.options import read_json
from data_prep.converters.folder.views import PhotoFinder, View
from data_prep.converters.lens import Lens, build_lens
from data_prep.converters.matrices import rigid_from_matrix
from data_prep.converters.photos import photo_size
from data_prep.converters.rejects import RejectedError, reject_as
from data_prep.problems import Problems
from l3r.errors import DataError

CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns camera axes about x by half a turn; its own inverse."""

_PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = "OPENCV_FISHEYE"
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


def read_transforms(path: Path, find: PhotoFinder, problems: Problems) -> Iterator[View]:
    """Read frames and find their photos.

    Args:
        path: The file.
        find: Finds the photos.
        problems: Told about frames that cannot be used.

    Raises:
        DataError: The file is no such file.
    """
    table = read_json(path)
    frames = table.get("frames") if isinstance(table, dict) else None
    if not isinstance(frames, list):
        raise DataError(f"{path}: no list 'frames'; expected a transforms.json")
    for number, frame in enumerate(frames):
        where = f"{path}: frame {number}"
        try:
            view = _read_frame(where, table, frame, partial(find.find, problems=problems))
        except RejectedError as error:
            problems.add(*error.problem)
        else:
            if view is not None:
                yield view


def _read_frame(
    where: str, table: dict[str, Any], frame: Any, find: Callable[[str], Path | None]
) -> View | None:
    name = frame.get("file_path") if isinstance(frame, dict) else None
    if not isinstance(name, str):
        raise RejectedError("bad_frame", where, f"'file_path' is {name!r}, expected a path")
    with reject_as("bad_pose", where):
        world_from_cam = rigid_from_matrix(_matrix(frame.get("transform_matrix"))) @ CV_FROM_GL
    photo = find(name)
    if photo is None:
        return None
    values = {**table, **frame}
    with reject_as("bad_camera", where):
        lens = _read_lens(values, photo)
    depth_name = values.get("depth_file_path", "")
    if not isinstance(depth_name, str):
        raise RejectedError("bad_frame", where, "'depth_file_path' is no path")
    return View(
        name=name.removeprefix("./"),
        photo=photo,
        image_size=lens.image_size,
        K=lens.K,
        lens=lens if lens.is_distorted else None,
        world_from_cam=world_from_cam,
        depth_name=depth_name,
    )


def _read_lens(values: dict[str, Any], photo: Path) -> Lens:
    """Build a camera of a frame's values."""
    given = {key: _number(values, key) for key in ("w", "h") if key in values}
    size = (given["h"], given["w"]) if len(given) == 2 else photo_size(photo)
    height, width = map(float, size)
    if height % 1 or width % 1:
        raise DataError(f"size {width} x {height}, expected whole numbers of pixels")
    fx = _focal(values, "x", width)
    fy = _focal(values, "y", height) if _has_focal(values, "y") else fx
    center = _number(values, "cx", width / 2), _number(values, "cy", height / 2)
    model, coefficients = _distortion(values)
    return build_lens(model, (int(height), int(width)), (fx, fy, *center, *coefficients))


def _has_focal(values: dict[str, Any], axis: str) -> bool:
    return f"fl_{axis}" in values or f"camera_angle_{axis}" in values


def _focal(values: dict[str, Any], axis: str, side: float) -> float:
    if f"fl_{axis}" in values:
        return _number(values, f"fl_{axis}")
    angle = _number(values, f"camera_angle_{axis}")
    if not 0 < angle < math.pi:
        raise DataError(f"'camera_angle_{axis}' is {angle}, expected radians from 0 to pi")
    return side / 2 / math.tan(angle / 2)


def _distortion(values: dict[str, Any]) -> tuple[str, tuple[float, ...]]:
    """Give COLMAP's model and coefficients for nerfstudio's."""
    name = values.get("camera_model", _FISHEYE if values.get("is_fisheye") else "OPENCV")
    k1, k2, k3, k4, p1, p2 = (_number(values, key, 0.0) for key in _COEFFICIENTS)
    if name == _FISHEYE:
        if p1 or p2:
            raise DataError("a fisheye with p1 or p2, expected k1 to k4; undistort the images")
        return _FISHEYE, (k1, k2, k3, k4)
    if name not in _PERSPECTIVE or "ftheta_p0" in values:
        raise DataError(
            f"camera model {name!r}, expected {', '.join(_PERSPECTIVE)} or {_FISHEYE}; undistort"
            " the images"
        )
    if k4:
        raise DataError("k4 of a lens that is no fisheye, expected k1 to k3; undistort the images")
    if k3:
        return "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return ("OPENCV", (k1, k2, p1, p2)) if k1 or k2 or p1 or p2 else ("PINHOLE", ())


def _number(values: dict[str, Any], key: str, default: float | None = None) -> float:
    value: Any = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DataError(f"'{key}' is {value!r}, expected a number")
    if not abs(value) < 1e9:
        raise DataError(f"'{key}' is {value!r}, expected a finite number")
    return float(value)


def _matrix(value: Any) -> Float64[np.ndarray, "_r _c"]:
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError("'transform_matrix' is no matrix, expected 4x4 numbers") from error
    if matrix.ndim != 2:
        raise DataError("'transform_matrix' is no matrix, expected 4x4 numbers")
    return matrix
