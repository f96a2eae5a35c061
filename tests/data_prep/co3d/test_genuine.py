"""Genuine CO3D images with genuine cameras, judged by matches that never saw the cameras."""

import json
import shutil
import zlib
from itertools import pairwise

import cv2
import numpy as np
import pytest

from data_prep.converters.co3d import Options, read, survey
from data_prep.converters.co3d.annotations import group_frames
from data_prep.converters.co3d.frames import Needs
from data_prep.converters.co3d.pixels import read_mask
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.co3d import mistakes
from tests.data_prep.co3d.writer import write_jgz

SHRINK = 2
CHOSEN = 8
"""Frames compared, each with the next."""


@pytest.fixture(scope="module")
def apple_root(shared, tmp_path_factory):
    """The layout with the genuine images in their place."""
    source = shared / "data" / "raw" / "co3d"
    root = tmp_path_factory.mktemp("apple")
    shutil.copytree(
        source / "derived_co3d_root" / "apple", root / "apple", copy_function=shutil.copyfile
    )
    root.joinpath("apple").chmod(0o755)
    images = root / "apple" / "posediffusion" / "images"
    images.mkdir(parents=True)
    for image in (source / "posediffusion_apple").glob("*.jpg"):
        (images / image.name).symlink_to(image)
    return root


def records_of(root):
    """The annotations as they are, decoded here."""
    return json.loads(zlib.decompress((root / "apple" / "frame_annotations.jgz").read_bytes(), 31))


def read_one(root, **options):
    options["options"] = Options(needs=Needs(depth=False))
    (scene,) = read(root, problems=Problems(), **options)
    return scene


@pytest.fixture(scope="module")
def apple(apple_root):
    """The genuine sequence; it has no depth."""
    return read_one(apple_root)


@pytest.fixture(scope="module")
def matches(apple):
    """Matching pixels of neighbouring frames, chosen by RANSAC on the matches alone."""
    sift = cv2.SIFT_create(3000)
    features = []
    for frame in apple.frames[:CHOSEN]:
        gray = cv2.cvtColor(frame.read_image(), cv2.COLOR_RGB2GRAY)
        small = cv2.resize(gray, None, fx=1 / SHRINK, fy=1 / SHRINK, interpolation=cv2.INTER_AREA)
        points, descriptors = sift.detectAndCompute(small, None)
        # OpenCV's key points have the centre of the top-left pixel at (0, 0).
        features.append((SHRINK * (cv2.KeyPoint_convert(points).astype(float) + 0.5), descriptors))
    found = []
    cv2.setRNGSeed(0)
    for (here, a), (there, b) in pairwise(features):
        near = cv2.BFMatcher().knnMatch(a, b, k=2)
        good = [m for m, n in near if m.distance < 0.75 * n.distance]
        left = here[[m.queryIdx for m in good]]
        right = there[[m.trainIdx for m in good]]
        _, inlier = cv2.findFundamentalMat(left, right, cv2.USAC_MAGSAC, 1.5, 0.9999, 5000)
        keep = inlier.ravel() > 0
        found.append((left[keep], right[keep]))
    return found


def epipolar_error(matches, cameras):
    """Median over all matches of the Sampson distance [px]."""
    errors = []
    for (left, right), (first, second) in zip(matches, pairwise(cameras), strict=True):
        (K1, world_from_1), (K2, world_from_2) = first, second
        two_from_one = np.linalg.inv(world_from_2) @ world_from_1
        x, y, z = two_from_one[:3, 3]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        F = np.linalg.inv(K2).T @ cross @ two_from_one[:3, :3] @ np.linalg.inv(K1)
        a = np.c_[left, np.ones(len(left))]
        b = np.c_[right, np.ones(len(right))]
        Fa, Fb = a @ F.T, b @ F
        squared = (b * Fa).sum(1) ** 2 / (
            Fa[:, 0] ** 2 + Fa[:, 1] ** 2 + Fb[:, 0] ** 2 + Fb[:, 1] ** 2
        )
        errors.append(np.sqrt(squared))
    return float(np.median(np.concatenate(errors)))


def cameras_of(scene):
    return [(frame.K, frame.world_from_cam) for frame in scene.frames[:CHOSEN]]


def test_genuine_cameras_agree_with_matches_of_the_images(matches, apple):
    assert sum(len(left) for left, _ in matches) > 400
    # 0.49 px at 1066x1896, 0.26 px at the 1,024 pixels photos are usually judged at.
    assert epipolar_error(matches, cameras_of(apple)) < 0.6


@pytest.mark.parametrize(
    "mistake",
    [mistakes.column_vectors, mistakes.opencv_axes, mistakes.other_unit, mistakes.no_unit],
)
def test_any_other_convention_contradicts_the_images(matches, apple, apple_root, tmp_path, mistake):
    root = shutil.copytree(apple_root, tmp_path / "root", symlinks=True)
    mistakes.plant(root, records_of(root), mistake)
    planted = read_one(root)
    assert epipolar_error(matches, cameras_of(planted)) > 20 * epipolar_error(
        matches, cameras_of(apple)
    )


def test_portrait_images_stay_upright(apple):
    assert (apple.name, len(apple.frames), apple.is_metric) == ("apple/posediffusion", 20, False)
    for frame in apple.frames[::7]:
        image = frame.read_image()
        assert image.shape == (1896, 1066, 3)
        assert frame.image_size == (1896, 1066)
        assert frame.K[0, 2] < frame.K[1, 2]
    red, _, blue = apple.frames[0].read_image()[650:750, 500:700].reshape(-1, 3).mean(0)
    assert red > 2.5 * blue, "the apple is in the upper half"
    assert not apple.frames[0].read_depth().any()


def test_frames_come_by_number_and_every_other_on_request(apple, apple_root):
    assert [frame.name for frame in apple.frames[:3]] == [
        "frame000007.jpg",
        "frame000012.jpg",
        "frame000017.jpg",
    ]
    thinned = read_one(apple_root, frame_step=9)
    assert [frame.name for frame in thinned.frames] == [
        "frame000007.jpg",
        "frame000077.jpg",
        "frame000191.jpg",
    ]


def test_a_sequence_without_depth_trains_nothing(apple_root):
    problems = Problems()
    with pytest.raises(DataError, match="20 missing_depth"):
        list(read(apple_root, problems=problems))
    assert problems.counts == {"missing_depth": 20, "empty_scene": 1}


def test_the_one_genuine_record_is_understood(shared, tmp_path):
    source = shared / "data" / "raw" / "co3d" / "one_genuine_frame_annotation.json"
    write_jgz(tmp_path / "frame_annotations.jgz", [json.loads(source.read_text())])
    problems = Problems()
    ((name, (record,)),) = group_frames(
        tmp_path / "frame_annotations.jgz", lambda name: True, problems
    )
    assert (name, record.number, record.image_size) == ("110_13051_23361", 1, (640, 479))
    base = "apple/110_13051_23361"
    assert record.depth_path == f"{base}/depths/frame000001.jpg.geometric.png"
    assert record.depth_mask_path == f"{base}/depth_masks/frame000001.png"
    assert record.mask_path == f"{base}/masks/frame000001.png"
    assert record.scale_adjustment == 1
    assert not problems.counts


def test_genuine_folders_are_listed_from_their_files(shared, apple_root):
    root = shared / "data" / "raw" / "co3d" / "relpose_subset"
    (plant,) = survey(root)
    assert (plant.name, plant.num_images, plant.num_missing) == ("plant/374_41993_84073", 0, 10)
    assert plant.image_size == (1265, 711)
    assert plant.excluded == "no frame annotations"
    (apple,) = survey(apple_root)
    assert (apple.num_images, apple.num_missing, apple.excluded) == (0, 20, "")


def test_genuine_masks_are_read(shared):
    folder = shared / "data" / "raw" / "co3d" / "relpose_subset" / "plant" / "374_41993_84073"
    mask = read_mask(folder / "masks" / "frame000001.png", (1265, 711), 0.5)
    assert 0.05 < mask.mean() < 0.95
    assert mask[600:660, 330:380].mean() > 2 * mask[:60, :60].mean()
