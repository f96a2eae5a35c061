"""The same points of a scene in two images, found by depth, intrinsics and cameras alone.

Whoever sees a number on the same corner in both images knows that the cameras and the depth are
right; a shift, a mirror image or a wrong scale is seen at once.
"""

import colorsys
import math
from collections import Counter
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from data_prep.roundtrip import lift
from data_prep.surfaces import AGREE, surface_of
from l3r.data.schema import GraphSample
from l3r.geometry.camera import project
from l3r.geometry.rigid import invert_rigid, transform_points

_COLUMNS, _ROWS = 6, 4
"""Points of an image: at most one in each cell of such a grid."""
_APART = (0.07, 0.09)
"""Smallest cell: shares of the image's width and height."""
_MAX_CANDIDATES = 10_000

Status = Literal["seen", "hidden", "contradicted", "unknown", "outside"]
"""What j says of a point of i.

``seen``: j's depth agrees within 5%. ``hidden``: j sees something nearer there. ``contradicted``:
j sees something farther, though the point should stand before it. ``unknown``: j's depth is not
known there, or its neighbours disagree. ``outside``: not in j's image, or behind its camera.
"""


@dataclass(frozen=True, kw_only=True)
class Correspondence:
    """One point of i and where it lies in j."""

    number: int
    start: tuple[float, float]
    """In pixels of i; centre of the top-left pixel at (0.5, 0.5)."""
    end: tuple[float, float] | None
    """In pixels of j; None where it is outside."""
    status: Status
    color: str
    """As CSS writes it; its own, the same in both images."""


def find_correspondences(sample: GraphSample, i: int, j: int) -> list[Correspondence]:
    """Carry points of image i into image j: a grid over the part of i that lies in j's image.

    Args:
        sample: The graph.
        i: Image whose points are taken where its depth is known.
        j: Image they are carried into.

    Returns:
        A grid over the whole of i where no point of it lies in j's image.
    """
    candidates = _known_pixels(sample.depth[i])
    there = _carry(sample, i, j, candidates)
    inside = there.inside.numpy()
    usable = inside if inside.any() else ~inside
    picked = _pick_grid(candidates, usable, sample.image_size[i])
    points = []
    for number, index in enumerate(picked, start=1):
        x, y = (float(v) + 0.5 for v in candidates[index])
        end_x, end_y = there.pts2d[index].tolist()
        points.append(
            Correspondence(
                number=number,
                start=(x, y),
                end=(end_x, end_y) if inside[index] else None,
                status=there.judge(index),
                color=_color(x / sample.image_size[i][1], y / sample.image_size[i][0]),
            )
        )
    return points


def count_status(points: list[Correspondence]) -> str:
    """One line: ``24 points: 11 seen, 5 hidden, 8 outside``."""
    counts = Counter(point.status for point in points)
    order = get_args(Status)
    told = ", ".join(f"{counts[status]} {status}" for status in order if counts[status])
    return f"{len(points)} points: {told or 'no depth is known'}"


@dataclass(frozen=True, kw_only=True)
class _Landing:
    """Where points of i land in j, and what j knows there."""

    pts2d: Float[Tensor, "p 2"]
    z: Float[Tensor, " p"]
    inside: Bool[Tensor, " p"]
    found: Float[Tensor, " p"]
    known: Bool[Tensor, " p"]

    def judge(self, point: int) -> Status:
        """Say what j says of one point."""
        if not self.inside[point]:
            return "outside"
        if not self.known[point]:
            return "unknown"
        off = float((self.found[point] - self.z[point]) / self.z[point])
        if abs(off) < AGREE:
            return "seen"
        return "hidden" if off < 0 else "contradicted"


def _carry(sample: GraphSample, i: int, j: int, pixels: Int64[np.ndarray, "p 2"]) -> _Landing:
    z = torch.from_numpy(sample.depth[i][pixels[:, 1], pixels[:, 0]]).double()
    seen = lift(torch.from_numpy(pixels + 0.5), z, torch.from_numpy(sample.K[i]))
    i_from_world, j_from_world = (torch.from_numpy(sample.cam_from_world[v]) for v in (i, j))
    j_from_i = j_from_world @ invert_rigid(i_from_world)
    pts2d, z_there = project(transform_points(j_from_i, seen), torch.from_numpy(sample.K[j]))
    height, width = sample.image_size[j]
    inside = (pts2d >= 0).all(-1) & (pts2d < pts2d.new_tensor([width, height])).all(-1)
    found, known = surface_of(torch.from_numpy(sample.depth[j]).double()).interpolate(pts2d)
    return _Landing(pts2d=pts2d, z=z_there, inside=inside & (z_there > 0), found=found, known=known)


def _known_pixels(depth: Float32[np.ndarray, "h w"]) -> Int64[np.ndarray, "p 2"]:
    """Give (column, row) of known pixels, at most some ten thousand spread over the image."""
    rows, columns = np.nonzero(depth)
    step = max(1, math.isqrt(depth.size // _MAX_CANDIDATES))
    if len(rows) > _MAX_CANDIDATES:
        kept = (rows % step == step // 2) & (columns % step == step // 2)
        rows, columns = rows[kept], columns[kept]
    return np.stack([columns, rows], axis=-1).astype(np.int64)


def _pick_grid(
    pixels: Int64[np.ndarray, "p 2"], usable: Bool[np.ndarray, " p"], image_size: tuple[int, int]
) -> list[int]:
    """Pick, in each cell of a grid over the usable pixels, the one nearest the cell's middle."""
    numbers = np.nonzero(usable)[0]
    if not len(numbers):
        return []
    low, high = pixels[numbers].min(0), pixels[numbers].max(0) + 1
    # A small part of an image gets fewer cells, so that their numbers do not cover each other.
    room = (high - low) / (image_size[1] * _APART[0], image_size[0] * _APART[1])
    cells = np.clip(room.astype(int), 1, (_COLUMNS, _ROWS))
    place = (pixels[numbers] - low) / (high - low) * cells
    cell = place.astype(int)
    off = np.hypot(*(place - cell - 0.5).T)
    picked: dict[tuple[int, int], int] = {}
    for k in np.argsort(off, kind="stable"):
        picked.setdefault((int(cell[k, 1]), int(cell[k, 0])), int(numbers[k]))
    return [picked[where] for where in sorted(picked)]


def _color(x: float, y: float) -> str:
    """A colour that changes across the image, lighter towards its foot."""
    r, g, b = colorsys.hls_to_rgb(0.85 * x, 0.42 + 0.2 * y, 0.95)
    return f"#{round(255 * r):02x}{round(255 * g):02x}{round(255 * b):02x}"
