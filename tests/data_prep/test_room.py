import numpy as np
import pytest
import torch

from data_prep.converters.synthetic import RoomRequest, intrinsics, write_room
from data_prep.raycast import render
from data_prep.room import build_room, clearance, draw_cameras, draw_walk
from data_prep.surfaces import interpolate_depth
from l3r.errors import DataError
from l3r.geometry.camera import pixel_centers, project, unproject
from l3r.geometry.rigid import invert_rigid, transform_points

SIZE = (60, 80)
K = torch.from_numpy(intrinsics(SIZE))


@pytest.fixture(scope="module")
def room():
    return build_room(3)


@pytest.fixture(scope="module")
def views(room):
    cameras = draw_cameras(room, 12, seed=1)
    return cameras, *render(room, K, cameras, SIZE)


def world_points(cameras, depth):
    points = unproject(depth.double(), K.expand(len(depth), 3, 3))
    return transform_points(cameras, points)


def test_every_rendered_point_lies_on_a_surface(room, views):
    cameras, _, depth = views
    points = world_points(cameras, depth).reshape(-1, 3).float()
    assert clearance(room, points).abs().max() < 1e-4  # float32 over some metres


def test_no_surface_stands_between_a_camera_and_what_it_sees(room, views):
    cameras, _, depth = views
    points = world_points(cameras, depth)
    for share in (0.2, 0.5, 0.9, 0.99):
        between = cameras[:, None, :3, 3] * (1 - share) + share * points
        assert clearance(room, between.reshape(-1, 3).float()).min() > -1e-4


def test_depth_is_z_at_pixel_centres_and_not_range(views):
    cameras, _, depth = views
    there, z = project(
        transform_points(invert_rigid(cameras), world_points(cameras, depth)),
        K.expand(len(depth), 3, 3),
    )
    torch.testing.assert_close(there[0], pixel_centers(*SIZE, like=there), atol=1e-6, rtol=0)
    torch.testing.assert_close(z[0].reshape(SIZE), depth[0].double())


def test_two_views_agree_on_depth_and_colour(room, views):
    # The other view looks along the same ray bundle from 3 cm to the side.
    cameras, image, depth = views
    aside = cameras.clone()
    aside[:, :3, 3] += 0.03 * cameras[:, :3, 0]
    other_image, other_depth = render(room, K, aside, SIZE)
    for view in range(len(cameras)):
        points = transform_points(invert_rigid(aside[view]), world_points(cameras, depth)[view])
        there, z = project(points, K)
        found, known = interpolate_depth(other_depth[view].double(), there)
        close = known & ((found - z).abs() < 0.02 * z)
        assert close.double().mean() > 0.4  # steep surfaces have no four neighbours alike
        assert ((found - z).abs() / z)[close].median() < 1e-5
        column, row = there[close].long().unbind(-1)
        difference = other_image[view][row, column] - image[view].reshape(-1, 3)[close]
        assert difference.abs().median() < 0.03


def test_all_views_in_one_call_equal_one_view_a_call(room, views):
    cameras, image, depth = views
    for view in (0, 7):
        one_image, one_depth = render(room, K, cameras[view : view + 1], SIZE)
        torch.testing.assert_close(one_depth[0], depth[view])
        torch.testing.assert_close(one_image[0], image[view], atol=1e-4, rtol=0)


def test_a_room_shows_many_colours(views):
    _, image, _ = views
    assert image.amin() >= 0
    assert image.amax() <= 1
    assert (image.reshape(-1, 3).std(0) > 0.1).all()


def test_textures_are_smooth_enough_for_small_images(room):
    # Rendered at three times the size and averaged, the picture hardly changes.
    cameras = draw_cameras(room, 6, seed=5)
    small, _ = render(room, torch.from_numpy(intrinsics((48, 48))), cameras, (48, 48))
    large, _ = render(room, torch.from_numpy(intrinsics((144, 144))), cameras, (144, 144))
    averaged = large.reshape(6, 48, 3, 48, 3, 3).mean((2, 4))
    assert (averaged - small).abs().mean() < 0.01


def test_cameras_are_rigid_clear_of_objects_and_drawn_by_their_own_seed(room):
    first, again, other = (draw_cameras(room, 50, seed=s) for s in (1, 1, 2))
    R = first[:, :3, :3]
    eye = torch.eye(3, dtype=R.dtype).expand_as(R)
    torch.testing.assert_close(R @ R.mT, eye)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(50, dtype=R.dtype))
    assert clearance(room, first[:, :3, 3].float()).min() > 0.3
    assert torch.equal(first, again)
    assert (torch.cdist(first[:, :3, 3], other[:, :3, 3]).amin(1) > 1e-3).all()


def test_a_walk_is_smooth_and_stays_clear(room):
    walk = draw_walk(room, 100, seed=2)
    step = walk[:, :3, 3].diff(dim=0).norm(dim=-1)
    turn = (walk[1:, :3, 2] * walk[:-1, :3, 2]).sum(-1)
    assert clearance(room, walk[:, :3, 3].float()).min() > 0.1
    assert step.max() < 0.5
    assert turn.min() > 0.8


def test_rooms_differ_by_seed_and_repeat():
    assert torch.equal(build_room(1).base, build_room(1).base)
    assert not torch.equal(build_room(1).base, build_room(2).base)


def test_files_repeat_and_finished_trajectories_are_left_alone(tmp_path):
    request = RoomRequest(num_views=3, num_held_out=2, num_walk=0, image_size=(16, 24))
    for name in ("a", "b"):
        write_room(tmp_path / name, request)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*"))
    assert len(files) == 2 * (3 + 2) + 2
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    image = tmp_path / "a" / "room000" / "Easy" / "P000" / "image_left" / "000001_left.png"
    before = image.stat().st_mtime_ns
    write_room(tmp_path / "a", request)
    assert image.stat().st_mtime_ns == before
    with pytest.raises(DataError, match="holds 3 views of another request"):
        write_room(tmp_path / "a", RoomRequest(num_views=4, image_size=(16, 24)))


def test_too_small_a_request_is_refused():
    with pytest.raises(DataError, match="expected 2 or more"):
        RoomRequest(num_views=1)


def test_depth_files_hold_float32(raw_room):
    path = raw_room / "room000" / "Easy" / "P000" / "depth_left" / "000000_left_depth.npy"
    depth = np.load(path, allow_pickle=False)
    assert depth.dtype == np.float32
    assert depth.shape == (120, 160)
