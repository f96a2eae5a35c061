"""MegaDepth's archives: intrinsics, scenes, splits, what is left out."""

import pickle
import shutil

import cv2
import numpy as np
import pycolmap
import pytest

from data_prep.converters import read_scenes
from data_prep.converters.lens import build_lens
from data_prep.converters.megadepth import read, survey
from data_prep.converters.megadepth.depth import drop_outliers, read_depth
from data_prep.converters.megadepth.intrinsics import undistorted_K
from data_prep.converters.megadepth.splits import CLEAN, excluded_because, is_in
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.folder.analytic import photograph_pinhole, shift_between
from tests.data_prep.folder.geometry import HALF, agree, view_of
from tests.data_prep.megadepth.writers import LENS, RAW, write_depth
from tests.data_prep.naming import assert_scenes_are_named_before_they_are_read


@pytest.fixture
def spoilable(merged, tmp_path):
    """A copy of it that a test may change."""
    shutil.copytree(merged[0] / "0001", tmp_path / "0001")
    return tmp_path


def read_one(root, split="train", **options):
    problems = Problems()
    (scene,) = read(root, split, problems=problems, **options)
    return scene, problems


def test_a_reconstruction_is_read(merged):
    scene, problems = read_one(merged[0])
    assert problems.summary() == "none"
    assert (scene.dataset, scene.name, scene.is_metric) == ("megadepth", "0001/dense0", False)
    assert [frame.name for frame in scene.frames] == [f"{n}_photo_o.png" for n in range(3)]
    assert not scene.has_sparse_depth


def test_intrinsics_are_those_of_the_image_that_colmap_undistorted(merged):
    scene, _ = read_one(merged[0])
    for frame, pinhole in zip(scene.frames, merged[1][1], strict=True):
        assert frame.image_size == (pinhole.height, pinhole.width)
        np.testing.assert_allclose(frame.K, pinhole.calibration_matrix(), rtol=1e-3)
        image = frame.read_image()
        expected, _ = photograph_pinhole(frame.K, frame.world_from_cam, frame.image_size)
        assert shift_between(image, expected) < 0.1
        # Half a pixel, and the focal length and size of the photo as it was uploaded, are seen.
        scale = max(frame.image_size) / max(RAW)
        f, cx, cy, _ = LENS
        raw = np.array([[scale * f, 0, scale * cx], [0, scale * f, scale * cy], [0, 0, 1]])
        for K in (frame.K - HALF, frame.K + HALF, raw):
            planted, _ = photograph_pinhole(K, frame.world_from_cam, frame.image_size)
            assert shift_between(image, planted) > 0.5


@pytest.mark.parametrize("k", [-0.2, -0.05, 0.0, 0.02, 0.1])
@pytest.mark.parametrize("longest", [1600, 900])
def test_intrinsics_agree_with_opencv_s_way_shifted_by_half_a_pixel(k, longest):
    params = (1800.0, 1000.0, 750.0, k)
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=2000, height=1500, params=params)
    target = pycolmap.undistort_camera(
        pycolmap.UndistortCameraOptions(max_image_size=longest), camera
    )
    integer_centers = np.array([[1800, 0, 999.5], [0, 1800, 749.5], [0, 0, 1]])
    expected, _ = cv2.getOptimalNewCameraMatrix(
        integer_centers,
        np.array([k, 0, 0, 0]),
        (2000, 1500),
        0,
        (target.width, target.height),
        centerPrincipalPoint=True,
    )
    lens = build_lens("SIMPLE_RADIAL", (1500, 2000), params)
    found = undistorted_K(lens, (target.height, target.width))
    np.testing.assert_allclose(found[:2, 2], expected[:2, 2] + 0.5, atol=1e-6)
    np.testing.assert_allclose(np.diag(found), np.diag(expected), rtol=2e-3)
    np.testing.assert_allclose(found, target.calibration_matrix(), rtol=1e-3)


def test_depth_agrees_between_images_and_mistakes_are_seen(merged):
    scene, _ = read_one(merged[0])
    first, second = (view_of(frame) for frame in scene.frames[:2])
    as_read = agree(first, second, step=1)
    assert as_read.share > 0.6
    assert as_read.depth < 0.002
    turned = [
        view.__class__(view.image, view.K, np.linalg.inv(view.world_from_cam), view.depth)
        for view in (first, second)
    ]
    assert agree(*turned, step=1).share < 0.3


def test_depth_is_z_with_zero_where_unknown(merged):
    scene, _ = read_one(merged[0])
    depth = scene.frames[0].read_depth()
    assert (depth[:4] == 0).all()
    assert (depth[4:] > 0).all()
    frame = scene.frames[0]
    _, exact = photograph_pinhole(frame.K, frame.world_from_cam, frame.image_size)
    assert np.median(np.abs(depth / exact - 1)[4:]) < 2e-3


def test_overlap_is_that_of_shared_points(merged):
    scene, _ = read_one(merged[0])
    sets = [set() for _ in scene.frames]
    for number, track in enumerate(merged[1][2]):
        for view, _ in track:
            sets[view].add(number)
    expected = [[len(a & b) / len(a | b) for b in sets] for a in sets]
    np.testing.assert_allclose(scene.read_overlap().toarray(), expected, atol=1e-12)
    part, _ = read_one(merged[0], frame_step=2)
    found = part.read_overlap().toarray()
    np.testing.assert_allclose(found, np.array(expected)[::2, ::2], atol=1e-12)


def test_scenes_travel_to_other_processes(merged):
    scene, _ = read_one(merged[0])
    copy = pickle.loads(pickle.dumps(scene))
    np.testing.assert_array_equal(copy.frames[1].read_image(), scene.frames[1].read_image())
    np.testing.assert_array_equal(copy.read_overlap().toarray(), scene.read_overlap().toarray())


def test_two_reconstructions_of_a_scene_are_two_scenes(spoilable):
    scene = spoilable / "0001"
    shutil.copytree(scene / "dense0", scene / "dense1")
    shutil.copytree(scene / "sparse" / "manhattan" / "0", scene / "sparse" / "manhattan" / "1")
    scenes = list(read(spoilable, problems=Problems()))
    assert [scene.name for scene in scenes] == ["0001/dense0", "0001/dense1"]
    (scene,) = read(spoilable, scenes="*/dense1", problems=Problems())
    assert scene.name == "0001/dense1"


@pytest.mark.parametrize("v1", ["phoenix/S6/zl548/MegaDepth_v1", "MegaDepth_v1", ""])
def test_archives_side_by_side_are_found(merged, tmp_path, v1):
    source = merged[0] / "0001"
    shutil.copytree(source / "dense0", tmp_path / v1 / "0001" / "dense0")
    shutil.copytree(source / "sparse", tmp_path / "MegaDepth_v1_SfM" / "0001" / "sparse")
    assert len(read_one(tmp_path)[0].frames) == 3


def test_evaluation_scenes_are_excluded_with_the_reason(merged, tmp_path):
    for scene_id in ("0001", "0008", "0015", "0002", "5004", "5016"):
        shutil.copytree(merged[0] / "0001", tmp_path / scene_id)
    problems = Problems()
    names = [scene.name for scene in read(tmp_path, problems=problems)]
    assert (names, problems.summary()) == (["0001/dense0"], "4 excluded_scene")
    assert [scene.name for scene in read(tmp_path, "test", problems=problems)] == ["0015/dense0"]
    whole = read(tmp_path, "all", problems=Problems(), include_excluded=True)
    every = ["0001", "0002", "0008", "0015", "5004", "5016"]
    assert [scene.name[:4] for scene in whole] == every
    named = read_scenes("megadepth", tmp_path, "all", problems=Problems(), include_excluded=True)
    assert [scene.name[:4] for scene in named] == every
    reasons = {row.name[:4]: row.excluded for row in survey(tmp_path)}
    assert reasons["0001"] == ""
    assert "Image Matching Challenge" in reasons["0008"]
    assert "MegaDepth-1500" in reasons["0015"]
    assert "cleaned training list" in reasons["0002"]
    assert "Tanks and Temples" in reasons["5004"]


def test_the_training_list_holds_no_evaluation_scene():
    assert len(CLEAN) == 137
    assert not any(excluded_because(scene) for scene in CLEAN)
    assert all(is_in(scene, "train") and not is_in(scene, "test") for scene in CLEAN)
    assert all(excluded_because(f"{number:04d}") for number in range(5000, 5019))
    assert not excluded_because("harbour")


def spoil(root, number, depth):
    write_depth(root / "0001" / "dense0" / "depths" / f"{number}_photo_o.h5", depth)


def size_of(merged):
    pinhole = merged[1][1][0]
    return pinhole.height, pinhole.width


def test_ordinal_maps_are_dropped(merged, spoilable):
    labels = np.zeros(size_of(merged))
    labels[5:9], labels[20:40] = -2, -1
    spoil(spoilable, 1, labels)
    scene, problems = read_one(spoilable)
    assert [frame.name for frame in scene.frames] == ["0_photo_o.png", "2_photo_o.png"]
    assert problems.summary() == "1 ordinal_depth"
    with pytest.raises(DataError, match="ordinal labels"):
        read_depth(spoilable / "0001/dense0/depths/1_photo_o.h5", size_of(merged))


@pytest.mark.parametrize(
    ("make", "kind"),
    [(lambda size: np.zeros(size), "empty_depth"), (lambda size: np.ones((9, 9)), "size_mismatch")],
)
def test_maps_without_depth_or_of_another_size_are_counted(merged, spoilable, make, kind):
    spoil(spoilable, 1, make(size_of(merged)))
    scene, problems = read_one(spoilable)
    assert (len(scene.frames), problems.summary()) == (2, f"1 {kind}")


def test_missing_files_are_counted(spoilable):
    dense = spoilable / "0001" / "dense0"
    (dense / "imgs" / "0_photo_o.png").unlink()
    (dense / "depths" / "1_photo_o.h5").unlink()
    (dense / "imgs" / "._2_photo_o.png").write_bytes(b"\0\5\26\7")
    scene, problems = read_one(spoilable)
    assert [frame.name for frame in scene.frames] == ["2_photo_o.png"]
    assert problems.summary() == "1 missing_depth, 1 missing_photo"
    (row,) = survey(spoilable)
    assert (row.num_images, row.num_missing) == (1, 1)


def test_an_image_that_cannot_come_from_its_camera_is_counted(merged, spoilable):
    path = spoilable / "0001" / "dense0" / "imgs" / "1_photo_o.png"
    cv2.imwrite(str(path), cv2.imread(str(path)).transpose(1, 0, 2))
    spoil(spoilable, 1, np.ones(size_of(merged)[::-1]))
    scene, problems = read_one(spoilable)
    assert (len(scene.frames), problems.summary()) == (2, "1 bad_camera")
    assert "do not belong together" in problems.first["bad_camera"].detail


def test_a_model_that_is_missing_is_said(merged, spoilable):
    shutil.copytree(spoilable / "0001", spoilable / "0003")
    shutil.rmtree(spoilable / "0003" / "sparse")
    problems = Problems()
    assert [scene.name for scene in read(spoilable, problems=problems)] == ["0001/dense0"]
    assert problems.summary() == "1 missing_model"
    assert [row.excluded for row in survey(spoilable)] == ["", "no SfM model"]


def test_a_folder_without_megadepth_is_refused(tmp_path, merged):
    with pytest.raises(DataError, match="expected MegaDepth's"):
        list(read(tmp_path, problems=Problems()))
    with pytest.raises(DataError, match="no scene in split 'test'"):
        list(read(merged[0], "test", problems=Problems()))
    with pytest.raises(DataError, match="that matches '0003/"):
        list(read(merged[0], scenes="0003/*", problems=Problems()))


def test_depth_far_outside_an_image_s_own_is_dropped():
    depth = np.linspace(2, 6, 10_000, dtype=np.float32).reshape(100, 100)
    np.testing.assert_array_equal(drop_outliers(depth), depth)
    spoiled = depth.copy()
    spoiled[0, :5], spoiled[1, :5], spoiled[2, :5] = 50, 0.1, 0
    found = drop_outliers(spoiled)
    assert (found[:3, :5] == 0).all()
    np.testing.assert_array_equal(found[3:], depth[3:])
    assert not drop_outliers(np.zeros((4, 4), np.float32)).any()


def test_numbers_that_are_not_finite_are_unknown(merged, spoilable):
    depth = np.full(size_of(merged), 3.0)
    depth[0, :3] = np.nan, np.inf, -np.inf
    spoil(spoilable, 1, depth)
    scene, _ = read_one(spoilable)
    found = scene.frames[1].read_depth()
    assert (found[0, :3] == 0).all()
    assert (found[0, 3:] == 3).all()


def test_reconstructions_are_named_before_they_are_read(merged):
    assert assert_scenes_are_named_before_they_are_read("megadepth", merged[0]) == ["0001/dense0"]
