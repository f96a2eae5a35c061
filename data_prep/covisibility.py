"""Which images of a scene see the same surface, and from how different directions.

Depth pixels on a fixed grid of image i are moved to image j; one counts as seen there if it is
in front, inside the image, and within 5% of the depth j has at that pixel. With c_ij the number
of pixels of i seen in j, of n_i known ones, IoU = c / (n_i + n_j - c), c = (c_ij + c_ji) / 2.
A scene that knows better by itself, from points triangulated in both images, gives its own IoU.

What is said of a pair depends on its two images alone, to the last bit: not on the pairs beside
it, nor on how many are taken at once.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64
from scipy.sparse import csr_array
from torch import Tensor

from data_prep.depth_views import DepthViews
from data_prep.overlap_table import OverlapTable
from data_prep.scene import Scene
from l3r.errors import DataError
from l3r.geometry.rigid import rotation_angle

RELATIVE = 0.05
"""Depths that differ by less than this share are one surface."""
MIN_ROTATION = math.radians(2)
"""Below this rotation the parallax angle stands in for it [rad]."""

_BLOCK = 2**17
"""Points (or pairs) taken at once: enough to hide the calls, few enough for the cache."""


def relate_pairs(
    scene: Scene,
    views: DepthViews,
    pairs: Int64[np.ndarray, "m 2"],
    own: csr_array | None = None,
) -> OverlapTable:
    """Relate pairs of images of a scene.

    Args:
        scene: Its cameras.
        views: What :func:`~data_prep.depth_views.prepare_views` made of it, or part of its points.
        pairs: View numbers (i, j), i < j, each pair once, in any order.
        own: The scene's own overlap where it has one: :func:`read_own_overlap`.

    Returns:
        A row for each pair, in ascending order.
    """
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    seen, parallax = relate_depth(views, pairs)
    seen = seen.astype(np.float32)
    count = views.valid.sum(-1).cpu().numpy().astype(np.float32)[pairs]
    common = seen.sum(1) / 2
    iou = common / np.maximum(count.sum(1) - common, 1)
    # scipy gives a sparse array for no entry at all.
    if own is not None and len(pairs):
        iou = np.asarray(own[pairs[:, 0], pairs[:, 1]]).astype(np.float32)
    rotation, axis = _angles(scene.world_from_cam[:, :3, :3], pairs)
    still = (rotation < MIN_ROTATION) & (iou > 0)
    angle = np.where(still, np.nan_to_num(parallax, nan=0.0), rotation)
    return OverlapTable(
        num_views=len(scene.frames),
        views=pairs,
        iou=iou,
        covisible=seen / np.maximum(count, 1),
        rotation=rotation,
        axis=axis,
        parallax=parallax,
        angle=angle,
        score=croco_score(torch.from_numpy(iou), torch.from_numpy(angle)).numpy(),
    )


def relate_depth(
    views: DepthViews, pairs: Int64[np.ndarray, "m 2"]
) -> tuple[Int64[np.ndarray, "m 2"], Float32[np.ndarray, " m"]]:
    """Find what pairs of images both see, and how far apart they see it.

    Args:
        views: Depth of the scene.
        pairs: View numbers (i, j); neighbours in this order are looked up fastest.

    Returns:
        ``(seen, parallax)``: the number of grid points of i that j sees, and of j that i sees; the
        median angle C_i - X - C_j over both [rad], NaN where there are none.
    """
    chunk = max(1, _BLOCK // views.valid.shape[1])
    seen = np.zeros((len(pairs), 2), dtype=np.int64)
    parallax = np.full(len(pairs), np.nan, dtype=np.float32)
    for at in range(0, len(pairs), chunk):
        index = torch.from_numpy(pairs[at : at + chunk]).to(views.center.device)
        ways = index, index.flip(1)
        common = torch.stack([_sees(views, *way.unbind(1)) for way in ways], dim=1)
        count = common.sum(-1)
        seen[at : at + chunk] = count.cpu().numpy()
        met = count.any(dim=1).nonzero()[:, 0]
        if len(met):
            angle = torch.stack([_parallax(views, *way[met].unbind(1)) for way in ways], dim=1)
            angle = torch.where(common[met], angle, torch.inf).flatten(1)
            parallax[at + met.cpu().numpy()] = _median(angle, count[met].sum(1))
    return seen, parallax


def _parallax(
    views: DepthViews, source: Int[Tensor, " m"], target: Int[Tensor, " m"]
) -> Float[Tensor, "m p"]:
    """Angles C_source - X - C_target at the grid points of source views [rad]."""
    points = views.pts3d_world.index_select(0, source)
    x, y, z = (views.center.index_select(0, source)[..., None] - points).unbind(1)
    u, v, w = (views.center.index_select(0, target)[..., None] - points).unbind(1)
    # The arc cosine would lose small angles, which are the ones asked for.
    sine = (y * w - z * v).square_()
    sine.add_((z * u - x * w).square_()).add_((x * v - y * u).square_()).sqrt_()
    return torch.atan2(sine, x * u + y * v + z * w)


def _sees(
    views: DepthViews, source: Int[Tensor, " m"], target: Int[Tensor, " m"]
) -> Bool[Tensor, "m p"]:
    """Test which known grid points of each source view its target view sees."""
    x, y, z = views.pts3d_world.index_select(0, source).unbind(1)
    P = views.pixels_from_world.index_select(0, target)[..., None]
    # Not a matrix product, whose last bits may depend on what else is multiplied.
    x, y, z = (
        (x * P[:, row, 0]).add_(y * P[:, row, 1]).add_(z * P[:, row, 2]).add_(P[:, row, 3])
        for row in range(3)
    )
    in_front = z > 0
    z = z.clamp_min(1e-6)
    height, width = views.depth.shape[-2:]
    # The padding is one pixel wide, so what lies outside is clamped onto depth that is unknown.
    column = (x / z).clamp_(-1, width - 2).floor_().long().add_(1)
    row = (y / z).clamp_(-1, height - 2).floor_().long().add_(1)
    column.add_(row, alpha=width).add_((target * (height * width))[:, None])
    found = views.depth.flatten().index_select(0, column.flatten()).reshape(z.shape)
    near = (found - z).abs_() <= (RELATIVE * z).clamp_min_(views.floor)
    return near & in_front & views.valid.index_select(0, source)


def _median(angle: Float[Tensor, "m q"], count: Int[Tensor, " m"]) -> Float32[np.ndarray, " m"]:
    """Take the (lower) median of the finite numbers of each row, of which there are ``count``."""
    # numpy's sort of rows takes a tenth of the time of torch's nanmedian.
    ordered = np.sort(angle.cpu().numpy(), axis=1)
    return np.asarray(ordered[np.arange(len(ordered)), (count.cpu().numpy() - 1) // 2])


def croco_score(iou: Float[Tensor, "*b"], angle: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Score pairs by CroCo v2: IoU 4 cos a (1 - cos a), at least 0; 1 at full overlap and 60 deg.

    Args:
        iou: Covisibility in [0, 1].
        angle: Viewpoint angle [rad].
    """
    cos = angle.cos()
    return (iou * 4 * cos * (1 - cos)).clamp_min(0)


def read_own_overlap(scene: Scene) -> csr_array | None:
    """Read the overlap that a scene knows by itself.

    Returns:
        IoU of its n images, n x n, symmetric, 1 on the diagonal; None where it has none.

    Raises:
        DataError: It cannot be read, or is none.
    """
    if scene.read_overlap is None:
        return None
    own = scene.read_overlap()
    n = len(scene.frames)
    good = own.shape == (n, n) and bool(((own.data >= 0) & (own.data <= 1)).all())
    if not (good and abs(own - own.T).max() == 0 and (own.diagonal() == 1).all()):
        raise DataError(
            f"{scene.name}: its own overlap has shape {own.shape}, expected {n} x {n},"
            " symmetric, from 0 to 1, and 1 on the diagonal; the source's points are damaged"
        )
    return own


def _angles(
    world_from_cam_R: Float64[np.ndarray, "n 3 3"], pairs: Int64[np.ndarray, "m 2"]
) -> tuple[Float32[np.ndarray, " m"], Float32[np.ndarray, " m"]]:
    """Angles of relative rotations, and between optical axes [rad]."""
    R = torch.from_numpy(world_from_cam_R)
    parts = []
    for at in range(0, max(len(pairs), 1), _BLOCK):
        first, second = (R[index] for index in pairs[at : at + _BLOCK].T)
        rotation = rotation_angle(first.transpose(-1, -2) @ second)
        chord = (first[..., 2] - second[..., 2]).norm(dim=-1)
        axis = 2 * torch.asin((chord / 2).clamp_max(1))
        parts.append(torch.stack([rotation, axis]).float())
    rotation, axis = torch.cat(parts, dim=1)
    return rotation.numpy(), axis.numpy()
