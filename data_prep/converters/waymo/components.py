"""Version 2's components: one Parquet table of each for a segment, joined by their keys.

Rows come in any order. Transforms are single precision in some files, and cameras and lasers are
named by text in old ones. Columns are found by the end of their names, ``[Component].part.of.it``.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from data_prep.converters.waymo.calibration import (
    CAMERAS,
    LASERS,
    TOP,
    Camera,
    Laser,
    make_camera,
    make_laser,
    rigid_from_rows,
)
from data_prep.converters.waymo.lidar import SIGN, Box, Scan, make_scan
from data_prep.converters.waymo.parquet import Cell, Table, read_cell, read_table
from data_prep.problems import Problems
from l3r.errors import DataError

_CONTEXT = "key.segment_context_name"
_TIME = "key.frame_timestamp_micros"
_CAMERA = "key.camera_name"
_LASER = "key.laser_name"
_LENS = [f"intrinsic.{name}" for name in ["f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3"]]
_VALUES, _SHAPE = "range_image_return1.values", "range_image_return1.shape"
_BOX = [f"box.{part}.{axis}" for part in ("center", "size") for axis in "xyz"]
_MAX_MATRIX = 2**24
"""Most numbers of a range image; the pixel poses of TOP are 1.0 million."""


@dataclass(frozen=True, kw_only=True)
class ImageRow:
    """One row of ``camera_image``."""

    timestamp: int
    """Start of the turn of the top laser [us]."""
    camera: int
    """Key of ``CAMERAS``."""
    vehicle_rows: Float64[np.ndarray, " n"]
    """Vehicle pose at the image's own time, row-major and not yet checked."""
    jpeg: Cell
    """Its pixels."""


@dataclass(frozen=True, kw_only=True)
class Matrix:
    """A range image in its table."""

    cell: Cell
    """Its numbers."""
    shape: tuple[int, ...]
    """(rows, columns, channels), as stored."""


@dataclass(frozen=True, kw_only=True)
class ScanPlace:
    """First return of one laser, still in its tables."""

    laser: Laser
    """What took it."""
    ranges: Matrix
    """Range, intensity, elongation, no-label zone."""
    projection: Matrix
    """Camera, x, y, twice."""
    pixel_poses: Matrix | None
    """Roll, pitch, yaw, x, y, z; TOP only."""


def component_path(folder: Path, component: str, context: str) -> Path:
    """Name the table of a component."""
    return folder / component / f"{context}.parquet"


def _read(folder: Path, component: str, context: str, small: Sequence[str], **kinds: Any) -> Table:
    path = component_path(folder, component, context)
    if not path.is_file():
        raise DataError(f"{path}: no such file; download component {component}")
    return read_table(path, [_CONTEXT, *small], **kinds)


def _rows(table: Table, context: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """Give the rows of a segment, and their numbers."""
    for index, name in enumerate(table.columns[_CONTEXT]):
        if name == context:
            yield index, {end: column[index] for end, column in table.columns.items() if column}


def _number_of(value: Any, names: Mapping[int, str]) -> int:
    """Give a camera's or laser's number, stored as number or as text; 0 where it is neither."""
    if isinstance(value, str):
        return next((number for number, name in names.items() if name == value), 0)
    return value if value in names else 0


def _numbers(value: Any) -> Float64[np.ndarray, " n"]:
    """Turn a list into an array; null becomes an empty one, null elements NaN."""
    return np.array([] if value is None else value, dtype=np.float64).reshape(-1)


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def read_cameras(folder: Path, context: str, problems: Problems) -> dict[int, Camera]:
    """Read the camera calibrations, those that are sound.

    Raises:
        DataError: The table is missing or damaged.
    """
    small = [_CAMERA, "width", "height", "transform", *_LENS]
    table = _read(folder, "camera_calibration", context, small)
    cameras = {}
    for _, row in _rows(table, context):
        try:
            camera = make_camera(
                _number_of(row[_CAMERA], CAMERAS),
                np.array([_number(row[end]) for end in _LENS]),
                _numbers(row["transform"]),
                (row["height"] or 0, row["width"] or 0),
            )
        except DataError as error:
            problems.add("bad_calibration", table.path, str(error))
            continue
        cameras[camera.number] = camera
    return cameras


def _read_lasers(folder: Path, context: str, problems: Problems) -> dict[int, Laser]:
    low, high, each = (f"beam_inclination.{end}" for end in ("min", "max", "values"))
    table = _read(folder, "lidar_calibration", context, [_LASER, "transform", low, high, each])
    lasers = {}
    for _, row in _rows(table, context):
        try:
            laser = make_laser(
                _number_of(row[_LASER], LASERS),
                _numbers(row[each]),
                (_number(row[low]), _number(row[high])),
                _numbers(row["transform"]),
            )
        except DataError as error:
            problems.add("bad_calibration", table.path, str(error))
            continue
        lasers[laser.number] = laser
    return lasers


def read_vehicle_poses(
    folder: Path, context: str, problems: Problems
) -> dict[int, Float64[np.ndarray, "4 4"]]:
    """Read the frames' own poses by timestamp, those that are sound.

    Raises:
        DataError: The table is missing or damaged.
    """
    end = "world_from_vehicle.transform"
    table = _read(folder, "vehicle_pose", context, [_TIME, end])
    poses = {}
    for _, row in _rows(table, context):
        what = f"{table.path}: vehicle pose at {row[_TIME]}"
        try:
            poses[row[_TIME]] = rigid_from_rows(_numbers(row[end]), what)
        except DataError as error:
            problems.add("bad_pose", what, str(error))
    return poses


def read_image_rows(folder: Path, context: str) -> list[ImageRow]:
    """Read all of the images but their pixels.

    Raises:
        DataError: The table is missing or damaged.
    """
    small = [_TIME, _CAMERA, "pose.transform"]
    table = _read(folder, "camera_image", context, small, large=["image"])
    return [
        ImageRow(
            timestamp=row[_TIME] or 0,
            camera=_number_of(row[_CAMERA], CAMERAS),
            vehicle_rows=_numbers(row["pose.transform"]),
            jpeg=table.cell("image", index),
        )
        for index, row in _rows(table, context)
    ]


def read_scan_places(folder: Path, context: str, problems: Problems) -> dict[int, list[ScanPlace]]:
    """Find the range images that can be placed, by timestamp; lasers by number.

    Raises:
        DataError: A table is missing or damaged.
    """
    lasers = _read_lasers(folder, context, problems)
    ranges = _read_matrices(folder, context, "lidar")
    projections = _read_matrices(folder, context, "lidar_camera_projection")
    poses = _read_matrices(folder, context, "lidar_pose")
    places: dict[int, list[ScanPlace]] = {}
    for key in sorted(ranges.keys() & projections.keys()):
        timestamp, number = key
        if number in lasers and (number != TOP or key in poses):
            place = ScanPlace(
                laser=lasers[number],
                ranges=ranges[key],
                projection=projections[key],
                pixel_poses=poses[key] if number == TOP else None,
            )
            places.setdefault(timestamp, []).append(place)
    return places


def _read_matrices(folder: Path, context: str, component: str) -> dict[tuple[int, int], Matrix]:
    """Find the range images of a component by (timestamp, laser)."""
    table = _read(folder, component, context, [_TIME, _LASER, _SHAPE], large=[_VALUES])
    return {
        (row[_TIME] or 0, _number_of(row[_LASER], LASERS)): Matrix(
            cell=table.cell(_VALUES, index), shape=tuple(side or 0 for side in row[_SHAPE])
        )
        for index, row in _rows(table, context)
        if row[_SHAPE] is not None
    }


def read_scan(place: ScanPlace) -> Scan:
    """Read the numbers of a range image.

    Raises:
        DataError: They are damaged.
    """
    projection = _read_matrix(place.projection)
    # Whole numbers, stored as floats; what is no number sees nothing.
    whole = np.where(np.abs(projection) < 2**24, projection, 0).astype(np.int32)
    pixel_poses = None if place.pixel_poses is None else _read_matrix(place.pixel_poses)
    return make_scan(place.laser, _read_matrix(place.ranges), whole, pixel_poses)


def _read_matrix(matrix: Matrix) -> Float32[np.ndarray, "h w c"]:
    shape = matrix.shape
    if len(shape) != 3 or min(shape) < 1 or math.prod(shape) > _MAX_MATRIX:
        raise DataError(f"{matrix.cell}: shape {shape}, expected 3 sides")
    values = read_cell(matrix.cell).values.to_numpy(zero_copy_only=False).astype(np.float32)
    if len(values) != math.prod(shape):
        raise DataError(f"{matrix.cell}: {len(values)} numbers, expected {math.prod(shape)}")
    return np.asarray(values.reshape(shape))


def read_boxes(folder: Path, context: str) -> dict[int, list[Box]]:
    """Read the laser labels by timestamp.

    Raises:
        DataError: The table is missing or damaged.
    """
    small = [_TIME, "type", "box.heading", *_BOX]
    table = _read(folder, "lidar_box", context, small, optional=["speed.x", "speed.y"])
    boxes: dict[int, list[Box]] = {}
    for _, row in _rows(table, context):
        speed = math.hypot(_number(row.get("speed.x")), _number(row.get("speed.y")))
        x, y, z, length, width, height = (_number(row[end]) for end in _BOX)
        box = Box(
            center=(x, y, z),
            size=(length, width, height),
            heading=_number(row["box.heading"]),
            speed=0.0 if row["type"] == SIGN and math.isnan(speed) else speed,
        )
        boxes.setdefault(row[_TIME] or 0, []).append(box)
    return boxes
