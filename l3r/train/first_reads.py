"""The first reads of a training run: every source once, and batches of every shape."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from l3r.config import RunConfig, SourceConfig
from l3r.data.loader import SkipGuard, StepLoader
from l3r.data.source import ShardFolder, open_folders
from l3r.data.steps import read_or_another
from l3r.errors import DataError

MIN_BATCHES = 3
"""Batches that are read at least, for a median."""
MAX_SEARCH = 10_000
"""Steps in which the first of each shape is looked for."""


@dataclass(frozen=True, kw_only=True)
class SourceFacts:
    """A source of graphs that can be read."""

    name: str
    """As in ``data.sources`` or ``data.validation``."""
    num_graphs: int
    """Graphs of ``data.num_views`` images or more, in its span."""
    share: float
    """Of the graphs that are drawn, or of those of all validation sources."""


@dataclass(frozen=True, kw_only=True)
class BatchRead:
    """A batch read in this process, by no other one ahead of it."""

    image_size: tuple[int, int]
    """(height, width)."""
    num_graphs: int
    """Graphs of it."""
    seconds: float
    """From the disk, or the web server, to tensors."""


def read_sources(config: RunConfig, loader: StepLoader) -> tuple[SourceFacts, ...]:
    """Read one graph of every training source.

    Args:
        config: Of the run.
        loader: Its training batches.

    Raises:
        DataError: One cannot be read.
    """
    sources, folders = config.data.sources, loader.dataset.folders
    total = sum(source.weight for source in sources.values())
    shares = [source.weight / total for source in sources.values()]
    return _read_each(config, sources, folders, shares)


def read_validation(config: RunConfig) -> tuple[SourceFacts, ...]:
    """Read one graph of every validation source.

    Raises:
        DataError: One cannot be read.
    """
    sources = config.data.validation
    folders = open_folders(sources, config.data)
    total = sum(map(len, folders))
    return _read_each(config, sources, folders, [len(folder) / total for folder in folders])


def read_batches(config: RunConfig, loader: StepLoader, first_step: int) -> tuple[BatchRead, ...]:
    """Read the first batch of every shape that the run draws, and the first few of all.

    Args:
        config: Of the run.
        loader: Its training batches; stays where it is.
        first_step: Steps that the run has taken already.

    Raises:
        DataError: Too many graphs cannot be read.
    """
    dataset, accumulate = loader.dataset, config.train.accumulate
    first, last = first_step * accumulate, config.train.max_steps * accumulate
    numbers = set(range(first, min(first + MIN_BATCHES, last)))
    missing = set(dataset.variation.image_sizes)
    for step in range(first_step, min(first_step + MAX_SEARCH, config.train.max_steps)):
        size = dataset.variation.draw_image_size(step)
        if size in missing:
            numbers.add(step * accumulate)
            missing.remove(size)
        if not missing:
            break
    here = replace(config.data, num_workers=0)
    reader = StepLoader(dataset, here, config.train.max_steps, pin_memory=False)
    reads = []
    for number in sorted(numbers):
        reader.batch = number
        began = time.perf_counter()
        views = next(iter(reader))
        seconds = time.perf_counter() - began
        height, width = views.image.shape[-2:]
        reads.append(
            BatchRead(image_size=(height, width), num_graphs=len(views.key), seconds=seconds)
        )
    return tuple(reads)


def _read_each(
    config: RunConfig,
    sources: dict[str, SourceConfig],
    folders: Sequence[ShardFolder],
    shares: Sequence[float],
) -> tuple[SourceFacts, ...]:
    height, width = config.model.image_size
    guard = SkipGuard(config.data.max_skip_rate)
    facts = []
    for name, folder, share in zip(sources, folders, shares, strict=True):
        skipped: list[str] = []
        if read_or_another(folder, 0, (height, width), skipped) is None:
            raise DataError(
                f"{folder.store.place}: none of {len(skipped)} graphs can be read; last: "
                f"{skipped[-1]}; run 'l3r-prep check' on it"
            )
        guard.count(1, skipped)
        facts.append(SourceFacts(name=name, num_graphs=len(folder), share=share))
    return tuple(facts)
