"""The genuine pair: two photos with depth, and the index that names them."""

from dataclasses import replace

import numpy as np
import pytest

from data_prep.converters.megadepth import read
from data_prep.converters.megadepth.depth import load_depth
from data_prep.converters.megadepth.scene_info import read_scene_info
from data_prep.problems import Problems
from tests.data_prep.folder.geometry import (
    HALF,
    agree,
    interpolate,
    match,
    sampson,
    transfer,
    view_of,
)


@pytest.fixture(scope="module")
def scene(shared):
    root = shared / "data" / "raw" / "megadepth"
    problems = Problems()
    (scene,) = read(root / "loftr_pytorch_sample", problems=problems)
    assert problems.summary() == "334 missing_photo"
    return scene


@pytest.fixture(scope="module")
def pair(scene):
    return [view_of(frame) for frame in scene.frames]


@pytest.fixture(scope="module")
def matches(pair):
    return match(*pair, count=2000)


def miss(pair, matches):
    """Median distance of matches from where depth says they are [px of the second image]."""
    first, second = pair
    z = interpolate(first.depth, matches[0])
    known = z > 0
    there, _ = transfer(first, second, matches[0][known], z[known])
    distance = np.linalg.norm(there - matches[1][known], axis=-1)
    return (distance < 5).mean(), np.median(
        distance[distance < 5]
    ) if distance.min() < 5 else np.inf


def test_the_pair_is_read(scene):
    assert [frame.image_size for frame in scene.frames] == [(1600, 1194), (827, 1242)]
    assert not scene.is_metric
    for frame in scene.frames:
        height, width = frame.image_size
        # Where COLMAP's own convention put it: nothing is shifted.
        assert (frame.K[0, 2], frame.K[1, 2]) == (width / 2, height / 2)
        depth = frame.read_depth()
        assert 0.3 < (depth > 0).mean() < 0.46
        assert frame.read_image().shape == (height, width, 3)


def test_depth_agrees_there_and_back(pair):
    there, back = agree(*pair), agree(*pair[::-1])
    assert there.share > 0.94
    assert there.depth < 0.0003
    assert there.pixels < 0.05
    assert back.share > 0.3
    assert back.depth < 0.0003


def test_half_a_pixel_is_seen_by_matched_features(pair, matches):
    share, distance = miss(pair, matches)
    assert share > 0.8
    assert distance < 0.3
    assert sampson(*pair, *matches)[1] < 0.17
    for off in (-HALF, HALF):
        planted = [replace(view, K=view.K + off) for view in pair]
        assert miss(planted, matches)[1] > 1.5 * distance
        assert sampson(*planted, *matches)[1] > 0.3


def test_a_camera_turned_about_is_seen(pair, matches):
    turned = [replace(view, world_from_cam=np.linalg.inv(view.world_from_cam)) for view in pair]
    assert agree(*turned).share < 0.001
    assert miss(turned, matches)[0] < 0.01
    assert sampson(*turned, *matches)[0] < 0.05


def test_the_focal_length_of_a_distorted_photo_is_seen(pair, matches):
    # A coefficient of -0.1 enlarges the undistorted image by 3%, the focal length stays.
    spoiled = replace(pair[0], K=np.diag([1 / 1.03, 1 / 1.03, 1]) @ pair[0].K)
    spoiled.K[:2, 2] = pair[0].K[:2, 2]
    distance = miss(pair, matches)[1]
    assert miss([spoiled, pair[1]], matches)[1] > 4 * distance
    assert agree(spoiled, pair[1]).depth > 2 * agree(*pair).depth


def test_range_in_place_of_z_is_seen(pair):
    def bend(view):
        y, x = np.mgrid[: view.depth.shape[0], : view.depth.shape[1]] + 0.5
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(view.K).T
        return replace(view, depth=view.depth * np.linalg.norm(rays, axis=-1))

    assert agree(*map(bend, pair)).depth > 3 * agree(*pair).depth


def test_a_cut_at_percentiles_would_lose_good_depth(scene, pair):
    path = scene.frames[0].read_depth.args[0]
    whole = load_depth(path, scene.frames[0].image_size)
    np.testing.assert_array_equal(pair[0].depth, whole)
    far = np.where(whole > np.percentile(whole[whole > 0], 98), whole, 0)
    assert agree(replace(pair[0], depth=far), pair[1], step=2).of_known > 0.995


def test_the_genuine_index_of_the_test_pairs_is_read(shared):
    folder = shared / "data" / "raw" / "megadepth" / "scene_info_1500"
    problems = Problems()
    images = read_scene_info(folder / "0022_0.5_0.7.npz", problems)
    assert problems.summary() == "none"
    assert len(images) == 553
    assert {image.part for image in images} == {"0022/dense0"}
    R = np.stack([image.cam_from_world[:3, :3] for image in images])
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (553, 1, 1)), atol=1e-6)
