"""Depth between the pixels at which it is known.

Inverse depth is linear over the image of a plane, so that interpolating it is exact there, and
half a pixel shows; the nearest pixel's depth would hide it.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy.spatial import Delaunay, QhullError
from torch import Tensor

AGREE = 0.05
"""Depths that differ by less than this share are one surface."""

_REACH = 1 / 16
"""Longest side of a triangle, as a share of the image's width."""


@dataclass(frozen=True)
class GridSurface:
    """Depth known at neighbouring pixels."""

    depth: Float[Tensor, "h w"]
    """z, 0 where unknown."""

    def interpolate(
        self, pts2d: Float[Tensor, "p 2"]
    ) -> tuple[Float[Tensor, " p"], Bool[Tensor, " p"]]:
        """Interpolate bilinearly; see :func:`interpolate_depth`."""
        return interpolate_depth(self.depth, pts2d)


def interpolate_depth(
    depth: Float[Tensor, "h w"], pts2d: Float[Tensor, "p 2"]
) -> tuple[Float[Tensor, " p"], Bool[Tensor, " p"]]:
    """Interpolate inverse depth bilinearly.

    Args:
        depth: z, 0 where unknown.
        pts2d: Where to; pixel centres at .5.

    Returns:
        ``(depth, known)``: known where the four neighbours are inside, known, and agree within 5%.
    """
    height, width = depth.shape
    corner = (pts2d - 0.5).nan_to_num(-1, -1, -1)
    inside = ((corner >= 0) & (corner <= corner.new_tensor([width - 1, height - 1]))).all(-1)
    column = corner[:, 0].clamp(0, width - 1.001).long().clamp_max(width - 2)
    row = corner[:, 1].clamp(0, height - 1.001).long().clamp_max(height - 2)
    four = torch.stack([depth[row + dy, column + dx] for dy in (0, 1) for dx in (0, 1)])
    low, high = four.amin(0), four.amax(0)
    known = inside & (low > 0) & (high <= (1 + AGREE) * low)
    x, y = corner[:, 0] - column, corner[:, 1] - row
    weights = torch.stack([(1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x])
    inverse = (weights / torch.where(known, four, 1)).sum(0)
    return torch.where(known, 1 / inverse.clamp_min(1e-12), 0), known


class MeshSurface:
    """Depth known at scattered pixels, joined by a Delaunay triangulation.

    Args:
        depth: z, 0 where unknown.
    """

    def __init__(self, depth: Float[Tensor, "h w"]) -> None:
        rows, columns = np.nonzero(depth.numpy() > 0)
        self.pts2d: Float64[np.ndarray, "m 2"] = np.stack([columns + 0.5, rows + 0.5], axis=-1)
        self.z = depth.numpy()[rows, columns].astype(np.float64)
        self.reach = _REACH * depth.shape[1]
        try:
            self.triangles = Delaunay(self.pts2d) if len(rows) > 2 else None
        except QhullError:  # all on one line
            self.triangles = None

    def interpolate(
        self, pts2d: Float[Tensor, "p 2"]
    ) -> tuple[Float[Tensor, " p"], Bool[Tensor, " p"]]:
        """Interpolate inverse depth linearly over triangles.

        Returns:
            ``(depth, known)``: known where the corners agree within 5% and no side is longer than
            1/16 of the image's width.
        """
        if self.triangles is None:
            return torch.zeros(len(pts2d)).double(), torch.zeros(len(pts2d), dtype=torch.bool)
        where = pts2d.numpy()
        where = np.where(np.isfinite(where), where, -1)
        found = self.triangles.find_simplex(where)
        turn = self.triangles.transform[found]
        two = np.einsum("pij,pj->pi", turn[:, :2], where - turn[:, 2])
        weights = np.concatenate([two, 1 - two.sum(1, keepdims=True)], axis=1)
        corner = self.triangles.simplices[found]
        z, at = self.z[corner], self.pts2d[corner]
        side = np.linalg.norm(at - np.roll(at, 1, axis=1), axis=-1).max(1)
        known = (found >= 0) & (z.max(1) <= (1 + AGREE) * z.min(1)) & (side <= self.reach)
        inverse = np.where(known, (weights / z).sum(1), 1)
        return torch.from_numpy(np.where(known, 1 / inverse, 0)), torch.from_numpy(known)


Surface = GridSurface | MeshSurface
"""Something seen from one camera."""


def surface_of(depth: Float[Tensor, "h w"]) -> Surface:
    """Choose how to interpolate a depth map: by its pixels, or by triangles where few are known.

    Args:
        depth: z, 0 where unknown.
    """
    return MeshSurface(depth) if is_scattered(depth) else GridSurface(depth)


def is_scattered(depth: Float[Tensor, "h w"]) -> bool:
    """Whether most known pixels have no known pixel to the right, below and between."""
    known = depth > 0
    whole = known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]
    return bool(whole.sum() < 0.5 * known.sum())
