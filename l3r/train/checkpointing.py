"""Checkpoints that are whole or absent."""

import logging
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning as L
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from lightning.pytorch.callbacks import Checkpoint

from l3r.config import RunConfig, find_changes, from_plain
from l3r.errors import CheckpointError, ConfigError, LaunchError
from l3r.files import hidden_sibling, hidden_siblings
from l3r.inference.checkpoint import read_checkpoint
from l3r.model.weight_files import write_checkpoint
from l3r.train.ranks import Agreement, step_is_whole
from l3r.train.signals import SAVE_AND_END, SAVE_AND_REQUEUE, StopSignals, requeue_job
from l3r.types import Views

log = logging.getLogger(__name__)

FREE_TO_CHANGE = {
    "data.cache_dir",
    "data.cache_gb",
    "data.max_skip_rate",
    "data.num_workers",
    "data.prefetch_factor",
    "train.accelerator",
    "train.accumulate",
    "train.checkpoint_every",
    "train.checkpoint_minutes",
    "train.devices",
    "train.gradient_checkpointing",
    "train.init",
    "train.log_every",
    "train.max_bad_steps",
    "train.note",
    "train.num_nodes",
    "train.output_dir",
    "train.strategy",
    "train.timeout_minutes",
    "train.validate_every",
    "train.validation_graphs",
}
"""Keys that may differ when a run is resumed; they do not change what is learnt."""


class CheckpointFiles(TorchCheckpointIO):
    """Writes ``last.ckpt`` whole or not at all, keeps the one before; reads without pickles.

    A checkpoint that cannot be written, for want of space most often, is warned of and the run
    goes on with the last good one in place.

    Attributes:
        problem: Why the last attempt to write failed; empty: it did not.
    """

    def __init__(self, accumulate: int) -> None:
        super().__init__()
        self.accumulate = accumulate
        self.problem = ""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any = None
    ) -> None:
        """Write a checkpoint beside the last one, then let it take its place."""
        last = Path(path)
        fresh = hidden_sibling(last)
        self.problem = ""
        try:
            write_checkpoint(fresh, checkpoint)
            if last.exists():
                last.replace(previous_of(last))
            fresh.replace(last)
        # Torch turns a write that fails into a RuntimeError of its archive writer.
        except (OSError, RuntimeError) as error:
            cause = error if isinstance(error, OSError) else error.__context__ or error
            self.problem = str(cause).split("\n")[0]
            log.warning(
                "%s: step %s cannot be saved (%s); the checkpoint before it stays; make room",
                *(last, checkpoint.get("global_step"), self.problem),
            )

    def load_checkpoint(
        self, path: str | os.PathLike[str], map_location: Any = None, weights_only: Any = None
    ) -> dict[str, Any]:
        """Read a checkpoint without executing anything in it."""
        content = read_checkpoint(Path(path))
        fit_progress(content, self.accumulate)
        return content


class StepCheckpoint(Checkpoint):
    """Saves after whole steps: every so many, every so many minutes, and when a signal asks.

    All processes decide alike. SIGUSR1 saves and, in a SLURM job, requeues it and ends the run;
    SIGTERM saves and ends it.

    Args:
        path: The checkpoint.
        config: Of the run.
        signals: What has come in.
        agreement: With the other processes.
    """

    def __init__(
        self, path: Path, config: RunConfig, signals: StopSignals, agreement: Agreement
    ) -> None:
        self.path = path
        self.config = config.train
        self.has_validation = bool(config.data.validation and config.train.validation_graphs)
        self.signals = signals
        self.agreement = agreement
        self.saved_at = 0.0
        self.is_owed = False

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Connect to the other processes."""
        self.agreement.open(self.config.timeout_minutes)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Check that all processes have read the same checkpoint."""
        self.signals.install()
        self.saved_at = time.monotonic()
        require_same_step(trainer.global_step, str(self.path), self.agreement)

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Views,
        batch_idx: int,
    ) -> None:
        """Save where it is time to, and stop where it is asked."""
        if not step_is_whole(trainer, batch_idx):
            return
        step = trainer.global_step
        minutes = self.config.checkpoint_minutes
        is_late = minutes is not None and time.monotonic() - self.saved_at > 60 * minutes
        requeue, end, late = self.agreement.any(
            [SAVE_AND_REQUEUE in self.signals, SAVE_AND_END in self.signals, is_late]
        )
        is_asked = requeue or end
        if is_asked or late or step % self.config.checkpoint_every == 0:
            # Where a validation comes next, lightning would not go back to it from here.
            self.is_owed = self.has_validation and step % self.config.validate_every == 0
            if is_asked or not self.is_owed:
                self._save(trainer)
        if (requeue or end) and step < trainer.max_steps:
            self._stop(trainer, "SIGTERM" if end else "SIGUSR1")

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save what was due at the step before."""
        if self.is_owed:
            self._save(trainer)

    def _save(self, trainer: L.Trainer) -> None:
        trainer.save_checkpoint(self.path)
        self.saved_at = time.monotonic()
        self.is_owed = False

    def _stop(self, trainer: L.Trainer, name: str) -> None:
        said = f"{name}: step {trainer.global_step} is saved in {self.path}"
        if name == "SIGTERM":
            raise LaunchError(f"{said}; the same command goes on from there")
        self.signals.forget(SAVE_AND_REQUEUE)
        if "SLURM_JOB_ID" not in os.environ:
            return
        outcome = requeue_job() if trainer.is_global_zero else ""
        # None ends before the controller knows: a process that ends may end the job.
        outcome = str(self.agreement.gather(outcome)[0])
        raise LaunchError(f"{said}; {outcome}")


def require_same_step(step: int, where: str, agreement: Agreement) -> None:
    """Check that all processes have read the same checkpoint.

    Args:
        step: That this process goes on from.
        where: The checkpoint or its folder, for the message.
        agreement: With the other processes.

    Raises:
        CheckpointError: They have not.
    """
    steps = agreement.gather(step)
    if len(set(steps)) > 1:
        raise CheckpointError(
            f"{where}: the processes go on from steps {steps}, by rank; expected the same; "
            "train.output_dir must be a folder that all nodes share"
        )


def previous_of(path: Path) -> Path:
    """Where the checkpoint before the last one is kept."""
    return path.with_name(f"previous{path.suffix}")


def find_resume(checkpoint: Path, config: RunConfig) -> Path | None:
    """Find what a run goes on from: the last checkpoint, or the one before if it is damaged.

    Raises:
        CheckpointError: There are checkpoints and none can be read.
        ConfigError: It was made with another configuration.
    """
    present = [path for path in (checkpoint, previous_of(checkpoint)) if path.exists()]
    damage: list[str] = []
    for path in present:
        try:
            content = read_checkpoint(path, mapped=True)
        except CheckpointError as error:
            damage.append(str(error))
            continue
        for line in damage:
            log.warning("%s; going on from %s", line, path)
        _require_same_run(path, content, config)
        return path
    if damage:
        raise CheckpointError(f"{damage[0]}; or move it away to begin anew")
    return None


def clear_leftovers(checkpoint: Path) -> None:
    """Remove what processes that were killed while writing it have left; it may be large."""
    for path in hidden_siblings(checkpoint):
        path.unlink(missing_ok=True)


def fit_progress(checkpoint: dict[str, Any], accumulate: int) -> None:
    """Make lightning's count of batches that of a run with another ``train.accumulate``.

    Args:
        checkpoint: As read; changed in place.
        accumulate: Batches of a step, from now on.
    """
    before = checkpoint["l3r_config"]["train"].get("accumulate", 1)
    if before == accumulate or "loops" not in checkpoint:
        return
    progress = checkpoint["loops"]["fit_loop"]["epoch_loop.batch_progress"]
    for counts in (progress["total"], progress["current"]):
        # How many are ready but not completed says where in a step lightning saved.
        shift = counts["ready"] // before * accumulate - counts["ready"]
        for key in ("ready", "started", "processed", "completed"):
            counts[key] += shift


def _require_same_run(path: Path, content: Mapping[str, Any], config: RunConfig) -> None:
    # Keys that are younger than the checkpoint count as their defaults.
    before = from_plain(content["l3r_config"], str(path))
    for key, (old, new) in find_changes(before, config).items():
        if not may_change(key, config):
            raise ConfigError(
                f"{path}: made with {key}={old}, this run has {new}; "
                "give that value, or another train.output_dir"
            )
    if config.train.max_steps < content.get("global_step", 0):
        raise CheckpointError(f"{path}: is past train.max_steps={config.train.max_steps}")


def may_change(key: str, config: RunConfig) -> bool:
    """Tell whether a resumed run may have another value of a key than its checkpoint."""
    if key == "train.max_steps":
        return config.train.schedule == "constant"
    # Shards may move; logs and inference change nothing that is learnt.
    is_elsewhere = key.endswith(".shards") or key.startswith(("inference.", "logs."))
    return key in FREE_TO_CHANGE or is_elsewhere
