"""Scenes with a COLMAP model: geometry is judged by photographs of an analytic scene."""

import pickle
import shutil

import cv2
import numpy as np
import pytest

from data_prep.converters.colmap_model import read_model, read_points, shared_point_overlap
from data_prep.converters.folder import read, survey
from data_prep.converters.lens import build_lens
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.folder.analytic import photograph_pinhole, shift_between
from tests.data_prep.folder.writers import (
    PARAMS,
    cameras_of,
    write_depth,
    write_model,
    write_photos,
)
from tests.data_prep.naming import assert_scenes_are_named_before_they_are_read

# Bilinear resampling of a texture of ten pixels' wavelength blurs and shifts it by so much [px].
RESAMPLED = 0.1


def read_one(root, **options):
    problems = Problems()
    (scene,) = read(root, problems=problems, **options)
    return scene, problems


@pytest.mark.parametrize("lens", PARAMS)
def test_photos_are_what_the_cameras_see_whatever_the_lens(colmap_scenes, lens):
    scene, problems = read_one(colmap_scenes[0], scenes=lens.lower())
    assert (problems.summary(), scene.is_metric, len(scene.frames)) == ("none", False, 5)
    for frame in scene.frames[::4]:
        image = frame.read_image()
        expected, _ = photograph_pinhole(frame.K, frame.world_from_cam, frame.image_size)
        assert image.shape == (*frame.image_size, 3)
        assert shift_between(image, expected) < RESAMPLED
        # The same measure sees half a pixel in the principal point, in either direction.
        for off in (-0.5, 0.5):
            K = frame.K + np.array([[0, 0, off], [0, 0, off], [0, 0, 0]])
            planted, _ = photograph_pinhole(K, frame.world_from_cam, frame.image_size)
            assert shift_between(image, planted) > 0.5


@pytest.mark.parametrize("lens", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_intrinsics_of_the_distorted_photo_would_be_seen(colmap_scenes, lens):
    scene, _ = read_one(colmap_scenes[0], scenes=lens.lower())
    frame = scene.frames[2]
    (image, *_) = read_model(colmap_scenes[0] / lens.lower() / "sparse" / "0", Problems())
    stale = image.lens.K
    stale[:2, 2] *= np.divide(frame.image_size[::-1], image.lens.image_size[::-1])
    stale[:2, :2] *= np.divide(frame.image_size[::-1], image.lens.image_size[::-1])[:, None]
    planted, _ = photograph_pinhole(stale, frame.world_from_cam, frame.image_size)
    assert shift_between(frame.read_image(), planted) > 3 * RESAMPLED


@pytest.mark.parametrize("lens", PARAMS)
def test_points_become_depth_where_there_are_no_maps(colmap_scenes, lens):
    scene, _ = read_one(colmap_scenes[0], scenes=lens.lower())
    assert scene.has_sparse_depth
    _, names, _, tracks = colmap_scenes[1][lens]
    for view, frame in enumerate(scene.frames):
        assert frame.name == names[view]
        depth = frame.read_depth()
        known = depth > 0
        seen = sum(view in [v for v, _ in track] for track in tracks)
        assert 0.8 * seen < known.sum() <= seen
        _, exact = photograph_pinhole(frame.K, frame.world_from_cam, frame.image_size)
        # A point lies up to half a pixel beside the centre of the pixel it falls into.
        assert np.median(np.abs(depth / exact - 1)[known]) < 0.004


@pytest.mark.parametrize(
    ("model", "params", "is_distorted"),
    [
        ("PINHOLE", (9.0, 9.0, 8.0, 6.0), False),
        ("OPENCV", (9.0, 9.0, 8.0, 6.0, 0.0, 0.0, 0.0, 0.0), False),
        ("OPENCV", (9.0, 9.0, 8.0, 6.0, 0.0, 0.0, 0.0, 0.1), True),
        ("SIMPLE_RADIAL", (9.0, 8.0, 6.0, 0.1), True),
        ("OPENCV_FISHEYE", (9.0, 9.0, 8.0, 6.0, 0.0, 0.0, 0.0, 0.0), True),
    ],
)
def test_a_fisheye_bends_lines_whatever_its_coefficients(model, params, is_distorted):
    assert build_lens(model, (12, 16), params).is_distorted == is_distorted


def test_overlap_is_that_of_shared_points(colmap_scenes):
    scene, _ = read_one(colmap_scenes[0], scenes="opencv")
    sets = [set() for _ in scene.frames]
    for number, track in enumerate(colmap_scenes[1]["OPENCV"][3]):
        for view, _ in track:
            sets[view].add(number)
    expected = [[len(a & b) / len(a | b) for b in sets] for a in sets]
    np.testing.assert_allclose(scene.read_overlap().toarray(), expected, atol=1e-12)


def test_overlap_follows_the_frames_that_are_kept(colmap_scenes):
    whole, _ = read_one(colmap_scenes[0], scenes="pinhole")
    part, _ = read_one(colmap_scenes[0], scenes="pinhole", frame_step=2)
    assert [frame.name for frame in part.frames] == ["im 0.png", "im 2.png", "im 4.png"]
    expected = whole.read_overlap().toarray()[::2, ::2]
    np.testing.assert_array_equal(part.read_overlap().toarray(), expected)


def test_text_and_binary_say_the_same(colmap_scenes, tmp_path):
    root, written = colmap_scenes
    cameras, names, points, _ = written["SIMPLE_RADIAL"]
    write_model(tmp_path, cameras, names, form="txt")
    binary = root / "simple_radial" / "sparse" / "0"
    problems = Problems()
    pairs = zip(read_model(tmp_path, problems), read_model(binary, problems), strict=True)
    for text, image in pairs:
        assert (text.name, text.lens) == (image.name, image.lens)
        np.testing.assert_allclose(text.cam_from_world, image.cam_from_world, atol=1e-12)
    for folder in (tmp_path, binary):
        np.testing.assert_allclose(read_points(folder, problems).pts3d_world, points, atol=1e-12)
        overlap = shared_point_overlap(folder, tuple(names)).toarray()
        expected = shared_point_overlap(binary, tuple(names)).toarray()
        np.testing.assert_array_equal(overlap, expected)
    assert problems.summary() == "none"


@pytest.mark.parametrize("at", ["sparse", "colmap/sparse/0", "colmap", "dense/sparse", "."])
def test_models_are_found_where_tools_leave_them(colmap_scenes, tmp_path, at):
    source = colmap_scenes[0] / "pinhole"
    photos = tmp_path / "own" / ("dense/images" if at.startswith("dense") else "images")
    shutil.copytree(source / "images", photos)
    (tmp_path / "own" / at).mkdir(parents=True, exist_ok=True)
    for path in (source / "sparse" / "0").iterdir():
        shutil.copy(path, tmp_path / "own" / at)
    assert len(read_one(tmp_path)[0].frames) == 5


def test_another_model_is_mentioned_and_can_be_named(colmap_scenes, tmp_path):
    folder = tmp_path / "own"
    shutil.copytree(colmap_scenes[0] / "pinhole", folder)
    cameras, names, *_ = colmap_scenes[1]["PINHOLE"]
    write_model(folder / "sparse" / "1", cameras[:2], names[:2])
    scene, problems = read_one(tmp_path)
    assert (len(scene.frames), problems.summary()) == (5, "1 unread_model")
    (folder / "scene.json").write_text('{"cameras": "sparse/1"}')
    assert len(read_one(tmp_path)[0].frames) == 2


@pytest.mark.parametrize("lens", ["PINHOLE", "OPENCV"])
def test_depth_maps_win_over_points_and_follow_the_lens(tmp_path, lens):
    folder = tmp_path / "own"
    cameras = cameras_of(lens, 3)
    names = [f"{n}.png" for n in range(3)]
    depths = write_photos(folder / "images", cameras, names)
    write_model(folder / "sparse" / "0", cameras, names, num_points=20)
    for number, depth in enumerate(depths):
        write_depth(folder / "depth" / f"{number}.npy", depth)
    scene, _ = read_one(tmp_path)
    assert not scene.has_sparse_depth
    assert scene.read_overlap is None
    for frame in scene.frames:
        depth = frame.read_depth()
        _, exact = photograph_pinhole(frame.K, frame.world_from_cam, frame.image_size)
        assert (depth > 0).mean() > 0.98
        error = np.abs(depth / exact - 1)[2:-2, 2:-2]
        assert np.median(error) < 2e-4
        assert np.quantile(error, 0.9) < 0.01


def test_scenes_travel_to_other_processes(colmap_scenes):
    scene, _ = read_one(colmap_scenes[0], scenes="opencv_fisheye")
    copy = pickle.loads(pickle.dumps(scene))
    np.testing.assert_array_equal(copy.frames[1].read_image(), scene.frames[1].read_image())
    np.testing.assert_array_equal(copy.frames[1].read_depth(), scene.frames[1].read_depth())
    np.testing.assert_array_equal(copy.read_overlap().toarray(), scene.read_overlap().toarray())


def spoil(folder, old, new, file="images.txt"):
    path = folder / "sparse" / "0" / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.fixture(scope="module")
def text_model(tmp_path_factory, colmap_scenes):
    """The model of the pinhole in text."""
    folder = tmp_path_factory.mktemp("text")
    cameras, names, *_ = colmap_scenes[1]["PINHOLE"]
    write_model(folder, cameras, names, form="txt")
    return folder


@pytest.fixture
def text_scene(tmp_path, colmap_scenes, text_model):
    """A scene with a model in text that a test may spoil."""
    folder = tmp_path / "own"
    shutil.copytree(colmap_scenes[0] / "pinhole" / "images", folder / "images")
    shutil.copytree(text_model, folder / "sparse" / "0")
    return folder


def head_of(folder, name):
    lines = (folder / "sparse" / "0" / "images.txt").read_text().splitlines()
    return next(line for line in lines if line.endswith(name))


def test_a_pose_that_is_not_a_number_costs_its_image_alone(text_scene):
    head = head_of(text_scene, "im 2.png")
    spoil(text_scene, head, " ".join([head.split()[0], "nan", *head.split()[2:]]))
    scene, problems = read_one(text_scene.parent)
    assert [frame.name for frame in scene.frames] == [f"im {n}.png" for n in (0, 1, 3, 4)]
    assert problems.summary() == "1 bad_pose"
    assert scene.read_overlap().shape == (4, 4)


def test_a_quaternion_that_is_no_rotation_is_refused(text_scene):
    head = head_of(text_scene, "im 2.png")
    spoil(text_scene, head, " ".join([head.split()[0], "3.0", *head.split()[2:]]))
    scene, problems = read_one(text_scene.parent)
    assert (len(scene.frames), problems.summary()) == (4, "1 bad_pose")


def test_a_line_that_is_missing_costs_its_image_alone(text_scene):
    path = text_scene / "sparse" / "0" / "images.txt"
    lines = path.read_text().splitlines(keepends=True)
    at = next(n for n, line in enumerate(lines) if line.endswith("im 2.png\n"))
    del lines[at + 1]
    path.write_text("".join(lines))
    scene, problems = read_one(text_scene.parent)
    assert [frame.name for frame in scene.frames] == [f"im {n}.png" for n in (0, 1, 3, 4)]
    assert problems.summary() == "1 damaged_model"


@pytest.mark.parametrize(
    ("bad", "kind"),
    [
        ("../im 2.png", "unsafe_path"),
        ("/etc/im 2.png", "unsafe_path"),
        ("im 9.png", "missing_photo"),
        ("im 1.png", "duplicate_name"),
    ],
)
def test_names_that_lead_nowhere_are_counted(text_scene, bad, kind):
    (text_scene.parent / "im 2.png").write_bytes((text_scene / "images/im 2.png").read_bytes())
    spoil(text_scene, "im 2.png", bad)
    scene, problems = read_one(text_scene.parent)
    assert (len(scene.frames), problems.summary()) == (4, f"1 {kind}")


@pytest.mark.parametrize(
    "line",
    [
        "1 NOLENS 128 96 1 2 3 4",
        "1 PINHOLE 128 96 120 118 65.3",
        "1 PINHOLE 128 96 120 nan 65.3 46.9",
        "1 PINHOLE 128 96 -120 118 65.3 46.9",
        "1 PINHOLE 0 96 120 118 65.3 46.9",
        "1 PINHOLE 99999999999 96 120 118 65.3 46.9",
        "1 EQUIRECTANGULAR 128 96 128 96",
    ],
)
def test_a_scene_of_an_impossible_lens_is_left_out(text_scene, colmap_scenes, line):
    shutil.copytree(colmap_scenes[0] / "simple_radial", text_scene.parent / "whole")
    (text_scene / "sparse" / "0" / "cameras.txt").write_text(line + "\n")
    scene, problems = read_one(text_scene.parent)
    assert scene.name == "whole"
    assert problems.counts["bad_camera"] >= 5
    assert problems.counts["empty_scene"] == 1


def test_photos_of_another_size_than_their_camera_are_counted(text_scene):
    path = text_scene / "images" / "im 3.png"
    cv2.imwrite(str(path), cv2.imread(str(path)).transpose(1, 0, 2))
    scene, problems = read_one(text_scene.parent)
    assert (len(scene.frames), problems.summary()) == (4, "1 size_mismatch")
    assert "stored turned" in problems.first["size_mismatch"].detail


def test_points_seen_once_are_no_depth(text_scene):
    # As in the models that l3r itself writes: every point has the one pixel it comes from.
    path = text_scene / "sparse" / "0" / "images.txt"
    lines = path.read_text().splitlines()
    heads = [n for n, line in enumerate(lines) if line.endswith(".png")]
    for at in heads[1:]:
        lines[at + 1] = ""
    path.write_text("\n".join(lines) + "\n")
    problems = Problems()
    with pytest.raises(DataError, match="none of 1 scenes"):
        list(read(text_scene.parent, problems=problems))
    assert problems.summary() == "1 empty_scene, 5 no_points"


def test_a_survey_says_what_is_there(colmap_scenes, text_scene):
    rows = list(survey(colmap_scenes[0]))
    assert [row.name for row in rows] == sorted(name.lower() for name in PARAMS)
    assert {(row.num_images, row.image_size, row.num_missing) for row in rows} == {
        (5, (96, 128), 0)
    }
    (text_scene / "images" / "im 2.png").unlink()
    (row,) = survey(text_scene.parent)
    assert (row.num_images, row.num_missing, row.excluded) == (4, 1, "")


def test_numbers_in_names_are_ordered_by_their_value(text_scene):
    # 10 follows 4, so that the share held out is the end of the recording.
    spoil(text_scene, "im 1.png", "im 10.png")
    (text_scene / "images" / "im 1.png").rename(text_scene / "images" / "im 10.png")
    scene, _ = read_one(text_scene.parent)
    assert [frame.name for frame in scene.frames] == [f"im {n}.png" for n in (0, 2, 3, 4, 10)]


def test_scenes_are_named_before_they_are_read(colmap_scenes):
    root, written = colmap_scenes
    names = assert_scenes_are_named_before_they_are_read("folder", root)
    assert names == sorted(name.lower() for name in written)
