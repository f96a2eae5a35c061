"""Range images become points in the world.

Row 0 is the highest beam, column 0 looks backwards and columns run clockwise; the first return is
used. TOP turns while the car drives, so each of its pixels has a vehicle pose of its own; the other
lasers' points are already in the vehicle frame of the frame's own pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from data_prep.converters.waymo.calibration import LASERS, TOP, Laser
from l3r.errors import DataError

MOVING_SPEED = 0.2
"""A labelled object faster than this moves [m/s]; parked cars and signs of genuine frames are
labelled with up to 0.17, walking people with 1.3 and more."""
BOX_MARGIN = 0.3
"""Boxes of moving objects are enlarged by this on each side [m]..."""
BOX_TIME = 0.1
"""...and horizontally by what the object covers in this time, that of one turn of TOP [s]."""
SIGN = 3
"""Type of the labels of signs, which never move."""
MAX_RANGE = 1000.0
"""Returns from farther are damaged; the data set ends at 75 m [m]."""


@dataclass(frozen=True, kw_only=True)
class Scan:
    """First return of one laser."""

    laser: Laser
    """What took it."""
    range_image: Float32[np.ndarray, "rows columns"]
    """Range; 0 or less where nothing came back [m]."""
    projection: Int32[np.ndarray, "rows columns 6"]
    """Camera, x, y of the first and of the second image that sees the point; camera 0: none."""
    pixel_poses: Float32[np.ndarray, "rows columns 6"] | None
    """Roll, pitch, yaw, x, y, z of the vehicle in the world at each pixel; TOP only."""


@dataclass(frozen=True, kw_only=True)
class Box:
    """Upright box of a labelled object, in the vehicle frame of the frame's own pose."""

    center: tuple[float, float, float]
    """Middle [m]."""
    size: tuple[float, float, float]
    """Length, width, height [m]."""
    heading: float
    """Angle about z [rad]."""
    speed: float
    """Horizontal [m/s]; NaN where it is not known, which counts as moving."""


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Points of all lasers that some camera sees."""

    pts3d_world: Float64[np.ndarray, "p 3"]
    """Where they were when the laser met them [m]."""
    projection: Int32[np.ndarray, "p 6"]
    """As in :class:`Scan`."""
    moving: Bool[np.ndarray, " p"]
    """Whether they lie in the box of a moving object."""


def make_scan(
    laser: Laser,
    ranges: Float32[np.ndarray, "_h _w _c"],
    projection: Int32[np.ndarray, "_h2 _w2 _c2"],
    pixel_poses: Float32[np.ndarray, "_h3 _w3 _c3"] | None,
) -> Scan:
    """Check that the images of a return belong together.

    Args:
        laser: What took it.
        ranges: Range, intensity, elongation, no-label zone.
        projection: Camera, x, y, twice.
        pixel_poses: Roll, pitch, yaw, x, y, z; needed for TOP, ignored for others.

    Raises:
        DataError: Their sizes differ, or TOP has no poses.
    """
    size = ranges.shape[:2]
    shapes = [ranges.shape, projection.shape]
    expected = [(*size, 4), (*size, 6)]
    if laser.number == TOP:
        shapes.append(() if pixel_poses is None else pixel_poses.shape)
        expected.append((*size, 6))
    if shapes != expected:
        raise DataError(
            f"laser {LASERS[laser.number]}: ranges, camera projections and pixel poses are"
            f" {shapes}, expected {expected}"
        )
    return Scan(
        laser=laser,
        range_image=ranges[..., 0],
        projection=projection,
        pixel_poses=pixel_poses if laser.number == TOP else None,
    )


def make_sweep(
    scans: Sequence[Scan],
    world_from_vehicle: Float64[np.ndarray, "4 4"],
    boxes: Sequence[Box],
) -> Sweep:
    """Gather the points of all lasers.

    Args:
        scans: First returns.
        world_from_vehicle: The frame's own pose.
        boxes: Labelled objects.

    Raises:
        DataError: A scan has another number of rows than its laser has beams.
    """
    # Damaged numbers become infinite or NaN on the way and then fall out.
    with np.errstate(invalid="ignore", over="ignore"):
        parts = [_scan_points(scan, world_from_vehicle) for scan in scans]
    points = np.concatenate([np.empty((0, 3)), *(part[0] for part in parts)])
    projection = np.concatenate([np.empty((0, 6), np.int32), *(part[1] for part in parts)])
    R, t = world_from_vehicle[:3, :3], world_from_vehicle[:3, 3]
    return Sweep(
        pts3d_world=points, projection=projection, moving=find_moving((points - t) @ R, boxes)
    )


def _scan_points(
    scan: Scan, world_from_vehicle: Float64[np.ndarray, "4 4"]
) -> tuple[Float64[np.ndarray, "p 3"], Int32[np.ndarray, "p 6"]]:
    """Give the points of one laser in the world, and where cameras see them."""
    seen = (scan.projection[..., 0] > 0) | (scan.projection[..., 3] > 0)
    # A comparison with NaN is false, so damaged ranges fall out here.
    valid = seen & (scan.range_image > 0) & (scan.range_image < MAX_RANGE)
    rows, columns = np.nonzero(valid)
    pts3d_vehicle = _vehicle_points(scan, rows, columns)
    if scan.pixel_poses is not None:
        points = _move(pts3d_vehicle, scan.pixel_poses[rows, columns].astype(np.float64))
    else:
        points = pts3d_vehicle @ world_from_vehicle[:3, :3].T + world_from_vehicle[:3, 3]
    finite = np.isfinite(points).all(-1)
    return points[finite], scan.projection[rows, columns][finite]


def _vehicle_points(
    scan: Scan, rows: np.ndarray, columns: np.ndarray
) -> Float64[np.ndarray, "p 3"]:
    """Turn pixels of a range image into points of the vehicle frame at their own time."""
    laser = scan.laser
    height, width = scan.range_image.shape
    inclination = beam_inclinations(laser, height)[rows]
    # Columns count angles of the vehicle, not of a laser that is mounted turned.
    turned = np.arctan2(laser.vehicle_from_laser[1, 0], laser.vehicle_from_laser[0, 0])
    azimuth = ((width - columns - 0.5) / width * 2 - 1) * np.pi - turned
    distance = scan.range_image[rows, columns].astype(np.float64)
    horizontal = distance * np.cos(inclination)
    points = np.stack(
        [
            horizontal * np.cos(azimuth),
            horizontal * np.sin(azimuth),
            distance * np.sin(inclination),
        ],
        axis=-1,
    )
    return np.asarray(points @ laser.vehicle_from_laser[:3, :3].T + laser.vehicle_from_laser[:3, 3])


def beam_inclinations(laser: Laser, num_rows: int) -> Float64[np.ndarray, " rows"]:
    """Give the pitch of each row, highest first [rad].

    Args:
        laser: Its calibration.
        num_rows: Rows of its range image.

    Raises:
        DataError: The calibration lists another number of beams.
    """
    if not len(laser.inclinations):
        low, high = laser.inclination_range
        return (low + (np.arange(num_rows) + 0.5) / num_rows * (high - low))[::-1]
    if len(laser.inclinations) != num_rows:
        raise DataError(
            f"laser {LASERS[laser.number]}: {num_rows} rows, its calibration lists"
            f" {len(laser.inclinations)} beams"
        )
    return laser.inclinations[::-1]


def _move(
    points: Float64[np.ndarray, "p 3"], poses: Float64[np.ndarray, "p 6"]
) -> Float64[np.ndarray, "p 3"]:
    """Apply to each point its own pose: Rz(yaw) Ry(pitch) Rx(roll) p + t."""
    x, y, z = points.T
    (sin_r, sin_p, sin_y), (cos_r, cos_p, cos_y) = np.sin(poses[:, :3].T), np.cos(poses[:, :3].T)
    y, z = cos_r * y - sin_r * z, sin_r * y + cos_r * z
    x, z = cos_p * x + sin_p * z, cos_p * z - sin_p * x
    x, y = cos_y * x - sin_y * y, sin_y * x + cos_y * y
    return np.asarray(np.stack([x, y, z], axis=-1) + poses[:, 3:])


def find_moving(
    pts3d_vehicle: Float64[np.ndarray, "p 3"], boxes: Sequence[Box]
) -> Bool[np.ndarray, " p"]:
    """Test which points lie in the enlarged box of a moving object.

    Args:
        pts3d_vehicle: Points in the vehicle frame of the frame's own pose.
        boxes: Labelled objects.
    """
    moving = np.zeros(len(pts3d_vehicle), bool)
    for box in boxes:
        if not box.speed <= MOVING_SPEED:
            reach = np.array(box.size) / 2 + BOX_MARGIN
            reach[:2] += BOX_TIME * np.nan_to_num(box.speed)
            offset = pts3d_vehicle - box.center
            sin, cos = np.sin(box.heading), np.cos(box.heading)
            along = cos * offset[:, 0] + sin * offset[:, 1]
            across = cos * offset[:, 1] - sin * offset[:, 0]
            inside = (np.abs(along) <= reach[0]) & (np.abs(across) <= reach[1])
            moving |= inside & (np.abs(offset[:, 2]) <= reach[2])
    return moving
