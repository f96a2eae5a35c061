"""The step-indexed loader: step number in, batch out, in any process.

Its whole state is one integer. Workers prefetch, but the count is kept in the main process, so a
resumed run goes on with the very next sample whatever the workers had read ahead.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset

from l3r.config import DataConfig, SourceConfig
from l3r.data.sampling import SampleChooser
from l3r.data.source import ShardFolder
from l3r.data.stages import collate, resize_crop, to_views
from l3r.errors import ConfigError, DataError
from l3r.types import Views

log = logging.getLogger(__name__)

LOG_SKIP_EVERY = 100
MAX_ATTEMPTS = 20
"""Unreadable graphs in a row after which the source is given up."""
MIN_READ_BEFORE_STOP = 200
"""A skip rate over fewer reads says little."""


@dataclass(frozen=True, kw_only=True)
class DeviceShare:
    """The slots of a step that one device takes: ``rank``, ``rank + world_size``, ..."""

    rank: int = 0
    world_size: int = 1


@dataclass(frozen=True, kw_only=True)
class StepBatch:
    """What a worker sends: the batch and what it had to leave out."""

    views: Views | None
    """The batch; None where no sample of a source could be read."""
    skipped: list[str]
    """One line for each unreadable sample, which another of the same source replaced."""

    def pin_memory(self) -> "StepBatch":
        """Pin the batch's tensors."""
        pinned = None if self.views is None else self.views.pin_memory()
        return StepBatch(views=pinned, skipped=self.skipped)


class StepDataset(Dataset[StepBatch]):
    """Batches by step number.

    Args:
        folders: Shards of each source.
        chooser: Says which graph stands where.
        image_size: (height, width) of the batch.
        share: Which slots are this device's.
    """

    def __init__(
        self,
        folders: list[ShardFolder],
        chooser: SampleChooser,
        image_size: tuple[int, int],
        share: DeviceShare,
    ) -> None:
        self.folders = folders
        self.chooser = chooser
        self.image_size = image_size
        self.slots = range(share.rank, chooser.slots_per_step, share.world_size)

    def __getitem__(self, step: int) -> StepBatch:
        """Read this device's graphs of a step."""
        skipped: list[str] = []
        graphs: list[Views] = []
        for slot in self.slots:
            source, first = self.chooser.choose(step, slot)
            views = read_or_next(self.folders[source], first, self.image_size, skipped)
            if views is None:
                # Not raised here: an error that leaves a worker arrives as a traceback.
                return StepBatch(views=None, skipped=skipped)
            graphs.append(views)
        return StepBatch(views=collate(graphs), skipped=skipped)


class StepLoader:
    """Endless batches from a step on, for lightning's trainer.

    Args:
        dataset: Batches by step number.
        config: ``num_workers`` and ``max_skip_rate``.
        num_steps: Where to end.
        pin_memory: Whether batches go to an accelerator.
    """

    def __init__(
        self, dataset: StepDataset, config: DataConfig, num_steps: int, *, pin_memory: bool
    ) -> None:
        self.dataset = dataset
        self.config = config
        self.num_steps = num_steps
        self.pin_memory = pin_memory
        self.step = 0
        self.num_read = 0
        self.num_skipped = 0

    def __iter__(self) -> Iterator[Views]:
        """Yield batches from the current step.

        Raises:
            DataError: More than ``max_skip_rate`` of the samples cannot be read.
        """
        loader = DataLoader(
            self.dataset,
            batch_size=None,
            sampler=range(self.step, self.num_steps),
            num_workers=self.config.num_workers,
            pin_memory=self.pin_memory,
            # Forked workers of a process that has used threads can hang; these import afresh.
            multiprocessing_context="spawn" if self.config.num_workers else None,
            worker_init_fn=_use_one_thread,
        )
        for batch in loader:
            self._count(batch)
            if batch.views is None:
                raise DataError(
                    f"{MAX_ATTEMPTS} graphs in a row cannot be read; last: {batch.skipped[-1]}; "
                    "check that the folder of shards is there, and run 'l3r-prep check' on it"
                )
            self.step += 1
            yield batch.views

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs."""
        return {"step": self.step}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on after the step of a checkpoint."""
        self.step = int(state["step"])

    def _count(self, batch: StepBatch) -> None:
        self.num_read += len(self.dataset.slots) + len(batch.skipped)
        for line in batch.skipped:
            if self.num_skipped % LOG_SKIP_EVERY == 0:
                log.warning("sample skipped (%d so far): %s", self.num_skipped + 1, line)
            self.num_skipped += 1
        rate = self.num_skipped / self.num_read
        if rate > self.config.max_skip_rate and self.num_read >= MIN_READ_BEFORE_STOP:
            raise DataError(
                f"{self.num_skipped} of {self.num_read} samples cannot be read, more than "
                f"data.max_skip_rate={self.config.max_skip_rate}; last: {batch.skipped[-1:]}; "
                "run 'l3r-prep check' on the shards"
            )


def open_folders(sources: dict[str, SourceConfig], num_views: int) -> list[ShardFolder]:
    """Open the shards of every source.

    Raises:
        DataError: A folder holds no finished shards.
    """
    return [
        ShardFolder(Path(source.shards), num_views, (source.span[0], source.span[1]))
        for source in sources.values()
    ]


def build_training_loader(
    config: DataConfig,
    image_size: tuple[int, int],
    *,
    seed: int,
    num_steps: int,
    share: DeviceShare,
) -> StepLoader:
    """Build the loader of a training run on one device.

    Raises:
        ConfigError: There is no source, or the graphs of a step do not split over the devices.
        DataError: A folder holds no finished shards.
    """
    if not config.sources:
        raise ConfigError("data.sources is empty; add data.sources.NAME.shards=FOLDER")
    if config.graphs_per_step % share.world_size:
        raise ConfigError(
            f"data.graphs_per_step is {config.graphs_per_step}, expected a multiple of the "
            f"{share.world_size} devices"
        )
    folders = open_folders(config.sources, config.num_views)
    weights = [source.weight for source in config.sources.values()]
    sizes = [len(folder) for folder in folders]
    chooser = SampleChooser(sizes, weights, config.graphs_per_step, seed)
    dataset = StepDataset(folders, chooser, image_size, share)
    return StepLoader(dataset, config, num_steps, pin_memory=torch.cuda.is_available())


def read_or_next(
    folder: ShardFolder, index: int, image_size: tuple[int, int], skipped: list[str]
) -> Views | None:
    """Read a graph as a batch of one; the next ones stand in for an unreadable one.

    Args:
        folder: Where it is.
        index: Which one.
        image_size: (height, width).
        skipped: Receives a line for each unreadable one.

    Returns:
        None where ``MAX_ATTEMPTS`` in a row cannot be read.
    """
    for attempt in range(min(MAX_ATTEMPTS, len(folder))):
        current = (index + attempt) % len(folder)
        try:
            return read_graph(folder, current, image_size)
        except DataError as error:
            skipped.append(f"{folder.key(current)}: {error}")
    return None


def read_graph(folder: ShardFolder, index: int, image_size: tuple[int, int]) -> Views:
    """Read one graph as a batch of one.

    Raises:
        DataError: The graph cannot be read.
    """
    (views,) = to_views(resize_crop([folder.read(index)], image_size=image_size))
    return views


def _use_one_thread(worker: int) -> None:
    torch.set_num_threads(1)
