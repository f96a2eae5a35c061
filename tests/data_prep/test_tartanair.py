import shutil

import numpy as np
import pytest
import torch

from data_prep.converters import read_scenes, survey_scenes
from data_prep.converters.synthetic import pose_lines
from data_prep.converters.tartanair import HELD_OUT, read, read_npy_depth
from data_prep.converters.trajectories import read_poses
from data_prep.problems import Problems
from data_prep.surfaces import interpolate_depth
from l3r.errors import DataError
from l3r.geometry.camera import project, unproject
from l3r.geometry.rigid import invert_rigid, transform_points
from tests.data_prep.naming import assert_scenes_are_named_before_they_are_read
from tests.data_prep.raw_writer import write_v1, write_v2

RELEASES = {"tartanair": write_v1, "tartanair_v2": write_v2}
GENUINE = {
    "tartanair": ("tartanair_v1_seq", "hospital/Easy/P012", 30, (480, 640)),
    "tartanair_v2": ("tartanair_v2", "AbandonedSchoolExposure/Data_easy/P000", 10, (640, 640)),
}
PAIRS = {"tartanair": ((0, 1), (5, 7), (20, 18)), "tartanair_v2": ((0, 1), (3, 5), (9, 7))}


def read_all(root, dataset="tartanair", split="all", **options):
    """Scenes and what was left out."""
    problems = Problems()
    return list(read_scenes(dataset, root, split, problems=problems, **options)), problems.counts


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


@pytest.mark.parametrize("dataset", list(GENUINE))
def test_axes_and_intrinsics_of_genuine_trajectories_are_proven_by_reprojection(shared, dataset):
    folder, name, number, size = GENUINE[dataset]
    (scene,), left_out = read_all(shared / "data" / "raw" / folder, dataset, "train")
    assert (scene.dataset, scene.name, len(scene.frames)) == (dataset, name, number)
    assert scene.is_metric
    assert not left_out
    height, width = size
    np.testing.assert_array_equal(
        scene.frames[0].K, [[320, 0, width / 2], [0, 320, height / 2], [0, 0, 1]]
    )
    for first, second in PAIRS[dataset]:
        assert agreement(scene.frames[first], scene.frames[second]) > 0.75


@pytest.mark.parametrize("dataset", list(RELEASES))
def test_files_written_from_the_description_read_back_exactly(room_scene, tmp_path, dataset):
    RELEASES[dataset](tmp_path / "env" / "level" / "P000", room_scene.frames[:3])
    (scene,), left_out = read_all(tmp_path, dataset)
    assert not left_out
    for frame, expected in zip(scene.frames, room_scene.frames, strict=False):
        np.testing.assert_array_equal(frame.read_image(), expected.read_image())
        np.testing.assert_array_equal(frame.read_depth(), expected.read_depth())
        np.testing.assert_allclose(frame.world_from_cam, expected.world_from_cam, atol=1e-9)
        np.testing.assert_array_equal(frame.K, expected.K)


def test_a_rendered_room_reads_back_with_its_axes(raw_room):
    ((walk,), _) = read_all(raw_room, scenes="*/P002")
    assert agreement(walk.frames[0], walk.frames[1]) > 0.8


def test_scenes_are_read_frame_by_frame_with_the_image_centre_as_principal_point(raw_room):
    scenes, _ = read_all(raw_room)
    assert [scene.name for scene in scenes] == [f"room000/Easy/P00{n}" for n in range(3)]
    assert scenes[1].slug == "room000-Easy-P001"
    frame = scenes[0].frames[3]
    assert (frame.name, frame.image_size) == ("000003_left.png", (120, 160))
    np.testing.assert_array_equal(frame.K, [[80, 0, 80], [0, 80, 60], [0, 0, 1]])
    assert frame.read_image().shape == (120, 160, 3)
    assert scenes[0].intrinsics.shape == (24, 3, 3)


def test_every_other_frame_is_taken_on_request(raw_room):
    (scene,), _ = read_all(raw_room, scenes="*/P001", frame_step=3)
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
    names = {s: [x.name for x in read_all(tmp_path, split=s)[0]] for s in ("train", "test", "all")}
    assert names["train"] == ["office2/Easy/P010"]
    assert names["test"] == ["office2/Easy/P011"]
    assert names["all"] == ["office2/Easy/P010", "office2/Easy/P011"]
    excluded = {row.name: row.excluded for row in survey_scenes("tartanair", tmp_path)}
    assert excluded == {"office2/Easy/P010": "", "office2/Easy/P011": "held out for testing"}


def test_the_second_release_has_no_test_trajectories(room_scene, tmp_path):
    write_v2(tmp_path / "office2" / "Easy" / "P011", room_scene.frames[:1])
    assert len(read_all(tmp_path, "tartanair_v2", "train")[0]) == 1
    with pytest.raises(DataError, match="is in split 'test'"):
        read_all(tmp_path, "tartanair_v2", "test")


def test_companions_a_mac_leaves_are_ignored(raw):
    (raw / "._pose_left.txt").write_bytes(b"\0\5\26\7")
    (raw / "image_left" / "._000000_left.png").write_bytes(b"\0\5\26\7")
    mac = raw.parent / "._P009"
    mac.mkdir()
    (mac / "pose_left.txt").write_text("")
    (scene,), left_out = read_all(raw.parents[2])
    assert len(scene.frames) == 4
    assert not left_out


def test_folders_that_link_to_each_other_are_searched_once(raw):
    (raw.parent / "again").symlink_to(raw.parents[1], target_is_directory=True)
    assert len(read_all(raw.parents[2])[0]) == 1


def test_of_two_trajectories_of_one_name_the_first_is_kept(raw, tmp_path):
    shutil.copytree(raw, tmp_path / "raw" / "z" / "room000" / "Easy" / "P001")
    scenes, left_out = read_all(tmp_path / "raw")
    assert len(scenes) == 1
    assert left_out == {"duplicate_scene": 1}


def test_sky_and_unknown_depth_become_zero(tmp_path):
    depth = np.array([[1.5, 1001, np.inf], [np.nan, -1, 1000]], np.float32)
    np.save(tmp_path / "d.npy", depth)
    np.testing.assert_array_equal(
        read_npy_depth(tmp_path / "d.npy", (2, 3)), np.array([[1.5, 0, 0], [0, 0, 1000]])
    )


@pytest.mark.parametrize("dataset", list(RELEASES))
def test_a_folder_without_trajectories_is_refused(tmp_path, dataset):
    for call in (read_all, lambda root, dataset: list(survey_scenes(dataset, root))):
        with pytest.raises(DataError, match=r"no pose_\w+\.txt below it"):
            call(tmp_path, dataset)


def test_a_pattern_that_matches_nothing_is_refused(raw_room):
    with pytest.raises(DataError, match="none of 3 trajectories"):
        read_all(raw_room, scenes="nowhere/*")


def test_a_survey_counts_what_is_whole_and_what_lacks_something(raw_room, raw):
    (raw / "depth_left" / "000002_left_depth.npy").unlink()
    lost = raw.parent / "P009" / "image_left"
    lost.mkdir(parents=True)
    row, orphan = survey_scenes("tartanair", raw.parents[2])
    assert (row.name, row.num_images, row.num_missing) == ("room000/Easy/P001", 3, 1)
    assert (row.image_size, row.excluded) == ((120, 160), "")
    assert (orphan.name, orphan.num_images) == (str(lost.parent), 0)
    assert "no pose_left.txt" in orphan.excluded
    assert [row.num_images for row in survey_scenes("tartanair", raw_room)] == [24, 4, 6]


def test_reading_starts_before_all_is_read(raw_room):
    scenes = read(raw_room, "all", problems=Problems())
    assert next(scenes).name == "room000/Easy/P000"


def test_trajectories_are_named_before_they_are_read(raw, raw_room):
    (raw / "image_left" / "000002_left.png").unlink()
    names = assert_scenes_are_named_before_they_are_read("tartanair", raw.parents[2], "all")
    assert names == ["room000/Easy/P001"]
    names = assert_scenes_are_named_before_they_are_read("tartanair", raw_room, "all")
    assert names == [f"room000/Easy/P{n:03d}" for n in range(3)]
