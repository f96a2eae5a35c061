"""The confident points of a reconstruction, sampled evenly over its images."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from l3r.config import InferenceConfig
from l3r.geometry.camera import window_centers
from l3r.types import Reconstruction

_DEFAULT = InferenceConfig()


@dataclass(kw_only=True, slots=True)
class PointSelection:
    """Which points leave the program."""

    min_conf: float = _DEFAULT.min_conf
    """Points of a confidence above this, in images that PnP took by ``threshold``."""
    fallback_share: float = _DEFAULT.fallback_share
    """Share of most confident points, in images that PnP took by ``quantile``."""
    max_points: int = 100_000
    """Points in all, spread evenly over the images."""


@dataclass(frozen=True, kw_only=True)
class PointSample:
    """Points of all images, one image after the other."""

    view: Int[Tensor, " p"]
    """Index of the image that saw each point."""
    pts3d_world: Float[Tensor, "p 3"]
    """Positions in the world."""
    pts2d: Float[Tensor, "p 2"]
    """Where the image saw it: pixel centre (x, y) in the photo at its own size, float64."""
    color: UInt8[Tensor, "p 3"]
    """RGB."""
    conf: Float[Tensor, " p"]
    """Confidence."""


def sample_points(scene: Reconstruction, selection: PointSelection) -> PointSample:
    """Choose the points that passed the rule PnP used for their image.

    Images that are not registered give none, and neither does a point behind its own camera. Images
    with fewer points than an even share leave the rest of it to the others. The same reconstruction
    gives the same sample.
    """
    views = [view for view in range(len(scene.conf)) if scene.cameras.registered[view]]
    usable = [_usable_pixels(scene, view, selection) for view in views]
    quotas = even_shares([len(pixels) for pixels in usable], selection.max_points)
    parts = [
        _take(scene, view, _thin(pixels, quota, view))
        for view, pixels, quota in zip(views, usable, quotas, strict=True)
    ]
    return _join(parts)


def even_shares(available: list[int], total: int) -> list[int]:
    """Split a total evenly; who has less than an even share leaves the rest to the others."""
    shares = [0] * len(available)
    remaining = total
    by_size = sorted(range(len(available)), key=lambda index: available[index])
    for position, index in enumerate(by_size):
        shares[index] = min(available[index], remaining // (len(by_size) - position))
        remaining -= shares[index]
    return shares


def confident_pixels(
    conf: Float[Tensor, "h w"], rule: str, selection: PointSelection
) -> Bool[Tensor, "h w"]:
    """Mark the pixels of an image that pass its point rule.

    Args:
        conf: Confidence, 1 or more.
        rule: ``threshold``, ``quantile`` or ``none``, as the reconstruction states it.
        selection: The numbers of the rule.
    """
    if rule == "threshold":
        return conf > selection.min_conf
    passes = torch.zeros(conf.numel(), dtype=torch.bool, device=conf.device)
    if rule == "quantile":
        count = round(selection.fallback_share * conf.numel())
        passes[conf.flatten().topk(count).indices] = True
    return passes.reshape(conf.shape)


def _usable_pixels(
    scene: Reconstruction, view: int, selection: PointSelection
) -> Int[Tensor, " p"]:
    passes = confident_pixels(scene.conf[view], scene.point_rule[view], selection)
    pixels = passes.flatten().nonzero()[:, 0]
    points = scene.pts3d_world[view].reshape(-1, 3)[pixels]
    forward = scene.cameras.cam_from_world[view, 2].to(points)
    depth = points @ forward[:3] + forward[3]
    # A comparison with NaN is false, infinity is asked for by name.
    return pixels[(depth > 0) & points.isfinite().all(1)]


def _thin(pixels: Int[Tensor, " p"], quota: int, view: int) -> Int[Tensor, " q"]:
    """Keep a random ``quota`` in the order of the pixels."""
    generator = torch.Generator().manual_seed(view)
    return pixels[torch.randperm(len(pixels), generator=generator)[:quota].sort().values]


def _take(scene: Reconstruction, view: int, pixels: Int[Tensor, " p"]) -> PointSample:
    conf = scene.conf[view]
    height, width = conf.shape
    pts2d = window_centers(height, width, scene.window[view], torch.zeros(0, dtype=torch.float64))
    rgb = scene.image[view].flatten(1).T[pixels]
    return PointSample(
        view=torch.full_like(pixels, view),
        pts3d_world=scene.pts3d_world[view].reshape(-1, 3)[pixels],
        pts2d=pts2d[pixels],
        color=(rgb * 255).round().clamp(0, 255).to(torch.uint8),
        conf=conf.flatten()[pixels],
    )


def _join(parts: list[PointSample]) -> PointSample:
    if not parts:
        return PointSample(
            view=torch.zeros(0, dtype=torch.int64),
            pts3d_world=torch.zeros(0, 3),
            pts2d=torch.zeros(0, 2, dtype=torch.float64),
            color=torch.zeros(0, 3, dtype=torch.uint8),
            conf=torch.zeros(0),
        )
    return PointSample(
        view=torch.cat([part.view for part in parts]),
        pts3d_world=torch.cat([part.pts3d_world for part in parts]),
        pts2d=torch.cat([part.pts2d for part in parts]),
        color=torch.cat([part.color for part in parts]),
        conf=torch.cat([part.conf for part in parts]),
    )
