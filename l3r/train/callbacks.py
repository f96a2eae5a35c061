"""What happens around a step: measures and progress."""

import math
import sys
import time
from dataclasses import dataclass
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

from l3r.data.loader import StepLoader
from l3r.train.ranks import step_is_whole
from l3r.train.run_log import row_is_due
from l3r.train.sharding import total_norm
from l3r.types import Views


@dataclass(frozen=True, kw_only=True)
class Pace:
    """What whole steps took, by the clock of the host."""

    steps: int = 0
    """Optimisation steps."""
    seconds: float = 0.0
    """Wall time, without validation."""
    waited: float = 0.0
    """Seconds of it in which this process waited for the loader."""

    def since(self, before: "Pace") -> "Pace":
        """The steps after an earlier reading."""
        return Pace(
            steps=self.steps - before.steps,
            seconds=self.seconds - before.seconds,
            waited=self.waited - before.waited,
        )

    @property
    def steps_per_second(self) -> float:
        """Throughput."""
        return self.steps / max(self.seconds, 1e-9)

    @property
    def data_wait(self) -> float:
        """Share of the time spent waiting for the loader."""
        return self.waited / max(self.seconds, 1e-9)


class StepTimer(Callback):
    """Measures throughput and the wait for data, over the steps since the row of the log before.

    Logs ``train/graphs_per_second`` and ``train/data_wait``. The host runs ahead of a GPU within a
    step, so that its times of one step mean little; over several they are the device's.

    Args:
        every: Steps between rows of the log.
        graphs_per_step: Of all processes.
    """

    def __init__(self, every: int, graphs_per_step: int) -> None:
        self.every = every
        self.graphs_per_step = graphs_per_step
        self.first_step = 0
        self.began = 0.0
        self.paused_at = 0.0
        self.logged = Pace()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the clock."""
        self.first_step = trainer.global_step
        self.began = time.perf_counter()

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Views,
        batch_idx: int,
    ) -> None:
        """Log the means where a row is due."""
        step = trainer.global_step
        if not step_is_whole(trainer, batch_idx) or not row_is_due(trainer, step, self.every):
            return
        now = self.read(trainer)
        pace = now.since(self.logged)
        self.logged = now
        rate = self.graphs_per_second(pace)
        scalars = {"train/graphs_per_second": rate, "train/data_wait": pace.data_wait}
        # As tensors of the host: lightning sends plain numbers to the device, and waits for it.
        pl_module.log_dict({name: torch.tensor(value) for name, value in scalars.items()})

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Stop the clock."""
        self.paused_at = time.perf_counter()

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Let it go on."""
        self.began += time.perf_counter() - self.paused_at

    def read(self, trainer: L.Trainer) -> Pace:
        """Read the clock at the end of a step; nothing waits for the device."""
        loader = trainer.train_dataloader
        assert isinstance(loader, StepLoader)
        return Pace(
            steps=trainer.global_step - self.first_step,
            seconds=time.perf_counter() - self.began,
            waited=loader.waited,
        )

    def graphs_per_second(self, pace: Pace) -> float:
        """Throughput of all processes."""
        return self.graphs_per_step * pace.steps_per_second


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
        if not row_is_due(trainer, trainer.global_step + 1, self.every):
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
    """A progress bar on standard error; a plain line now and then where that is no terminal.

    Args:
        timer: Gives throughput and wait for data, here since the note before.
    """

    def __init__(self, timer: StepTimer) -> None:
        self.timer = timer
        self.noted = Pace()
        self.console = Console(stderr=True)
        self.progress: Progress | None = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Open the bar, on the first process."""
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
            left = (total - step) / self.timer.read(trainer).steps_per_second
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
        now = self.timer.read(trainer)
        pace = now.since(self.noted)
        self.noted = now
        rate = self.timer.graphs_per_second(pace)
        return f"loss {loss:.3f}  error {error:.3f}  {rate:.1f} graphs/s  data {pace.data_wait:.0%}"
