"""The pairwise term: both point maps of every edge, in the parent's camera frame."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from l3r.config import LossConfig
from l3r.loss.confidence import confidence_loss, point_error
from l3r.loss.reduction import mean_of_each_graph, mean_over_pixels
from l3r.loss.scale import ScaleFactors
from l3r.loss.targets import PairTargets
from l3r.types import PairPointmaps


@dataclass(frozen=True, kw_only=True)
class TermValue:
    """One term of the loss and the plain error behind it."""

    loss: Float[Tensor, ""]
    """What is minimised."""
    error: Float[Tensor, ""]
    """Mean point error in units of the scene's scale, without confidence; for the log."""
    graph_loss: Float[Tensor, " b"]
    """``loss`` of each graph alone, detached; for the log."""
    graph_error: Float[Tensor, " b"]
    """``error`` of each graph alone."""


def pairwise_loss(
    pairs: PairPointmaps, target: PairTargets, factors: ScaleFactors, config: LossConfig
) -> TermValue:
    """Sum over both views of the mean confidence loss (the paper's L_pair).

    Args:
        pairs: Predictions.
        target: Ground truth in the same frames.
        factors: Scales of both, per edge or per graph.
        config: ``alpha`` and ``reduction``.
    """
    parent = _view_loss(
        _divide(pairs.parent_pts3d, factors.prediction),
        _divide(target.parent_pts3d, factors.target),
        pairs.parent_log_conf,
        target.parent_valid,
        config,
    )
    child = _view_loss(
        _divide(pairs.child_pts3d, factors.prediction),
        _divide(target.child_pts3d, factors.target),
        pairs.child_log_conf,
        target.child_valid,
        config,
    )
    return TermValue(
        loss=parent.loss + child.loss,
        error=(parent.error + child.error) / 2,
        graph_loss=parent.graph_loss + child.graph_loss,
        graph_error=(parent.graph_error + child.graph_error) / 2,
    )


def _divide(pts3d: Float[Tensor, "b e p 3"], factor: Float[Tensor, "b k"]) -> Tensor:
    return pts3d / factor[..., None, None]


def _view_loss(
    pts3d: Float[Tensor, "b e p 3"],
    target: Float[Tensor, "b e p 3"],
    log_conf: Float[Tensor, "b e p"],
    valid: Bool[Tensor, "b e p"],
    config: LossConfig,
) -> TermValue:
    error = point_error(pts3d, target, valid)
    loss = confidence_loss(error, log_conf, valid, config.alpha)
    loss, error, valid = loss.flatten(1), error.flatten(1), valid.flatten(1)
    return TermValue(
        loss=mean_over_pixels(loss, valid, config.reduction),
        error=mean_over_pixels(error.detach(), valid, config.reduction),
        graph_loss=mean_of_each_graph(loss.detach(), valid),
        graph_error=mean_of_each_graph(error.detach(), valid),
    )
