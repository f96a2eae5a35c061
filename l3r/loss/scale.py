"""The scale in which prediction and ground truth are compared."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from l3r.loss.targets import PairTargets
from l3r.types import PairPointmaps

SMALLEST_FACTOR = 1e-8


@dataclass(frozen=True, kw_only=True)
class ScaleFactors:
    """What predictions and ground truth are divided by; ``k`` is e (per edge) or 1 (per graph)."""

    prediction: Float[Tensor, "b k"]
    target: Float[Tensor, "b k"]


def scale_factors(
    pairs: PairPointmaps,
    target: PairTargets,
    is_metric: Bool[Tensor, " b"],
    over: Literal["per_graph", "per_edge", "none"],
) -> ScaleFactors:
    """Measure the mean distance from the parent's camera, over valid pixels of both views.

    Accumulation is rigid, so all edges of a graph must share one scale (``per_graph``). Metric
    graphs divide the prediction by the ground truth's factor, so that its size is learnt; the
    others by its own, through which the gradient flows.
    """
    if over == "none":
        one = pairs.parent_pts3d.new_ones(len(is_metric), 1)
        return ScaleFactors(prediction=one, target=one)
    valid = torch.cat([target.parent_valid, target.child_valid], dim=-1)
    of_target = _mean_distance(target.parent_pts3d, target.child_pts3d, valid, over)
    of_prediction = _mean_distance(pairs.parent_pts3d, pairs.child_pts3d, valid, over)
    return ScaleFactors(
        prediction=torch.where(is_metric[:, None], of_target, of_prediction), target=of_target
    )


def _mean_distance(
    parent_pts3d: Float[Tensor, "b e p 3"],
    child_pts3d: Float[Tensor, "b e p 3"],
    valid: Bool[Tensor, "b e q"],
    over: Literal["per_graph", "per_edge"],
) -> Float[Tensor, "b k"]:
    pts3d = torch.cat([parent_pts3d, child_pts3d], dim=-2)
    pts3d = torch.where(valid[..., None], pts3d, torch.zeros_like(pts3d))
    total = torch.linalg.vector_norm(pts3d, dim=-1).sum(-1)
    count = valid.sum(-1)
    if over == "per_graph":
        total, count = total.sum(-1, keepdim=True), count.sum(-1, keepdim=True)
    mean: Tensor = total / count.clamp_min(1)
    return mean.clamp_min(SMALLEST_FACTOR)
