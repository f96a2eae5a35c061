import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from l3r.geometry.camera import pixel_centers
from l3r.geometry.focal import fit_focal
from tests.geometry.scenes import generator

SEEDS = st.integers(0, 2**32 - 1)


def view(draw, focal, height=24, width=32):
    pts2d = pixel_centers(height, width, like=torch.zeros(1, dtype=torch.float64))
    centered = pts2d - torch.tensor([width / 2, height / 2], dtype=torch.float64)
    depth = 1 + 4 * torch.rand(len(pts2d), generator=draw, dtype=torch.float64)
    pts3d = torch.cat([centered / focal, torch.ones_like(depth)[:, None]], -1) * depth[:, None]
    return pts3d, centered, torch.ones_like(depth)


@given(SEEDS, st.floats(8, 300), st.floats(1e-3, 1e3))
def test_exact_points_of_any_unit_give_the_exact_focal_length(seed, focal, unit):
    pts3d, centered, weights = view(generator(seed), focal)
    assert float(fit_focal(pts3d * unit, centered, weights)) == pytest.approx(focal, rel=1e-6)


@given(SEEDS, st.floats(0, 0.4))
@example(225, 0.3)  # their sum has its least at a focal length of 4
def test_forty_percent_of_outliers_near_the_camera_cost_nothing(seed, share):
    draw = generator(seed)
    pts3d, centered, weights = view(draw, 40.0)
    bad = torch.rand(len(pts3d), generator=draw) < share
    noise = torch.randn(len(pts3d), 3, generator=draw, dtype=torch.float64)
    pts3d = torch.where(bad[:, None], noise, pts3d)
    for rounds in (30, 300):
        focal = fit_focal(pts3d, centered, weights, num_iterations=rounds)
        assert float(focal) == pytest.approx(40, rel=1e-6)


def test_padded_points_and_points_behind_the_camera_are_left_out():
    pts3d, centered, weights = view(generator(1), 40.0)
    pts3d[:50] *= -1
    pts3d[50:90], weights[50:90] = torch.nan, 0
    assert float(fit_focal(pts3d, centered, weights)) == pytest.approx(40, rel=1e-6)


def test_items_of_a_batch_do_not_touch_each_other():
    one, two = view(generator(1), 20.0), view(generator(2), 60.0)
    both = [torch.stack(pair) for pair in zip(one, two, strict=True)]
    assert fit_focal(*both).tolist() == pytest.approx([20, 60], rel=1e-6)


def test_no_usable_point_gives_nan():
    pts3d, centered, weights = view(generator(1), 20.0)
    assert fit_focal(-pts3d, centered, weights).isnan()
    assert fit_focal(pts3d, centered, weights * 0).isnan()
