"""What a step amounts to, over its batches and processes, and whether it counts."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning as L
import torch
import torch.distributed as dist
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn

from l3r.config import RunConfig
from l3r.errors import LaunchError, NotFiniteError
from l3r.files import append_whole, write_atomic
from l3r.loss.joint import LossTerms
from l3r.train.csv_table import bear_loss_of
from l3r.train.ranks import Agreement, batch_weight
from l3r.train.sharding import total_norm
from l3r.types import Views


class StepMean(Callback):
    """Logs the loss and its terms as means over all graphs of a step.

    Lightning would log those of the first process's last batch.

    Args:
        config: Of the run.
    """

    def __init__(self, config: RunConfig) -> None:
        self.config = config
        self.batches: list[dict[str, Tensor]] = []
        self.weight = 1.0

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Listen to what the loss gives in training."""
        loss = pl_module.get_submodule("loss")
        loss.register_forward_hook(self._collect)

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Views, batch_idx: int
    ) -> None:
        """Take the weight of the batch to come."""
        self.weight = batch_weight(trainer, batch, self.config)

    def on_before_optimizer_step(
        self, trainer: L.Trainer, pl_module: L.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        """Log the means, under the names of the module's own figures."""
        names = list(self.batches[0])
        rows = torch.stack([torch.stack([row[name] for name in names]) for row in self.batches])
        means = rows.mean(dim=0)
        if trainer.world_size > 1:  # by torch: lightning's way has a barrier, which waits
            dist.all_reduce(means)
            means = means / trainer.world_size
        pl_module.log_dict(dict(zip(names, means, strict=True)))
        self.batches.clear()

    def _collect(self, loss: nn.Module, inputs: Any, terms: LossTerms) -> None:
        if loss.training:
            row = terms.scalars("train")
            self.batches.append({name: self.weight * value for name, value in row.items()})


class GradientGuard(Callback):
    """Skips a step whose loss or gradient is not finite, on all processes alike.

    The keys of the step's graphs, those of all processes, are added to ``bad_steps.jsonl``. Also
    measures the gradient's norm, as ``train/grad_norm``. A step in which the network has no finite
    numbers at all ends the run, and its row says so as ``problem``. Stands behind
    :class:`StepMean`. A resumed run goes on counting, and drops the rows after its checkpoint
    first.

    Args:
        path: Where bad steps are written down.
        max_bad_steps: Training stops after so many in a row.
        agreement: With the other processes.
    """

    def __init__(self, path: Path, max_bad_steps: int, agreement: Agreement) -> None:
        self.path = path
        self.max_bad_steps = max_bad_steps
        self.agreement = agreement
        self.bad_in_a_row = 0
        self.keys: list[str] = []

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Forget what a stopped run wrote after its checkpoint."""
        if trainer.is_global_zero:
            drop_bad_steps_after(self.path, trainer.global_step)

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Views, batch_idx: int
    ) -> None:
        """Remember which graphs the step is made of."""
        if batch_idx % trainer.accumulate_grad_batches == 0:
            self.keys = []
        self.keys += batch.key

    def on_before_optimizer_step(
        self, trainer: L.Trainer, pl_module: L.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        """Drop the gradients of a bad step: the optimiser leaves parameters without one alone."""
        parameters = [p for p in pl_module.parameters() if p.grad is not None]
        norm = total_norm(p.grad for p in parameters if p.grad is not None)
        pl_module.log("train/grad_norm", norm)
        loss = trainer.callback_metrics.get("train/loss", norm)
        is_bad = not bool(torch.isfinite(norm) & torch.isfinite(loss))
        if not self.agreement.any([is_bad])[0]:
            self.bad_in_a_row = 0
            return
        for parameter in parameters:
            parameter.grad = None
        keys = [key for part in self.agreement.gather(self.keys) for key in part]
        step = trainer.global_step + 1
        row = {"step": step, "loss": str(float(loss)), "grad_norm": str(float(norm))}
        if trainer.is_global_zero:
            self._write({**row, "keys": keys})
        self._count(row)

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Write down a step that could not be finished, as weights left the finite before it."""
        if isinstance(exception, NotFiniteError):
            row = {"step": trainer.global_step + 1, "loss": "nan", "grad_norm": "nan"}
            # Each process its own graphs: others may never come to know of it.
            self._write({**row, "keys": self.keys, "problem": str(exception)})

    def state_dict(self) -> dict[str, Any]:
        """Give what a checkpoint keeps; it is the same in all processes."""
        return {"bad_in_a_row": self.bad_in_a_row}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on counting."""
        self.bad_in_a_row = int(state_dict["bad_in_a_row"])

    def _write(self, row: dict[str, Any]) -> None:
        with bear_loss_of(f"the row of bad step {row['step']}"):
            append_whole(self.path, json.dumps(row) + "\n")

    def _count(self, row: dict[str, Any]) -> None:
        self.bad_in_a_row += 1
        if self.bad_in_a_row >= self.max_bad_steps:
            raise LaunchError(
                f"step {row['step']}: loss {row['loss']}, gradient norm {row['grad_norm']}; "
                f"{self.bad_in_a_row} such steps in a row, fewer than "
                f"train.max_bad_steps={self.max_bad_steps} expected; their graphs are listed in "
                f"{self.path}"
            )


def drop_bad_steps_after(path: Path, step: int) -> None:
    """Forget rows of ``bad_steps.jsonl`` after a step, and half a row that a kill left."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text(errors="replace").splitlines():
        try:
            if json.loads(line)["step"] <= step:
                kept.append(line + "\n")
        except (ValueError, TypeError, LookupError):
            continue
    write_atomic(path, "".join(kept))
