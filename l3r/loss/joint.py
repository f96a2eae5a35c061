"""L = L_pair + lambda L_global."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from l3r.config import LossConfig
from l3r.loss.pairwise import pairwise_loss
from l3r.loss.scale import scale_factors
from l3r.loss.targets import build_targets
from l3r.loss.world import world_loss
from l3r.types import Prediction, Views


@dataclass(frozen=True, kw_only=True)
class LossTerms:
    """The loss and what it is made of."""

    total: Float[Tensor, ""]
    """What is minimised."""
    parts: dict[str, Float[Tensor, ""]]
    """Detached terms and errors, for the log."""
    graphs: dict[str, Float[Tensor, " b"]]
    """``loss`` and ``pair_error`` of each graph alone, detached, for the log of each data set."""

    def scalars(self, prefix: str) -> dict[str, Tensor]:
        """Name every number for the log: ``prefix/loss``, ``prefix/pairwise``, ..."""
        named = {"loss": self.total.detach(), **self.parts}
        return {f"{prefix}/{name}": value for name, value in named.items()}


class JointLoss(nn.Module):
    """Pairwise and global supervision in one scale per graph.

    To add a term: compute it from ``prediction`` and the targets here, add it to ``total`` with
    its weight from :class:`~l3r.config.LossConfig`, and name it in ``parts``.
    """

    def __init__(self, config: LossConfig) -> None:
        super().__init__()
        self.config = config

    def forward(self, prediction: Prediction, views: Views) -> LossTerms:
        """Compare a prediction with the ground truth, in float32 outside autocast."""
        with torch.autocast(views.image.device.type, enabled=False):
            pair_targets, world_targets = build_targets(views, prediction.tree)
            normalize = self.config.normalize
            factors = scale_factors(prediction.pairs, pair_targets, views.is_metric, normalize)
            pairwise = pairwise_loss(prediction.pairs, pair_targets, factors, self.config)
            if normalize == "per_edge":  # the world has one scale in any case
                factors = scale_factors(
                    prediction.pairs, pair_targets, views.is_metric, "per_graph"
                )
            world = world_loss(prediction.world, world_targets, factors, self.config)
        parts = {
            "pairwise": pairwise.loss.detach(),
            "global": world.loss.detach(),
            "pair_error": pairwise.error,
            "global_error": world.error,
        }
        weight = self.config.global_weight
        graphs = {
            "loss": pairwise.graph_loss + weight * world.graph_loss,
            "pair_error": pairwise.graph_error,
        }
        total = pairwise.loss + weight * world.loss
        return LossTerms(total=total, parts=parts, graphs=graphs)
