import numpy as np
import pytest

from data_prep.converters.waymo.calibration import make_camera
from data_prep.converters.waymo.depth import MAX_SHIFT, sparse_depth
from data_prep.converters.waymo.lidar import Sweep
from tests.data_prep.waymo import drive

LENS = np.array([500.0, 500, 96, 64, 0.04, -0.33, 0, 0, 0])
ORIGIN = np.eye(4)
CAMERA = make_camera(1, LENS, ORIGIN.ravel(), (128, 192))


def at(pixels, z):
    """Points seen at pixels of the undistorted image, in a camera at the origin."""
    pixels = np.array(pixels, np.float64).reshape(-1, 2)
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(CAMERA.K).T
    return rays * np.broadcast_to(z, len(pixels))[:, None]


def sweep(points, *, second=False, offset=(0.0, 0.0), moving=False):
    """A sweep whose stored projections are right but for ``offset``."""
    x, y = (points[:, :2] / points[:, 2:]).T
    u, v, _ = drive.lens_forward(x, y, CAMERA.lens)
    stored = np.stack([np.ones_like(u), u + offset[0], v + offset[1]], -1)
    other = np.tile([3, 7, 7], (len(points), 1))
    both = [other, stored] if second else [stored, np.zeros_like(stored)]
    return Sweep(
        pts3d_world=points,
        projection=np.floor(np.concatenate(both, 1)).astype(np.int32),
        moving=np.full(len(points), moving),
    )


def depth_of(sweep, world_from_cam=ORIGIN):
    return sparse_depth(sweep, CAMERA, world_from_cam)


@pytest.mark.parametrize("second", [False, True])
def test_a_point_goes_to_the_pixel_it_falls_into_by_either_projection(second):
    depth = depth_of(sweep(at([[10.2, 20.9], [150.5, 100.5]], [7.0, 9.0]), second=second))
    assert depth.dtype == np.float32
    assert np.argwhere(depth).tolist() == [[20, 10], [100, 150]]
    np.testing.assert_allclose(depth[[20, 100], [10, 150]], [7, 9])


def test_points_other_cameras_see_are_not_taken():
    points = sweep(at([[50, 50]], 7.0))
    points.projection[:, 0] = 2
    assert not depth_of(points).any()


def test_depth_is_z_in_the_camera_not_distance():
    depth = depth_of(sweep(at([[1.5, 1.5]], 10.0)))
    assert depth[1, 1] == 10


def test_the_nearest_of_a_pixel_counts_whatever_the_order():
    pixels = [[50.5, 50.5]] * 3
    for z in ([20.0, 19, 21], [19.0, 20, 21], [21.0, 20, 19]):
        assert depth_of(sweep(at(pixels, z)))[50, 50] == 19


def test_points_near_behind_and_outside_are_left_out():
    points = at([[50.5, 50.5]] * 2 + [[-3.0, 50], [50, 131]], [0.3, -5, 7, 7])
    assert not depth_of(sweep(points)).any()


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0.6, -0.8)])
def test_points_the_rolling_shutter_displaces_too_far_are_left_out(direction):
    offsets = [0, MAX_SHIFT - 1, MAX_SHIFT + 1, 60]
    shifted = [np.array(direction) * offset for offset in offsets]
    kept = [depth_of(sweep(at([[90.5, 60.5]], 7.0), offset=o)).any() for o in shifted]
    assert kept == [True, True, False, False]


def test_moving_points_are_left_out_and_still_hide_what_is_behind():
    behind, mover = sweep(at([[50.5, 50.5]], 30.0)), sweep(at([[51.5, 50.5]], 8.0), moving=True)
    assert depth_of(behind).any()
    both = Sweep(
        **{
            name: np.concatenate([getattr(behind, name), getattr(mover, name)])
            for name in ("pts3d_world", "projection", "moving")
        }
    )
    assert not depth_of(both).any()


def test_points_behind_neighbours_are_left_out():
    pixels = [[50.5, 50.5], [52.5, 50.5], [90.5, 50.5]]
    depth = depth_of(sweep(at(pixels, [8.0, 30.0, 30.0])))
    assert depth[50, 50] == 8
    assert depth[50, 52] == 0
    assert depth[50, 90] == 30


def test_ground_does_not_hide_itself():
    # Seen from 1.5 m; every pixel of the lower part of the image has a point.
    y, x = np.mgrid[70:128, 0:192] + 0.5
    z = 1.5 * CAMERA.K[1, 1] / (y - CAMERA.K[1, 2])
    points = at(np.stack([x, y], -1).reshape(-1, 2), z.ravel())
    assert (depth_of(sweep(points))[70:] > 0).all()


def test_no_point_gives_an_image_of_zeros():
    empty = Sweep(
        pts3d_world=np.empty((0, 3)),
        projection=np.empty((0, 6), np.int32),
        moving=np.empty(0, bool),
    )
    assert depth_of(empty).shape == (128, 192)
    assert not depth_of(empty).any()


def test_the_camera_may_stand_anywhere():
    world_from_cam = drive.mount([1e4, -2e4, 50], [1.0, 0.2, -0.1])
    points = at([[10.2, 20.9]], 7.0)
    moved = sweep(points)
    world = points @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    there = Sweep(pts3d_world=world, projection=moved.projection, moving=moved.moving)
    np.testing.assert_allclose(depth_of(there, world_from_cam)[20, 10], 7, rtol=1e-6)
