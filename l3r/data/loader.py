"""The step-indexed loader: step number in, batch out, in any process.

Its whole state is one integer. Workers prefetch, but the count is kept in the main process, so a
resumed run goes on with the very next sample whatever the workers had read ahead.
"""

import logging
import os
import signal
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Any, TypeVar

import cv2
import torch
from torch.utils.data import DataLoader, Dataset

from l3r.config import DataConfig
from l3r.data.sampling import SampleChooser, Variation
from l3r.data.source import open_folders
from l3r.data.steps import DeviceShare, StepDataset
from l3r.errors import ConfigError, DataError, LaunchError
from l3r.types import Views

log = logging.getLogger(__name__)

LOG_SKIP_EVERY = 100
SKIP_WINDOW = 1000
"""Samples over which the rate of unreadable ones is taken."""
MAX_TEMPORARY_PATH = 107 - len("/pymp-12345678/listener-12345678")
"""Longest path, in bytes, that leaves room for a socket's name as Python makes it."""
GRACE_SECONDS = 10
"""For how long a loader process that is told to end goes on delivering."""

Item = TypeVar("Item")


class SkipGuard:
    """Counts unreadable samples and stops the run where there are too many.

    The rate is that of a device's last ``SKIP_WINDOW`` samples, so that it neither hides what
    breaks late in a run nor needs the devices to speak to each other.

    Args:
        max_rate: Share of unreadable samples that is borne.
    """

    def __init__(self, max_rate: float) -> None:
        self.max_rate = max_rate
        self.total = 0
        self._window: deque[bool] = deque(maxlen=SKIP_WINDOW)

    def count(self, num_read: int, skipped: list[str]) -> None:
        """Take note of a batch; the first unreadable sample and each hundredth are logged.

        Args:
            num_read: Samples that could be read.
            skipped: A line for each that could not.

        Raises:
            DataError: Too many cannot be read.
        """
        for line in skipped:
            self.total += 1
            if self.total == 1 or self.total % LOG_SKIP_EVERY == 0:
                log.warning("sample skipped (%d so far): %s", self.total, line)
        self._window.extend([True] * len(skipped) + [False] * num_read)
        found = sum(self._window)
        if found > self.max_rate * SKIP_WINDOW:
            raise DataError(
                f"{found} of the last {len(self._window)} samples cannot be read, more than "
                f"data.max_skip_rate={self.max_rate} of {SKIP_WINDOW}; last: {skipped[-1]}; run "
                "'l3r-prep check' on the shards"
            )


class StepLoader:
    """Endless batches from a step on, for lightning's trainer.

    Args:
        dataset: Batches by number.
        config: Processes, read-ahead and ``max_skip_rate``.
        num_steps: Optimisation step at which to end.
        pin_memory: Whether batches go to an accelerator.
    """

    def __init__(
        self, dataset: StepDataset, config: DataConfig, num_steps: int, *, pin_memory: bool
    ) -> None:
        self.dataset = dataset
        self.config = config
        self.num_batches = num_steps * dataset.share.accumulate
        self.pin_memory = pin_memory
        self.batch = 0
        self.waited = 0.0
        """Seconds for which batches have kept their taker waiting so far."""

    def __iter__(self) -> Iterator[Views]:
        """Yield batches from the current step.

        Raises:
            DataError: More than ``max_skip_rate`` of the samples cannot be read.
            LaunchError: A loader process died.
        """
        guard = SkipGuard(self.config.max_skip_rate)
        numbers = range(self.batch, self.num_batches)
        asked = time.perf_counter()
        for batch in read_ahead(self.dataset, numbers, self.config, pin_memory=self.pin_memory):
            views = batch.unpack()
            if views is None:
                raise DataError(
                    f"no graph can be read; last: {batch.skipped[-1]}; "
                    "check that the shards are there, and run 'l3r-prep check' on them"
                )
            guard.count(len(views.key), batch.skipped)
            self.batch += 1
            self.waited += time.perf_counter() - asked
            yield views
            asked = time.perf_counter()

    def state_dict(self) -> dict[str, Any]:
        """Everything a resumed run needs; a step begun is begun again."""
        return {"step": self.batch // self.dataset.share.accumulate}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on after the step of a checkpoint."""
        self.batch = int(state["step"]) * self.dataset.share.accumulate


def build_training_loader(
    config: DataConfig,
    image_size: tuple[int, int],
    *,
    seed: int,
    num_steps: int,
    share: DeviceShare,
) -> StepLoader:
    """Build the loader of a training run on one device.

    Args:
        config: Sources and batches.
        image_size: (height, width) where ``config.image_sizes`` is empty.
        seed: Seed of all draws.
        num_steps: Optimisation step at which to end.
        share: Which graphs of each step are this device's.

    Raises:
        ConfigError: There is no source, or a step has fewer graphs than devices and batches.
        DataError: A place holds no finished shards.
    """
    if not config.sources:
        raise ConfigError("data.sources is empty; add data.sources.NAME.shards=FOLDER")
    parts = share.world_size * share.accumulate
    if config.graphs_per_step < parts:
        raise ConfigError(
            f"data.graphs_per_step is {config.graphs_per_step}, expected at least {parts}: "
            f"{share.world_size} devices, {share.accumulate} batches each"
        )
    if share.rank == 0:
        _warn_of_idle_settings(config)
    folders = open_folders(config.sources, config)
    weights = [source.weight for source in config.sources.values()]
    sizes = [len(folder) for folder in folders]
    brightness, contrast, saturation, hue = config.color_jitter
    variation = Variation(
        image_sizes=tuple((h, w) for h, w in config.image_sizes) or (image_size,),
        color_jitter=(brightness, contrast, saturation, hue),
        seed=seed,
    )
    chooser = SampleChooser(sizes, weights, config.graphs_per_step, seed)
    dataset = StepDataset(folders, chooser, variation, share)
    return StepLoader(dataset, config, num_steps, pin_memory=torch.cuda.is_available())


def read_ahead(
    dataset: Dataset[Item], numbers: range, config: DataConfig, *, pin_memory: bool
) -> Iterator[Item]:
    """Get items of a data set in order, from processes that work ahead.

    Args:
        dataset: Items by number.
        numbers: Which, in this order.
        config: ``num_workers`` and ``prefetch_factor``.
        pin_memory: Whether items go to an accelerator.

    Raises:
        ConfigError: The path of the folder for temporary files is too long.
        LaunchError: A process died.
    """
    has_workers = config.num_workers > 0
    if has_workers:
        _require_short_paths()
    loader = DataLoader(
        dataset,
        batch_size=None,
        sampler=numbers,
        num_workers=config.num_workers,
        prefetch_factor=config.prefetch_factor if has_workers else None,
        pin_memory=pin_memory,
        # Forked workers of a process that has used threads can hang; these import afresh.
        multiprocessing_context="spawn" if has_workers else None,
        worker_init_fn=_settle,
    )
    handler = signal.getsignal(signal.SIGCHLD)
    items = iter(loader)
    # Torch would report a death from a signal handler, in the middle of whatever the training step
    # does; without it the loader finds out when it is next asked for a batch.
    if has_workers and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGCHLD, handler)
    while True:
        try:
            item = next(items)
        except StopIteration:
            return
        except RuntimeError as error:
            if not str(error).startswith("DataLoader worker"):
                raise
            raise LaunchError(
                f"{str(error).splitlines()[0]}; most often memory ran out: lower data.num_workers "
                "or data.prefetch_factor, or give the job more memory (and /dev/shm); then start "
                "the same command again"
            ) from error
        yield item


def _settle(worker: int) -> None:
    """Make a loader process quiet: one thread, and deaf to signals meant for the run."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for number in (signal.SIGINT, signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(number, signal.SIG_IGN)
    # SLURM sends this one to every process of a job; the run saves first, and may need a batch.
    signal.signal(signal.SIGTERM, lambda *_: signal.alarm(GRACE_SECONDS))


def _warn_of_idle_settings(config: DataConfig) -> None:
    """Name settings that do nothing in this run."""
    places = [s.shards for s in (*config.sources.values(), *config.validation.values())]
    is_remote = any(place.startswith(("http://", "https://")) for place in places)
    keeps = bool(config.cache_dir and config.cache_gb)
    changed = config.prefetch_factor != DataConfig().prefetch_factor
    idle = [
        (config.cache_gb and not config.cache_dir, "data.cache_gb: no data.cache_dir is given"),
        (config.cache_dir and not config.cache_gb, "data.cache_dir: data.cache_gb is 0"),
        (keeps and not is_remote, "data.cache_dir: no source is an http(s) address"),
        (changed and not config.num_workers, "data.prefetch_factor: data.num_workers is 0"),
    ]
    for applies, words in idle:
        if applies:
            log.warning("no effect of %s", words)


def _require_short_paths() -> None:
    """Refuse a folder in which batches could not be handed over: the taker would wait for ever."""
    folder = tempfile.gettempdir()
    found = len(os.fsencode(folder))
    if found > MAX_TEMPORARY_PATH:
        raise ConfigError(
            f"TMPDIR={folder} has {found} bytes, expected {MAX_TEMPORARY_PATH} at most, since "
            "loader processes open sockets there; set TMPDIR to a folder with a shorter name, or "
            "data.num_workers=0"
        )
