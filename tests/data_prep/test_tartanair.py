import shutil

import numpy as np
import pytest
import torch

from data_prep.converters.synthetic import pose_lines
from data_prep.converters.tartanair import HELD_OUT, read, read_npy_depth, read_png, read_poses
from data_prep.roundtrip import interpolate_depth
from l3r.errors import DataError
from l3r.geometry.camera import project, unproject
from l3r.geometry.rigid import invert_rigid, transform_points


@pytest.fixture
def raw(raw_room, tmp_path):
    """A copy of the small held-out trajectory that a test may spoil."""
    target = tmp_path / "raw" / "room000" / "Easy" / "P001"
    shutil.copytree(raw_room / "room000" / "Easy" / "P001", target)
    return target


def agreement(frame, other):
    """Share of the frame's pixels that lie within 1% of the other's depth."""
    here, there = frame.world_from_cam, other.world_from_cam
    depth = torch.from_numpy(frame.read_depth()).double()
    points = unproject(depth, torch.from_numpy(frame.K))[depth.flatten() > 0]
    other_from_here = invert_rigid(torch.from_numpy(there)) @ torch.from_numpy(here)
    pts2d, z = project(transform_points(other_from_here, points), torch.from_numpy(other.K))
    found, known = interpolate_depth(torch.from_numpy(other.read_depth()).double(), pts2d)
    inside = known & (z > 0)
    return float(((found - z).abs() < 0.01 * z)[inside].double().mean())


def test_axes_and_intrinsics_of_a_genuine_trajectory_are_proven_by_reprojection(shared):
    (scene,) = read(shared / "data" / "raw" / "tartanair_v1_seq")
    assert (scene.name, len(scene.frames), scene.is_metric) == ("hospital/Easy/P012", 30, True)
    for first, second in ((0, 1), (5, 7), (20, 18)):
        assert agreement(scene.frames[first], scene.frames[second]) > 0.75


def test_a_rendered_room_reads_back_with_its_axes(raw_room):
    (walk,) = read(raw_room, scenes="*/P002")
    assert agreement(walk.frames[0], walk.frames[1]) > 0.8


def test_scenes_are_read_frame_by_frame_with_the_image_centre_as_principal_point(raw_room):
    scenes = list(read(raw_room))
    assert [scene.name for scene in scenes] == [f"room000/Easy/P00{n}" for n in range(3)]
    assert scenes[1].slug == "room000-Easy-P001"
    frame = scenes[0].frames[3]
    assert (frame.name, frame.image_size) == ("000003_left.png", (120, 160))
    np.testing.assert_array_equal(frame.K, [[80, 0, 80], [0, 80, 60], [0, 0, 1]])
    assert frame.read_image().shape == (120, 160, 3)
    assert scenes[0].intrinsics.shape == (24, 3, 3)


def test_every_other_frame_is_taken_on_request(raw_room):
    (scene,) = read(raw_room, scenes="*/P001", frame_step=3)
    assert [frame.name for frame in scene.frames] == ["000000_left.png", "000003_left.png"]


def test_poses_written_are_poses_read(room_scene, tmp_path):
    path = tmp_path / "pose_left.txt"
    path.write_text(pose_lines(room_scene.world_from_cam))
    np.testing.assert_allclose(read_poses(path), room_scene.world_from_cam, atol=1e-10)


def test_the_camera_looks_along_its_body_axis(tmp_path):
    # No rotation: body x (forward) is the camera's z, body y (right) its x, body z (down) its y.
    (tmp_path / "pose_left.txt").write_text("1 2 3 0 0 0 1\n")
    (camera,) = read_poses(tmp_path / "pose_left.txt")
    forward, right, down = camera[:3, 2], camera[:3, 0], camera[:3, 1]
    np.testing.assert_allclose([forward, right, down], np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(camera[:3, 3], [1, 2, 3])


def test_the_public_test_trajectories_are_held_out(raw_room, tmp_path):
    assert len(HELD_OUT) == 32
    for name in ("office2/Easy/P011", "office2/Easy/P010"):
        shutil.copytree(raw_room / "room000" / "Easy" / "P001", tmp_path / "office2" / name)
    names = {s: [scene.name for scene in read(tmp_path, s)] for s in ("train", "test", "all")}
    assert names["train"] == ["office2/Easy/P010"]
    assert names["test"] == ["office2/Easy/P011"]
    assert names["all"] == ["office2/Easy/P010", "office2/Easy/P011"]


def test_companions_a_mac_leaves_are_ignored(raw):
    (raw / "._pose_left.txt").write_bytes(b"\0\5\26\7")
    (raw / "image_left" / "._000000_left.png").write_bytes(b"\0\5\26\7")
    mac = raw.parent / "._P009"
    mac.mkdir()
    (mac / "pose_left.txt").write_text("")
    (scene,) = read(raw.parents[2])
    assert len(scene.frames) == 4


def test_sky_and_unknown_depth_become_zero(tmp_path):
    depth = np.array([[1.5, 1001, np.inf], [np.nan, -1, 1000]], np.float32)
    np.save(tmp_path / "d.npy", depth)
    np.testing.assert_array_equal(
        read_npy_depth(tmp_path / "d.npy", (2, 3)), np.array([[1.5, 0, 0], [0, 0, 1000]])
    )


def test_a_folder_without_trajectories_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"no pose_left\.txt below it"):
        list(read(tmp_path))


def test_a_pattern_that_matches_nothing_is_refused(raw_room):
    with pytest.raises(DataError, match="none of 3 trajectories"):
        list(read(raw_room, scenes="nowhere/*"))


def test_another_number_of_poses_than_images_is_refused(raw):
    lines = (raw / "pose_left.txt").read_text().splitlines(keepends=True)
    (raw / "pose_left.txt").write_text("".join(lines[:-1]))
    with pytest.raises(DataError, match=r"4 images in image_left, 3 lines in pose_left\.txt"):
        list(read(raw))


@pytest.mark.parametrize(
    "line",
    ["1 2 3 0 0 0 0.5", "1 2 3 nan 0 0 1", "nan 2 3 0 0 0 1", "1 2 3 0 0 0", "1 2 3 0 0 0 one", ""],
)
def test_a_bad_pose_is_refused_with_file_and_line(raw, line):
    lines = (raw / "pose_left.txt").read_text().splitlines()
    lines[2] = line
    (raw / "pose_left.txt").write_text("\n".join(lines) + "\n")
    with pytest.raises(DataError, match=r"pose_left\.txt:3: "):
        list(read(raw))


def test_a_missing_depth_map_is_named(raw):
    (raw / "depth_left" / "000002_left_depth.npy").unlink()
    with pytest.raises(DataError, match="000002_left_depth"):
        list(read(raw))


@pytest.mark.parametrize("share", [0.0, 0.5, 0.98])
def test_files_cut_off_are_named(raw, share):
    image = raw / "image_left" / "000001_left.png"
    depth = raw / "depth_left" / "000001_left_depth.npy"
    for path in (image, depth):
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(DataError, match="no whole PNG"):
        read_png(image)
    with pytest.raises(DataError, match="no whole array"):
        read_npy_depth(depth, (120, 160))


def test_depth_of_another_type_or_size_is_refused(tmp_path):
    for depth in (np.ones((2, 3), np.float64), np.ones((3, 2), np.float32)):
        np.save(tmp_path / "d.npy", depth)
        with pytest.raises(DataError, match="expected float32"):
            read_npy_depth(tmp_path / "d.npy", (2, 3))
