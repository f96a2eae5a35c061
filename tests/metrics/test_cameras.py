import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from l3r.geometry.rigid import invert_rigid, rigid_from_parts
from l3r.metrics.cameras import CameraMetrics, camera_metrics, mean_metrics
from l3r.metrics.registration import registration_rate


@pytest.fixture
def gt():
    rng = np.random.default_rng(0)
    R = torch.from_numpy(Rotation.random(6, rng=rng).as_matrix())
    return rigid_from_parts(R, torch.from_numpy(rng.normal(size=(6, 3))))


def test_a_perfect_scene_scores_100_and_0(gt):
    scores = camera_metrics(gt, gt).to_dict()
    assert scores.pop("ate") == pytest.approx(0, abs=1e-7)
    assert scores.pop("ate_rmse") == pytest.approx(0, abs=1e-9)
    assert set(scores.values()) == {100.0}


def test_policies_for_missing_images(gt):
    pred = gt.clone()
    pred[4:] = math.nan
    failed = camera_metrics(pred, gt)
    assert failed.rra_5 == failed.rta_5 == failed.maa_30 == pytest.approx(100 * 6 / 15)
    excluded = camera_metrics(pred, gt, missing="exclude_image")
    assert excluded.rra_5 == excluded.maa_30_min == 100
    assert camera_metrics(pred, gt, missing="exclude_scene") == failed
    assert failed.reg == excluded.reg == pytest.approx(100 * 4 / 6)
    assert failed.ate == excluded.ate == pytest.approx(0, abs=1e-7)


def test_a_scene_without_any_camera(gt):
    nothing = torch.full_like(gt, math.nan)
    failed = camera_metrics(nothing, gt)
    assert failed.rra_30 == failed.reg == 0
    assert math.isnan(failed.ate)
    left_out = camera_metrics(nothing, gt, missing="exclude_scene")
    assert math.isnan(left_out.rra_30)
    assert left_out.reg == 0
    assert math.isnan(camera_metrics(nothing, gt, missing="exclude_image").maa_30)


def test_a_camera_left_as_the_identity_scores_nothing_when_flagged(gt):
    pred = gt.clone()
    pred[0] = torch.eye(4)
    flags = torch.ones(6, dtype=torch.bool)
    flags[0] = False
    assert camera_metrics(pred, gt, flags).rra_5 == pytest.approx(100 * 10 / 15)


def test_single_precision_is_scored_too(gt):
    assert camera_metrics(gt.float(), gt).maa_30 == 100


def test_mean_leaves_out_what_is_undefined(gt):
    perfect = camera_metrics(gt, gt)
    lost = camera_metrics(torch.full_like(gt, math.nan), gt, missing="exclude_scene")
    mean = mean_metrics([perfect, lost])
    assert mean.rra_5 == 100
    assert mean.reg == 50
    assert mean.ate == pytest.approx(0, abs=1e-7)
    assert math.isnan(mean_metrics([]).rra_5)
    assert isinstance(mean, CameraMetrics)


def test_registration_rate():
    assert registration_rate(torch.tensor([True, False, True, True])) == 75
    assert math.isnan(registration_rate(torch.zeros(0, dtype=torch.bool)))


def test_inverted_transforms_are_noticed(gt):
    assert camera_metrics(invert_rigid(gt), gt).maa_30 < 50
