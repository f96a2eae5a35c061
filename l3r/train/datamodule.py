"""Loaders for the trainer, on the device that asks."""

import logging

import lightning as L
import torch
from torch.utils.data import DataLoader, Dataset

from l3r.config import RunConfig
from l3r.data.loader import StepLoader, build_training_loader
from l3r.data.source import ShardFolder, open_folders
from l3r.data.stages import lay_out
from l3r.data.steps import DeviceShare, read_or_another
from l3r.errors import DataError
from l3r.types import Views

log = logging.getLogger(__name__)


class ShardData(L.LightningDataModule):
    """Training batches by step, validation graphs one by one.

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
        """Build the loader of the validation graphs; none without validation shards."""
        data = self.config.data
        if not data.validation:
            return []
        size = self.config.model.image_size
        dataset = ValidationGraphs(
            open_folders(data.validation, data),
            (size[0], size[1]),
            self.config.train.validation_graphs,
        )
        return DataLoader(dataset, batch_size=None, pin_memory=torch.cuda.is_available())


class ValidationGraphs(Dataset[Views]):
    """The same graphs every time, spread evenly over all validation shards.

    Args:
        folders: Validation shards.
        image_size: (height, width).
        num_graphs: Graphs at most.
    """

    def __init__(
        self, folders: list[ShardFolder], image_size: tuple[int, int], num_graphs: int
    ) -> None:
        self.image_size = image_size
        everything = [(folder, index) for folder in folders for index in range(len(folder))]
        count = min(num_graphs, len(everything))
        self.graphs = [everything[i * len(everything) // count] for i in range(count)]

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
