import subprocess
import sys

import pytest
import roma
import torch
from hypothesis import given
from hypothesis import strategies as st

from l3r.geometry.similarity import (
    Similarity,
    fit_residual,
    fit_similarity,
    identity_similarity,
)
from tests.geometry.scenes import generator, random_rotation
from tests.tolerance import TOLERANCE

CLOSE = TOLERANCE[torch.float64]
SEEDS = st.integers(0, 2**32 - 1)


def draw_similarity(draw, *batch, with_scale):
    scale = torch.ones(batch, dtype=torch.float64)
    if with_scale:
        scale = 0.2 + 4 * torch.rand(batch, generator=draw, dtype=torch.float64)
    t = 5 * torch.randn((*batch, 3), generator=draw, dtype=torch.float64)
    return Similarity(scale, random_rotation(*batch, draw=draw), t)


def draw_points(draw, *shape):
    points = torch.randn(*shape, 3, generator=draw, dtype=torch.float64)
    return points, torch.rand(shape, generator=draw, dtype=torch.float64) + 0.01


def assert_same(found, expected, tolerance=1e-8):
    for name in ("scale", "R", "t"):
        torch.testing.assert_close(
            getattr(found, name), getattr(expected, name), atol=tolerance, rtol=tolerance
        )


@given(SEEDS, st.booleans(), st.sampled_from([(), (3,), (2, 2)]), st.floats(1e-6, 1e6))
def test_the_fit_recovers_the_transform_that_made_the_points(seed, with_scale, batch, unit):
    draw = generator(seed)
    b_from_a = draw_similarity(draw, *batch, with_scale=with_scale)
    points, weights = draw_points(draw, *batch, 12)
    b_from_a = Similarity(b_from_a.scale, b_from_a.R, b_from_a.t * unit)
    points = points * unit
    fit = fit_similarity(b_from_a.transform(points), points, weights, with_scale=with_scale)
    torch.testing.assert_close(fit.R, b_from_a.R, atol=1e-8, rtol=0)
    torch.testing.assert_close(fit.scale, b_from_a.scale, atol=0, rtol=1e-8)
    torch.testing.assert_close(fit.t, b_from_a.t, atol=1e-7 * unit, rtol=1e-8)
    residual = fit_residual(fit, b_from_a.transform(points), points, weights)
    assert float(residual.max()) < 1e-8 * unit


@given(SEEDS, st.booleans())
def test_a_reflection_is_never_returned(seed, with_scale):
    draw = generator(seed)
    points, weights = draw_points(draw, 4, 10)
    mirrored = points * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    fit = fit_similarity(mirrored, points, weights, with_scale=with_scale)
    torch.testing.assert_close(torch.linalg.det(fit.R), torch.ones(4, dtype=torch.float64))


@given(SEEDS, st.booleans())
def test_points_of_weight_zero_do_not_matter_even_if_nan(seed, with_scale):
    draw = generator(seed)
    target, weights = draw_points(draw, 2, 15)
    source, _ = draw_points(draw, 2, 15)
    weights[:, 9:] = 0
    spoiled = source.clone()
    spoiled[:, 9:12], spoiled[:, 12:] = torch.nan, 1e30
    expected = fit_similarity(target[:, :9], source[:, :9], weights[:, :9], with_scale=with_scale)
    assert_same(fit_similarity(target, spoiled, weights, with_scale=with_scale), expected)


@given(SEEDS)
def test_the_fit_is_the_best_rigid_transform(seed):
    draw = generator(seed)
    target, weights = draw_points(draw, 20)
    source, _ = draw_points(draw, 20)
    fit = fit_similarity(target, source, weights)
    best = fit_residual(fit, target, source, weights)
    nudge = roma.rotvec_to_rotmat(0.02 * torch.randn(30, 3, generator=draw, dtype=torch.float64))
    for R in nudge:
        center = (weights[:, None] * source).sum(0) / weights.sum()
        turned = Similarity(fit.scale, fit.R @ R, fit.t + fit.R @ (center - R @ center))
        assert float(fit_residual(turned, target, source, weights)) >= float(best) - 1e-12


@given(SEEDS)
def test_moving_the_target_moves_the_fit(seed):
    """The law that lets accumulation fit all edges before any is chained."""
    draw = generator(seed)
    target, weights = draw_points(draw, 20)
    source, _ = draw_points(draw, 20)
    c_from_b = draw_similarity(draw, with_scale=False)
    moved = fit_similarity(c_from_b.transform(target), source, weights)
    assert_same(moved, c_from_b.compose(fit_similarity(target, source, weights)))


@given(SEEDS)
def test_compose_and_invert_are_those_of_the_group(seed):
    draw = generator(seed)
    a, b = (draw_similarity(draw, 3, with_scale=True) for _ in range(2))
    points, _ = draw_points(draw, 3, 5)
    torch.testing.assert_close(a.compose(b).transform(points), a.transform(b.transform(points)))
    assert_same(a.compose(a.invert()), identity_similarity(3, like=points))
    assert torch.equal(a.rigid()[:, :3, :3], a.R)


@pytest.mark.parametrize("with_scale", [False, True])
def test_gradients_match_finite_differences(with_scale):
    draw = generator(3)
    target, weights = draw_points(draw, 2, 6)
    source, _ = draw_points(draw, 2, 6)
    inputs = [x.requires_grad_() for x in (target, source, weights)]

    def fit(b, a, w):
        found = fit_similarity(b, a, w, with_scale=with_scale)
        return found.scale, found.R, found.t

    assert torch.autograd.gradcheck(fit, inputs)


@pytest.mark.parametrize("with_scale", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", ["no weight", "coincident", "nan at weight 0", "line", "plane"])
def test_degenerate_points_give_finite_answers_and_gradients(case, dtype, with_scale):
    draw = generator(5)
    target, source = (torch.randn(2, 9, 3, generator=draw, dtype=dtype) for _ in range(2))
    weights = torch.rand(2, 9, generator=draw, dtype=dtype)
    if case == "no weight":
        weights = torch.zeros_like(weights)
    elif case == "coincident":
        source = source[:, :1].expand_as(source).clone()
    elif case == "nan at weight 0":
        source[:, 4], weights[:, 4] = torch.nan, 0
    else:
        source = source * torch.tensor([1, float(case == "plane"), 0], dtype=dtype)
        target = source.clone()
    inputs = [x.requires_grad_() for x in (target, source, weights)]
    fit = fit_similarity(*inputs, with_scale=with_scale)
    (fit.scale.sum() + (fit.R * torch.arange(9.0).reshape(3, 3)).sum() + fit.t.sum()).backward()
    for value in (fit.scale, fit.R, fit.t, *(x.grad for x in inputs)):
        assert value.isfinite().all()
    torch.testing.assert_close(torch.linalg.det(fit.R), torch.ones(2, dtype=dtype))
    if case == "coincident":
        assert fit.scale.tolist() == [1, 1]


def test_a_fit_made_in_inference_mode_does_not_spoil_later_training():
    """In a process of its own: what roma keeps between calls must be made by the first fit."""
    program = (
        "import torch; from l3r.geometry.similarity import fit_similarity as fit\n"
        "b, a, w = torch.rand(1, 9, 3), torch.rand(1, 9, 3), torch.ones(1, 9)\n"
        "with torch.inference_mode(): fit(b, a, w)\n"
        "a.requires_grad_()\n"
        "fit(b, a, w).transform(a).sum().backward()\n"
        "assert a.grad.isfinite().all()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
