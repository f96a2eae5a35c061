"""Scenes become a folder of shards: tars, their indices and a manifest.

The graphs of a shard are fixed by their number before anything is encoded, and the bytes depend
on nothing but the request and the source, so two builds agree byte for byte.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
import webdataset
from jaxtyping import Float64

from data_prep.frames import FrameCache
from data_prep.graph_sampling import SamplingOptions
from data_prep.ledger import Ledger
from data_prep.plan import GraphPlan, plan_graphs
from data_prep.scene import Scene
from l3r.data.schema import (
    GraphSample,
    Manifest,
    ShardEntry,
    ShardIndex,
    encode_graph,
    index_shard,
    write_index,
    write_manifest,
)
from l3r.errors import DataError
from l3r.files import atomic_path
from l3r.geometry.rigid import invert_rigid


@dataclass(frozen=True, kw_only=True)
class BuildRequest:
    """What a folder of shards shall hold."""

    num_graphs: int = 1000
    """Graphs of each scene."""
    graphs_per_shard: int = 100
    """Graphs of each tar; the last of a scene may have fewer."""
    seed: int = 0
    """Seed of the draw of graphs."""
    sampling: SamplingOptions = field(default_factory=SamplingOptions)
    """Thresholds of the sampler."""
    source: dict[str, Any] = field(default_factory=dict)
    """Options of the converter; only recorded and compared."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if self.num_graphs < 1 or self.graphs_per_shard < 1:
            raise DataError(
                f"build: {self.num_graphs} graphs, {self.graphs_per_shard} per shard, expected 1 or"
                " more; change --num-graphs or --graphs-per-shard"
            )


Report = Callable[[str, int, int], None]
"""Called with a scene's name, its shards finished so far and in all."""


def build_shards(
    scenes: Iterable[Scene],
    out: Path,
    request: BuildRequest,
    *,
    num_workers: int = 0,
    report: Report = lambda scene, done, total: None,
) -> Manifest:
    """Write the shards of scenes, or what is missing of them, and the manifest last.

    Args:
        scenes: All of one data set; taken one at a time.
        out: Folder that gets the shards.
        request: What they shall hold.
        num_workers: Processes that encode; 0 encodes in this one. The bytes do not change.
        report: Told about the progress.

    Raises:
        DataError: The folder belongs to another request, a source file cannot be read, or no
            scene yields a graph.
    """
    ledger = Ledger(out, asdict(request))
    entries: list[ShardEntry] = []
    datasets: set[str] = set()
    for scene in scenes:
        datasets.add(scene.dataset)
        entries += _build_scene(scene, ledger, request, num_workers, report)
    if not entries:
        raise DataError(
            f"{out}: no scene yields a graph of {request.sampling.min_views} views; look for wrong"
            " cameras or depth, take more frames, or lower --min-views"
        )
    manifest = Manifest(
        dataset=" ".join(sorted(datasets)),
        min_views=request.sampling.min_views,
        max_views=request.sampling.max_views,
        shards=entries,
        request=asdict(request),
    )
    write_manifest(out, manifest)
    return manifest


def _build_scene(
    scene: Scene, ledger: Ledger, request: BuildRequest, num_workers: int, report: Report
) -> list[ShardEntry]:
    num_graphs = ledger.find_scene(scene)
    if num_graphs is not None:
        names = _shard_names(scene, num_graphs, request)
        found = [entry for entry in map(ledger.find_shard, names) if entry]
        if len(found) == len(names):
            report(scene.name, len(names), len(names))
            return found
    plans = plan_graphs(scene, request.num_graphs, request.seed, request.sampling)
    ledger.plan_scene(scene, len(plans))
    entries: dict[str, ShardEntry] = {}
    jobs = []
    for number, name in enumerate(_shard_names(scene, len(plans), request)):
        first = number * request.graphs_per_shard
        part = plans[first : first + request.graphs_per_shard]
        entry = ledger.find_shard(name)
        if entry:
            entries[name] = entry
        else:
            jobs.append((ledger.out / name, part))
    total = len(entries) + len(jobs)
    for entry in _write_all(scene, jobs, num_workers):
        ledger.finish_shard(entry)
        entries[entry.name] = entry
        report(scene.name, len(entries), total)
    return [entries[name] for name in sorted(entries)]


def _shard_names(scene: Scene, num_graphs: int, request: BuildRequest) -> list[str]:
    num_shards = -(-num_graphs // request.graphs_per_shard)
    return [f"{scene.dataset}-{scene.slug}-{number:06d}.tar" for number in range(num_shards)]


def _write_all(
    scene: Scene, jobs: list[tuple[Path, list[GraphPlan]]], num_workers: int
) -> Iterator[ShardEntry]:
    if num_workers == 0 or len(jobs) < 2:
        cache = FrameCache(scene)
        for path, plans in jobs:
            yield write_shard(path, cache, plans)
        return
    with ProcessPoolExecutor(num_workers, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(write_shard, path, FrameCache(scene), part) for path, part in jobs]
        for future in futures:
            yield future.result()


def write_shard(path: Path, cache: FrameCache, plans: list[GraphPlan]) -> ShardEntry:
    """Write one tar and its index, whole or not at all.

    Args:
        path: The tar.
        cache: Frames of the scene.
        plans: Its graphs, in order.

    Raises:
        DataError: A frame cannot be read or stored.
    """
    with atomic_path(path) as temporary:
        index, digest = _write_tar(temporary, cache, plans)
    write_index(path, index)
    return ShardEntry(name=path.name, num_graphs=len(plans), bytes=index.tar_bytes, sha256=digest)


def _write_tar(path: Path, cache: FrameCache, plans: list[GraphPlan]) -> tuple[ShardIndex, str]:
    """Write a tar; give its index and its digest."""
    with (
        path.open("wb") as stream,
        webdataset.TarWriter(stream, encoder=False, mtime=0) as writer,
    ):
        for plan in plans:
            members = encode_graph(_graph_sample(cache, plan), plan.key)
            # One by one, since a whole sample would be written in alphabetical order.
            for name, data in list(members.items())[1:]:
                writer.write({"__key__": plan.key, name: data})
    with path.open("rb") as written:
        digest = hashlib.file_digest(written, "sha256").hexdigest()
    return index_shard(path), digest


def _graph_sample(cache: FrameCache, plan: GraphPlan) -> GraphSample:
    scene = cache.scene
    frames = [cache.read(view) for view in plan.views]
    world_from_cam = np.stack([scene.frames[view].world_from_cam for view in plan.views])
    return GraphSample(
        dataset=scene.dataset,
        scene=scene.name,
        is_metric=scene.is_metric,
        file=[scene.frames[view].name for view in plan.views],
        image=[frame.image for frame in frames],
        depth=[frame.depth for frame in frames],
        K=np.stack([frame.K for frame in frames]),
        cam_from_world=relative_to_first(world_from_cam),
        pairs=plan.pairs,
    )


def relative_to_first(
    world_from_cam: Float64[np.ndarray, "n 4 4"],
) -> Float64[np.ndarray, "n 4 4"]:
    """Give ``cam_from_first`` of cameras; exactly the identity for the first itself."""
    cam_from_world = invert_rigid(torch.from_numpy(world_from_cam)).numpy()
    relative: Float64[np.ndarray, "n 4 4"] = cam_from_world @ world_from_cam[0]
    relative[0] = np.eye(4)
    return relative
