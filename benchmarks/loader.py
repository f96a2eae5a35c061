"""Graphs per second that the loader delivers from one core, and the stage that limits it.

The graphs are those of ``made_shards``. Colours are jittered.
"""

import multiprocessing
import os
import tarfile
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import torch

from benchmarks.made_shards import write_shards
from benchmarks.timing import stopwatch
from l3r.config import DataConfig, SourceConfig
from l3r.data.loader import build_training_loader
from l3r.data.steps import DeviceShare
from tests.data.range_server import serve

STEPS, GRAPHS, VIEWS = 12, 4, 8
STORED = (480, 640)

STAGES = {
    "read": ["l3r.data.store.read_range", "l3r.data.http_store.HttpStore.read_graph"],
    "untar": ["l3r.data.source.members_from_bytes"],
    "JPEG decode": ["l3r.data.schema.codec._decode_image"],
    "depth decode": ["l3r.data.schema.codec._decode_depth"],
    "resize, crop": ["l3r.data.stages._fit_view"],
    "jitter": ["l3r.data.stages.change_colors"],
    "to tensors": ["l3r.data.steps.lay_out", "l3r.data.stages.PackedViews.unpack"],
}
"""What is timed as which stage; the rest is the plan, JSON and checks of cameras."""


def run() -> list[tuple[str, str]]:
    """Load graphs of 8 images in this process, on one core.

    Returns:
        Names and values of what was measured.
    """
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = write_shards(Path(temporary) / "shards", GRAPHS, VIEWS, STORED)
        pixels = GRAPHS * VIEWS * STORED[0] * STORED[1]
        ratio = _bytes_of_images(folder) / pixels
        rows.append((f"images stored at {STORED[0]}x{STORED[1]}", f"{ratio:.2f} bytes a pixel"))
        with _server(folder) as url, _one_core():
            rows += _measure("from disk, given at 384x512", str(folder), with_stages=True)
            rows += _measure("the same without jitter", str(folder), color_jitter=[0.0] * 4)
            rows += _measure("from disk, given at 224x224", str(folder), image_sizes=[[224, 224]])
            rows += _measure("from a loader process, same core", str(folder), num_workers=1)
            rows += _measure("over HTTP, given at 384x512", url, with_stages=True)
    return rows


def _measure(
    label: str, place: str, *, with_stages: bool = False, **changes: Any
) -> list[tuple[str, str]]:
    sources = {"made": SourceConfig(shards=place)}
    fixed = {"graphs_per_step": GRAPHS, "num_workers": 0, "image_sizes": [[384, 512]]}
    config = DataConfig(sources=sources, **{**fixed, **changes})
    loader = build_training_loader(
        config, (384, 512), seed=0, num_steps=STEPS + 1, share=DeviceShare()
    )
    batches = iter(loader)
    next(batches)
    with stopwatch(STAGES) as spent:
        wall, busy = time.perf_counter(), time.process_time()
        for _ in batches:
            pass
        wall, busy = time.perf_counter() - wall, time.process_time() - busy
    number = STEPS * GRAPHS
    # What others do on a shared machine slows the clock on the wall, not the core's own.
    own = "" if config.num_workers else f" ({number / busy:.1f} a busy second)"
    rows = [(label, f"{number / wall:.1f} graphs/s{own}")]
    if with_stages:
        seconds = {**spent, "rest": wall - sum(spent.values())}
        limit = max(seconds, key=seconds.__getitem__)
        for stage in (*STAGES, "rest"):
            note = "  <- limits" if stage == limit else ""
            each = f"{1e3 * seconds[stage] / number:.1f} ms {seconds[stage] / wall:>4.0%}"
            rows.append((f"    {stage}{note}", each))
    return rows


def _bytes_of_images(folder: Path) -> int:
    """Sum of the sizes of all JPEGs."""
    total = 0
    for path in folder.glob("*.tar"):
        with tarfile.open(path) as tar:
            total += sum(member.size for member in tar if member.name.endswith(".jpg"))
    return total


@contextmanager
def _one_core() -> Iterator[None]:
    """Keep this process to one core and one thread."""
    threads = torch.get_num_threads(), cv2.getNumThreads()
    cores = os.sched_getaffinity(0)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)
        torch.set_num_threads(threads[0])
        cv2.setNumThreads(threads[1])


@contextmanager
def _server(folder: Path) -> Iterator[str]:
    """Serve a folder from a process of its own, which may use another core."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(folder, theirs), daemon=True)
    process.start()
    try:
        yield ours.recv()
    finally:
        process.terminate()
        process.join()


def _serve(folder: Path, connection: Connection) -> None:
    with serve(folder) as running:
        connection.send(running.url)
        connection.recv()
