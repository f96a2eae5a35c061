"""How fast each converter reads, reduces and encodes images, in one thread, and where time goes.

The files are synthetic and as large as the genuine ones; ``benchmarks/raw_files.py`` makes them.
"""

import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.raw_files import WRITERS
from benchmarks.timing import stopwatch
from data_prep.converters import read_scenes
from data_prep.frames import reduce_frame
from data_prep.problems import Problems
from data_prep.scene import Scene
from data_prep.shards import relative_to_first
from l3r.data.schema import GraphSample, PairTable, encode_graph

ROUNDS = 3
MAX_FRAMES = 5

STAGES = {
    "decode": [
        "cv2.imdecode",
        "PIL.ImageFile.ImageFile.load",
        "numpy.fromfile",
        "h5py.Dataset.__getitem__",
    ],
    "undistort": ["cv2.initUndistortRectifyMap", "cv2.remap"],
    "resize": ["cv2.resize"],
    "encode": ["benchmarks.data_prep.encode_graph"],
}
"""What is timed as which stage; the rest is reading and checking files, unpacking range images and
placing lidar's points."""


def run() -> list[tuple[str, str]]:
    """Write a scene of each data set and read it.

    Returns:
        Names and values of what was measured; a data set that cannot be written or read here is
        named.
    """
    threads = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rows = []
    try:
        for name, write in WRITERS.items():
            with tempfile.TemporaryDirectory() as folder:
                try:
                    write(Path(folder))
                    rows += _measure(name, Path(folder))
                except ImportError as error:
                    rows.append((f"{name}: {error}"[:58], "skipped"))
    finally:
        torch.set_num_threads(threads[0])
        cv2.setNumThreads(threads[1])
    return rows


def _measure(name: str, root: Path) -> list[tuple[str, str]]:
    problems = Problems()
    (scene,) = read_scenes(name, root, "all", problems=problems)
    scene = scene.take(range(min(MAX_FRAMES, len(scene.frames))))
    assert not problems.counts, problems.summary()
    with stopwatch(STAGES) as spent:
        start = time.perf_counter()
        for _ in range(ROUNDS):
            _store(scene)
        total = time.perf_counter() - start
    shares = [spent[stage] / total for stage in STAGES]
    shares.append(1 - sum(shares))
    height, width = scene.frames[0].image_size
    stages = " / ".join([*STAGES, "rest"])
    return [
        (
            f"{name}: images per second, {width}x{height}",
            f"{ROUNDS * len(scene.frames) / total:.1f}",
        ),
        (f"{name}: {stages}", "/".join(f"{share:.0%}"[:-1] for share in shares) + " %"),
    ]


def _store(scene: Scene) -> None:
    """Do to every frame once what a build does for each graph that holds it."""
    frames = [reduce_frame(frame, sparse=scene.has_sparse_depth) for frame in scene.frames]
    nothing = np.zeros((len(frames), len(frames)))
    sample = GraphSample(
        dataset=scene.dataset,
        scene=scene.name,
        is_metric=scene.is_metric,
        file=[frame.name for frame in scene.frames],
        image=[frame.image for frame in frames],
        depth=[frame.depth for frame in frames],
        K=np.stack([frame.K for frame in frames]),
        cam_from_world=relative_to_first(scene.world_from_cam),
        pairs=PairTable(
            iou=nothing,
            covisible=nothing,
            score=nothing,
            rotation=nothing,
            axis=nothing,
            parallax=nothing,
        ),
    )
    encode_graph(sample, "benchmark")
