"""Spanning trees over the views: which n - 1 pairs are decoded.

All functions work on a batch of graphs in numpy on the host; ties are broken by index.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l3r.config import GraphConfig
from l3r.errors import GeometryError, NotFiniteError
from l3r.graph.edge_costs import edge_costs
from l3r.types import SceneTree


def build_tree(scores: Float[Tensor, "b n n"], config: GraphConfig) -> SceneTree:
    """Build the tree of every graph of a batch; waits for the device once, for the scores.

    The root is the view of the largest summed similarity.

    Args:
        scores: Similarity of each pair, higher is more alike; symmetric. For ``oracle`` the
            ground-truth overlap (IoU).
        config: ``algorithm``, ``cost``, ``cost_power`` and ``knn``.

    Raises:
        GeometryError: Fewer than two views.
        NotFiniteError: A score is not finite.
    """
    similarity = scores.detach().cpu().double().numpy()
    num_views = similarity.shape[-1]
    if num_views < 2:
        raise GeometryError(f"a tree over {num_views} view: expected 2 or more; add images")
    if not np.isfinite(similarity).all():
        raise NotFiniteError(
            "similarity scores are not finite; the encoder's weights may be broken"
        )
    costs = edge_costs(similarity, config)
    if config.knn:
        costs = sparsify(costs, config.knn)
    root = find_root(similarity)
    sum_costs = config.algorithm != "mst"
    return _order_edges(_grow_tree(costs, root, sum_costs=sum_costs), costs, root)


def find_root(similarity: Float[np.ndarray, "b n n"]) -> Int[np.ndarray, " b"]:
    """Find the view of the largest summed similarity to all others."""
    diagonal = np.einsum("bii->bi", similarity)
    root: np.ndarray = (similarity.sum(-1) - diagonal).argmax(-1)
    return root


def sparsify(costs: Float[np.ndarray, "b n n"], knn: int) -> np.ndarray:
    """Keep each view's ``knn`` cheapest edges, in either direction, and join what falls apart.

    A disconnected graph gets the cheapest edges that join its parts: those which a minimum
    spanning tree adds when the kept edges cost less than nothing.
    """
    order = np.argsort(costs, axis=-1, kind="stable")[..., :knn]
    kept = np.zeros(costs.shape, dtype=bool)
    np.put_along_axis(kept, order, True, axis=-1)
    kept |= kept.transpose(0, 2, 1)
    kept &= np.isfinite(costs)
    parent = _grow_tree(np.where(kept, -1.0, costs), np.zeros(len(costs), int), sum_costs=False)
    graph, child = np.nonzero(parent >= 0)
    kept[graph, child, parent[graph, child]] = True
    kept[graph, parent[graph, child], child] = True
    return np.where(kept, costs, np.inf)


def _grow_tree(
    costs: Float[np.ndarray, "b n n"], root: Int[np.ndarray, " b"], *, sum_costs: bool
) -> Int[np.ndarray, "b n"]:
    """Grow all trees of a batch from their roots, one view a round.

    With ``sum_costs`` a view is reached at the cost of its whole path: Dijkstra, the shortest-path
    tree. Without, at the cost of its last edge: Prim, the minimum spanning tree.

    Returns:
        Parent of each view; -1 for the root.
    """
    num_graphs, num_views, _ = costs.shape
    graph = np.arange(num_graphs)
    reached_at = np.full((num_graphs, num_views), np.inf)
    reached_at[graph, root] = -np.inf
    parent = np.full((num_graphs, num_views), -1)
    done: Bool[np.ndarray, "b n"] = np.zeros((num_graphs, num_views), dtype=bool)
    for step in range(num_views):
        view = np.where(done, np.inf, reached_at).argmin(-1)
        done[graph, view] = True
        path = reached_at[graph, view][:, None] if sum_costs and step else 0.0
        offer = costs[graph, view] + path
        # An equal offer counts if its parent has the lower index.
        tie = (offer == reached_at) & np.isfinite(offer) & (view[:, None] < parent)
        better = ~done & ((offer < reached_at) | tie)
        reached_at = np.where(better, offer, reached_at)
        parent = np.where(better, view[:, None], parent)
    return parent


def _order_edges(
    parent_of: Int[np.ndarray, "b n"],
    costs: Float[np.ndarray, "b n n"],
    root: Int[np.ndarray, " b"],
) -> SceneTree:
    """Lay edges out breadth-first, children of one parent by ascending cost, then by index."""
    num_graphs, num_views = parent_of.shape
    graph, child = np.nonzero(parent_of >= 0)
    parent = parent_of[graph, child]
    cost = costs[graph, parent, child]
    level = _levels(parent_of)[graph, child]
    position = np.full((num_graphs, num_views), -1)  # of the edge that leads to a view
    next_free = np.zeros(num_graphs, int)
    for depth in range(1, int(level.max()) + 1):
        here = np.nonzero(level == depth)[0]
        key = (child[here], cost[here], position[graph[here], parent[here]], graph[here])
        here = here[np.lexsort(key)]
        count = np.bincount(graph[here], minlength=num_graphs)
        start = np.cumsum(count) - count
        rank = np.arange(len(here)) - start[graph[here]]
        position[graph[here], child[here]] = next_free[graph[here]] + rank
        next_free += count
    edge = position[graph, child]

    def laid_out(values: np.ndarray) -> Tensor:
        table = np.empty((num_graphs, num_views - 1), values.dtype)
        table[graph, edge] = values
        return torch.from_numpy(table)

    return SceneTree(
        root=torch.from_numpy(root),
        parent=laid_out(parent),
        child=laid_out(child),
        level=laid_out(level),
        parent_edge=laid_out(position[graph, parent]),
        cost=laid_out(cost),
    )


def _levels(parent_of: Int[np.ndarray, "b n"]) -> Int[np.ndarray, "b n"]:
    """Count the edges between each view and the root."""
    level = np.zeros_like(parent_of)
    ancestor = parent_of
    while (ancestor >= 0).any():
        level += ancestor >= 0
        above = np.take_along_axis(parent_of, np.maximum(ancestor, 0), axis=-1)
        ancestor = np.where(ancestor >= 0, above, -1)
    return level
