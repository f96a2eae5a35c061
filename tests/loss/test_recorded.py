"""The pairwise loss against values and gradients recorded from the reference."""

import numpy as np
import pytest
import torch

from l3r.config import LossConfig
from l3r.geometry.rigid import transform_points
from l3r.loss.pairwise import pairwise_loss
from l3r.loss.scale import scale_factors
from l3r.loss.targets import PairTargets
from l3r.types import PairPointmaps

CASES = [
    ("loss_plain", "conf_regr3d", "per_edge"),
    ("loss_plain", "conf_regr3d_nonorm", "none"),
    ("loss_plain", "regr3d_mean", "per_edge"),
    ("loss_item2_all_invalid", "conf_regr3d", "per_edge"),
    ("loss_view2_all_invalid", "conf_regr3d", "per_edge"),
]
CLOSE = 1e-12


@pytest.fixture
def recorded(shared, request):
    return np.load(shared / "model" / "fixtures" / f"{request.param}.npz", allow_pickle=False)


def one_edge_graphs(data, name):
    """Each recorded pair is a graph of one edge."""
    return torch.from_numpy(data[name]).flatten(1, 2)[:, None]


@pytest.mark.parametrize(
    ("recorded", "criterion", "normalize"), CASES, indirect=["recorded"], ids=lambda v: str(v)
)
def test_loss_and_gradients_equal_the_recorded_ones(recorded, criterion, normalize):
    parent_from_world = torch.linalg.inv(torch.from_numpy(recorded["camera_pose1"]))[:, None]
    target = PairTargets(
        parent_pts3d=transform_points(parent_from_world, one_edge_graphs(recorded, "gt_pts1")),
        child_pts3d=transform_points(parent_from_world, one_edge_graphs(recorded, "gt_pts2")),
        parent_valid=one_edge_graphs(recorded, "valid1"),
        child_valid=one_edge_graphs(recorded, "valid2"),
    )
    has_conf = criterion != "regr3d_mean"
    conf = [one_edge_graphs(recorded, name).requires_grad_() for name in ("conf1", "conf2")]
    points = [one_edge_graphs(recorded, f"pred_pts{v}").requires_grad_() for v in (1, 2)]
    log_conf = [c.log() if has_conf else torch.zeros_like(c) for c in conf]
    pairs = PairPointmaps(
        parent_pts3d=points[0],
        child_pts3d=points[1],
        parent_log_conf=log_conf[0],
        child_log_conf=log_conf[1],
    )
    config = LossConfig(normalize=normalize, reduction="pooled", alpha=0.2 if has_conf else 0.0)
    free_scale = torch.zeros(len(points[0]), dtype=torch.bool)
    factors = scale_factors(pairs, target, free_scale, normalize)
    loss = pairwise_loss(pairs, target, factors, config).loss
    assert float(loss.detach()) == pytest.approx(
        float(recorded[f"{criterion}__f64__loss"]), abs=CLOSE
    )
    loss.backward()
    names = {"grad_pred_pts1": points[0], "grad_pred_pts2": points[1]}
    if has_conf:
        names |= {"grad_conf1": conf[0], "grad_conf2": conf[1]}
    for name, leaf in names.items():
        found = torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        expected = torch.zeros_like(found)
        if recorded[f"{criterion}__f64__{name}"].ndim:  # else none reached the leaf
            expected = one_edge_graphs(recorded, f"{criterion}__f64__{name}")
        torch.testing.assert_close(found, expected, atol=CLOSE, rtol=0)


@pytest.mark.parametrize("recorded", ["loss_plain"], indirect=True)
def test_scale_factors_equal_the_recorded_ones(recorded):
    parent_from_world = torch.linalg.inv(torch.from_numpy(recorded["camera_pose1"]))[:, None]
    target = PairTargets(
        parent_pts3d=transform_points(parent_from_world, one_edge_graphs(recorded, "gt_pts1")),
        child_pts3d=transform_points(parent_from_world, one_edge_graphs(recorded, "gt_pts2")),
        parent_valid=one_edge_graphs(recorded, "valid1"),
        child_valid=one_edge_graphs(recorded, "valid2"),
    )
    pairs = PairPointmaps(
        parent_pts3d=one_edge_graphs(recorded, "pred_pts1"),
        child_pts3d=one_edge_graphs(recorded, "pred_pts2"),
        parent_log_conf=one_edge_graphs(recorded, "conf1"),
        child_log_conf=one_edge_graphs(recorded, "conf2"),
    )
    free_scale = torch.zeros(3, dtype=torch.bool)
    for over in ("per_edge", "per_graph"):
        factors = scale_factors(pairs, target, free_scale, over)
        assert factors.target[:, 0].numpy() == pytest.approx(recorded["norm_factor_gt"], abs=CLOSE)
        prediction = factors.prediction[:, 0].numpy()
        assert prediction == pytest.approx(recorded["norm_factor_pred"], abs=CLOSE)
