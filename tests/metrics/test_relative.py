import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l3r.geometry.rigid import invert_rigid, rigid_from_parts
from l3r.metrics.relative import maa, maa_min, pair_errors, rra, rta, short_baselines

SEEDS = st.integers(0, 2**31 - 1)


def random_cameras(rng, n):
    R = torch.from_numpy(Rotation.random(n, rng=rng).as_matrix())
    return rigid_from_parts(R, torch.from_numpy(rng.normal(size=(n, 3))))


def disturbed(rng, cam_from_world, degrees=20.0):
    turn = Rotation.from_rotvec(np.radians(rng.normal(size=(len(cam_from_world), 3)) * degrees / 2))
    shift = torch.from_numpy(rng.normal(size=(len(cam_from_world), 3)) * 0.2)
    return rigid_from_parts(torch.from_numpy(turn.as_matrix()), shift) @ cam_from_world


def in_other_world(cam_from_world, scale, R, t):
    """The same cameras after the world was moved by x -> scale R x + t."""
    world_from_cam = invert_rigid(cam_from_world)
    R_new = R @ world_from_cam[:, :3, :3]
    centers = scale * world_from_cam[:, :3, 3] @ R.T + t
    return invert_rigid(rigid_from_parts(R_new, centers))


def everything(n):
    return torch.ones(n, dtype=torch.bool)


def at(*centers):
    """Unrotated cameras at the given centres."""
    centers = torch.tensor(centers, dtype=torch.float64)
    return invert_rigid(rigid_from_parts(torch.eye(3).double().expand(len(centers), 3, 3), centers))


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(0.01, 100.0))
def test_errors_ignore_a_global_similarity_of_the_prediction(seed, scale):
    rng = np.random.default_rng(seed)
    gt = random_cameras(rng, 6)
    pred = disturbed(rng, gt)
    R = torch.from_numpy(Rotation.random(rng=rng).as_matrix())
    moved = in_other_world(pred, scale, R, torch.from_numpy(rng.normal(size=3) * 10))
    before, after = pair_errors(pred, gt, everything(6)), pair_errors(moved, gt, everything(6))
    for name in ("rotation_deg", "direction_deg", "signed_direction_deg"):
        # Centres are differences of numbers up to 1,000 times larger.
        torch.testing.assert_close(getattr(before, name), getattr(after, name), rtol=0, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_a_perfect_prediction_has_no_error_and_full_scores(seed):
    gt = random_cameras(np.random.default_rng(seed), 5)
    errors = pair_errors(gt, gt, everything(5))
    assert errors.num_pairs == 10
    assert errors.rotation_deg.max() < 1e-6
    assert errors.signed_direction_deg.max() < 1e-6
    assert [rra(errors, 1.0), rta(errors, 1.0), rta(errors, 1.0, signed=True)] == [100] * 3
    assert maa(errors) == maa_min(errors) == 100


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_rotation_errors_do_not_depend_on_the_order_of_images(seed):
    rng = np.random.default_rng(seed)
    gt = random_cameras(rng, 6)
    pred = disturbed(rng, gt)
    order = torch.from_numpy(rng.permutation(6))
    before = pair_errors(pred, gt, everything(6)).rotation_deg.sort().values
    after = pair_errors(pred[order], gt[order], everything(6)).rotation_deg.sort().values
    torch.testing.assert_close(before, after)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_laws_between_the_scores_hold(seed):
    rng = np.random.default_rng(seed)
    gt = random_cameras(rng, 8)
    registered = torch.from_numpy(rng.random(8) < 0.8)
    pred = disturbed(rng, gt, degrees=float(rng.uniform(1, 60)))
    errors = pair_errors(pred, gt, registered)
    for k in (5.0, 15.0, 30.0):
        assert rta(errors, k, signed=True) <= rta(errors, k)
        assert rra(errors, k) <= rra(pair_errors(pred, gt, everything(8)), k)
    assert maa(errors) <= maa_min(errors) <= min(rra(errors, 30.0), rta(errors, 30.0))
    assert maa(errors, signed=True) <= maa(errors)


def test_maa_is_the_histogram_of_the_larger_error():
    rng = np.random.default_rng(3)
    gt = random_cameras(rng, 10)
    errors = pair_errors(disturbed(rng, gt), gt, everything(10))
    worst = np.maximum(errors.rotation_deg.numpy(), errors.direction_deg.numpy())
    counts, _ = np.histogram(worst, bins=np.arange(31))
    assert maa(errors) == pytest.approx(100 * np.mean(np.cumsum(counts / len(worst))))


def test_a_quarter_turn_of_one_camera_is_90_degrees():
    gt = at([0, 0, 0], [1, 0, 0])
    pred = gt.clone()
    quarter = torch.from_numpy(Rotation.from_euler("z", 90, degrees=True).as_matrix())
    pred[1, :3] = quarter @ gt[1, :3]  # turns camera 1 about its own centre
    errors = pair_errors(pred, gt, everything(2))
    assert errors.rotation_deg.item() == pytest.approx(90)
    # Camera 0 did not turn, and sees camera 1 where it is.
    assert errors.direction_deg.item() == pytest.approx(0)


def test_a_sideways_step_is_90_degrees_and_a_step_back_only_with_sign():
    gt = at([0, 0, 0], [1, 0, 0])
    sideways = pair_errors(at([0, 0, 0], [0, 1, 0]), gt, everything(2))
    assert sideways.direction_deg.item() == pytest.approx(90)
    back = pair_errors(at([0, 0, 0], [-1, 0, 0]), gt, everything(2))
    assert back.direction_deg.item() == pytest.approx(0)
    assert back.signed_direction_deg.item() == pytest.approx(180)


@pytest.mark.parametrize("which", ["pred", "gt", "both"])
def test_coincident_centres_are_exactly_90_degrees(which):
    rng = np.random.default_rng(1)
    apart = random_cameras(rng, 2)
    center = torch.tensor([[0.3], [-7.1], [2.0]]).double().expand(2, 3, 1)
    together = rigid_from_parts(apart[:, :3, :3], -(apart[:, :3, :3] @ center)[..., 0])
    pred = apart if which == "gt" else together
    gt = apart if which == "pred" else together
    errors = pair_errors(pred, gt, everything(2))
    assert errors.direction_deg.item() == errors.signed_direction_deg.item() == 90.0


def test_pairs_of_unregistered_images_fail_whatever_their_matrix_holds():
    gt = random_cameras(np.random.default_rng(0), 3)
    pred = gt.clone()
    pred[2] = math.nan
    for registered in (torch.tensor([True, True, False]), everything(3)):
        errors = pair_errors(pred, gt, registered)
        assert errors.rotation_deg[1:].isinf().all()
        assert errors.direction_deg[1:].isinf().all()
        assert rra(errors, 30.0) == pytest.approx(100 / 3)
    identity_left_behind = gt.clone()
    assert rra(pair_errors(identity_left_behind, gt, torch.zeros(3).bool()), 30.0) == 0


def test_without_pairs_rates_are_nan():
    for n in (0, 1):
        gt = random_cameras(np.random.default_rng(0), n)
        errors = pair_errors(gt, gt, everything(n))
        assert errors.num_pairs == 0
        assert math.isnan(rra(errors, 5.0))
        assert math.isnan(maa(errors))


def test_blocks_of_pairs_change_nothing(monkeypatch):
    rng = np.random.default_rng(5)
    gt = random_cameras(rng, 9)
    pred = disturbed(rng, gt)
    whole = pair_errors(pred, gt, everything(9))
    monkeypatch.setattr("l3r.metrics.relative._BLOCK", 5)
    parts = pair_errors(pred, gt, everything(9))
    torch.testing.assert_close(whole.rotation_deg, parts.rotation_deg)
    torch.testing.assert_close(whole.direction_deg, parts.direction_deg)


def test_short_baselines_are_counted():
    assert short_baselines(at([0, 0, 0], [0.005, 0, 0], [1, 0, 0]), 0.01) == 1
