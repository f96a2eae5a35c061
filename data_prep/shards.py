"""Scenes become a folder of shards: tars, their indices and a manifest.

The graphs of a shard are fixed by their number before anything is encoded, and the bytes depend
on nothing but the request and the source, so two builds agree byte for byte.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
import webdataset
from jaxtyping import Float64

from data_prep.draw import GraphPlan
from data_prep.frames import FrameCache
from data_prep.graph_sampling import SamplingOptions
from data_prep.ledger import PROBLEMS, Ledger, SceneRecord, ShardRecord
from data_prep.plan import ScenePlan, plan_graphs
from data_prep.problems import Problem, Problems
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
    problems: Problems | None = None,
) -> Manifest:
    """Write the shards of scenes, or what is missing of them, and the manifest last.

    Every frame is read once before the graphs of its scene are drawn, so that one that cannot be
    read is in none. A frame that breaks after that takes its graphs with it: they are skipped,
    the others keep their shard and their key. A shard that loses all its graphs stays as an empty
    tar that the manifest does not list.

    Args:
        scenes: All of one data set; taken one at a time.
        out: Folder that gets the shards.
        request: What they shall hold.
        num_workers: Processes that encode; 0 encodes in this one. The bytes do not change.
        report: Told about the progress.
        problems: Told about what is left out; the manifest gets all its counts, those of the
            converter too.

    Raises:
        DataError: The folder belongs to another request, the source has changed since an
            interrupted build, or no scene yields a graph.
    """
    problems = Problems() if problems is None else problems
    ledger = Ledger(out, asdict(request))
    build = _Build(ledger, request, num_workers, report, problems)
    entries: list[ShardEntry] = []
    datasets: set[str] = set()
    slugs: dict[str, str] = {}
    for scene in scenes:
        if slugs.setdefault(scene.slug, scene.name) != scene.name:
            problems.add("name_clash", scene.name, f"its shards would be {slugs[scene.slug]}'s")
            continue
        datasets.add(scene.dataset)
        entries += build.write_scene(scene)
    if not entries:
        raise DataError(
            f"{out}: no scene yields a graph of {request.sampling.min_views} views (left out:"
            f" {problems.summary()}); look for wrong cameras or depth, take more frames, or lower"
            " --min-views"
        )
    counts = {PROBLEMS: dict(sorted(problems.counts.items()))} if problems.counts else {}
    manifest = Manifest(
        dataset=" ".join(sorted(datasets)),
        min_views=request.sampling.min_views,
        max_views=request.sampling.max_views,
        shards=entries,
        request={**asdict(request), **counts},
    )
    write_manifest(out, manifest)
    return manifest


@dataclass(frozen=True)
class _Build:
    """What all scenes of a build share."""

    ledger: Ledger
    request: BuildRequest
    num_workers: int
    report: Report
    problems: Problems

    def write_scene(self, scene: Scene) -> list[ShardEntry]:
        """Write what is missing of a scene's shards; give those that hold graphs."""
        planned = self.ledger.find_scene(scene)
        if planned is not None:
            names = _shard_names(scene, planned.num_graphs, self.request)
            found = [record for record in map(self.ledger.find_shard, names) if record]
            if len(found) == len(names):
                self._count(planned.dropped)
                self.report(scene.name, len(names), len(names))
                return self._finish(found)
        plan = self._plan(scene, planned)
        if plan is None:
            return []
        self._count(plan.dropped)
        if planned is None:
            record = SceneRecord(num_graphs=len(plan.graphs), dropped=plan.dropped)
            self.ledger.plan_scene(scene, record)
        return self._finish(self._write_missing(plan))

    def _plan(self, scene: Scene, planned: SceneRecord | None) -> ScenePlan | None:
        request = self.request
        dropped = None if planned is None else planned.dropped
        try:
            return plan_graphs(scene, request.num_graphs, request.seed, request.sampling, dropped)
        except DataError as error:
            if planned is not None:
                raise
            self.problems.add("unusable_scene", scene.name, str(error))
            return None

    def _write_missing(self, plan: ScenePlan) -> list[ShardRecord]:
        size = self.request.graphs_per_shard
        records: dict[str, ShardRecord] = {}
        jobs = []
        for number, name in enumerate(_shard_names(plan.scene, len(plan.graphs), self.request)):
            record = self.ledger.find_shard(name)
            if record:
                records[name] = record
            else:
                part = plan.graphs[number * size : (number + 1) * size]
                jobs.append((self.ledger.out / name, part))
        total = len(records) + len(jobs)
        for record in _write_all(plan.scene, jobs, self.num_workers):
            self.ledger.finish_shard(record)
            records[record.entry.name] = record
            self.report(plan.scene.name, len(records), total)
        return [records[name] for name in sorted(records)]

    def _count(self, dropped: Mapping[str, Problem]) -> None:
        for problem in dropped.values():
            self.problems.add(problem.kind, problem.where, problem.detail)

    def _finish(self, records: list[ShardRecord]) -> list[ShardEntry]:
        for record in records:
            for key, detail in record.skipped.items():
                self.problems.add("skipped_graph", key, detail)
        return [record.entry for record in records if record.entry.num_graphs]


def _shard_names(scene: Scene, num_graphs: int, request: BuildRequest) -> list[str]:
    num_shards = -(-num_graphs // request.graphs_per_shard)
    return [f"{scene.dataset}-{scene.slug}-{number:06d}.tar" for number in range(num_shards)]


def _write_all(
    scene: Scene, jobs: list[tuple[Path, list[GraphPlan]]], num_workers: int
) -> Iterator[ShardRecord]:
    # The overlap has served, and may be large.
    scene = replace(scene, read_overlap=None)
    if num_workers == 0 or len(jobs) < 2:
        cache = FrameCache(scene)
        for path, plans in jobs:
            yield write_shard(path, cache, plans)
        return
    with ProcessPoolExecutor(num_workers, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(write_shard, path, FrameCache(scene), part) for path, part in jobs]
        for future in futures:
            yield future.result()


def write_shard(path: Path, cache: FrameCache, plans: list[GraphPlan]) -> ShardRecord:
    """Write one tar and its index, whole or not at all.

    Args:
        path: The tar.
        cache: Frames of the scene.
        plans: Its graphs, in order; one whose frames cannot be read or stored is skipped.
    """
    with atomic_path(path) as temporary:
        index, digest, skipped = _write_tar(temporary, cache, plans)
    write_index(path, index)
    entry = ShardEntry(
        name=path.name, num_graphs=len(index.graphs), bytes=index.tar_bytes, sha256=digest
    )
    return ShardRecord(entry=entry, skipped=skipped)


def _write_tar(
    path: Path, cache: FrameCache, plans: list[GraphPlan]
) -> tuple[ShardIndex, str, dict[str, str]]:
    """Write a tar; give its index, its digest and the graphs skipped."""
    skipped: dict[str, str] = {}
    with (
        path.open("wb") as stream,
        webdataset.TarWriter(stream, encoder=False, mtime=0) as writer,
    ):
        for plan in plans:
            try:
                members = encode_graph(_graph_sample(cache, plan), plan.key)
            except DataError as error:
                skipped[plan.key] = str(error)
                continue
            # One by one, since a whole sample would be written in alphabetical order.
            for name, data in list(members.items())[1:]:
                writer.write({"__key__": plan.key, name: data})
    with path.open("rb") as written:
        digest = hashlib.file_digest(written, "sha256").hexdigest()
    return index_shard(path), digest, skipped


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
