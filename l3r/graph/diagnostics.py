"""What a tree looks like, where it is weak, and where it should be cut."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from l3r.config import GraphConfig
from l3r.types import SceneTree

STAR_MIN_VIEWS = 20
"""Below this many views a star is a fine tree."""


@dataclass(frozen=True, kw_only=True)
class TreeDiagnostics:
    """Shape and weak points of one tree."""

    root: int
    """View at the root."""
    root_degree: int
    """Edges at the root."""
    largest_degree: int
    """Edges at the best-connected view."""
    views_at_depth: list[int]
    """Number of views 0, 1, 2, ... edges from the root."""
    weakest_edge: list[int]
    """[parent, child] of the edge of least similarity."""
    weakest_similarity: float
    """Its similarity."""
    edges: list[dict[str, Any]]
    """parent, child, similarity, cost and residual of every edge, in the tree's order."""

    def warnings(self) -> list[str]:
        """Say what a user should know."""
        num_views = sum(self.views_at_depth)
        if num_views > STAR_MIN_VIEWS and self.root_degree > num_views / 2:
            return [
                f"the tree is nearly a star: {self.root_degree} of {num_views - 1} edges end at "
                f"image {self.root}; similarities may be too flat (see graph.cost_power, graph.knn)"
            ]
        return []

    def to_plain(self) -> dict[str, Any]:
        """Builtins only, for ``run.json``."""
        return asdict(self)


def diagnose_tree(
    tree: SceneTree, scores: Float[Tensor, "n n"], residual: Float[Tensor, " e"]
) -> TreeDiagnostics:
    """Describe a tree (a batch of one) with the similarities and fit residuals of its edges."""
    parent, child = tree.parent[0].tolist(), tree.child[0].tolist()
    similarity = scores.cpu()[tree.parent[0], tree.child[0]].tolist()
    degree = np.bincount(np.array(parent + child))
    weakest = int(np.argmin(similarity))
    rows = zip(parent, child, similarity, tree.cost[0].tolist(), residual.tolist(), strict=True)
    keys = ("parent", "child", "similarity", "cost", "residual")
    root = int(tree.root[0])
    return TreeDiagnostics(
        root=root,
        root_degree=int(degree[root]),
        largest_degree=int(degree.max()),
        views_at_depth=[1, *np.bincount(tree.level[0].numpy())[1:].tolist()],
        weakest_edge=[parent[weakest], child[weakest]],
        weakest_similarity=similarity[weakest],
        edges=[dict(zip(keys, row, strict=True)) for row in rows],
    )


def summarise_trees(tree: SceneTree) -> dict[str, float]:
    """Describe the trees of a batch in few numbers, which show a collapse to stars.

    Returns:
        ``root_degree``: mean number of edges at the root; ``root_degree_max``: the largest of the
        batch, n - 1 for a star; ``tree_depth``: mean number of edges from the root to the
        farthest view, 1 for a star.
    """
    degrees = (tree.level == 1).sum(1)
    return {
        "root_degree": float(degrees.double().mean()),
        "root_degree_max": float(degrees.max()),
        "tree_depth": float(tree.level.amax(1).double().mean()),
    }


def split_components(
    tree: SceneTree,
    scores: Float[Tensor, "n n"],
    residual: Float[Tensor, " e"],
    config: GraphConfig,
) -> Int[Tensor, " n"]:
    """Number the parts that remain when weak edges are cut, 0 being the root's.

    An edge is weak below ``min_similarity`` or above ``max_residual``; both are off by default,
    and then all images form part 0. Parts are numbered in the tree's order.
    """
    similarity = scores.cpu()[tree.parent[0], tree.child[0]]
    weak = torch.zeros(tree.num_edges, dtype=torch.bool)
    if config.min_similarity is not None:
        weak |= similarity < config.min_similarity
    if config.max_residual is not None:
        weak |= residual.cpu() > config.max_residual
    component = torch.zeros(tree.num_edges + 1, dtype=torch.long)
    new_number = torch.cumsum(weak, 0)
    # Edges are in breadth-first order: a parent's number is final before its children's.
    for edge in range(tree.num_edges):
        own = component[tree.parent[0, edge]]
        component[tree.child[0, edge]] = new_number[edge] if weak[edge] else own
    return component
