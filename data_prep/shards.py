"""Graphs that were planned become one tar and its index.

The bytes depend on nothing but the plan and the source, so two builds agree byte for byte.
"""

import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import torch
import webdataset
from jaxtyping import Float64

from data_prep.draw import GraphPlan
from data_prep.frames import FrameCache
from data_prep.ledger import ShardRecord
from data_prep.scene import Scene
from l3r.data.schema import (
    GraphSample,
    ShardEntry,
    ShardIndex,
    encode_graph,
    index_path,
    index_shard,
    write_index,
)
from l3r.errors import DataError
from l3r.files import atomic_path, hidden_siblings
from l3r.geometry.rigid import invert_rigid

ScenePart = tuple[Scene, list[GraphPlan]]
"""A scene, and those of its graphs that stand in a tar."""


def write_shard(path: Path, parts: Iterable[ScenePart]) -> ShardRecord:
    """Write one tar and its index, whole or not at all; nothing where no graph is left.

    Args:
        path: The tar. What a killed process left of it is removed.
        parts: What it holds, in order; a graph whose frames cannot be read or stored is skipped.
    """
    for remains in (*hidden_siblings(path), *hidden_siblings(index_path(path))):
        remains.unlink(missing_ok=True)
    skipped: dict[str, str] = {}
    graphs = _read_graphs(parts, skipped)
    first = next(graphs, None)
    if first is None:
        path.unlink(missing_ok=True)
        index_path(path).unlink(missing_ok=True)
        entry = ShardEntry(name=path.name, num_graphs=0, bytes=0, sha256="")
        return ShardRecord(entry=entry, skipped=skipped)
    with atomic_path(path) as temporary:
        index, digest = _write_tar(temporary, first, graphs)
    write_index(path, index)
    entry = ShardEntry(
        name=path.name, num_graphs=len(index.graphs), bytes=index.tar_bytes, sha256=digest
    )
    return ShardRecord(entry=entry, skipped=skipped)


def _read_graphs(
    parts: Iterable[ScenePart], skipped: dict[str, str]
) -> Iterator[dict[str, str | bytes]]:
    """Give the members of each graph; note those that cannot be read."""
    for scene, plans in parts:
        cache = FrameCache(scene)
        for plan in plans:
            try:
                yield encode_graph(_graph_sample(cache, plan), plan.key)
            except DataError as error:
                skipped[plan.key] = str(error)


def _write_tar(
    path: Path, first: dict[str, str | bytes], others: Iterator[dict[str, str | bytes]]
) -> tuple[ShardIndex, str]:
    with (
        path.open("wb") as stream,
        webdataset.TarWriter(stream, encoder=False, mtime=0) as writer,
    ):
        for members in (first, *others):
            # One by one, since a whole sample would be written in alphabetical order.
            for name, data in list(members.items())[1:]:
                writer.write({"__key__": members["__key__"], name: data})
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
