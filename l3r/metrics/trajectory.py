"""Absolute error of camera centres after alignment: ATE in two definitions.

Both take registered cameras only, so they say nothing of the images left out: read them beside the
registration rate. Both are NaN for fewer than three cameras, and for centres that coincide.
"""

import math

import torch
from jaxtyping import Float
from scipy.spatial import procrustes
from torch import Tensor

from l3r.geometry.similarity import fit_similarity

_MIN_CAMERAS = 3
"""Two centres can always be aligned exactly."""
_COINCIDENT = 1e-12
"""A spread below this share of the largest coordinate is rounding."""


def ate(pred_centers: Float[Tensor, "n 3"], gt_centers: Float[Tensor, "n 3"]) -> float:
    """Normalised error: both sets centred and divided by their norm, rotated, scaled, compared.

    The root mean square over COORDINATES of what ``scipy.spatial.procrustes`` leaves; a reflection
    is allowed. It has no unit and is at most ``sqrt(1 / (3 n))``, so values of different numbers of
    images cannot be compared.

    Args:
        pred_centers: Predicted centres in the world, registered cameras only.
        gt_centers: True centres of the same cameras.
    """
    if _degenerate(pred_centers) or _degenerate(gt_centers):
        return math.nan
    _, _, disparity = procrustes(
        gt_centers.double().cpu().numpy(), pred_centers.double().cpu().numpy()
    )
    return math.sqrt(max(float(disparity), 0.0) / (3 * len(gt_centers)))


def ate_rmse(pred_centers: Float[Tensor, "n 3"], gt_centers: Float[Tensor, "n 3"]) -> float:
    """Root mean square distance of the centres after Umeyama's similarity, without reflection.

    Args:
        pred_centers: Predicted centres in the world, registered cameras only.
        gt_centers: True centres of the same cameras; the error has their unit.
    """
    if _degenerate(pred_centers) or _degenerate(gt_centers):
        return math.nan
    pred, gt = pred_centers.double(), gt_centers.double()
    gt_from_pred = fit_similarity(gt, pred, torch.ones_like(gt[:, 0]), with_scale=True)
    return float((gt - gt_from_pred.transform(pred)).square().sum(1).mean().sqrt())


def _degenerate(centers: Float[Tensor, "n 3"]) -> bool:
    if len(centers) < _MIN_CAMERAS:
        return True
    spread = (centers - centers.mean(0)).norm()
    return not bool(spread > _COINCIDENT * centers.abs().max())
