"""Points of all lasers become the sparse depth of one undistorted image.

A point is kept where the data set's own projection says that this camera sees it, unless

* it lies in the box of a moving object: the laser and the camera met that at different places;
* the stored projection and ours differ by more than :data:`MAX_SHIFT`: the stored one knows when
  each image column was exposed, ours puts all at the image's own pose, so what is left is the
  rolling shutter's displacement of the image there (or a point that is wrong);
* nearer points lie around it: the lasers stand elsewhere than the camera and see behind things.
"""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from data_prep.converters.waymo.calibration import Camera
from data_prep.converters.waymo.lens import distort
from data_prep.converters.waymo.lidar import Sweep

MAX_SHIFT = 10.0
"""Largest distance between the stored and our own projection [px of the stored image]."""
MIN_DEPTH = 0.5
"""Nearer points are on the car itself [m]."""
BEAM_GAP = 0.004
"""Angle between neighbouring beams of TOP: an occluder is sampled this sparsely [rad]."""
OCCLUDED = 0.1
"""A point is hidden behind neighbours nearer by this share of its inverse depth..."""
GROUND_SLOPE = 0.5
"""...and by what ground seen from this height changes over the neighbourhood [1/m]."""


def read_depth(
    read_sweep: Callable[[], Sweep], camera: Camera, world_from_cam: Float64[np.ndarray, "4 4"]
) -> Float32[np.ndarray, "h w"]:
    """Read the lasers and project them.

    Args:
        read_sweep: Gives the points of all lasers; raises DataError.
        camera: What the depth belongs to.
        world_from_cam: Where the camera was at the image's own time.
    """
    return sparse_depth(read_sweep(), camera, world_from_cam)


def sparse_depth(
    sweep: Sweep, camera: Camera, world_from_cam: Float64[np.ndarray, "4 4"]
) -> Float32[np.ndarray, "h w"]:
    """Give z of the nearest kept point of each pixel, 0 elsewhere.

    Args:
        sweep: Points of all lasers.
        camera: Its undistorted image is meant.
        world_from_cam: Rigid, OpenCV axes.
    """
    first = sweep.projection[:, 0] == camera.number
    chosen = first | (sweep.projection[:, 3] == camera.number)
    stored = np.where(first[:, None], sweep.projection[:, 1:3], sweep.projection[:, 4:6])[chosen]
    R, t = world_from_cam[:3, :3], world_from_cam[:3, 3]
    pts3d_cam = (sweep.pts3d_world[chosen] - t) @ R
    front = pts3d_cam[:, 2] > MIN_DEPTH
    pts3d_cam, stored = pts3d_cam[front], stored[front]
    z = pts3d_cam[:, 2]
    rays = pts3d_cam[:, :2] / z[:, None]
    own, valid = distort(rays, camera.lens)
    # Stored pixels are whole numbers counted from the outer corner: the middle is half further.
    shift = np.linalg.norm(own - (stored + 0.5), axis=-1)
    pts2d = rays * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    height, width = camera.image_size
    inside = ((pts2d >= 0) & (pts2d < [width, height])).all(-1)
    pixels = np.where(inside[:, None], pts2d, 0).astype(np.int64)
    keep = inside & valid & (shift <= MAX_SHIFT) & ~sweep.moving[chosen][front]
    # Points that are dropped hide what is behind them all the same.
    keep[inside] &= ~_hidden(pixels[inside], z[inside], camera)
    depth = np.zeros((height, width), np.float32)
    columns, rows = pixels[keep].T
    z = z[keep]
    order = np.argsort(-z, kind="stable")
    # Of several values for one pixel numpy keeps the last: the nearest.
    depth[rows[order], columns[order]] = z[order]
    return depth


def _hidden(
    pixels: np.ndarray, z: Float64[np.ndarray, " p"], camera: Camera
) -> Bool[np.ndarray, " p"]:
    """Test which points have clearly nearer ones around them, within one to two beam gaps."""
    focal = float(camera.K[1, 1])
    cell = max(1, round(BEAM_GAP * focal))
    columns, rows = pixels.T // cell
    height, width = camera.image_size
    nearest = np.zeros((height // cell + 1, width // cell + 1))
    np.maximum.at(nearest, (rows, columns), 1 / z)
    around = cv2.dilate(nearest, np.ones((3, 3), np.uint8))[rows, columns]
    allowed = GROUND_SLOPE * 2 * cell / focal
    return np.asarray(around > (1 + OCCLUDED) / z + allowed)
