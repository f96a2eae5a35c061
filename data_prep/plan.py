"""Which graphs a scene's shards will hold, decided before any image is encoded."""

import hashlib
import logging
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Float32

from data_prep.covisibility import (
    DepthViews,
    OverlapTable,
    build_table,
    median_parallax,
    pairs_of,
    prepare_views,
)
from data_prep.graph_sampling import SamplingOptions, sample_graphs
from data_prep.scene import Scene
from l3r.data.schema import PairTable

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class GraphPlan:
    """One graph to be stored."""

    key: str
    """Its name in the shard."""
    views: list[int]
    """Frames of the scene, in greedy order."""
    pairs: PairTable
    """How they relate."""


def plan_graphs(
    scene: Scene, num_graphs: int, seed: int, options: SamplingOptions
) -> list[GraphPlan]:
    """Relate all frames of a scene and draw its graphs.

    Args:
        scene: Frames with depth.
        num_graphs: How many graphs are wanted.
        seed: Seed of the whole build; every scene derives its own from it and its name.
        options: Thresholds of the sampler.

    Returns:
        Graphs in the order drawn; fewer, with a warning, where the scene has no more.

    Raises:
        DataError: Depth cannot be read.
    """
    if len(scene.frames) < options.min_views:
        found = len(scene.frames)
        _LOG.warning("%s: %d frames, a graph has %d or more", scene.name, found, options.min_views)
        return []
    views = prepare_views(scene)
    table = build_table(scene, views)
    graphs = sample_graphs(
        table.iou.numpy(),
        table.score.numpy(),
        table.angle.numpy(),
        num_graphs,
        seed=scene_seed(scene.name, seed),
        options=options,
    )
    if len(graphs) < num_graphs:
        _LOG.warning(
            "%s: %d graphs of %d views or more, %d asked; the scene has no more start pairs",
            scene.name,
            len(graphs),
            options.min_views,
            num_graphs,
        )
    parallax = _parallax_of(views, graphs)
    return [
        GraphPlan(
            key=f"{scene.dataset}-{scene.slug}-{number:06d}",
            views=graph,
            pairs=_take_pairs(table, parallax, graph),
        )
        for number, graph in enumerate(graphs)
    ]


def scene_seed(name: str, seed: int) -> int:
    """Derive a scene's own seed, which does not depend on the scenes beside it."""
    return int.from_bytes(hashlib.sha256(f"{seed}:{name}".encode()).digest()[:4], "big")


def hold_out(scene: Scene, share: float) -> tuple[Scene, Scene]:
    """Split a scene by time: the last frames are held out, so that no graph sees both parts.

    Args:
        scene: The whole scene.
        share: Share of the frames to hold out.

    Returns:
        ``(kept, held_out)``.
    """
    cut = len(scene.frames) - round(share * len(scene.frames))
    return replace(scene, frames=scene.frames[:cut]), replace(scene, frames=scene.frames[cut:])


def _parallax_of(views: DepthViews, graphs: list[list[int]]) -> Float32[np.ndarray, "n n"]:
    """Median parallax of all pairs that share a graph; NaN elsewhere."""
    parallax = np.full((views.num_views, views.num_views), np.nan, dtype=np.float32)
    np.fill_diagonal(parallax, 0)
    pairs = sorted({pair for graph in graphs for pair in pairs_of(graph)})
    if pairs:
        index = torch.tensor(pairs, device=views.center.device)
        first, second = np.array(pairs).T
        parallax[first, second] = median_parallax(views, index).cpu().numpy()
        parallax[second, first] = parallax[first, second]
    return parallax


def _take_pairs(
    table: OverlapTable, parallax: Float32[np.ndarray, "n n"], graph: list[int]
) -> PairTable:
    """Cut a graph's rows and columns out of the scene's tables."""
    rows = np.ix_(graph, graph)
    tables = {
        f.name: parallax if f.name == "parallax" else getattr(table, f.name).numpy()
        for f in fields(PairTable)
    }
    return PairTable(**{name: whole[rows].astype(np.float64) for name, whole in tables.items()})
