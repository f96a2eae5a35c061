"""The thin lightning module: runs model and loss on a batch, and logs."""

from typing import Any

import lightning as L
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor

from l3r.config import RunConfig, to_plain
from l3r.inference.reconstruct import reconstruct_views
from l3r.loss.joint import JointLoss, LossTerms
from l3r.metrics.cameras import CameraMetrics, camera_metrics, mean_metrics
from l3r.model.light3r import Light3R
from l3r.train.optim import build_optimizer, build_schedule
from l3r.types import Views


class TrainModule(L.LightningModule):
    """No geometry and no metric maths here; model and loss are used without lightning as well.

    Args:
        config: The whole run; stored in every checkpoint.
        model: The network.
        loss: Joint loss.
    """

    def __init__(self, config: RunConfig, model: Light3R, loss: JointLoss) -> None:
        super().__init__()
        self.config = config
        self.model = model
        self.loss = loss
        self.accuracy: list[CameraMetrics] = []

    def training_step(self, batch: Views, batch_idx: int) -> Tensor:
        """Run one optimisation step's forward pass."""
        terms = self._compare(batch)
        self.log_dict(terms.scalars("train"), batch_size=len(batch.key))
        return terms.total

    def validation_step(self, batch: Views, batch_idx: int) -> None:
        """Log the loss of held-out graphs, and score their cameras by the full inference path."""
        terms = self._compare(batch)
        self.log_dict(terms.scalars("val"), batch_size=len(batch.key))
        for scene, truth in reconstruct_views(self.model, batch, self.config.inference):
            self.accuracy.append(camera_metrics(scene.cam_from_world, truth))

    def on_validation_epoch_end(self) -> None:
        """Log the mean accuracy over graphs."""
        mean = mean_metrics(self.accuracy).to_dict()
        self.log_dict({f"val/{name}": value for name, value in mean.items()})
        self.accuracy.clear()

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Build AdamW and its schedule."""
        optimizer = build_optimizer(self.model, self.config)
        schedule = build_schedule(optimizer, self.config)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the whole configuration beside the weights, as builtins."""
        checkpoint["l3r_config"] = to_plain(self.config)

    def _compare(self, batch: Views) -> LossTerms:
        prediction = self.model(batch.image, batch.true_shape, batch.scores)
        terms: LossTerms = self.loss(prediction, batch)
        return terms
