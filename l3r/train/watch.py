"""What a dry run measures: steps, memory, and the size of a checkpoint that is never written."""

import io
import math
import os
import time
from dataclasses import replace
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback

from l3r.config import RunConfig
from l3r.errors import LaunchError
from l3r.inference.clock import resident_peak_mib
from l3r.model.activations import count_kept
from l3r.model.light3r import Light3R
from l3r.train.checkpointing import CheckpointFiles, require_same_step
from l3r.train.ranks import Agreement, step_is_whole
from l3r.train.rehearsal import MemoryFacts, Size, StepFacts, tell
from l3r.train.signals import StopSignals
from l3r.types import Views

PATIENCE_SECONDS = 120.0
"""After so long no further step is begun."""


class StepWatch(Callback):
    """Measures the first steps, refuses what is not finite, and ends the run after a few of them.

    Waits for the device at the end of each step. Stands behind all that logs.

    Args:
        config: Of the run.
        num_steps: Steps to take, or fewer where time is over.
        signals: What has come in.
        agreement: With the other processes.
    """

    def __init__(
        self, config: RunConfig, num_steps: int, signals: StopSignals, agreement: Agreement
    ) -> None:
        self.config = config
        self.num_steps = num_steps
        self.signals = signals
        self.agreement = agreement
        self.steps: list[StepFacts] = []
        self.keys: list[str] = []
        self.waited = 0.0
        self.step_ended = self.batch_ended = 0.0
        self.device = torch.device("cpu")
        self.used = (0, 0, 0)  # peak, and on a GPU reserved and capacity

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Connect to the other processes."""
        self.agreement.open(self.config.train.timeout_minutes)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Check that all processes go on from the same step, and start the clock."""
        self.signals.install()
        require_same_step(trainer.global_step, self.config.train.output_dir, self.agreement)
        self.device = trainer.strategy.root_device
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        self.step_ended = self.batch_ended = time.perf_counter()

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Views, batch_idx: int
    ) -> None:
        """Take the time since the last batch ended."""
        self.waited += time.perf_counter() - self.batch_ended
        self.keys += batch.key

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Views,
        batch_idx: int,
    ) -> None:
        """Note a step, and decide with the other processes whether there is another."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        self.batch_ended = time.perf_counter()
        if not step_is_whole(trainer, batch_idx):
            return
        height, width = batch.image.shape[-2:]
        step = StepFacts(
            image_size=(height, width),
            seconds=self.batch_ended - self.step_ended,
            waited=self.waited,
            loss=float(trainer.callback_metrics["train/loss"]),
            grad_norm=float(trainer.callback_metrics["train/grad_norm"]),
        )
        self._take(step, is_first=trainer.is_global_zero)
        self.keys, self.waited = [], 0.0
        if self._is_enough(trainer):
            # Lightning validates before it stops.
            trainer.should_stop = True
        self.step_ended = self.batch_ended = time.perf_counter()

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Measure memory while all is still on its device."""
        self.used = (round(2**20 * resident_peak_mib()), 0, 0)
        if self.device.type == "cuda":
            own = (
                torch.cuda.max_memory_allocated(self.device),
                torch.cuda.max_memory_reserved(self.device),
                torch.cuda.get_device_properties(self.device).total_memory,
            )
            self.used = max(self.agreement.gather(own), key=lambda used: used[0] / used[2])

    def add_measured(self, memory: MemoryFacts, checkpoint_bytes: int) -> MemoryFacts:
        """Add what was measured to what was counted.

        Args:
            memory: As counted before the steps, of a process that keeps all.
            checkpoint_bytes: Size of a checkpoint; 0 on processes that make none.
        """
        others = checkpoint_bytes - memory.weights - memory.optimizer
        peak, reserved, capacity = self.used
        return replace(
            memory,
            # Configuration and counters are small.
            others=others if others > max(memory.weights // 4, 2**20) else 0,
            peak=peak,
            reserved=reserved,
            capacity=capacity,
        )

    def _take(self, step: StepFacts, *, is_first: bool) -> None:
        height, width = step.image_size
        if not (math.isfinite(step.loss) and math.isfinite(step.grad_norm)):
            keys = [key for part in self.agreement.gather(self.keys) for key in part]
            raise LaunchError(
                f"a step at {height}x{width} gives loss {step.loss}, gradient norm "
                f"{step.grad_norm}, expected finite ones; its graphs: {', '.join(keys)}"
            )
        self.steps.append(step)
        if is_first:
            number = len(self.steps)
            tell(f"step {number} at {height}x{width}: {step.seconds:.3g} s, loss {step.loss:.3g}")

    def _is_enough(self, trainer: L.Trainer) -> bool:
        # A step that compiles, or meets a GPU for the first time, says little of the others.
        least = 2 if self.device.type == "cuda" or self.config.train.compile else 1
        took = sum(step.seconds for step in self.steps[least - 1 :])
        is_late = len(self.steps) >= least and took > PATIENCE_SECONDS
        is_late, is_asked = self.agreement.any([is_late, bool(self.signals)])
        if is_asked:
            raise LaunchError("the dry run was asked to stop by a signal; nothing is left of it")
        is_last = trainer.global_step >= self.config.train.max_steps
        return is_late or is_last or len(self.steps) >= self.num_steps


class MeasuredFiles(CheckpointFiles):
    """Makes checkpoints to the last byte and keeps none of them.

    Attributes:
        num_bytes: Size of the last one.
    """

    num_bytes = 0

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any = None
    ) -> None:
        """Count what would be written."""
        meter = _Meter()
        torch.save(checkpoint, meter)
        self.num_bytes = meter.num_bytes


class _Meter(io.BytesIO):
    """A stream that counts and keeps nothing."""

    num_bytes = 0

    def write(self, data: Any) -> int:
        size = memoryview(data).nbytes
        self.num_bytes += size
        return size


def count_memory(model: Light3R, config: RunConfig, size: Size, num_graphs: int) -> MemoryFacts:
    """Count what a process will need for its largest batch, before it is run.

    Args:
        model: The network.
        config: Of the run.
        size: (height, width) of the largest images.
        num_graphs: Graphs of a batch.
    """
    train = config.train
    kept = count_kept(
        replace(config.model, image_size=list(size)),
        config.data.num_views,
        precision=train.precision,
        recompute=train.gradient_checkpointing,
    )
    weights = sum(x.nbytes for x in (*model.parameters(), *model.buffers()))
    gradients = sum(x.nbytes for x in model.parameters() if x.requires_grad)
    return MemoryFacts(
        weights=weights,
        gradients=gradients,
        optimizer=2 * gradients,  # AdamW's moments
        activations=num_graphs * sum(kept.values()),
    )
