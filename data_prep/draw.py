"""The graphs of one scene, from what its images see of each other."""

import hashlib
import logging
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64
from scipy.sparse import csr_array

from data_prep.candidates import choose_pairs
from data_prep.covisibility import read_own_overlap, relate_pairs
from data_prep.depth_views import DepthViews
from data_prep.graph_sampling import SamplingOptions, sample_graphs
from data_prep.overlap_table import OverlapTable, all_pairs
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
    """Relate the images of a scene and draw its graphs.

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
    own = read_own_overlap(scene)
    table = relate_pairs(scene, views, choose_pairs(scene, views, own, options), own)
    relations = SceneRelations(scene, views, own, table)
    graphs = sample_graphs(
        table,
        scene.world_from_cam[:, :3, :3],
        num_graphs,
        seed=scene_seed(scene.name, seed),
        options=options,
        overlap_of=relations.overlap_of,
    )
    if len(graphs) < num_graphs:
        _LOG.warning(
            "%s: %d graphs of %d views or more, %d asked; the scene has no more start pairs",
            scene.name,
            len(graphs),
            options.min_views,
            num_graphs,
        )
    known = relations.known(graphs)
    return [
        GraphPlan(
            key=f"{scene.dataset}-{scene.slug}-{number:06d}",
            views=graph,
            pairs=known.among(graph),
        )
        for number, graph in enumerate(graphs)
    ]


def scene_seed(name: str, seed: int) -> int:
    """Derive a scene's own seed, which does not depend on the scenes beside it."""
    return int.from_bytes(hashlib.sha256(f"{seed}:{name}".encode()).digest()[:4], "big")


class SceneRelations:
    """What is known of a scene's pairs: the candidates, and whatever was asked for besides.

    Args:
        scene: Frames with depth.
        views: That depth, prepared for look-ups.
        own: The scene's own overlap where it has one.
        table: The candidates.
    """

    def __init__(
        self, scene: Scene, views: DepthViews, own: csr_array | None, table: OverlapTable
    ) -> None:
        self._scene, self._views, self._own, self._table = scene, views, own, table
        self._others = table.take(slice(0))

    def overlap_of(self, pairs: Int64[np.ndarray, "m 2"]) -> Float32[np.ndarray, " m"]:
        """Give the IoU of pairs that are no candidates, and remember all of what they are."""
        self._relate(pairs)
        return np.asarray(self._others.iou[self._others.find(pairs)])

    def known(self, graphs: list[list[int]]) -> OverlapTable:
        """Relate all pairs of graphs.

        Args:
            graphs: View numbers.

        Returns:
            A table of these pairs at least.
        """
        inner = [np.array(graph)[all_pairs(len(graph))] for graph in graphs]
        pairs = np.concatenate([*inner, np.empty((0, 2), dtype=np.int64)])
        self._relate(pairs[self._table.find(pairs) < 0])
        return self._table.join(self._others)

    def _relate(self, pairs: Int64[np.ndarray, "m 2"]) -> None:
        new = np.unique(np.sort(pairs[self._others.find(pairs) < 0], axis=1), axis=0)
        if len(new):
            found = relate_pairs(self._scene, self._views, new, self._own)
            self._others = self._others.join(found)
