"""The thin lightning module: runs model and loss on a batch, and logs."""

from typing import Any

import lightning as L
import torch
from jaxtyping import Float
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from l3r.config import RunConfig, to_plain
from l3r.graph.diagnostics import summarise_trees
from l3r.inference.reconstruct import reconstruct_views
from l3r.loss.joint import JointLoss, LossTerms
from l3r.metrics.cameras import camera_metrics
from l3r.model.light3r import Light3R
from l3r.train.optim import build_optimizer, build_schedule
from l3r.train.ranks import Agreement, batch_weight
from l3r.train.validation import ValidationScores
from l3r.types import Prediction, Reconstruction, Views


class TrainModule(L.LightningModule):
    """No geometry and no metric maths here; model and loss are used without lightning as well.

    Args:
        config: The whole run; stored in every checkpoint.
        model: The network.
        loss: Joint loss.
        agreement: With the other processes of the run.
    """

    def __init__(
        self, config: RunConfig, model: Light3R, loss: JointLoss, agreement: Agreement
    ) -> None:
        super().__init__()
        self.config = config
        self.model = model
        self.loss = loss
        self.scores = ValidationScores(agreement)

    def training_step(self, batch: Views, batch_idx: int) -> dict[str, Any]:
        """Run one optimisation step's forward pass.

        Returns:
            ``loss``, weighted by the batch's share of the step's graphs, which lightning averages
            and minimises, and ``graphs``, figures of each graph alone.
        """
        prediction, terms = self._compare(batch)
        self.log_dict(terms.scalars("train"), batch_size=len(batch.key))
        facts = summarise_trees(prediction.tree) | self._confidence(prediction)
        self.log_dict({f"train/{name}": torch.as_tensor(x) for name, x in facts.items()})
        weight = batch_weight(self.trainer, batch, self.config)
        return {"loss": weight * terms.total, "graphs": terms.graphs}

    def validation_step(self, batch: Views, batch_idx: int) -> dict[str, Reconstruction]:
        """Score one held-out graph, its cameras by the full inference path.

        Processes may have unequal numbers of graphs, so nothing is sent to others here.

        Args:
            batch: A batch of one.
            batch_idx: Unused.

        Returns:
            ``scene``: the reconstruction, for pictures.
        """
        _, terms = self._compare(batch)
        ((scene, truth),) = reconstruct_views(self.model, batch, self.config.inference)
        cameras = camera_metrics(scene.cam_from_world, truth)
        self.scores.add(batch.dataset[0], terms, cameras)
        return {"scene": scene}

    def on_validation_epoch_end(self) -> None:
        """Log the means over the graphs of all processes, of all and of each data set."""
        self.log_dict({f"val/{name}": value for name, value in self.scores.take().items()})

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Build AdamW and its schedule."""
        optimizer = build_optimizer(self.model, self.config)
        schedule = build_schedule(optimizer, self.config)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip by the norm of all; lightning's own does not let a fused optimiser near autocast."""
        if gradient_clip_val is not None:
            clip_grad_norm_(self.parameters(), gradient_clip_val)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the whole configuration beside the weights, as builtins."""
        checkpoint["l3r_config"] = to_plain(self.config)

    def _compare(self, batch: Views) -> tuple[Prediction, LossTerms]:
        prediction: Prediction = self.model(batch.image, batch.true_shape, batch.scores)
        terms: LossTerms = self.loss(prediction, batch)
        return prediction, terms

    def _confidence(self, prediction: Prediction) -> dict[str, Float[Tensor, ""]]:
        """Mean log-confidence, and the share of points that inference would trust."""
        log_conf = prediction.world.log_conf.detach().float()
        trusted = log_conf.exp() > self.config.inference.min_conf
        return {"log_conf": log_conf.mean(), "confident": trusted.float().mean()}
