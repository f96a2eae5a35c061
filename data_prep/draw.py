"""The graphs of one scene, from what its images see of each other."""

import hashlib
import logging
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float32

from data_prep.covisibility import OverlapTable, build_table, median_parallax, pairs_of
from data_prep.depth_views import DepthViews
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
    """Frames of the planned scene, in greedy order."""
    pairs: PairTable
    """How they relate."""


def draw_graphs(
    scene: Scene, views: DepthViews, num_graphs: int, seed: int, options: SamplingOptions
) -> list[GraphPlan]:
    """Relate all images of a scene and draw its graphs.

    Args:
        scene: Frames with depth.
        views: That depth, prepared for look-ups.
        num_graphs: How many graphs are wanted.
        seed: Seed of the whole build; every scene derives its own from it and its name.
        options: Thresholds of the sampler.

    Returns:
        The graphs in the order drawn; fewer, and a warning, where the scene has no more.

    Raises:
        DataError: The scene's own overlap is damaged.
    """
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
