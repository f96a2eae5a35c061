"""The global term: accumulated point maps against the ground truth, after one rigid fit."""

from jaxtyping import Float
from torch import Tensor

from l3r.config import LossConfig
from l3r.geometry.similarity import fit_similarity
from l3r.loss.confidence import confidence_loss, point_error
from l3r.loss.pairwise import TermValue
from l3r.loss.reduction import mean_of_each_graph, mean_over_pixels
from l3r.loss.scale import ScaleFactors
from l3r.loss.targets import WorldTargets
from l3r.types import WorldPointmaps


def world_loss(
    world: WorldPointmaps, target: WorldTargets, factors: ScaleFactors, config: LossConfig
) -> TermValue:
    """Mean confidence loss over all images after ``P_align`` (the paper's L_global).

    One fit per graph, after normalisation, with its gradient. A graph with fewer than
    ``min_valid_pixels`` adds 0, yet keeps every parameter in the graph of the gradient.

    Args:
        world: Accumulated predictions.
        target: Ground truth in its own world frame.
        factors: Scales per graph.
        config: ``alpha``, ``reduction``, ``align_*`` and ``min_valid_pixels``.
    """
    valid = target.valid.flatten(1)
    counted = valid.sum(-1) >= config.min_valid_pixels
    valid = valid & counted[:, None]
    pts3d = _flatten(world.pts3d_world, factors.prediction)
    truth = _flatten(target.pts3d_world, factors.target)
    log_conf = world.log_conf.flatten(1)
    weights = valid.to(pts3d.dtype)
    if config.align_weights == "confidence":
        weights = weights * log_conf
    # A graph that does not count gives the fit nothing to work on: weights of zero, for which it
    # returns finite transforms and gradients.
    truth_from_world = fit_similarity(truth, pts3d, weights, with_scale=config.align_with_scale)
    error = point_error(truth_from_world.transform(pts3d), truth, valid)
    loss = confidence_loss(error, log_conf, valid, config.alpha)
    return TermValue(
        loss=mean_over_pixels(loss, valid, config.reduction),
        error=mean_over_pixels(error.detach(), valid, config.reduction),
        graph_loss=mean_of_each_graph(loss.detach(), valid),
        graph_error=mean_of_each_graph(error.detach(), valid),
    )


def _flatten(
    pts3d: Float[Tensor, "b n p 3"], factor: Float[Tensor, "b 1"]
) -> Float[Tensor, "b q 3"]:
    return pts3d.flatten(1, 2) / factor[..., None]
