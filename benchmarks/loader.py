"""Graphs per second per core that the loader delivers."""

import tempfile
import time
from pathlib import Path

import torch

from l3r.config import DataConfig, SourceConfig
from l3r.data.loader import DeviceShare, build_training_loader
from tests.data.graphs import make_graph, write_folder

STEPS, GRAPHS = 12, 4


def run() -> list[tuple[str, str]]:
    """Load graphs of 8 stored images in this process, one thread: one core."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    rows = []
    for stored, target in (
        ((480, 640), (384, 512)),
        ((480, 640), (224, 224)),
        ((48, 48), (48, 48)),
    ):
        with tempfile.TemporaryDirectory() as temporary:
            graphs = [make_graph(n, 8, *stored) for n in range(8)]
            folder = write_folder(Path(temporary), graphs)
            config = DataConfig(
                sources={"made": SourceConfig(shards=str(folder))},
                graphs_per_step=GRAPHS,
                num_workers=0,
            )
            loader = build_training_loader(
                config, target, seed=0, num_steps=STEPS + 1, share=DeviceShare()
            )
            batches = iter(loader)
            next(batches)
            start = time.perf_counter()
            for _ in batches:
                pass
            rate = STEPS * GRAPHS / (time.perf_counter() - start)
        label = f"8 images stored at {stored[0]}x{stored[1]}, given at {target[0]}x{target[1]}"
        rows.append((label, f"{rate:.1f} graphs/s"))
    torch.set_num_threads(threads)
    return rows
