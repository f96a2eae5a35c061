"""One training run: parse nothing, build, fit, write."""

import logging
import signal
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback

from l3r.config import RunConfig, TrainConfig, to_yaml
from l3r.errors import CheckpointError, ConfigError, LaunchError
from l3r.files import write_atomic
from l3r.inference.checkpoint import read_checkpoint, write_weights
from l3r.inference.weights import initialise
from l3r.loss.joint import JointLoss
from l3r.model.light3r import Light3R
from l3r.model.weight_files import network_weights
from l3r.train.callbacks import RoomGradients, StepProgress, StepTimer
from l3r.train.checkpointing import (
    CheckpointFiles,
    StepCheckpoint,
    clear_leftovers,
    find_resume,
)
from l3r.train.datamodule import ShardData
from l3r.train.ema import WeightAverage
from l3r.train.guard import GradientGuard, StepMean
from l3r.train.module import TrainModule
from l3r.train.ranks import Agreement, Ranks, explain_failure, find_ranks
from l3r.train.run_log import RunLog
from l3r.train.sharding import WholeNetwork
from l3r.train.signals import StopSignals
from l3r.train.sinks import Sink, build_sinks
from l3r.train.tf32 import NetworkTf32


@dataclass(frozen=True, kw_only=True)
class Start:
    """What a run begins with; nothing is written yet."""

    ranks: Ranks
    """The processes."""
    sinks: list[Sink]
    """Places for the log, on the first process."""
    resume_from: Path | None
    """Checkpoint that it goes on from."""
    model: Light3R
    """The network, with ``train.init`` in it where the run is new."""


def train(config: RunConfig) -> Path:
    """Train, or go on from where the same run stopped.

    Writes in ``train.output_dir``: ``config.yaml``, ``metrics.csv``, ``validation.csv``,
    ``last.ckpt`` every ``checkpoint_every`` steps and ``model.ckpt``, weights alone, at the end.
    Of several processes, the first one writes.

    Returns:
        Path of ``model.ckpt``.

    Raises:
        CheckpointError: ``init`` cannot be read or does not fit; nothing is written then. Or the
            end cannot be saved.
        ConfigError: No data, ``output_dir`` holds another run, or a package of ``logs.to`` is
            missing.
        DataError: The shards cannot be read.
        LaunchError: Too many bad steps in a row, another process was lost, memory ran out, or a
            signal came; the same call goes on.
    """
    start = prepare_start(config)
    ranks = start.ranks
    folder = Path(config.train.output_dir)
    last = folder / "last.ckpt"
    if ranks.is_first:
        folder.mkdir(parents=True, exist_ok=True)
        clear_leftovers(last)
        write_atomic(folder / "config.yaml", to_yaml(config).encode())
    agreement = Agreement()
    module = TrainModule(config, start.model, JointLoss(config.loss), agreement)
    files = CheckpointFiles(config.train.accumulate)
    with StopSignals() as signals:
        callbacks = build_callbacks(config, signals, start.sinks, agreement)
        trainer = build_trainer(config, ranks, callbacks, files)
        with explain_failures(trainer, ranks, config.train):
            trainer.fit(
                module, datamodule=ShardData(config), ckpt_path=start.resume_from, weights_only=True
            )
            trainer.save_checkpoint(last)
    if files.problem:
        raise CheckpointError(f"{last}: the end cannot be saved ({files.problem}); make room")
    if ranks.is_first:
        weights = network_weights(read_checkpoint(last, mapped=True))
        write_weights(folder / "model.ckpt", weights, config)
    return folder / "model.ckpt"


def prepare_start(config: RunConfig) -> Start:
    """Find and build all that can refuse a run before anything is written.

    Raises:
        CheckpointError: See :func:`train`.
        ConfigError: See :func:`train`.
    """
    if config.train.accelerator == "gpu" and not torch.cuda.is_available():
        raise ConfigError("train.accelerator is gpu and torch finds none; use auto or cpu")
    ranks = find_ranks(config)
    folder = Path(config.train.output_dir)
    sinks = build_sinks(config, folder) if ranks.is_first else []
    resume_from = find_resume(folder / "last.ckpt", config)
    model = _build_model(config, ranks, is_fresh=resume_from is None)
    return Start(ranks=ranks, sinks=sinks, resume_from=resume_from, model=model)


@contextmanager
def explain_failures(trainer: L.Trainer, ranks: Ranks, config: TrainConfig) -> Iterator[None]:
    """Make one line of what torch says of lost processes and of memory that ran out.

    Raises:
        LaunchError: That line.
    """
    try:
        yield
    except RuntimeError as error:
        explained = explain_failure(error, ranks, config)
        if isinstance(error, torch.OutOfMemoryError):
            explained = _explain_memory(error, ranks)
        if explained is None:
            raise
        if trainer.strategy.launcher is not None:
            # Those that this process started, and that may hang; srun ends its own.
            trainer.strategy.launcher.kill(signal.SIGKILL)
        raise explained from error


def _explain_memory(error: torch.OutOfMemoryError, ranks: Ranks) -> LaunchError:
    found = ". ".join(str(error).split("\n")[0].split(". ")[:3])
    return LaunchError(
        f"process {ranks.rank} of {ranks.world_size}: {found.rstrip('.')}; raise train.accumulate "
        "or the number of devices, or set train.gradient_checkpointing=true or "
        "train.precision=bf16"
    )


def _build_model(config: RunConfig, ranks: Ranks, *, is_fresh: bool) -> Light3R:
    torch.manual_seed(config.train.seed)
    model = Light3R(config.model, config.graph)
    if config.train.init and is_fresh:
        told = initialise(model, Path(config.train.init))
        if ranks.is_first:
            sys.stderr.write(told)
    model.recompute_activations(enabled=config.train.gradient_checkpointing)
    if config.train.compile:
        model.compile_blocks()
    return model


def build_callbacks(
    config: RunConfig, signals: StopSignals, sinks: list[Sink], agreement: Agreement
) -> list[Callback]:
    """Build what happens around the steps of a run."""
    train = config.train
    folder = Path(train.output_dir)
    timer = StepTimer(train.log_every, config.data.graphs_per_step)
    guard = GradientGuard(folder / "bad_steps.jsonl", train.max_bad_steps, agreement)
    callbacks: list[Callback] = [
        RoomGradients(train.log_every),
        StepMean(config),
        guard,
        NetworkTf32(enabled=train.tf32),
        timer,
        # On all processes, which give it their figures; the first one writes.
        RunLog(folder, train.log_every, agreement, sinks, pictures=config.logs.pictures),
        StepProgress(timer),
    ]
    if train.ema_decay is not None:
        callbacks.append(WeightAverage(train.ema_decay, guard))
    if train.strategy == "fsdp":
        callbacks.append(WholeNetwork())
    return [*callbacks, StepCheckpoint(folder / "last.ckpt", config, signals, agreement)]


def build_trainer(
    config: RunConfig, ranks: Ranks, callbacks: list[Callback], files: CheckpointFiles
) -> L.Trainer:
    """Build lightning's trainer of a run."""
    _quieten_lightning()
    train = config.train
    trainer = L.Trainer(
        accelerator=train.accelerator,
        precision="bf16-mixed" if train.precision == "bf16" else "32-true",
        devices=ranks.devices,
        num_nodes=ranks.num_nodes,
        strategy=ranks.strategy(train),
        max_steps=train.max_steps,
        max_epochs=-1,
        accumulate_grad_batches=train.accumulate,
        # An integer limit keeps lightning from fetching a batch too many, which a resumed run
        # would miss; one epoch is the whole run, so that workers start once.
        limit_train_batches=train.max_steps * train.accumulate,
        val_check_interval=train.validate_every * train.accumulate,
        check_val_every_n_epoch=None,
        num_sanity_val_steps=0,
        gradient_clip_val=train.clip_norm,
        callbacks=callbacks,
        plugins=[files, ranks.environment()],
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        log_every_n_steps=1,
    )
    # Before every batch lightning asks all processes for SIGTERM, and waits for the device. Here
    # StepCheckpoint asks, after whole steps, and nobody waits.
    trainer.fit_loop.epoch_loop._broadcast_sigterm_tensor = lambda: None  # type: ignore[method-assign]
    return trainer


def _quieten_lightning() -> None:
    """Keep lightning's advertisements and its advice on other loaders out of the terminal."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning.*")
