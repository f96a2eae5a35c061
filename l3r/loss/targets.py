"""Ground truth in the frames that the predictions are in."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l3r.geometry.camera import unproject
from l3r.geometry.rigid import invert_rigid, transform_points
from l3r.types import SceneTree, Views


@dataclass(frozen=True, kw_only=True)
class PairTargets:
    """Ground truth of every edge, in the parent's camera frame."""

    parent_pts3d: Float[Tensor, "b e p 3"]
    child_pts3d: Float[Tensor, "b e p 3"]
    parent_valid: Bool[Tensor, "b e p"]
    child_valid: Bool[Tensor, "b e p"]


@dataclass(frozen=True, kw_only=True)
class WorldTargets:
    """Ground truth of every view, in the world frame of its graph."""

    pts3d_world: Float[Tensor, "b n p 3"]
    valid: Bool[Tensor, "b n p"]


def build_targets(views: Views, tree: SceneTree) -> tuple[PairTargets, WorldTargets]:
    """Lift the depth maps of a batch and move the points to where they are compared."""
    valid = views.valid.flatten(-2)
    pts3d_cam = unproject(views.depth, views.K)
    parent = tree.parent.to(valid.device, non_blocking=True)
    child = tree.child.to(valid.device, non_blocking=True)
    world_from_parent = _take(views.world_from_cam, parent)
    parent_from_child = invert_rigid(world_from_parent) @ _take(views.world_from_cam, child)
    pairs = PairTargets(
        parent_pts3d=_take(pts3d_cam, parent),
        child_pts3d=transform_points(parent_from_child, _take(pts3d_cam, child)),
        parent_valid=_take(valid, parent),
        child_valid=_take(valid, child),
    )
    world = transform_points(views.world_from_cam, pts3d_cam)
    return pairs, WorldTargets(pts3d_world=world, valid=valid)


def _take(values: Tensor, index: Int[Tensor, "b e"]) -> Tensor:
    """Pick ``values[graph, index[graph]]`` along the second dimension."""
    return values[torch.arange(len(index), device=index.device)[:, None], index]
