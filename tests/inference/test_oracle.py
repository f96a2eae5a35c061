"""With true point maps, tree, accumulation and PnP must give back the true cameras."""

import cv2
import numpy as np
import pycolmap
import pytest
import torch

from l3r.config import EncoderConfig, GraphConfig, InferenceConfig, ModelConfig
from l3r.export.colmap import write_colmap
from l3r.export.points import PointSelection
from l3r.geometry.camera import crop_K, pixel_centers, resize_K, transpose_K
from l3r.geometry.rigid import invert_rigid, rotation_angle
from l3r.geometry.similarity import fit_similarity
from l3r.inference.clock import StageClock
from l3r.inference.framing import choose_framing
from l3r.inference.reconstruct import reconstruct_photos, reconstruct_views
from l3r.types import Photos, Views, Window
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


def run_oracle(model, sizes, original_sizes, windows=None, **settings):
    photos = Photos(
        image=numbered_images(sizes),
        original_size=original_sizes,
        window=windows or [Window.whole(*size) for size in original_sizes],
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


def photographed(original, focal):
    """K of a whole photo; the principal point is its centre."""
    height, width = original
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]).double()


@pytest.mark.parametrize("image_size", [[64, 64], [48, 64]])
def test_true_maps_of_cut_photos_give_the_cameras_of_the_whole_ones(tmp_path, image_size):
    """Photos of many shapes, odd sides among them, framed as the released loader frames them."""
    encoder = EncoderConfig(patch_size=8, width=16, depth=1, num_heads=1)
    config = ModelConfig(encoder=encoder, image_size=image_size)
    originals = [(301, 517), (640, 427), (400, 400), (333, 1001)]
    world_from_cam = random_rigid(len(originals), draw=generator(11))
    focals = [0.9 * max(original) + 10 * view for view, original in enumerate(originals)]
    sizes, windows, Ks, depths = [], [], [], []
    for view, (original, focal) in enumerate(zip(originals, focals, strict=True)):
        framing = choose_framing(*original, config, "official")
        (height, width), window = framing.size, framing.window(*original)
        cut = crop_K(photographed(original, focal), window.left, window.top)
        K = resize_K(cut, width / window.width, height / window.height)
        sizes.append((height, width))
        windows.append(window)
        Ks.append(K)
        depths.append(analytic_depth(height, width, K, view))
    model = OracleNetwork(depths, Ks, world_from_cam)
    scene = run_oracle(model, sizes, originals, windows)
    assert_cameras_are_true(scene, world_from_cam)
    assert scene.window == windows
    expected = torch.stack([photographed(o, f) for o, f in zip(originals, focals, strict=True)])
    torch.testing.assert_close(scene.cameras.K, expected, rtol=1e-5, atol=1e-9)
    write_colmap(tmp_path / "0", scene, PointSelection(max_points=3000))
    model = pycolmap.Reconstruction(tmp_path / "0")
    assert model.num_reg_images() == len(originals)
    for number, image in model.images.items():
        height, width = originals[number - 1]
        assert (image.camera.height, image.camera.width) == (height, width)
        left, top, *extent = windows[number - 1]
        xy = np.stack([point.xy for point in image.points2D])
        # All over what the network saw, and nowhere else.
        assert (xy.min(0) > [left, top]).all()
        assert (xy.max(0) < np.add([left, top], extent)).all()
        assert (np.ptp(xy, axis=0) > 0.9 * np.array(extent)).all()
        points = np.stack([model.point3D(point.point3D_id).xyz for point in image.points2D])
        in_photo = image.camera.img_from_cam(image.cam_from_world() * points)
        assert np.abs(in_photo - xy).max() < 0.1  # a pixel of the network is 5 to 12 of these


def test_transposed_images_of_a_training_batch_go_in_upright():
    world_from_cam = random_rigid(5, draw=generator(13))
    true_shape = [(48, 64), (64, 48), (48, 64), (64, 48), (64, 48)]
    Ks = [photographed(shape, 50.0 + 3 * view) for view, shape in enumerate(true_shape)]
    depths = [
        analytic_depth(*shape, K, view)
        for view, (shape, K) in enumerate(zip(true_shape, Ks, strict=True))
    ]
    images = numbered_images(true_shape)
    is_portrait = [height > width for height, width in true_shape]

    def laid_out(tensors):
        return [t.mT if turn else t for t, turn in zip(tensors, is_portrait, strict=True)]

    for view, image in enumerate(images):
        image[1] = torch.arange(image.shape[1])[:, None] / 64
        image[2] = view / 8
    depth = torch.stack(laid_out(depths))
    turned_Ks = [transpose_K(K) if turn else K for K, turn in zip(Ks, is_portrait, strict=True)]
    views = Views(
        image=torch.stack(laid_out(images))[None],
        true_shape=torch.tensor([true_shape]),
        K=torch.stack(turned_Ks)[None],
        world_from_cam=world_from_cam[None],
        depth=depth[None],
        valid=depth[None] > 0,
        is_metric=torch.tensor([True]),
        dataset=["waves"],
        scores=torch.eye(5)[None],
        key=["waves"],
    )
    model = OracleNetwork(depths, Ks, world_from_cam)
    ((scene, truth),) = reconstruct_views(model, views, InferenceConfig())
    assert scene.cameras.image_size == true_shape
    assert all(torch.equal(a, b) for a, b in zip(scene.image, images, strict=True))
    assert_cameras_are_true(scene, invert_rigid(truth))
    torch.testing.assert_close(scene.cameras.K, torch.stack(Ks), rtol=1e-5, atol=1e-9)


def test_true_depth_of_a_genuine_trajectory_gives_its_cameras(shared):
    from data_prep.converters.tartanair import read
    from data_prep.problems import Problems

    root = shared / "data" / "raw" / "tartanair_v1_seq"
    (genuine,) = read(root, "all", problems=Problems())
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
