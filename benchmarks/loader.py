"""Graphs per second that the loader delivers from one core, and the stage that limits it.

The images are views of a rendered room under a fractal texture and a little noise, since plain
renderings compress better than photos: their JPEGs take about as many bytes as genuine ones (0.23
to 0.52 bytes a pixel on five data sets, docs/data.md). Colours are jittered.
"""

import multiprocessing
import os
import tarfile
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.timing import stopwatch
from data_prep.converters.synthetic import intrinsics
from data_prep.raycast import render
from data_prep.room import build_room, draw_cameras
from data_prep.shards import relative_to_first
from l3r.config import DataConfig, SourceConfig
from l3r.data.loader import build_training_loader
from l3r.data.schema import index_shard, write_index
from l3r.data.steps import DeviceShare
from tests.data.graphs import make_graph, write_folder
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
        folder = _write_shards(Path(temporary))
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


def _write_shards(folder: Path) -> Path:
    """Write graphs of the same rendered views in different orders, with their indices."""
    room = build_room(0)
    world_from_cam = draw_cameras(room, VIEWS, 0)
    K = intrinsics(STORED)
    rng = np.random.default_rng(0)
    images, depths = [], []
    for camera in world_from_cam:
        image, depth = render(room, torch.from_numpy(K), camera[None], STORED)
        images.append(_textured(image[0].numpy(), rng))
        depths.append(depth[0].numpy())
    graphs = []
    for number in range(GRAPHS):
        order = np.roll(np.arange(VIEWS), number)
        cameras = world_from_cam.double().numpy()[order]
        graphs.append(
            replace(
                make_graph(number, VIEWS, *STORED),
                image=[images[view] for view in order],
                depth=[depths[view] for view in order],
                K=np.tile(K, (VIEWS, 1, 1)),
                cam_from_world=relative_to_first(cameras),
            )
        )
    written = write_folder(folder / "shards", graphs)
    for tar in written.glob("*.tar"):
        write_index(tar, index_shard(tar))
    return written


def _textured(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Multiply a rendering by a texture whose amplitude falls with frequency as photos' do."""
    height, width = image.shape[:2]
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width))
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.normal(size=(height, width))) / frequency
    texture = np.fft.irfft2(spectrum, s=(height, width))
    shaded = image * (1 + 0.07 * texture / texture.std())[..., None]
    noisy = 255 * shaded + rng.normal(scale=0.5, size=image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


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
