"""The tree over a graph's stored overlap, as nodes and lines of a small drawing."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from l3r.config import GraphConfig
from l3r.graph.trees import build_tree
from l3r.types import SceneTree

_LEVEL, _ROW, _MARGIN = 104.0, 38.0, 22.0
_LABEL_AT = 0.6
"""Where along an edge its label stands: nearer the child, where edges have parted."""


@dataclass(frozen=True, kw_only=True)
class Node:
    """One image."""

    view: int
    x: float
    y: float
    is_root: bool


@dataclass(frozen=True, kw_only=True)
class Edge:
    """One edge of the tree."""

    parent: int
    child: int
    start: tuple[float, float]
    end: tuple[float, float]
    label: str
    """Overlap (IoU) of the two images."""
    at: tuple[float, float]
    """Middle of the label."""


@dataclass(frozen=True, kw_only=True)
class TreePlan:
    """A tree ready for a page: the root at the left, one column for each level."""

    width: float
    height: float
    nodes: list[Node]
    edges: list[Edge]
    """Breadth-first."""


def oracle_tree(iou: Float64[np.ndarray, "n n"]) -> SceneTree:
    """Build the tree that ``graph.algorithm=oracle`` takes: shortest paths at -log IoU."""
    return build_tree(torch.from_numpy(iou)[None], GraphConfig(algorithm="oracle"))


def draw_tree(iou: Float64[np.ndarray, "n n"]) -> TreePlan:
    """Lay the tree of a graph out.

    Args:
        iou: Stored overlap of at least two images.
    """
    tree = oracle_tree(iou)
    root, parents, children = int(tree.root[0]), tree.parent[0].tolist(), tree.child[0].tolist()
    below: dict[int, list[int]] = {view: [] for view in range(len(iou))}
    for parent, child in zip(parents, children, strict=True):
        below[parent].append(child)
    position: dict[int, tuple[float, float]] = {}
    num_leaves = _place(root, 0, below, position, 0)
    deepest = max(x for x, _ in position.values())
    edges = []
    for parent, child in zip(parents, children, strict=True):
        start, end = position[parent], position[child]
        x, y = (a + _LABEL_AT * (b - a) for a, b in zip(start, end, strict=True))
        label = f"{iou[parent, child]:.2f}"
        edges.append(Edge(parent=parent, child=child, start=start, end=end, label=label, at=(x, y)))
    return TreePlan(
        width=deepest + _MARGIN,
        height=(num_leaves - 1) * _ROW + 2 * _MARGIN,
        nodes=[
            Node(view=view, x=x, y=y, is_root=view == root)
            for view, (x, y) in sorted(position.items())
        ],
        edges=edges,
    )


def _place(
    view: int,
    level: int,
    below: dict[int, list[int]],
    position: dict[int, tuple[float, float]],
    row: int,
) -> int:
    """Place a sub-tree from ``row`` on; give the row after its last leaf."""
    next_row = row
    for child in below[view]:
        next_row = _place(child, level + 1, below, position, next_row)
    if below[view]:
        y = float(np.mean([position[child][1] for child in below[view]]))
    else:
        y, next_row = _MARGIN + next_row * _ROW, next_row + 1
    position[view] = (_MARGIN + level * _LEVEL, y)
    return next_row
