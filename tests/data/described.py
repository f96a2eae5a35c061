"""Data sets for loader processes, which import them by name."""

from torch.utils.data import Dataset

from l3r.config import DataConfig, SourceConfig
from l3r.data.loader import build_training_loader
from l3r.data.steps import DeviceShare

SIZES = [[32, 32], [24, 32], [16, 32]]


def data_config(*folders, **changes):
    """Batches of 8 slots over sources of rising weight, in all that varies."""
    sources = {
        f"s{i}": SourceConfig(shards=str(folder), weight=1.0 + i)
        for i, folder in enumerate(folders)
    }
    fixed = {"num_views": 3, "graphs_per_step": 8, "num_workers": 0, "image_sizes": SIZES}
    return DataConfig(sources=sources, **{**fixed, **changes})


def datasets(config, shares, seed=3):
    """One data set for each device."""
    return [
        build_training_loader(config, (32, 32), seed=seed, num_steps=1000, share=share).dataset
        for share in shares
    ]


def all_shares(world_sizes):
    return [DeviceShare(rank=r, world_size=size) for size in world_sizes for r in range(size)]


class Described(Dataset):
    """The plans that several devices make of a batch, and of the first few the pixels too."""

    def __init__(self, parts, num_read):
        self.parts = parts
        self.num_read = num_read

    def __getitem__(self, number):
        plans = [part.describe(number) for part in self.parts]
        batches = [part[number].unpack() for part in self.parts] if number < self.num_read else []
        return plans, batches
