"""One training run: parse nothing, build, fit, write."""

import logging
import sys
import warnings
from pathlib import Path

import lightning as L
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from l3r.config import RunConfig, to_yaml
from l3r.errors import ConfigError
from l3r.files import write_atomic
from l3r.inference.checkpoint import write_model
from l3r.inference.weights import initialise
from l3r.loss.joint import JointLoss
from l3r.model.light3r import Light3R
from l3r.train.callbacks import GradientGuard, RoomGradients, StepProgress, StepTimer
from l3r.train.checkpointing import AtomicCheckpointIO, find_resume
from l3r.train.datamodule import ShardData
from l3r.train.module import TrainModule
from l3r.train.run_log import RunLog
from l3r.train.sinks import Sink, build_sinks


def train(config: RunConfig) -> Path:
    """Train, or go on from where the same run stopped.

    Writes in ``train.output_dir``: ``config.yaml``, ``metrics.csv``, ``validation.csv``,
    ``last.ckpt`` every ``checkpoint_every`` steps and ``model.ckpt``, weights alone, at the end.

    Returns:
        Path of ``model.ckpt``.

    Raises:
        CheckpointError: ``init`` cannot be read or does not fit; nothing is written then.
        ConfigError: No data, ``output_dir`` holds another run, or a package of ``logs.to`` is
            missing.
        DataError: The shards cannot be read.
        LaunchError: Too many bad steps in a row.
    """
    if config.train.accelerator == "gpu" and not torch.cuda.is_available():
        raise ConfigError("train.accelerator is gpu and torch finds none; use auto or cpu")
    folder = Path(config.train.output_dir)
    last = folder / "last.ckpt"
    sinks = build_sinks(config, folder)
    resume_from = find_resume(last, config)
    torch.manual_seed(config.train.seed)
    model = Light3R(config.model, config.graph)
    if config.train.init and resume_from is None:
        sys.stderr.write(initialise(model, Path(config.train.init)))
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(folder / "config.yaml", to_yaml(config).encode())
    model.recompute_activations(enabled=config.train.gradient_checkpointing)
    if config.train.compile:
        model.compile_blocks()
    module = TrainModule(config, model, JointLoss(config.loss))
    _quieten_lightning()
    trainer = _build_trainer(config, folder, sinks)
    trainer.fit(module, datamodule=ShardData(config), ckpt_path=resume_from, weights_only=True)
    trainer.save_checkpoint(last)
    write_model(folder / "model.ckpt", model, config)
    return folder / "model.ckpt"


def _build_trainer(config: RunConfig, folder: Path, sinks: list[Sink]) -> L.Trainer:
    train = config.train
    checkpoint = ModelCheckpoint(
        dirpath=folder,
        filename="last",
        every_n_train_steps=train.checkpoint_every,
        enable_version_counter=False,
    )
    return L.Trainer(
        accelerator=train.accelerator,
        precision="bf16-mixed" if train.precision == "bf16" else "32-true",
        devices=1,
        max_steps=train.max_steps,
        max_epochs=-1,
        # An integer limit keeps lightning from fetching a batch too many, which a resumed run
        # would miss; one epoch is the whole run, so that workers start once.
        limit_train_batches=train.max_steps,
        val_check_interval=train.validate_every,
        check_val_every_n_epoch=None,
        num_sanity_val_steps=0,
        gradient_clip_val=train.clip_norm,
        callbacks=[
            checkpoint,
            RoomGradients(train.log_every),
            GradientGuard(folder / "bad_steps.jsonl", train.max_bad_steps),
            StepTimer(),
            RunLog(folder, train.log_every, sinks, pictures=config.logs.pictures),
            StepProgress(),
        ],
        plugins=[AtomicCheckpointIO()],
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        log_every_n_steps=1,
    )


def _quieten_lightning() -> None:
    """Keep lightning's advertisements and its advice on other loaders out of the terminal."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning.*")
