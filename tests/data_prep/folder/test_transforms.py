"""Scenes with nerfstudio's transforms.json."""

import json
import math
import shutil

import numpy as np
import pytest

from data_prep.converters.folder import read
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.folder.analytic import Camera, photograph_pinhole, ring, shift_between
from tests.data_prep.folder.writers import cameras_of, write_depth, write_transforms


def read_one(root, **options):
    problems = Problems()
    (scene,) = read(root, problems=problems, **options)
    return scene, problems


def edit(root, change):
    path = root / "own" / "transforms.json"
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Three views of a pinhole, with depth in millimetres."""
    folder = tmp_path_factory.mktemp("transforms") / "own"
    write_transforms(folder, cameras_of("PINHOLE", 3), depth=".png")
    return folder


@pytest.fixture
def scene(written, tmp_path):
    """A copy of them that a test may spoil."""
    shutil.copytree(written, tmp_path / "own")
    return tmp_path


def assert_true(frame, *, depth=2e-4):
    """Hold a frame against what its own camera would photograph."""
    expected, exact = photograph_pinhole(frame.K, frame.world_from_cam, frame.image_size)
    assert shift_between(frame.read_image(), expected) < 0.1
    found = frame.read_depth()
    assert (found > 0).mean() > 0.98
    assert np.median(np.abs(found / exact - 1)) < depth


@pytest.mark.parametrize(
    ("lens", "shared"), [("PINHOLE", False), ("OPENCV", True), ("OPENCV_FISHEYE", False)]
)
def test_axes_and_lenses_are_proven_by_photographs(tmp_path, lens, shared):
    write_transforms(tmp_path / "own", cameras_of(lens, 2), shared=shared, depth=".npy")
    scene, problems = read_one(tmp_path)
    assert (problems.summary(), scene.is_metric, scene.has_sparse_depth) == ("none", False, False)
    for frame in scene.frames:
        assert_true(frame)
        # Cameras whose axes were left as OpenGL has them look the other way.
        wrong = frame.world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0])
        planted, _ = photograph_pinhole(frame.K, wrong, frame.image_size)
        assert shift_between(frame.read_image(), planted) > 0.4


def test_k3_of_a_perspective_lens_is_taken(tmp_path):
    write_transforms(tmp_path / "own", cameras_of("OPENCV", 2), depth=".npy")
    edit(tmp_path, lambda table: table.update(k3=1e-9))
    assert_true(read_one(tmp_path)[0].frames[0])
    edit(tmp_path, lambda table: table.update(k3=0.4))
    with pytest.raises(AssertionError):
        assert_true(read_one(tmp_path)[0].frames[0])


def test_a_field_of_view_stands_in_for_the_focal_length(tmp_path):
    camera = Camera("PINHOLE", (96, 128), (120.0, 120.0, 64.0, 48.0), ring(1)[0])
    write_transforms(tmp_path / "own", [camera], depth=".npy")

    def change(table):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"):
            del table[key]
        table["camera_angle_x"] = 2 * math.atan(64 / 120)
        # Blender's scenes leave the ending out.
        table["frames"][0]["file_path"] = "./images/frame_00000"

    edit(tmp_path, change)
    scene, _ = read_one(tmp_path)
    np.testing.assert_allclose(scene.frames[0].K, [[120, 0, 64], [0, 120, 48], [0, 0, 1]])
    assert_true(scene.frames[0])


@pytest.mark.parametrize("ending", [".png", ".npy", ".h5"])
def test_depth_is_read_in_the_unit_it_is_stored_in(tmp_path, ending):
    write_transforms(tmp_path / "own", cameras_of("PINHOLE", 1), depth=ending)
    (tmp_path / "own" / "scene.json").write_text('{"metric": true}')
    scene, _ = read_one(tmp_path)
    assert scene.is_metric
    assert_true(scene.frames[0], depth=3e-4 if ending == ".png" else 1e-6)


def test_another_unit_is_stated_in_scene_json(scene):
    (frame, *_) = read_one(scene)[0].frames
    (scene / "own" / "scene.json").write_text('{"depth_scale": 0.002, "note": "mine"}')
    (doubled, *_) = read_one(scene)[0].frames
    np.testing.assert_allclose(doubled.read_depth(), 2 * frame.read_depth(), rtol=1e-6)


def test_depth_is_found_by_the_name_of_the_photo(tmp_path):
    depths = write_transforms(tmp_path / "own", cameras_of("PINHOLE", 2))
    write_depth(tmp_path / "own" / "lidar" / "frame_00001.npy", depths[1])
    (tmp_path / "own" / "scene.json").write_text('{"depth_folder": "lidar"}')
    scene, problems = read_one(tmp_path)
    assert [frame.name for frame in scene.frames] == ["images/frame_00001.png"]
    assert problems.summary() == "1 missing_depth"
    assert_true(scene.frames[0])


def test_every_so_many_of_the_frames_with_depth_are_taken(tmp_path):
    depths = write_transforms(tmp_path / "own", cameras_of("PINHOLE", 4))
    for number in (1, 3):
        write_depth(tmp_path / "own" / "depth" / f"frame_0000{number}.npy", depths[number])
    scene, _ = read_one(tmp_path, frame_step=2)
    assert [frame.name for frame in scene.frames] == ["images/frame_00001.png"]


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({"file_path": "../own/images/frame_00000.png"}, "unsafe_path"),
        ({"file_path": "/etc/passwd"}, "unsafe_path"),
        ({"file_path": "images/none.png"}, "missing_photo"),
        ({"file_path": "images/frame_00001.png"}, "duplicate_name"),
        ({"file_path": 7}, "bad_frame"),
        ({"transform_matrix": None}, "bad_pose"),
        ({"transform_matrix": [[math.nan] * 4] * 4}, "bad_pose"),
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, "bad_pose"),
        ({"transform_matrix": np.diag([1, 1, -1, 1]).tolist()}, "bad_pose"),
        ({"transform_matrix": [[1, 2], [3]]}, "bad_pose"),
        ({"fl_x": math.inf}, "bad_camera"),
        ({"fl_x": "120"}, "bad_camera"),
        ({"cx": 1e6}, "bad_camera"),
        ({"w": 128.5}, "bad_camera"),
        ({"w": 64}, "bad_camera"),
        ({"w": 127}, "size_mismatch"),
        ({"k1": 0.1, "k4": 0.1}, "bad_camera"),
        ({"camera_model": "EQUIRECTANGULAR"}, "bad_camera"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "bad_camera"),
        ({"depth_file_path": "../0.png"}, "unsafe_path"),
        ({"depth_file_path": "depths/9.png"}, "missing_depth"),
    ],
)
def test_a_frame_that_cannot_be_used_is_counted_and_the_rest_kept(scene, change, kind):
    edit(scene, lambda table: table["frames"][0].update(change))
    found, problems = read_one(scene)
    assert (len(found.frames), problems.summary()) == (2, f"1 {kind}")


def test_depth_of_another_size_is_counted(scene):
    write_depth(scene / "own" / "depths" / "1.png", np.ones((48, 64)))
    found, problems = read_one(scene)
    assert (len(found.frames), problems.summary()) == (2, "1 size_mismatch")


@pytest.mark.parametrize("text", ["", "[]", '{"frames": 3}', '{"frames": []}', "{"])
def test_a_scene_without_frames_is_left_out(scene, text):
    (scene / "own" / "transforms.json").write_text(text)
    with pytest.raises(DataError, match="none of 1 scenes can be used"):
        read_one(scene)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"metrc": true}', "did you mean 'metric'"),
        ('{"metric": 1}', "expected true or false"),
        ('{"depth_scale": 0}', "expected a number above 0"),
        ('{"depth_scale": true}', "expected a number above 0"),
        ('{"cameras": "sparse/7"}', "expected a COLMAP model or a .json file"),
        ('{"cameras": "../own"}', "expected a path below"),
        ("[1]", "no object"),
        ("{", "not valid JSON"),
    ],
)
def test_a_wrong_scene_json_is_explained(scene, text, message):
    (scene / "own" / "scene.json").write_text(text)
    problems = Problems()
    with pytest.raises(DataError, match="none of 1 scenes can be used"):
        list(read(scene, problems=problems))
    assert message in problems.first["bad_scene"].detail


def test_a_scene_without_depth_says_what_is_missing(tmp_path):
    write_transforms(tmp_path / "own", cameras_of("PINHOLE", 2))
    problems = Problems()
    with pytest.raises(DataError, match="1 bad_scene"):
        list(read(tmp_path, problems=problems))
    assert "no depth maps in 'depth' and no COLMAP points" in problems.first["bad_scene"].detail


def test_the_folder_of_one_scene_is_not_taken_for_a_folder_of_scenes(scene):
    with pytest.raises(DataError, match="is a scene itself"):
        list(read(scene / "own", problems=Problems()))
    with pytest.raises(DataError, match="no such folder"):
        list(read(scene / "nowhere", problems=Problems()))
    (scene / "void").mkdir()
    with pytest.raises(DataError, match="no folder below it"):
        list(read(scene / "void", problems=Problems()))


def test_a_folder_has_no_test_split(scene):
    with pytest.raises(DataError, match="--held-out"):
        list(read(scene, "test", problems=Problems()))
    with pytest.raises(DataError, match="matches 'other'"):
        list(read(scene, scenes="other", problems=Problems()))
