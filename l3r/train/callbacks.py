"""What happens around a step: measures and progress."""

import math
import sys
import time
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from l3r.train.ranks import step_is_whole
from l3r.train.sharding import total_norm
from l3r.types import Views


class StepTimer(Callback):
    """Measures throughput and how long the step waited for data.

    Logs ``train/graphs_per_second`` and ``train/data_wait``, the share of a step's time.
    """

    def __init__(self) -> None:
        self.ended = time.perf_counter()
        self.waited = 0.0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the clock."""
        self.ended = time.perf_counter()

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Views, batch_idx: int
    ) -> None:
        """Take the time since the last step ended."""
        self.waited = time.perf_counter() - self.ended

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Views,
        batch_idx: int,
    ) -> None:
        """Log the step's figures."""
        now = time.perf_counter()
        total = max(now - self.ended, 1e-9)
        graphs = len(batch.key) * trainer.world_size
        scalars = {
            "train/graphs_per_second": graphs / total,
            "train/data_wait": self.waited / total,
        }
        pl_module.log_dict(scalars)
        self.ended = now

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Leave validation out of the next step's wait."""
        self.ended = time.perf_counter()


class RoomGradients(Callback):
    """Measures the gradient's norm in each room of the network, on steps that are logged.

    Logs ``train/grad_norm_encoder`` and so on, before clipping.

    Args:
        every: Steps between rows of the log.
    """

    def __init__(self, every: int) -> None:
        self.every = every

    def on_before_optimizer_step(
        self, trainer: L.Trainer, pl_module: L.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        """Measure without waiting for the device."""
        step = trainer.global_step + 1
        if step % self.every and step != trainer.max_steps:
            return
        norms: dict[str, list[torch.Tensor]] = {
            room: [] for room in ("encoder", "alignment", "decoder", "heads")
        }
        for name, parameter in pl_module.named_parameters():
            if parameter.grad is not None:
                room = name.removeprefix("model.").split(".")[0]
                norms["heads" if room.endswith("_head") else room].append(parameter.grad)
        for room, gradients in norms.items():
            pl_module.log(f"train/grad_norm_{room}", total_norm(gradients))


class StepProgress(Callback):
    """A progress bar on standard error; a plain line now and then where that is no terminal."""

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        self.progress: Progress | None = None
        self.began = (0, 0.0)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Open the bar, on the first process."""
        self.began = (trainer.global_step, time.perf_counter())
        if self.console.is_terminal and trainer.is_global_zero:
            self.progress = Progress(
                TextColumn("train"),
                BarColumn(bar_width=None),
                MofNCompleteColumn(),
                TextColumn("{task.fields[note]}"),
                TimeRemainingColumn(),
                console=self.console,
            )
            self.progress.add_task("", total=trainer.max_steps, note="")
            self.progress.start()

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Views,
        batch_idx: int,
    ) -> None:
        """Move the bar; look at the loss only now and then, since that waits for the device."""
        if not trainer.is_global_zero or not step_is_whole(trainer, batch_idx):
            return
        step, total = trainer.global_step, trainer.max_steps
        if self.progress is not None:
            task = self.progress.task_ids[0]
            self.progress.update(task, completed=step)
            if step % 10 == 0:
                self.progress.update(task, note=self._note(trainer))
        elif step % max(1, total // 20) == 0 or step == total:
            first, start = self.began
            left = (time.perf_counter() - start) / (step - first) * (total - step)
            sys.stderr.write(f"train {step}/{total}  {self._note(trainer)}  {left:.0f} s left\n")
            sys.stderr.flush()

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Close the bar."""
        if self.progress is not None:
            self.progress.stop()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Close the bar before a message is printed."""
        self.on_train_end(trainer, pl_module)

    def _note(self, trainer: L.Trainer) -> str:
        metrics = trainer.callback_metrics
        loss = float(metrics.get("train/loss", math.nan))
        error = float(metrics.get("train/pair_error", math.nan))
        rate = float(metrics.get("train/graphs_per_second", math.nan))
        return f"loss {loss:.3f}  error {error:.3f}  {rate:.1f} graphs/s"
