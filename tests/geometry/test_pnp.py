import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from l3r.geometry.camera import project
from l3r.geometry.pnp import fit_camera
from l3r.geometry.rigid import invert_rigid, rotation_angle, transform_points
from tests.geometry.scenes import generator, random_K, random_rigid

SEEDS = st.integers(0, 2**32 - 1)


def scene(seed, num_points=80, unit=1.0):
    draw = generator(seed)
    K, cam_from_world = random_K(draw=draw), random_rigid(draw=draw)
    cam_from_world[:3, 3] *= unit
    pts2d = torch.rand(num_points, 2, generator=draw, dtype=torch.float64)
    pts2d = pts2d * torch.tensor([64.0, 48.0])
    depth = unit * (1 + 4 * torch.rand(num_points, 1, generator=draw, dtype=torch.float64))
    rays = torch.cat([pts2d, torch.ones_like(depth)], -1) @ torch.linalg.inv(K).T
    return transform_points(invert_rigid(cam_from_world), rays * depth), pts2d, K, cam_from_world


def angle_deg(a, b):
    return float(rotation_angle(a[:3, :3] @ b[:3, :3].T).rad2deg())


@settings(max_examples=20)
@given(SEEDS, st.sampled_from([1e-3, 1.0, 1e4]))
def test_exact_points_of_any_unit_give_the_exact_camera(seed, unit):
    pts3d, pts2d, K, truth = scene(seed, unit=unit)
    fit = fit_camera(pts3d, pts2d, K, max_error_px=0.5)
    assert fit.inlier_share == 1
    assert angle_deg(fit.cam_from_world, truth) < 1e-4
    assert float((fit.cam_from_world - truth)[:3, 3].norm()) < 1e-5 * unit


@settings(max_examples=20)
@given(SEEDS)
def test_forty_percent_of_outliers_are_outvoted(seed):
    pts3d, pts2d, K, truth = scene(seed)
    pts2d[:32] = torch.rand(32, 2, generator=generator(seed + 1)).double() * 48
    fit = fit_camera(pts3d, pts2d, K, max_error_px=0.5)
    assert angle_deg(fit.cam_from_world, truth) < 0.5
    reprojected, _ = project(transform_points(fit.cam_from_world, pts3d[32:]), K)
    assert float((reprojected - pts2d[32:]).norm(dim=-1).median()) < 0.1


def test_the_same_seed_gives_the_same_camera():
    pts3d, pts2d, K, _ = scene(4)
    pts2d = pts2d + torch.randn(pts2d.shape, generator=generator(9)).double()
    first, second = (fit_camera(pts3d, pts2d, K, max_error_px=2.0) for _ in range(2))
    assert torch.equal(first.cam_from_world, second.cam_from_world)


def test_nothing_to_fit_gives_none():
    pts3d, pts2d, K, _ = scene(4)
    assert fit_camera(pts3d[:3], pts2d[:3], K, max_error_px=1.0) is None
    assert fit_camera(pts3d[:1].expand(40, 3), pts2d[:40], K, max_error_px=0.01) is None
