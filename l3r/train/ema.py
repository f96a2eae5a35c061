"""The moving average of the weights."""

from collections.abc import Iterable
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

from l3r.model.weight_files import AVERAGE_KEY
from l3r.train.guard import GradientGuard
from l3r.train.ranks import step_is_whole
from l3r.train.sharding import collect, own_share, shard_like
from l3r.types import Views


class WeightAverage(Callback):
    """Keeps the exponential moving average of all parameters, on their device.

    It starts as the weights of the first step, and each step that counts moves it by
    ``1 - decay`` of the way to the new weights, without a wait for the device. Validation sees it
    in place of the weights. Checkpoints hold both. Each process averages what it holds. Stands
    before what gathers weights for a validation or saves after it.

    Args:
        decay: Share of the average that a step leaves, 0 to less than 1.
        guard: Knows which steps were skipped; they leave the average alone.
    """

    def __init__(self, decay: float, guard: GradientGuard) -> None:
        self.guard = guard
        self.average: dict[str, Tensor] = {}
        self.weights: dict[str, Tensor] = {}
        self._move = get_ema_multi_avg_fn(decay)  # type: ignore[no-untyped-call]

    def on_load_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Take up the average of a checkpoint."""
        self.average = dict(checkpoint[AVERAGE_KEY])

    def on_save_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Put the average beside the weights, under the same names."""
        keep = trainer.is_global_zero
        average = {name: collect(value, keep=keep) for name, value in self.average.items()}
        checkpoint[AVERAGE_KEY] = average

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start from the weights, or from the checkpoint's average, where the weights lie."""
        self.weights = dict(pl_module.named_parameters())
        for name, weight in self.weights.items():
            restored = self.average.get(name)
            start = weight.detach().clone() if restored is None else shard_like(restored, weight)
            self.average[name] = start

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Views,
        batch_idx: int,
    ) -> None:
        """Follow the weights after a step that counts."""
        if step_is_whole(trainer, batch_idx) and not self.guard.bad_in_a_row:
            average, weights = self._shares()
            self._move(average, weights, 0)

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Let validation see the average."""
        exchange(*self._shares())

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Give the weights back, to the last bit."""
        exchange(*self._shares())

    def _shares(self) -> tuple[list[Tensor], list[Tensor]]:
        """What of average and weights lies here."""
        average = [own_share(self.average[name]) for name in self.weights]
        return average, [own_share(weight) for weight in self.weights.values()]


@torch.no_grad()
def exchange(one: Iterable[Tensor], other: Iterable[Tensor]) -> None:
    """Swap the values of tensors pairwise, in place: whoever holds a tensor sees the change."""
    for a, b in zip(one, other, strict=True):
        kept = a.clone()
        a.copy_(b)
        b.copy_(kept)
