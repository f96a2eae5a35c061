"""Loaders for the trainer, on the device that asks."""

import logging
from collections.abc import Iterator, Sequence

import lightning as L
import torch
from torch.utils.data import DataLoader, Dataset, IterableDataset

from l3r.config import RunConfig
from l3r.data.loader import StepLoader, build_training_loader
from l3r.data.source import ShardFolder, open_folders
from l3r.data.stages import lay_out
from l3r.data.steps import DeviceShare, read_or_another
from l3r.errors import DataError
from l3r.types import Views

log = logging.getLogger(__name__)


class ShardData(L.LightningDataModule):
    """Training batches by step, validation graphs one by one, shared out over the processes.

    Args:
        config: The whole run.
    """

    def __init__(self, config: RunConfig) -> None:
        super().__init__()
        self.config = config

    def train_dataloader(self) -> StepLoader:
        """Build the step-indexed loader; its state goes into checkpoints."""
        trainer = self.trainer
        assert trainer is not None
        share = DeviceShare(
            rank=trainer.global_rank,
            world_size=trainer.world_size,
            accumulate=self.config.train.accumulate,
        )
        size = self.config.model.image_size
        return build_training_loader(
            self.config.data,
            (size[0], size[1]),
            seed=self.config.train.seed,
            num_steps=self.config.train.max_steps,
            share=share,
        )

    def val_dataloader(self) -> DataLoader[Views] | list[DataLoader[Views]]:
        """Build the loader of this process's validation graphs; none where nothing is validated."""
        trainer = self.trainer
        assert trainer is not None
        data, num_graphs = self.config.data, self.config.train.validation_graphs
        if not data.validation or not num_graphs:
            return []
        size = self.config.model.image_size
        folders = open_folders(data.validation, data)
        graphs = ValidationGraphs(folders, (size[0], size[1]), num_graphs)
        share = ValidationShare(graphs, trainer.global_rank, trainer.world_size)
        return DataLoader(share, batch_size=None, pin_memory=torch.cuda.is_available())


class ValidationGraphs(Dataset[Views]):
    """The same graphs every time: as many of each place, spread evenly over it.

    Those of one place depend on nothing else, so that another data set beside it leaves its curve
    alone.

    Args:
        folders: Validation shards.
        image_size: (height, width).
        num_graphs: Graphs of each folder; all of one that has fewer.
    """

    def __init__(
        self, folders: list[ShardFolder], image_size: tuple[int, int], num_graphs: int
    ) -> None:
        self.image_size = image_size
        self.graphs = [
            (folder, index)
            for folder in folders
            for index in spread_evenly(len(folder), num_graphs)
        ]

    def __len__(self) -> int:
        return len(self.graphs)

    def __getitem__(self, index: int) -> Views:
        """Read one graph, a batch of one; another stands in for an unreadable one."""
        folder, graph = self.graphs[index]
        skipped: list[str] = []
        sample = read_or_another(folder, graph, self.image_size, skipped)
        for line in skipped:
            log.warning("validation sample skipped: %s", line)
        if sample is None:
            raise DataError(f"no validation graph can be read; last: {skipped[-1]}")
        return lay_out([sample]).unpack()


class ValidationShare(IterableDataset[Views]):
    """The graphs ``rank``, ``rank + world_size``, ... of a validation, one after the other.

    It has no length on purpose: of a process whose share is empty lightning would leave out the
    end of the validation, where the others wait for it.

    Args:
        graphs: Of all processes.
        rank: This process.
        world_size: Processes.
    """

    def __init__(self, graphs: ValidationGraphs, rank: int, world_size: int) -> None:
        self.graphs = graphs
        self.numbers = range(rank, len(graphs), world_size)

    def __iter__(self) -> Iterator[Views]:
        """Read one graph after the other."""
        return (self.graphs[number] for number in self.numbers)


def spread_evenly(total: int, count: int) -> Sequence[int]:
    """Choose ``count`` of the first ``total`` integers, or all if there are fewer."""
    count = min(count, total)
    return [number * total // count for number in range(count)]
