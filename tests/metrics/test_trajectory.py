import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import procrustes
from scipy.spatial.transform import Rotation

from l3r.metrics.trajectory import ate, ate_rmse

SEEDS = st.integers(0, 2**31 - 1)


def centers(rng, n):
    return torch.from_numpy(rng.normal(size=(n, 3)))


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.integers(3, 12))
def test_ate_is_scipys_and_below_its_bound(seed, n):
    rng = np.random.default_rng(seed)
    pred, gt = centers(rng, n), centers(rng, n)
    standard_gt, standard_pred, _ = procrustes(gt.numpy(), pred.numpy())
    assert ate(pred, gt) == pytest.approx(np.sqrt(np.mean((standard_gt - standard_pred) ** 2)))
    assert ate(pred, gt) <= math.sqrt(1 / (3 * n)) + 1e-12


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(0.01, 100.0))
def test_both_ignore_a_similarity_and_the_order(seed, scale):
    rng = np.random.default_rng(seed)
    gt = centers(rng, 7)
    pred = gt + 0.1 * centers(rng, 7)
    R = torch.from_numpy(Rotation.random(rng=rng).as_matrix())
    moved = scale * pred @ R.T + torch.tensor([3.0, -2.0, 9.0]).double()
    order = torch.from_numpy(rng.permutation(7))
    for metric in (ate, ate_rmse):
        assert metric(moved, gt) == pytest.approx(metric(pred, gt), rel=1e-6)
        assert metric(pred[order], gt[order]) == pytest.approx(metric(pred, gt), rel=1e-9)


def test_a_perfect_path_has_no_error():
    gt = centers(np.random.default_rng(0), 5)
    assert ate(3 * gt + 1, gt) == pytest.approx(0, abs=1e-7)
    assert ate_rmse(3 * gt + 1, gt) == pytest.approx(0, abs=1e-9)


def test_ate_rmse_has_the_unit_of_the_ground_truth_and_refuses_mirrors():
    gt = centers(np.random.default_rng(0), 6)
    mirrored = gt * torch.tensor([1.0, 1.0, -1.0]).double()
    assert ate(mirrored, gt) == pytest.approx(0, abs=1e-7)
    assert ate_rmse(mirrored, gt) > 0.1
    noisy = gt + 0.01 * centers(np.random.default_rng(1), 6)
    assert ate_rmse(noisy, 1000 * gt) == pytest.approx(1000 * ate_rmse(noisy, gt))


def test_ate_rmse_of_one_known_offset():
    # A cross whose one arm is lifted; rotation and scale cannot help by symmetry of the rest.
    gt = torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]).double()
    pred = gt + torch.tensor([[0, 0, 0.1], [0, 0, 0.1], [0, 0, -0.1], [0, 0, -0.1]]).double()
    # The best scale s shrinks by 1 / 1.01: |gt - s pred|^2 = (1 - s)^2 + (0.1 s)^2 each.
    s = 1 / 1.01
    assert ate_rmse(pred, gt) == pytest.approx(math.sqrt((1 - s) ** 2 + (0.1 * s) ** 2))


@pytest.mark.parametrize("metric", [ate, ate_rmse])
def test_degenerate_sets_are_nan(metric):
    good = centers(np.random.default_rng(0), 4)
    still = torch.full((4, 3), 7.3).double()
    assert math.isnan(metric(good[:2], good[:2]))
    assert math.isnan(metric(still, good))
    assert math.isnan(metric(good, still))
    assert math.isnan(metric(good[:0], good[:0]))
