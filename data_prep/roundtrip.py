"""How well depth, intrinsics and cameras of two images agree: there and back again.

Pixel centres of image i go to j by depth, K and cameras, and back by the depth of j. Inverse
depth is interpolated bilinearly, which is exact on a plane, so half a pixel shows; the nearest
pixel's depth would hide it.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from l3r.data.schema import GraphSample
from l3r.geometry.camera import project
from l3r.geometry.rigid import invert_rigid, transform_points

AGREE = 0.05
"""Depths that differ by less than this share are one surface."""

_MAX_COLUMNS = 80


@dataclass(frozen=True, kw_only=True)
class PairMeasure:
    """What two images of a graph say of each other, from i to j."""

    stored_covisible: float
    """Share of i's known depth that j sees, as stored."""
    share: float
    """The same share, measured here."""
    pixels: float
    """Median distance from where the round trip began [px]; NaN where nothing is seen."""
    depth: float
    """Median relative difference of depth at j; NaN where nothing is seen."""
    color: float
    """Correlation of brightness at what both see; NaN where nothing is seen or all is one tone."""


def measure_graph(sample: GraphSample) -> list[PairMeasure]:
    """Measure all ordered pairs of a graph.

    Args:
        sample: The graph.
    """
    views = [_View.of(sample, view) for view in range(sample.num_views)]
    return [
        _measure_pair(views[i], views[j], float(sample.pairs.covisible[i, j]))
        for i in range(len(views))
        for j in range(len(views))
        if i != j and len(views[i].z)
    ]


@dataclass(frozen=True, kw_only=True)
class _View:
    """One image, ready to be compared."""

    K: Float[Tensor, "3 3"]
    cam_from_world: Float[Tensor, "4 4"]
    depth: Float[Tensor, "h w"]
    gray: Float[Tensor, "h w"]
    pts2d: Float[Tensor, "p 2"]
    """Centres of known pixels on a grid."""
    z: Float[Tensor, " p"]
    """Their depth."""

    @classmethod
    def of(cls, sample: GraphSample, view: int) -> "_View":
        depth = torch.from_numpy(sample.depth[view]).double()
        pts2d, z = _grid(depth)
        return cls(
            K=torch.from_numpy(sample.K[view]),
            cam_from_world=torch.from_numpy(sample.cam_from_world[view]),
            depth=depth,
            gray=torch.from_numpy(sample.image[view]).double().mean(-1),
            pts2d=pts2d,
            z=z,
        )


def _grid(depth: Float[Tensor, "h w"]) -> tuple[Float[Tensor, "p 2"], Float[Tensor, " p"]]:
    """Give centres and depth of known pixels on a grid of at most 80 columns."""
    step = max(1, round(depth.shape[1] / _MAX_COLUMNS))
    rows, columns = torch.meshgrid(
        torch.arange(step // 2, depth.shape[0], step),
        torch.arange(step // 2, depth.shape[1], step),
        indexing="ij",
    )
    z = depth[rows, columns].flatten()
    pts2d = torch.stack([columns, rows], dim=-1).reshape(-1, 2).to(depth.dtype) + 0.5
    return pts2d[z > 0], z[z > 0]


def lift(
    pts2d: Float[Tensor, "p 2"], z: Float[Tensor, " p"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "p 3"]:
    """Lift pixels of known depth into the camera's frame."""
    rays = torch.cat([pts2d, torch.ones_like(pts2d[:, :1])], dim=-1) @ torch.linalg.inv(K).T
    return torch.mul(rays, z[:, None])


def _measure_pair(i: _View, j: _View, stored_covisible: float) -> PairMeasure:
    j_from_i = j.cam_from_world @ invert_rigid(i.cam_from_world)
    there, z = project(transform_points(j_from_i, lift(i.pts2d, i.z, i.K)), j.K)
    found, known = interpolate_depth(j.depth, there)
    difference = (found - z).abs() / z
    agree = known & (z > 0) & (difference < AGREE)
    pixels = relative = color = float("nan")
    if agree.any():
        there, start = there[agree], i.pts2d[agree]
        seen = lift(there, found[agree], j.K)
        back, _ = project(transform_points(invert_rigid(j_from_i), seen), i.K)
        pixels = float((back - start).norm(dim=-1).median())
        relative = float(difference[agree].median())
        color = _correlate(_pick(i.gray, start), _pick(j.gray, there))
    return PairMeasure(
        stored_covisible=stored_covisible,
        share=float(agree.double().mean()),
        pixels=pixels,
        depth=relative,
        color=color,
    )


def _pick(gray: Float[Tensor, "h w"], pts2d: Float[Tensor, "p 2"]) -> Float[Tensor, " p"]:
    column, row = pts2d.long().unbind(-1)
    return gray[row, column]


def _correlate(a: Float[Tensor, " p"], b: Float[Tensor, " p"]) -> float:
    """Pearson's correlation: an exposure of its own for each image changes nothing."""
    a, b = a - a.mean(), b - b.mean()
    size = float(a.norm() * b.norm())
    return float(a @ b) / size if size > 0 else float("nan")


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


def median(values: list[float]) -> float:
    """Median of what is not NaN; NaN where nothing is."""
    finite = [value for value in values if not np.isnan(value)]
    return float(np.median(finite)) if finite else float("nan")
