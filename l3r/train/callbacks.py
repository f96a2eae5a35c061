"""What happens around a step: timing, log, progress."""

import csv
import math
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)
from torch import Tensor

from l3r.errors import LaunchError
from l3r.files import write_atomic
from l3r.train.ranks import step_is_whole
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


class CsvLog(Callback):
    """Writes ``metrics.csv`` (training) and ``validation.csv`` in a folder, one row a time.

    A resumed run first drops the rows after its checkpoint, so that a file reads as if the run
    had never stopped.

    Args:
        folder: The run's folder.
        every: Steps between training rows.
    """

    def __init__(self, folder: Path, every: int) -> None:
        self.training = folder / "metrics.csv"
        self.validation = folder / "validation.csv"
        self.every = every

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Forget what a stopped run wrote after its checkpoint."""
        for path in (self.training, self.validation):
            _drop_rows_after(path, trainer.global_step)

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Views,
        batch_idx: int,
    ) -> None:
        """Write a training row."""
        if not step_is_whole(trainer, batch_idx):
            return
        step = trainer.global_step
        if step % self.every == 0 or step == trainer.max_steps:
            rate = trainer.optimizers[0].param_groups[0]["lr"]
            row = _numbers(trainer.callback_metrics, "train/")
            _append_row(self.training, {"step": float(step), "lr": float(rate), **row})

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Write a validation row."""
        row = _numbers(trainer.callback_metrics, "val/")
        _append_row(self.validation, {"step": float(trainer.global_step), **row})


class StepProgress(Callback):
    """A progress bar on standard error; a plain line now and then where that is no terminal."""

    def __init__(self) -> None:
        self.console = Console(stderr=True)
        self.progress: Progress | None = None
        self.began = (0, 0.0)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Open the bar."""
        self.began = (trainer.global_step, time.perf_counter())
        if self.console.is_terminal:
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
        if not step_is_whole(trainer, batch_idx):
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


def _numbers(metrics: Mapping[str, Tensor], prefix: str) -> dict[str, float]:
    chosen = {name: value for name, value in metrics.items() if name.startswith(prefix)}
    return {name.removeprefix(prefix): float(value) for name, value in sorted(chosen.items())}


def _append_row(path: Path, row: Mapping[str, float]) -> None:
    is_new = not path.exists()
    if not is_new:
        with path.open(newline="") as stream:
            header = next(csv.reader(stream), [])
        if header != list(row):
            raise LaunchError(
                f"{path}: columns {header}, this version writes {list(row)}; move the file away"
            )
    with path.open("a", newline="") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(row))
        if is_new:
            writer.writeheader()
        writer.writerow({name: f"{value:.9g}" for name, value in row.items()})


def _drop_rows_after(path: Path, step: int) -> None:
    if not path.exists():
        return
    with path.open(newline="") as stream:
        reader = csv.DictReader(stream)
        header = list(reader.fieldnames or [])
        # A kill in the middle of a write leaves half a row, which has fewer fields.
        rows = [row for row in reader if None not in row.values() and float(row["step"]) <= step]
    lines = [",".join(header), *(",".join(row[name] for name in header) for row in rows)]
    write_atomic(path, ("\n".join(lines) + "\n").encode())
