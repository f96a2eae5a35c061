"""Global accumulation: pairwise point maps are chained along the tree into one frame.

Every edge but the first fits the rigid transform between the two maps that its parent image has:
the one it came with (from its own parent edge) and the one this edge decoded. Both are known
before anything is chained, and a rigid fit commutes with a rigid motion of its target. So all
edges of all graphs are fitted in ONE batched call, in the frames they were decoded in, and the
transforms are then composed level by level, 4x4 by 4x4. The answer is the edge-by-edge one.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from l3r.config import GraphConfig
from l3r.geometry.similarity import (
    Similarity,
    fit_residual,
    fit_similarity,
    identity_similarity,
)
from l3r.types import PairPointmaps, SceneTree, WorldPointmaps


def accumulate(pairs: PairPointmaps, tree: SceneTree, config: GraphConfig) -> WorldPointmaps:
    """Chain pairwise point maps along the trees; the world is the root's camera.

    The root's cheapest edge (edge 0) sets the root's map and needs no fit. A further edge weighs
    all pixels by the mean of the two log confidences: the logarithm of the paper's geometric
    mean. Gradients flow through points and weights. Runs in the precision of the maps, outside
    autocast.

    Args:
        pairs: Both maps of every edge, in the parent's camera frame.
        tree: Edges in the order of :class:`~l3r.types.SceneTree`.
        config: ``confidence`` and ``with_scale``.
    """
    with torch.autocast(pairs.parent_pts3d.device.type, enabled=False):
        return _accumulate(pairs, tree, config)


def _accumulate(pairs: PairPointmaps, tree: SceneTree, config: GraphConfig) -> WorldPointmaps:
    device = pairs.parent_pts3d.device
    parent_edge = tree.parent_edge.to(device, non_blocking=True)
    level = tree.level.to(device, non_blocking=True)
    # Slot 0 holds the map the root came with, slot e + 1 the one that edge e's child came with.
    arrived_pts3d = torch.cat([pairs.parent_pts3d[:, :1], pairs.child_pts3d], dim=1)
    arrived_log_conf = torch.cat([pairs.parent_log_conf[:, :1], pairs.child_log_conf], dim=1)
    slot = parent_edge + 1  # of each edge's parent
    if config.confidence == "running":
        host_slot = tree.parent_edge + 1
        weights, log_conf = _running_confidence(arrived_log_conf, pairs.parent_log_conf, host_slot)
    else:
        weights, log_conf = _mean_confidence(arrived_log_conf, pairs.parent_log_conf, slot)
    target = _take(arrived_pts3d, slot[:, 1:])
    source = pairs.parent_pts3d[:, 1:]
    arrived_from_edge = fit_similarity(target, source, weights[:, 1:], with_scale=config.with_scale)
    with torch.no_grad():  # a diagnosis, not trained
        residual = fit_residual(arrived_from_edge, target, source, weights[:, 1:])
    world_from_edge = compose_along_tree(
        _prepend_identity(arrived_from_edge), parent_edge, level, tree.num_levels
    )
    child_pts3d_world = world_from_edge.transform(pairs.child_pts3d)
    by_slot = torch.cat([pairs.parent_pts3d[:, :1], child_pts3d_world], dim=1)
    slot_of_view = _slot_of_view(tree).to(device, non_blocking=True)
    return WorldPointmaps(
        pts3d_world=_take(by_slot, slot_of_view),
        log_conf=_take(log_conf, slot_of_view),
        residual=F.pad(residual, (1, 0)),
    )


def compose_along_tree(
    arrived_from_edge: Similarity,
    parent_edge: Int[Tensor, "b e"],
    level: Int[Tensor, "b e"],
    num_levels: int,
) -> Similarity:
    """Compose each edge's transform with its ancestors', one batched product per tree level.

    Args:
        arrived_from_edge: Of each edge, from the frame it was decoded in to the frame in which
            its parent's map arrived: the world at level 1, else the parent edge's frame.
        parent_edge: Edge above each edge; -1 at the root.
        level: 1 at the root.
        num_levels: Depth of the deepest tree.

    Returns:
        ``world_from_edge``, of the same batch shape.
    """
    world = arrived_from_edge
    above = parent_edge.clamp_min(0)
    for depth in range(2, num_levels + 1):
        ancestor = Similarity(
            _take(world.scale, above), _take(world.R, above), _take(world.t, above)
        )
        composed = ancestor.compose(arrived_from_edge)
        here = level == depth
        world = Similarity(
            torch.where(here, composed.scale, world.scale),
            torch.where(here[..., None, None], composed.R, world.R),
            torch.where(here[..., None], composed.t, world.t),
        )
    return world


def _mean_confidence(
    arrived: Float[Tensor, "b s p"], own: Float[Tensor, "b e p"], slot: Int[Tensor, "b e"]
) -> tuple[Float[Tensor, "b e p"], Float[Tensor, "b s p"]]:
    """Weights of every edge's fit, and the final log confidence of every slot: one mean of all."""
    weights = (_take(arrived, slot) + own) / 2
    # Edge 0 made the root's map: its own confidence has already arrived in slot 0.
    index = slot[:, 1:, None].expand_as(own[:, 1:])
    total = arrived.scatter_add(1, index, own[:, 1:])
    ones = arrived.new_ones(arrived.shape[:2])
    count = ones.scatter_add(1, slot[:, 1:], ones[:, 2:])
    return weights, total / count[..., None]


def _running_confidence(
    arrived: Float[Tensor, "b s p"], own: Float[Tensor, "b e p"], slot: Int[Tensor, "b e"]
) -> tuple[Float[Tensor, "b e p"], Float[Tensor, "b s p"]]:
    """Halve towards each edge in turn, as the paper prints it; the order of edges matters."""
    state = [list(graph) for graph in arrived]
    weights = [[graph[0]] for graph in own]
    for graph, slots in enumerate(slot.tolist()):
        for edge, arrived_in in enumerate(slots[1:], start=1):
            updated = (state[graph][arrived_in] + own[graph, edge]) / 2
            state[graph][arrived_in] = updated
            weights[graph].append(updated)
    return _stack(weights), _stack(state)


def _stack(rows: list[list[Tensor]]) -> Tensor:
    return torch.stack([torch.stack(row) for row in rows])


def _slot_of_view(tree: SceneTree) -> Int[Tensor, "b n"]:
    """Slot of the map that each view came with."""
    num_graphs, num_edges = tree.child.shape
    slot = torch.zeros(num_graphs, num_edges + 1, dtype=torch.long)
    return slot.scatter(1, tree.child, torch.arange(1, num_edges + 1).expand_as(tree.child))


def _take(values: Tensor, index: Int[Tensor, "b k"]) -> Tensor:
    """Pick ``values[graph, index[graph]]`` along the second dimension."""
    graph = torch.arange(len(index), device=index.device)[:, None]
    return values[graph, index]


def _prepend_identity(further: Similarity) -> Similarity:
    """Put the first edge, which needs no fit, before the others."""
    first = identity_similarity(len(further.scale), 1, like=further.scale)
    return Similarity(
        torch.cat([first.scale, further.scale], dim=1),
        torch.cat([first.R, further.R], dim=1),
        torch.cat([first.t, further.t], dim=1),
    )
