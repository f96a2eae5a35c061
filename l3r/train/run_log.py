"""One row of figures now and then, for every place that keeps them."""

import json
import os
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import lightning as L
import torch
from jaxtyping import Float
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from l3r.export.graph_sheet import write_graph_sheet
from l3r.files import write_atomic
from l3r.train.csv_table import append_row, bear_loss_of, drop_rows_after
from l3r.train.ranks import Agreement, step_is_whole
from l3r.train.sinks import Sink
from l3r.types import Views
from l3r.version import __version__


class DatasetMeans:
    """Means of figures over the graphs of each data set, since they were last taken.

    Values that are not finite are left out: their steps are skipped. Adding does not wait for the
    device; taking does.

    Args:
        agreement: With the other processes.
    """

    def __init__(self, agreement: Agreement) -> None:
        self.agreement = agreement
        self._totals: dict[str, Float[Tensor, " 2"]] = {}  # sum and count

    def add(self, datasets: Sequence[str], figures: Mapping[str, Float[Tensor, " b"]]) -> None:
        """Add the figures of a batch's graphs."""
        for name, values in figures.items():
            is_finite = values.isfinite()
            known = torch.where(is_finite, values, torch.zeros_like(values))
            pairs = torch.stack([known, is_finite.to(values.dtype)], dim=1).detach()
            # Picked apart on the host: an index on the device would have to be sent there.
            for dataset, pair in zip(datasets, pairs, strict=True):
                key = f"{dataset}/{name}"
                before = self._totals.get(key)
                # What a checkpoint kept lies on the host.
                self._totals[key] = pair if before is None else pair + before.to(pair.device)

    def take(self) -> dict[str, float]:
        """Give the means over all processes, ``DATASET/FIGURE``, and start anew."""
        own = {key: total.tolist() for key, total in self._totals.items()}
        self._totals.clear()
        totals: dict[str, list[float]] = {}
        for part in self.agreement.gather(own):
            for key, (sum_, count) in part.items():
                before = totals.get(key, [0.0, 0.0])
                totals[key] = [before[0] + sum_, before[1] + count]
        return {key: sum_ / count for key, (sum_, count) in sorted(totals.items()) if count}

    def state_dict(self) -> dict[str, Any]:
        """Give what a checkpoint keeps, on all processes together: the sums of each, by rank."""
        own = {key: total.tolist() for key, total in self._totals.items()}
        return {"parts": self.agreement.gather(own)}

    def load_state_dict(self, state: Mapping[str, Any], rank: int, world_size: int) -> None:
        """Take up the state of a checkpoint, which is the same in all processes.

        Args:
            state: Of as many processes as wrote it.
            rank: This process, which takes the sums of ``rank``, ``rank + world_size``, ...
            world_size: Processes now.
        """
        self._totals.clear()
        for part in state["parts"][rank::world_size]:
            for key, total in part.items():
                pair = torch.tensor(total)
                self._totals[key] = self._totals.get(key, torch.zeros_like(pair)) + pair


class RunLog(Callback):
    """Writes ``metrics.csv`` (training), ``validation.csv`` and the sinks, one row a time.

    A resumed run first drops the rows after its checkpoint, so that a file reads as if the run
    had never stopped. Numbers leave the device on logged steps alone.

    Args:
        folder: The run's folder.
        every: Steps between training rows.
        agreement: With the other processes.
        sinks: Other places for the same rows.
        pictures: Whether to draw the first validation graph at each validation.
    """

    def __init__(
        self,
        folder: Path,
        every: int,
        agreement: Agreement,
        sinks: Sequence[Sink] = (),
        *,
        pictures: bool = False,
    ) -> None:
        self.folder = folder
        self.pictures = pictures
        self.training = folder / "metrics.csv"
        self.validation = folder / "validation.csv"
        self.every = every
        self.sinks = sinks
        self.agreement = agreement
        self.datasets = DatasetMeans(agreement)
        self.place = 0, 1
        self.lr = 0.0

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Find out which of how many processes this is, before a checkpoint is taken up."""
        self.place = trainer.global_rank, trainer.world_size

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Forget what a stopped run wrote after its checkpoint."""
        if trainer.is_global_zero:
            for path in (self.training, self.validation):
                drop_rows_after(path, trainer.global_step)
            write_machine(self.folder / "machine.json", trainer)
            for sink in self.sinks:
                sink.start(trainer.global_step)

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Views, batch_idx: int
    ) -> None:
        """Note the learning rate: when the step has ended, it is that of the next one."""
        self.lr = float(trainer.optimizers[0].param_groups[0]["lr"])

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Views,
        batch_idx: int,
    ) -> None:
        """Write a training row, once a step however many batches it has."""
        self.datasets.add(batch.dataset, outputs["graphs"])
        step = trainer.global_step
        if not row_is_due(trainer, step, self.every) or not step_is_whole(trainer, batch_idx):
            return
        row = {"lr": self.lr}
        own = _numbers(trainer.callback_metrics, "train/")
        parts = self.agreement.gather(own)
        row |= {name: sum(part[name] for part in parts) / len(parts) for name in own}
        if torch.cuda.is_available():
            row["gpu_gib"] = torch.cuda.max_memory_allocated() / 2**30
        self._write(trainer, "train", row | self.datasets.take())

    def on_validation_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Views,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Draw the first graph."""
        if batch_idx or not self.pictures or not trainer.is_global_zero:
            return
        step = trainer.global_step
        path = self.folder / "pictures" / f"step_{step:06d}.png"
        with bear_loss_of(f"the picture of step {step}"):
            path.parent.mkdir(exist_ok=True)
            write_graph_sheet(path, outputs["scene"], batch)
            for sink in self.sinks:
                sink.add_picture(step, path)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Write a validation row."""
        self._write(trainer, "val", _numbers(trainer.callback_metrics, "val/"))

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Flush the sinks."""
        if trainer.is_global_zero:
            for sink in self.sinks:
                sink.close()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Flush the sinks of a run that stops early."""
        self.on_train_end(trainer, pl_module)

    def state_dict(self) -> dict[str, Any]:
        """Give what a checkpoint keeps: sums since the last row, and what sinks go on with."""
        sinks = {type(sink).__name__: sink.state_dict() for sink in self.sinks}
        return {"datasets": self.datasets.state_dict(), "sinks": sinks}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take up the state of a checkpoint."""
        # Checkpoints of older versions have neither.
        self.datasets.load_state_dict(state_dict.get("datasets", {"parts": []}), *self.place)
        for sink in self.sinks:
            sink.load_state_dict(state_dict.get("sinks", {}).get(type(sink).__name__, {}))

    def _write(self, trainer: L.Trainer, kind: str, row: Mapping[str, float]) -> None:
        if not trainer.is_global_zero:
            return
        step = trainer.global_step
        path = self.training if kind == "train" else self.validation
        with bear_loss_of(f"the row of step {step} in {path.name}"):
            append_row(path, {"step": float(step), **row})
        for sink in self.sinks:
            with bear_loss_of(f"the row of step {step} in {type(sink).__name__}"):
                sink.write(step, {f"{kind}/{name}": value for name, value in row.items()})


def row_is_due(trainer: L.Trainer, step: int, every: int) -> bool:
    """Tell whether a training row is written after a step: every so many, and after the last."""
    return step % every == 0 or step == trainer.max_steps


def write_machine(path: Path, trainer: L.Trainer) -> None:
    """Note what a run is computed on, at each start."""
    device = trainer.strategy.root_device
    facts = {
        "host": platform.node(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU",
        "processes": trainer.world_size,
        "CPU cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "light3r": __version__,
        "torch": str(torch.__version__),
        "python": platform.python_version(),
        "started at step": trainer.global_step,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    write_atomic(path, json.dumps(facts, indent=1) + "\n")


def _numbers(metrics: Mapping[str, Tensor], prefix: str) -> dict[str, float]:
    chosen = {name: value for name, value in metrics.items() if name.startswith(prefix)}
    # Those of single data sets, which have one more slash, come last.
    names = sorted(chosen, key=lambda name: (name.count("/"), name))
    return {name.removeprefix(prefix): float(chosen[name]) for name in names}
