"""A training run rehearsed: its data, its memory and a few of its steps, nothing written."""

import math
import os
import shutil
import tempfile
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch

from l3r.config import RunConfig
from l3r.data.loader import StepLoader, build_training_loader
from l3r.data.sampling import Variation
from l3r.data.steps import DeviceShare
from l3r.errors import ConfigError, LaunchError
from l3r.inference.checkpoint import read_checkpoint
from l3r.loss.joint import JointLoss
from l3r.train.callbacks import StepProgress
from l3r.train.checkpointing import StepCheckpoint
from l3r.train.datamodule import ShardData
from l3r.train.first_reads import read_batches, read_sources, read_validation
from l3r.train.module import TrainModule
from l3r.train.ranks import Agreement, Ranks
from l3r.train.rehearsal import Rehearsal, Size, format_bytes, tell
from l3r.train.run import Start, build_callbacks, build_trainer, explain_failures, prepare_start
from l3r.train.signals import StopSignals
from l3r.train.watch import MeasuredFiles, StepWatch, count_memory

STEPS_OF_A_SHAPE = 3
"""Steps of each shape, the first of which warms up."""
KEPT_CHECKPOINTS = 3
"""For which there must be room: last, previous, and the one being written."""


def rehearse(config: RunConfig) -> Rehearsal:
    """Do all that a training run does at its start, and a few steps; leave nothing behind.

    The steps are those of the real trainer, with batches of the largest shape first, and a
    validation of a graph for each process. Checkpoints are made and not written; the rest goes to
    a temporary folder. Where the devices that the configuration names are not here, one process
    takes the share of one. As in training, lightning starts processes on further devices by the
    command line of this one.

    Raises:
        CheckpointError: See :func:`l3r.train.run.train`.
        ConfigError: The run would be refused, or is finished.
        DataError: A source cannot be read.
        LaunchError: A step fails, is not finite or does not fit into memory, or there is no room
            for checkpoints.
    """
    start = prepare_start(config)
    free_bytes = _find_room(Path(config.train.output_dir))
    first_step = _find_first_step(config, start)
    here = _find_processes(config, start.ranks)
    own = _take_share(config, start.ranks, here)
    shapes = config.data.image_sizes or [config.model.image_size]
    sizes = sorted({(height, width) for height, width in shapes}, key=math.prod, reverse=True)
    rehearsal = Rehearsal(
        config=config,
        ranks=start.ranks,
        num_processes=here.world_size,
        first_step=first_step,
        image_sizes=tuple(sizes),
        free_bytes=free_bytes,
    )
    data = RehearsalData(own, here, rehearsal.image_sizes, first_step)
    if here.is_first:
        # Others wait for it when they first connect: what is wrong with the data is told once.
        rehearsal = _try_data(rehearsal, own, data.loader)
    parts = here.world_size * config.train.accumulate
    num_graphs = -(-own.data.graphs_per_step // parts)
    memory = count_memory(start.model, config, sizes[0], num_graphs)
    is_shared = config.train.strategy == "fsdp"
    _require_memory(memory.shared_out(here.world_size if is_shared else 1).counted, config, here)
    rehearsal = _try_steps(replace(rehearsal, memory=memory), own, here, start, data)
    needed = KEPT_CHECKPOINTS * rehearsal.checkpoint_bytes
    if needed > free_bytes:
        raise LaunchError(
            f"{config.train.output_dir}: {format_bytes(free_bytes)} free, expected room for "
            f"{KEPT_CHECKPOINTS} checkpoints of {format_bytes(rehearsal.checkpoint_bytes)}; free "
            "space, or take another train.output_dir"
        )
    return rehearsal


@dataclass(frozen=True, kw_only=True)
class ShapesInTurn(Variation):
    """Gives ``STEPS_OF_A_SHAPE`` steps to each shape instead of drawing one.

    Args:
        first_step: Steps that the run has taken already.
    """

    first_step: int

    def draw_image_size(self, step: int) -> Size:
        """Give the (height, width) of a step's images."""
        turn = (step - self.first_step) // STEPS_OF_A_SHAPE
        return self.image_sizes[turn % len(self.image_sizes)]


class RehearsalData(ShardData):
    """The data of a run, its training batches of the largest shape first.

    Args:
        config: The whole run.
        ranks: The processes that take the steps.
        sizes: Shapes in the order in which they are tried.
        first_step: Steps that the run has taken already.
    """

    def __init__(
        self, config: RunConfig, ranks: Ranks, sizes: tuple[Size, ...], first_step: int
    ) -> None:
        super().__init__(config)
        self.ranks = ranks
        self.sizes = sizes
        self.first_step = first_step

    @cached_property
    def loader(self) -> StepLoader:
        """The training batches of this process, as the run will have them."""
        height, width = self.config.model.image_size
        train = self.config.train
        rank, world_size = self.ranks.rank, self.ranks.world_size
        return build_training_loader(
            self.config.data,
            (height, width),
            seed=train.seed,
            num_steps=train.max_steps,
            share=DeviceShare(rank=rank, world_size=world_size, accumulate=train.accumulate),
        )

    def train_dataloader(self) -> StepLoader:
        """Give these batches with shapes in turn."""
        drawn = self.loader.dataset.variation
        self.loader.dataset.variation = ShapesInTurn(
            image_sizes=self.sizes,
            color_jitter=drawn.color_jitter,
            seed=drawn.seed,
            first_step=self.first_step,
        )
        return self.loader


def _try_data(rehearsal: Rehearsal, config: RunConfig, loader: StepLoader) -> Rehearsal:
    """Read from every source, and batches of every shape."""
    sources = read_sources(config, loader)
    validation = read_validation(config)
    tell(f"one graph of each of {len(sources) + len(validation)} sources is read")
    reads = read_batches(config, loader, rehearsal.first_step)
    tell(f"{len(reads)} batches are read")
    return replace(rehearsal, sources=sources, validation=validation, reads=reads)


def _try_steps(
    rehearsal: Rehearsal, config: RunConfig, here: Ranks, start: Start, data: RehearsalData
) -> Rehearsal:
    """Let the real trainer take a few steps."""
    sizes = rehearsal.image_sizes
    if here.is_first:
        tell(f"taking steps, the first at {sizes[0][0]}x{sizes[0][1]}")
    agreement = Agreement()
    files = MeasuredFiles(config.train.accumulate)
    with _open_folder(here) as folder, StopSignals() as signals:
        config.train.output_dir = folder
        watch = StepWatch(config, STEPS_OF_A_SHAPE * len(sizes), signals, agreement)
        callbacks = build_callbacks(config, signals, [], agreement)
        callbacks = [c for c in callbacks if not isinstance(c, StepProgress | StepCheckpoint)]
        trainer = build_trainer(config, here, [*callbacks, watch], files)
        module = TrainModule(config, start.model, JointLoss(config.loss), agreement)
        with explain_failures(trainer, here, config.train):
            trainer.fit(module, datamodule=data, ckpt_path=start.resume_from, weights_only=True)
            trainer.save_checkpoint(Path(folder) / "last.ckpt")
    memory = watch.add_measured(rehearsal.memory, files.num_bytes)
    if config.train.strategy == "fsdp":
        memory = memory.shared_out(rehearsal.ranks.world_size)
    name = torch.cuda.get_device_name(watch.device) if watch.device.type == "cuda" else "CPU"
    return replace(
        rehearsal,
        device=name,
        steps=tuple(watch.steps),
        memory=memory,
        checkpoint_bytes=files.num_bytes,
    )


def _open_folder(here: Ranks) -> AbstractContextManager[str]:
    """Make a folder for what the first process writes; others, which srun may kill, need none."""
    if here.is_first:
        return tempfile.TemporaryDirectory(prefix="l3r-dry-run-")
    return nullcontext(os.devnull)


def _find_room(folder: Path) -> int:
    """Find out how much may be written to a folder, which need not exist."""
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    if not there.is_dir():
        raise ConfigError(f"train.output_dir={folder}: {there} is a file, expected a folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"train.output_dir={folder}: {there} cannot be written to")
    kept = sum(path.stat().st_size for path in folder.glob("*.ckpt"))
    return shutil.disk_usage(there).free + kept


def _find_first_step(config: RunConfig, start: Start) -> int:
    """Find out how many steps the run has taken already."""
    if start.resume_from is None:
        return 0
    step = int(read_checkpoint(start.resume_from, mapped=True)["global_step"])
    if step >= config.train.max_steps:
        raise ConfigError(
            f"{start.resume_from}: finished at step {step} of "
            f"train.max_steps={config.train.max_steps}; there is nothing left to train"
        )
    return step


def _find_processes(config: RunConfig, ranks: Ranks) -> Ranks:
    """Find out which processes can take the steps: those of the run, or one in their place."""
    train = config.train
    is_short = train.accelerator != "cpu" and torch.cuda.device_count() < ranks.devices
    is_apart = ranks.num_nodes > 1 and "NODE_RANK" not in os.environ
    if ranks.world_size > 1 and not ranks.is_srun and (is_short or is_apart):
        return Ranks(rank=0, devices=1, num_nodes=1, is_srun=False)
    return ranks


def _take_share(config: RunConfig, ranks: Ranks, here: Ranks) -> RunConfig:
    """Give the configuration of the processes that are here, with no more validation than needed.

    One process in place of all gets a step's graphs of one, so that its batches are as large.
    """
    graphs = -(-config.data.graphs_per_step * here.world_size // ranks.world_size)
    train = replace(
        config.train,
        validate_every=config.train.max_steps + 1,
        validation_graphs=min(config.train.validation_graphs, here.world_size),
    )
    return replace(config, data=replace(config.data, graphs_per_step=graphs), train=train)


def _require_memory(num_bytes: int, config: RunConfig, here: Ranks) -> None:
    """Refuse steps on a CPU that would drive this machine out of its memory."""
    facts = Path("/proc/meminfo")
    if (config.train.accelerator != "cpu" and torch.cuda.is_available()) or not facts.exists():
        return
    lines = (line.split() for line in facts.read_text().splitlines())
    free = next(1024 * int(words[1]) for words in lines if words[0] == "MemAvailable:")
    if here.devices * num_bytes > free:
        raise LaunchError(
            f"a step takes about {format_bytes(here.devices * num_bytes)} of memory "
            f"({here.devices} x {format_bytes(num_bytes)}), {format_bytes(free)} is free here; run "
            "this in a job of the kind that will train, or say what that will have: "
            "train.devices=8 train.num_nodes=1, say"
        )
