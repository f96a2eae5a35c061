import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from l3r.geometry.rigid import transform_points
from l3r.inference.symmetrize import symmetrize
from l3r.types import PairPointmaps
from tests.geometry.scenes import generator, random_rigid

SEEDS = st.integers(0, 2**32 - 1)
FITS = st.sampled_from(["child", "both"])


def both_ways(seed, noise=0.0):
    """Edges (i, j) and the same decoded as (j, i), each exact up to noise."""
    draw = generator(seed)
    parent_from_child = random_rigid(1, 3, draw=draw)
    shape = (1, 3, 25, 3)
    of_i, of_j = (torch.randn(shape, generator=draw, dtype=torch.float64) for _ in range(2))
    confs = [torch.rand(shape[:-1], generator=draw, dtype=torch.float64) + 0.1 for _ in range(4)]

    def disturb(points):
        return points + noise * torch.randn(shape, generator=draw, dtype=torch.float64)

    child_from_parent = torch.linalg.inv(parent_from_child)
    forward = PairPointmaps(
        parent_pts3d=disturb(of_i),
        child_pts3d=disturb(of_j),
        parent_log_conf=confs[0],
        child_log_conf=confs[1],
    )
    reverse = PairPointmaps(
        parent_pts3d=disturb(transform_points(child_from_parent, of_j)),
        child_pts3d=disturb(transform_points(child_from_parent, of_i)),
        parent_log_conf=confs[2],
        child_log_conf=confs[3],
    )
    return forward, reverse, of_i, of_j


@settings(max_examples=20)
@given(SEEDS, FITS)
def test_two_exact_decodings_merge_into_the_same(seed, fit):
    forward, reverse, of_i, of_j = both_ways(seed)
    merged = symmetrize(forward, reverse, fit)
    torch.testing.assert_close(merged.parent_pts3d, of_i, atol=1e-8, rtol=1e-8)
    torch.testing.assert_close(merged.child_pts3d, of_j, atol=1e-8, rtol=1e-8)


@settings(max_examples=20)
@given(SEEDS, FITS)
def test_merging_noisy_decodings_is_better_than_one_alone(seed, fit):
    forward, reverse, _, of_j = both_ways(seed, noise=0.05)
    merged = symmetrize(forward, reverse, fit)
    before = (forward.child_pts3d - of_j).square().mean()
    after = (merged.child_pts3d - of_j).square().mean()
    assert float(after) < float(before)


def test_confidence_is_the_geometric_mean_and_weighs_the_points():
    forward, reverse, _, _ = both_ways(1, noise=0.1)
    merged = symmetrize(forward, reverse, "child")
    expected = (forward.parent_log_conf.exp() * reverse.child_log_conf.exp()).sqrt()
    torch.testing.assert_close(merged.parent_log_conf.exp(), expected)
    sure = dataclasses.replace(reverse, child_log_conf=torch.zeros_like(reverse.child_log_conf))
    alone = symmetrize(forward, sure, "child")
    torch.testing.assert_close(alone.parent_pts3d, forward.parent_pts3d)


def test_pixels_without_any_confidence_are_averaged_evenly():
    forward, reverse, of_i, _ = both_ways(2)
    zero = torch.zeros_like(forward.parent_log_conf)
    merged = symmetrize(
        dataclasses.replace(forward, parent_log_conf=zero),
        dataclasses.replace(reverse, child_log_conf=zero),
        "child",
    )
    torch.testing.assert_close(merged.parent_pts3d, of_i, atol=1e-8, rtol=1e-8)
    assert merged.parent_log_conf.abs().max() == pytest.approx(0)
