"""Which images of a scene see the same surface, and from how different directions.

Depth pixels on a fixed grid of image i are moved to image j; one counts as seen there if it is
in front, inside the image, and within 5% of the depth j has at that pixel. With c_ij the number
of pixels of i seen in j, of n_i known ones, IoU = c / (n_i + n_j - c), c = (c_ij + c_ji) / 2.
A scene that knows better by itself, from points triangulated in both images, gives its own IoU.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from data_prep.depth_views import DepthViews
from data_prep.scene import Scene
from l3r.errors import DataError
from l3r.geometry.rigid import rotation_angle

RELATIVE = 0.05
"""Depths that differ by less than this share are one surface."""
MIN_ROTATION = math.radians(2)
"""Below this rotation the parallax angle stands in for it [rad]."""

_BLOCK = 2**18
"""Points tested at once: large enough to hide the calls, small enough for the cache."""


@dataclass(frozen=True, kw_only=True)
class OverlapTable:
    """Overlap of all pairs of a scene."""

    iou: Float[Tensor, "n n"]
    """Symmetric, 1 on the diagonal."""
    covisible: Float[Tensor, "n n"]
    """``[i, j]``: share of the known depth of i that j sees too."""
    rotation: Float[Tensor, "n n"]
    """Angle of the relative rotation [rad]."""
    axis: Float[Tensor, "n n"]
    """Angle between the optical axes [rad]."""
    angle: Float[Tensor, "n n"]
    """Viewpoint angle: the rotation, or the median parallax where it is below 2 degrees [rad]."""
    score: Float[Tensor, "n n"]
    """CroCo score of IoU and viewpoint angle."""


def _sees(
    views: DepthViews,
    target: Int[Tensor, " t"],
    pts3d_world: Float[Tensor, "t p 3"] | Float[Tensor, "p 3"],
) -> Bool[Tensor, "t p"]:
    """Test whether target views see points: one set for each, or one set for all."""
    P = views.pixels_from_world[target]
    projected = P[:, :, :3] @ pts3d_world.transpose(-1, -2) + P[:, :, 3:]
    x, y, z = projected.unbind(1)
    in_front = z > 0
    z = z.clamp_min(1e-6)
    height, width = views.depth.shape[-2:]
    # The padding is one pixel wide, so what lies outside is clamped onto depth that is unknown.
    column = (x / z).clamp_(-1, width - 2).floor_().long().add_(1)
    row = (y / z).clamp_(-1, height - 2).floor_().long().add_(1)
    column.add_(row, alpha=width).add_((target * (height * width))[:, None])
    found = views.depth.flatten()[column]
    return ((found - z).abs_() <= (RELATIVE * z).clamp_min_(views.floor)) & in_front


def count_seen(views: DepthViews) -> Int[Tensor, "n n"]:
    """Count for each ordered pair (i, j) the grid points of i that j sees."""
    n, p = views.valid.shape
    device = views.center.device
    seen = torch.zeros(n, n, dtype=torch.int32, device=device)
    sources = max(1, min(n, _BLOCK // (16 * p)))
    targets = max(1, _BLOCK // (sources * p))
    for i in range(0, n, sources):
        points = views.pts3d_world[i : i + sources].reshape(-1, 3)
        valid = views.valid[i : i + sources]
        for j in range(0, n, targets):
            target = torch.arange(j, min(j + targets, n), device=device)
            hit = _sees(views, target, points).reshape(len(target), -1, p) & valid
            seen[i : i + sources, j : j + targets] = hit.sum(-1, dtype=torch.int32).T
    return seen


def median_parallax(
    views: DepthViews, pairs: Int[Tensor, "m 2"], chunk: int = 512
) -> Float[Tensor, " m"]:
    """Take the median angle C_i - X - C_j over the common points of pairs [rad].

    Args:
        views: Depth of the scene.
        pairs: View numbers (i, j).
        chunk: Pairs taken at once.

    Returns:
        One angle for each pair, NaN where the two have no common point.
    """
    parts = [_parallax_chunk(views, pairs[at : at + chunk]) for at in range(0, len(pairs), chunk)]
    return torch.cat(parts) if parts else torch.empty(0)


def _parallax_chunk(views: DepthViews, pairs: Int[Tensor, "m 2"]) -> Float[Tensor, " m"]:
    angles = []
    for source, target in (pairs.unbind(1), pairs.flip(1).unbind(1)):
        points = views.pts3d_world[source]
        common = _sees(views, target, points) & views.valid[source]
        here = views.center[source][:, None] - points
        there = views.center[target][:, None] - points
        # The arc cosine would lose small angles, which are the ones asked for.
        sine = torch.linalg.cross(here, there).norm(dim=-1)
        angle = torch.atan2(sine, (here * there).sum(-1))
        angles.append(torch.where(common, angle, torch.nan))
    return torch.cat(angles, dim=1).nanmedian(dim=1).values


def croco_score(iou: Float[Tensor, "*b"], angle: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Score pairs by CroCo v2: IoU 4 cos a (1 - cos a), at least 0; 1 at full overlap and 60 deg.

    Args:
        iou: Covisibility in [0, 1].
        angle: Viewpoint angle [rad].
    """
    cos = angle.cos()
    return (iou * 4 * cos * (1 - cos)).clamp_min(0)


def build_table(scene: Scene, views: DepthViews) -> OverlapTable:
    """Relate all pairs of a scene.

    Args:
        scene: Its cameras, and its own overlap where it has one.
        views: What :func:`~data_prep.depth_views.prepare_views` made of it.

    Raises:
        DataError: The scene's own overlap cannot be read, or is none.
    """
    seen = count_seen(views).float()
    count = views.valid.sum(-1).float()
    common = (seen + seen.T) / 2
    iou = common / (count[:, None] + count[None, :] - common).clamp_min(1)
    iou.fill_diagonal_(1)
    if scene.read_overlap is not None:
        iou = _own_overlap(scene).to(iou)
    covisible = (seen / count[:, None].clamp_min(1)).fill_diagonal_(1)
    R = torch.from_numpy(scene.world_from_cam[:, :3, :3])
    rotation, axis = (table.float().to(iou.device) for table in _angles(R))
    angle = rotation.clone()
    still = torch.triu((rotation < MIN_ROTATION) & (iou > 0), diagonal=1).nonzero()
    if len(still):
        parallax = median_parallax(views, still).nan_to_num(0.0)
        angle[still[:, 0], still[:, 1]] = parallax
        angle[still[:, 1], still[:, 0]] = parallax
    return OverlapTable(
        iou=iou,
        covisible=covisible,
        rotation=rotation,
        axis=axis,
        angle=angle,
        score=croco_score(iou, angle),
    )


def _own_overlap(scene: Scene) -> Float[Tensor, "n n"]:
    assert scene.read_overlap is not None
    iou = torch.from_numpy(scene.read_overlap())
    n = len(scene.frames)
    good = iou.shape == (n, n) and ((iou >= 0) & (iou <= 1)).all() and torch.equal(iou, iou.T)
    if not (good and (iou.diagonal() == 1).all()):
        raise DataError(
            f"{scene.name}: its own overlap has shape {tuple(iou.shape)}, expected {n} x {n},"
            " symmetric, from 0 to 1, and 1 on the diagonal; the source's points are damaged"
        )
    return iou


def _angles(
    world_from_cam_R: Float[Tensor, "n 3 3"],
) -> tuple[Float[Tensor, "n n"], Float[Tensor, "n n"]]:
    """Angles of relative rotations and between optical axes, row by row to save memory."""
    rotation = torch.stack([rotation_angle(R.T @ world_from_cam_R) for R in world_from_cam_R])
    z = world_from_cam_R[:, :, 2]
    chord = (z[:, None] - z[None, :]).norm(dim=-1)
    return rotation, 2 * torch.asin((chord / 2).clamp_max(1))


def pairs_of(views: Iterable[int]) -> list[tuple[int, int]]:
    """List the unordered pairs among views, lower number first."""
    ordered = sorted(views)
    return [(i, j) for at, i in enumerate(ordered) for j in ordered[at + 1 :]]
