"""With true point maps, tree, accumulation and PnP must give back the true cameras."""

import cv2
import numpy as np
import pytest
import torch

from l3r.config import GraphConfig, InferenceConfig
from l3r.geometry.camera import pixel_centers, resize_K
from l3r.geometry.rigid import invert_rigid, rotation_angle
from l3r.geometry.similarity import fit_similarity
from l3r.inference.clock import StageClock
from l3r.inference.reconstruct import reconstruct_photos
from l3r.types import Photos
from tests.geometry.scenes import generator, random_rigid
from tests.inference.oracle import OracleNetwork, numbered_images

SIZES = [(48, 64), (64, 48), (48, 64), (40, 64), (48, 64), (64, 48), (48, 48), (48, 64)]


def analytic_depth(height, width, K, view):
    """Wavy surfaces: depth in closed form at every pixel centre."""
    x, y = pixel_centers(height, width, like=K).T
    wave = torch.sin(0.21 * x + view) + torch.cos(0.17 * y - 0.5 * view)
    return (4 + wave).reshape(height, width)


def assert_cameras_are_true(scene, world_from_cam):
    assert scene.cameras.registered.all()
    truth = invert_rigid(world_from_cam)
    found = scene.cameras.cam_from_world
    centers, true_centers = (invert_rigid(c)[:, :3, 3] for c in (found, truth))
    aligned = fit_similarity(
        true_centers, centers, torch.ones(len(centers)).double(), with_scale=True
    )
    size = (true_centers - true_centers.mean(0)).norm(dim=-1).max()
    error = (aligned.transform(centers) - true_centers).norm(dim=-1)
    assert float(error.max() / size) < 1e-3
    assert float(aligned.scale) == pytest.approx(1, abs=1e-3)  # rigid chains keep the unit
    relative = found @ invert_rigid(found[:1])
    expected = truth @ invert_rigid(truth[:1])
    angle = rotation_angle(relative[:, :3, :3] @ expected[:, :3, :3].mT).rad2deg()
    assert float(angle.max()) < 0.1


def run_oracle(model, sizes, original_sizes, **settings):
    photos = Photos(
        image=numbered_images(sizes),
        original_size=original_sizes,
        file=[f"{view:02d}.jpg" for view in range(len(sizes))],
    )
    config = InferenceConfig(**settings)
    return reconstruct_photos(model, photos, config, StageClock(torch.device("cpu")))


@pytest.mark.parametrize("symmetrize", ["child", "both", "off"])
@pytest.mark.parametrize("algorithm", ["spt", "mst"])
def test_true_maps_of_mixed_shapes_give_true_cameras(algorithm, symmetrize):
    world_from_cam = random_rigid(len(SIZES), draw=generator(7))
    Ks, depths = [], []
    for view, (height, width) in enumerate(SIZES):
        focal = 50.0 + 3 * view
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]).double()
        Ks.append(K)
        depths.append(analytic_depth(height, width, K, view))
    model = OracleNetwork(depths, Ks, world_from_cam, GraphConfig(algorithm=algorithm))
    original = [(height * 5, width * 5) for height, width in SIZES]
    scene = run_oracle(model, SIZES, original, symmetrize=symmetrize, chunk_size=3)
    assert_cameras_are_true(scene, world_from_cam)
    expected = [5 * (50.0 + 3 * view) for view in range(len(SIZES))]
    assert scene.cameras.K[:, 0, 0].tolist() == pytest.approx(expected, rel=1e-5)
    assert scene.cameras.K[0, 0, 2] == 160
    if algorithm == "mst":
        assert scene.tree.num_levels > 2


def test_true_depth_of_a_genuine_trajectory_gives_its_cameras(shared):
    from data_prep.converters.tartanair import read

    (genuine,) = read(shared / "data" / "raw" / "tartanair_v1_seq", "all")
    frames = genuine.frames[::2]
    Ks, depths = [], []
    for frame in frames:
        depth = np.ascontiguousarray(frame.read_depth())
        height, width = depth.shape
        small = cv2.resize(depth, (64, 48), interpolation=cv2.INTER_NEAREST_EXACT)
        depths.append(torch.from_numpy(small).double())
        Ks.append(resize_K(torch.from_numpy(frame.K), 64 / width, 48 / height))
    world_from_cam = torch.stack([torch.from_numpy(frame.world_from_cam) for frame in frames])
    model = OracleNetwork(depths, Ks, world_from_cam)
    sizes = [(48, 64)] * len(frames)
    scene = run_oracle(model, sizes, sizes)
    assert_cameras_are_true(scene, world_from_cam)
    assert scene.cameras.K[:, 0, 0].tolist() == pytest.approx([32.0] * len(frames), rel=1e-3)
