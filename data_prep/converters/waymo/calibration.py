"""Names and mounts of the car's cameras and lasers, with axes turned to OpenCV's."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from data_prep.converters.matrices import rigid_from_matrix
from data_prep.converters.waymo.lens import undistorted_K
from l3r.errors import DataError

CAMERAS = {1: "FRONT", 2: "FRONT_LEFT", 3: "FRONT_RIGHT", 4: "SIDE_LEFT", 5: "SIDE_RIGHT"}
"""Cameras by number."""
LASERS = {1: "TOP", 2: "FRONT", 3: "SIDE_LEFT", 4: "SIDE_RIGHT", 5: "REAR"}
"""Lasers by number."""
TOP = 1
"""The laser whose range image carries a vehicle pose for every pixel."""

SENSOR_FROM_CAM = np.array(
    [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=np.float64
)
"""Columns are OpenCV's x right, y down, z forward in Waymo's x forward, y left, z up."""

_MIN_SIDE, _MAX_SIDE = 16, 8192


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A calibrated camera on the car."""

    number: int
    """Key of :data:`CAMERAS`."""
    image_size: tuple[int, int]
    """(height, width), of the stored and of the undistorted image."""
    lens: tuple[float, ...]
    """``f_u f_v c_u c_v k1 k2 p1 p2 k3`` of the stored, distorted image."""
    K: Float64[np.ndarray, "3 3"]
    """Intrinsics of the undistorted image; centre of the top-left pixel at (0.5, 0.5)."""
    vehicle_from_cam: Float64[np.ndarray, "4 4"]
    """Mount; OpenCV camera axes, vehicle x forward, y left, z up [m]."""

    @property
    def name(self) -> str:
        """Name as the data set prints it."""
        return CAMERAS[self.number]


@dataclass(frozen=True, kw_only=True)
class Laser:
    """A calibrated laser on the car."""

    number: int
    """Key of :data:`LASERS`."""
    vehicle_from_laser: Float64[np.ndarray, "4 4"]
    """Mount [m]."""
    inclinations: Float64[np.ndarray, " rows"]
    """Pitch of each beam, lowest first [rad]; empty where they are spaced evenly."""
    inclination_range: tuple[float, float]
    """Lowest and highest edge of evenly spaced beams [rad]."""


def rigid_from_rows(rows: Float[np.ndarray, " n"], what: str) -> Float64[np.ndarray, "4 4"]:
    """Check a row-major rigid transform and take rounding out of it.

    Args:
        rows: 16 numbers, single precision in some Parquet files.
        what: Named in errors.

    Raises:
        DataError: They are not finite, or no rotation and shift.
    """
    if rows.size != 16:
        raise DataError(f"{what}: {rows.size} numbers, expected the 16 of a transform")
    try:
        return rigid_from_matrix(rows.astype(np.float64).reshape(4, 4))
    except DataError as error:
        raise DataError(f"{what}: {error}") from error


def make_camera(
    number: int,
    lens: Float64[np.ndarray, " n"],
    vehicle_from_sensor: Float[np.ndarray, " m"],
    image_size: tuple[int, int],
) -> Camera:
    """Check a camera's calibration and turn its axes.

    Args:
        number: Key of :data:`CAMERAS`.
        lens: ``f_u f_v c_u c_v k1 k2 p1 p2 k3``.
        vehicle_from_sensor: 16 numbers, row-major; sensor axes x forward, y left, z up.
        image_size: (height, width).

    Raises:
        DataError: It is no calibration of a camera known here.
    """
    if number not in CAMERAS:
        raise DataError(f"camera {number}, expected one of {sorted(CAMERAS)}")
    what = f"calibration of {CAMERAS[number]}"
    if not all(_MIN_SIDE <= side <= _MAX_SIDE for side in image_size):
        raise DataError(
            f"{what}: image of (height, width) {image_size}, expected {_MIN_SIDE} to {_MAX_SIDE}"
        )
    if lens.shape != (9,) or not np.isfinite(lens).all():
        raise DataError(f"{what}: {lens.size} numbers of the lens, expected 9 finite ones")
    values = tuple(lens.tolist())
    return Camera(
        number=number,
        image_size=image_size,
        lens=values,
        K=undistorted_K(values, image_size),
        vehicle_from_cam=rigid_from_rows(vehicle_from_sensor, what) @ SENSOR_FROM_CAM,
    )


def make_laser(
    number: int,
    inclinations: Float64[np.ndarray, " n"],
    inclination_range: tuple[float, float],
    vehicle_from_laser: Float[np.ndarray, " m"],
) -> Laser:
    """Check a laser's calibration.

    Args:
        number: Key of :data:`LASERS`.
        inclinations: Pitch of each beam, lowest first [rad]; empty: evenly spaced.
        inclination_range: Their lowest and highest edge [rad].
        vehicle_from_laser: 16 numbers, row-major.

    Raises:
        DataError: It is no calibration of a laser known here.
    """
    if number not in LASERS:
        raise DataError(f"laser {number}, expected one of {sorted(LASERS)}")
    what = f"calibration of laser {LASERS[number]}"
    angles = inclinations if len(inclinations) else np.array(inclination_range)
    if not (np.abs(angles) <= np.pi).all():
        raise DataError(f"{what}: beam inclinations {angles[:4]}..., expected radians")
    return Laser(
        number=number,
        vehicle_from_laser=rigid_from_rows(vehicle_from_laser, what),
        inclinations=inclinations,
        inclination_range=inclination_range,
    )
