"""A street of textured boxes, seen by a driving car: everything in it is known exactly."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

# low corner, high corner [m], in the street's own frame; the ground is z = 0.
BOXES = np.array(
    [
        [[-60, 11, 0], [110, 14, 9]],
        [[-60, -15, 0], [110, -12, 7]],
        [[70, -60, 0], [74, 60, 12]],
        [[-45, -60, 0], [-41, 60, 10]],
        [[9, 4, 0], [13.5, 6, 1.6]],
        [[20, -7, 0], [24, -5, 1.5]],
        [[17, 7, 0], [17.6, 7.6, 6]],
        [[3, -8.6, 0], [7, -6.5, 1.7]],
        [[-9, 5, 0], [-5, 7, 1.5]],
        [[31, 2, 0], [35, 4.2, 2.8]],
    ],
    dtype=np.float64,
)
MOVER_SIZE = np.array([4.0, 1.8, 1.6])
MOVER_SPEED = 9.0
SPEED = 12.0
"""The car's own [m/s]."""
WORLD_FROM_STREET = np.eye(4)
WORLD_FROM_STREET[:3, :3] = Rotation.from_euler("zyx", [0.9, 0.02, -0.015]).as_matrix()
WORLD_FROM_STREET[:3, 3] = [9000.0, -4000.0, 37.0]


def mover_center(time):
    """A car that comes towards us on the other side; one column for each time."""
    x = 34 - MOVER_SPEED * np.asarray(time)
    return np.array([x, np.full_like(x, -2.6), np.full_like(x, MOVER_SIZE[2] / 2)])


def world_from_vehicle(time):
    """The car drives along x, weaves a little and pitches."""
    turn = [0.05 * np.sin(2 * time), 0.01 * np.sin(7 * time), 0.008 * np.cos(5 * time)]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", turn).as_matrix()
    pose[:3, 3] = [SPEED * time, 0.3 * np.sin(2 * time), 0.02 * np.sin(9 * time)]
    return WORLD_FROM_STREET @ pose


@dataclass
class Hit:
    """Where rays end: distance along the ray (inf: sky), and whether on the moving car."""

    distance: np.ndarray
    moving: np.ndarray


def cast(origins, directions, time, *, with_mover=True):
    """Cast rays given in the world; origins and times may differ from ray to ray."""
    R, t = WORLD_FROM_STREET[:3, :3], WORLD_FROM_STREET[:3, 3]
    # One contiguous row for each axis: three times as fast as columns.
    o = (np.broadcast_to(np.asarray(origins) - t, directions.shape) @ R).T.copy()
    inverse = 1 / ((directions @ R).T + 1e-12)
    ground = -o[2] * inverse[2]
    distance = np.where(ground > 0, ground, np.inf)
    for low, high in BOXES:
        distance = np.minimum(distance, _hit_box(o, inverse, low, high))
    moving = np.zeros(len(directions), bool)
    if with_mover:
        center = mover_center(time)
        center = center[:, None] if center.ndim == 1 else center
        half = MOVER_SIZE[:, None] / 2
        hit = _hit_box(o, inverse, center - half, center + half)
        moving = hit < distance
        distance = np.minimum(distance, hit)
    return Hit(distance, moving)


def _hit_box(o, inverse, low, high):
    near, far = -np.inf, np.inf
    for axis in range(3):
        first, second = ((side[axis] - o[axis]) * inverse[axis] for side in (low, high))
        near = np.maximum(near, np.minimum(first, second))
        far = np.minimum(far, np.maximum(first, second))
    return np.where((near < far) & (near > 0), near, np.inf)


def shade(points, moving):
    """Colour of world points: waves of 1 to 4 m, other ones on the moving car."""
    p = (points - WORLD_FROM_STREET[:3, 3]) @ WORLD_FROM_STREET[:3, :3]
    p = np.nan_to_num(p, posinf=0, neginf=0)
    phase = p @ np.array([[1.0, 3.1, 1.8], [1.7, -0.8, 2.6], [2.5, 2.0, -1.3]])
    color = 128 + 45 * np.sin(phase) + 35 * np.cos(phase[:, [1, 2, 0]] * 0.6 + 1)
    return np.where(moving[:, None], 255 - color, color)


def picture(K, world_from_cam, image_size, time):
    """Render a pinhole camera: RGB and z, infinite in the sky."""
    height, width = image_size
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
    return render(rays.reshape(-1, 3), world_from_cam, time, image_size)


def render(rays, world_from_cam, time, image_size):
    """Render rays of z = 1 in a camera with OpenCV axes."""
    directions = rays @ world_from_cam[:3, :3].T
    hit = cast(world_from_cam[:3, 3], directions, time)
    finite = np.isfinite(hit.distance)
    points = world_from_cam[:3, 3] + directions * np.where(finite, hit.distance, 0)[:, None]
    color = np.where(finite[:, None], shade(points, hit.moving), [170.0, 190.0, 220.0])
    return color.reshape(*image_size, 3), hit.distance.reshape(image_size)
