"""Relative errors over pairs of cameras: RRA, RTA and mAA (evaluation protocols of PoseDiffusion).

Pairs ``i < j`` are compared through ``cam_i_from_cam_j = cam_i_from_world @ world_from_cam_j``; its
translation is the centre of camera j seen from camera i. A prediction's direction is therefore read
in its own, possibly wrongly turned, camera i, and pairs taken the other way round give slightly
other angles: :mod:`l3r.eval.poses` sorts images by name, so that a score depends on no order.
Every error is invariant to a global similarity of the prediction.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l3r.geometry.rigid import invert_rigid, rotation_angle

_BLOCK = 1 << 18
"""Pairs handled at once; 10,000 images have 50 million."""
_COINCIDENT = 1e-12
"""Centres nearer than this share of the largest coordinate differ by rounding only."""


@dataclass(frozen=True, kw_only=True)
class PairErrors:
    """Errors of all unordered pairs ``i < j``, in the order of ``torch.combinations`` [degrees].

    A pair with an image that is not registered has failed: all its errors are infinite.
    """

    rotation_deg: Float[Tensor, " p"]
    """Angle between the relative rotations, 0 to 180."""
    direction_deg: Float[Tensor, " p"]
    """Angle between the lines of the relative translations, 0 to 90: a flipped one looks right."""
    signed_direction_deg: Float[Tensor, " p"]
    """Angle between the relative translations, 0 to 180."""

    @property
    def num_pairs(self) -> int:
        """Pairs, failed ones included."""
        return self.rotation_deg.shape[0]

    def direction(self, *, signed: bool) -> Float[Tensor, " p"]:
        """One of the two direction errors."""
        return self.signed_direction_deg if signed else self.direction_deg


def pair_errors(
    pred_cam_from_world: Float[Tensor, "n 4 4"],
    gt_cam_from_world: Float[Tensor, "n 4 4"],
    registered: Bool[Tensor, " n"],
) -> PairErrors:
    """Compare every pair of predicted cameras with the true one.

    Args:
        pred_cam_from_world: Predicted transforms; ignored where not ``registered``.
        gt_cam_from_world: True transforms, all finite.
        registered: Whether a prediction exists. One that is not finite counts as none.

    Returns:
        Errors in float64. Coincident centres, true or predicted, count as exactly 90 degrees,
        as in the public evaluation code: such a pair fails.
    """
    registered = registered & pred_cam_from_world.isfinite().flatten(1).all(1)
    # Identity in place of a missing camera keeps NaN out; those pairs are overwritten below.
    missing = torch.eye(4, dtype=torch.float64, device=pred_cam_from_world.device)
    pred = torch.where(registered[:, None, None], pred_cam_from_world.double(), missing)
    gt = gt_cam_from_world.double()
    pairs = torch.combinations(torch.arange(len(registered), device=pred.device), 2)
    blocks = [_block_errors(pred, gt, block) for block in torch.split(pairs, _BLOCK)]
    rotation, direction = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    failed = ~(registered[pairs[:, 0]] & registered[pairs[:, 1]])
    agnostic = torch.minimum(direction, 180 - direction)
    return PairErrors(
        rotation_deg=rotation.masked_fill(failed, math.inf),
        direction_deg=agnostic.masked_fill(failed, math.inf),
        signed_direction_deg=direction.masked_fill(failed, math.inf),
    )


def rra(errors: PairErrors, threshold_deg: float) -> float:
    """Relative rotation accuracy: percent of pairs below the threshold; NaN without pairs."""
    return _percent_below(errors.rotation_deg, threshold_deg)


def rta(errors: PairErrors, threshold_deg: float, *, signed: bool = False) -> float:
    """Relative translation accuracy: percent of pairs below the threshold; NaN without pairs."""
    return _percent_below(errors.direction(signed=signed), threshold_deg)


def maa(errors: PairErrors, threshold_deg: int = 30, *, signed: bool = False) -> float:
    """Mean average accuracy as PoseDiffusion computes it (the primary reading) [percent].

    The area under the accuracy of the LARGER of a pair's two errors: the mean, over thresholds of
    1, 2, ... degrees, of the share of pairs below (its NumPy form, one histogram bin a degree).
    """
    worst = torch.maximum(errors.rotation_deg, errors.direction(signed=signed))
    return sum(_percent_below(worst, float(k)) for k in range(1, threshold_deg + 1)) / threshold_deg


def maa_min(errors: PairErrors, threshold_deg: int = 30, *, signed: bool = False) -> float:
    """Mean average accuracy as the paper words it: the area under ``min(RRA, RTA)`` [percent].

    Never below :func:`maa`, since a pair may pass one test and fail the other.
    """
    thresholds = [float(k) for k in range(1, threshold_deg + 1)]
    lower = (min(rra(errors, k), rta(errors, k, signed=signed)) for k in thresholds)
    return sum(lower) / threshold_deg


def short_baselines(gt_cam_from_world: Float[Tensor, "n 4 4"], shorter_than: float) -> int:
    """Count pairs of true centres nearer than a length: their directions are noise.

    Args:
        gt_cam_from_world: True transforms, all finite.
        shorter_than: In the units of the transforms.
    """
    centers = invert_rigid(gt_cam_from_world.double())[:, :3, 3]
    return int((torch.pdist(centers) < shorter_than).sum())


def _block_errors(
    pred: Float[Tensor, "n 4 4"], gt: Float[Tensor, "n 4 4"], pairs: Int[Tensor, "p 2"]
) -> tuple[Tensor, Tensor]:
    """Rotation and signed direction errors [degrees] of some pairs."""
    i, j = pairs.unbind(1)
    pred_R, gt_R = pred[:, :3, :3], gt[:, :3, :3]
    pred_i_from_j = pred_R[i] @ pred_R[j].mT
    gt_i_from_j = gt_R[i] @ gt_R[j].mT
    rotation = torch.rad2deg(rotation_angle(gt_i_from_j @ pred_i_from_j.mT))
    return rotation, _angle_deg(_direction(pred, i, j), _direction(gt, i, j))


def _direction(cam_from_world: Float[Tensor, "n 4 4"], i: Tensor, j: Tensor) -> Tensor:
    """Unit vector from camera i to camera j in camera i's axes; zero where they coincide."""
    centers = invert_rigid(cam_from_world)[:, :3, 3]
    if not len(i):
        return centers.new_zeros(0, 3)
    # The difference of centres, rotated, and not the product of transforms: its rounding would
    # give coincident cameras a direction.
    baseline = centers[j] - centers[i]
    length = baseline.norm(dim=1, keepdim=True)
    apart = length > _COINCIDENT * centers.abs().max()
    unit = torch.where(apart, baseline / length, torch.zeros_like(baseline))
    return (cam_from_world[i, :3, :3] @ unit[:, :, None])[:, :, 0]


def _angle_deg(a: Float[Tensor, "p 3"], b: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
    """Angle between vectors [degrees], accurate near 0 and 180; 90 where one is zero."""
    sine, cosine = torch.linalg.cross(a, b).norm(dim=1), (a * b).sum(1)
    undefined = (a.abs().sum(1) == 0) | (b.abs().sum(1) == 0)
    return torch.rad2deg(torch.atan2(sine, cosine)).masked_fill(undefined, 90.0)


def _percent_below(error_deg: Float[Tensor, " p"], threshold_deg: float) -> float:
    if not len(error_deg):
        return math.nan
    return 100 * int((error_deg < threshold_deg).sum()) / len(error_deg)
