"""How well depth, intrinsics and cameras of two images agree: there and back again.

Pixel centres of image i go to j by depth, K and cameras, and back by the depth of j, interpolated
as :mod:`data_prep.surfaces` says. The median difference with its sign is kept beside the median
difference: noise and rounded places cancel in it, so that half a pixel shows in lidar's and
stereo's depth as well.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from data_prep.surfaces import AGREE, Surface, is_scattered, surface_of
from l3r.data.schema import GraphSample
from l3r.geometry.camera import project
from l3r.geometry.rigid import invert_rigid, transform_points

_MAX_COLUMNS = 80
_MAX_SCATTERED = 1200


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
    bias: float
    """The same with its sign: how much farther j's surface is; NaN where nothing is seen."""
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


def measure_pair(sample: GraphSample, i: int, j: int) -> PairMeasure:
    """Measure one ordered pair of a graph; all NaN where nothing of i's depth is known.

    Args:
        sample: The graph.
        i: Image whose pixels go.
        j: Image they go to.
    """
    stored = float(sample.pairs.covisible[i, j])
    return _measure_pair(_View.of(sample, i), _View.of(sample, j), stored)


@dataclass(frozen=True, kw_only=True)
class _View:
    """One image, ready to be compared."""

    K: Float[Tensor, "3 3"]
    cam_from_world: Float[Tensor, "4 4"]
    surface: Surface
    gray: Float[Tensor, "h w"]
    pts2d: Float[Tensor, "p 2"]
    """Centres of known pixels."""
    z: Float[Tensor, " p"]
    """Their depth."""

    @classmethod
    def of(cls, sample: GraphSample, view: int) -> "_View":
        depth = torch.from_numpy(sample.depth[view]).double()
        pts2d, z = _scattered(depth) if is_scattered(depth) else _grid(depth)
        return cls(
            K=torch.from_numpy(sample.K[view]),
            cam_from_world=torch.from_numpy(sample.cam_from_world[view]),
            surface=surface_of(depth),
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


def _scattered(depth: Float[Tensor, "h w"]) -> tuple[Float[Tensor, "p 2"], Float[Tensor, " p"]]:
    """Give centres and depth of at most 1,200 known pixels, spread evenly."""
    where = (depth > 0).nonzero()
    where = where[:: max(1, -(-len(where) // _MAX_SCATTERED))]
    return where.flip(-1).to(depth.dtype) + 0.5, depth[where[:, 0], where[:, 1]]


def lift(
    pts2d: Float[Tensor, "p 2"], z: Float[Tensor, " p"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "p 3"]:
    """Lift pixels of known depth into the camera's frame."""
    rays = torch.cat([pts2d, torch.ones_like(pts2d[:, :1])], dim=-1) @ torch.linalg.inv(K).T
    return torch.mul(rays, z[:, None])


def _measure_pair(i: _View, j: _View, stored_covisible: float) -> PairMeasure:
    j_from_i = j.cam_from_world @ invert_rigid(i.cam_from_world)
    there, z = project(transform_points(j_from_i, lift(i.pts2d, i.z, i.K)), j.K)
    found, known = j.surface.interpolate(there)
    difference = (found - z).abs() / z
    agree = known & (z > 0) & (difference < AGREE)
    pixels = relative = bias = color = float("nan")
    if agree.any():
        there, start = there[agree], i.pts2d[agree]
        seen = lift(there, found[agree], j.K)
        back, _ = project(transform_points(invert_rigid(j_from_i), seen), i.K)
        pixels = float((back - start).norm(dim=-1).median())
        relative = float(difference[agree].median())
        bias = float(((found - z) / z)[agree].median())
        color = _correlate(_pick(i.gray, start), _pick(j.gray, there))
    return PairMeasure(
        stored_covisible=stored_covisible,
        share=float(agree.double().mean()),
        pixels=pixels,
        depth=relative,
        bias=bias,
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


def median(values: list[float]) -> float:
    """Median of what is not NaN; NaN where nothing is."""
    finite = [value for value in values if not np.isnan(value)]
    return float(np.median(finite)) if finite else float("nan")
