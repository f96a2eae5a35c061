"""Cameras from point maps: focal length by Weiszfeld, then RANSAC-PnP."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from l3r.config import InferenceConfig
from l3r.geometry.camera import window_centers
from l3r.geometry.focal import fit_focal
from l3r.geometry.pnp import fit_camera
from l3r.types import PairPointmaps, Photos, SceneTree, WorldPointmaps


@dataclass(frozen=True, kw_only=True)
class SelfViews:
    """Each image's points in its own camera's frame, pixels padded."""

    pts3d_cam: Float[Tensor, "n p 3"]
    log_conf: Float[Tensor, "n p"]


@dataclass(frozen=True, kw_only=True)
class CameraFits:
    """What PnP found for each image."""

    cam_from_world: Float[Tensor, "n 4 4"]
    """Float64; NaN where not registered."""
    registered: Bool[Tensor, " n"]
    point_rule: list[str]
    """``threshold``, ``quantile`` or ``none``."""


def collect_self_views(pairs: PairPointmaps, reverse: PairPointmaps, tree: SceneTree) -> SelfViews:
    """Average the maps that each image has in its own frame, weighted by log confidence.

    A parent has one from each of its edges. A leaf has none: it takes its own view of its edge
    decoded in reverse.

    Args:
        pairs: Edges of one tree (a batch of one), symmetrised or not.
        reverse: The same edges decoded in reverse; only those of leaves are read.
        tree: The tree.
    """
    device = pairs.parent_pts3d.device
    parent, child = tree.parent[0].to(device), tree.child[0].to(device)
    num_views = len(parent) + 1
    is_parent = torch.zeros(num_views, dtype=torch.bool, device=device).index_fill(0, parent, True)
    leaf = (~is_parent[child]).nonzero()[:, 0]
    view = torch.cat([parent, child[leaf]])
    pts3d = torch.cat([pairs.parent_pts3d[0], reverse.parent_pts3d[0, leaf]])
    log_conf = torch.cat([pairs.parent_log_conf[0], reverse.parent_log_conf[0, leaf]])
    shape = (num_views, log_conf.shape[1])
    total = log_conf.new_zeros(shape).index_add(0, view, log_conf)
    points = pts3d.new_zeros(*shape, 3).index_add(0, view, pts3d * log_conf[..., None])
    return SelfViews(pts3d_cam=points / total.clamp_min(1e-12)[..., None], log_conf=total)


def fit_intrinsics(views: SelfViews, photos: Photos) -> Float[Tensor, "n 3 3"]:
    """Fit one focal length per photo, in its original pixels; the principal point is its centre.

    Sides scale by slightly different factors to whole patches, and a crop may be off the centre by
    a fraction of a pixel; original pixels undo both.

    Returns:
        K of each photo at its original size, float64; NaN focal where nothing could be fitted.
    """
    pixels = padded_pixels(photos, views.log_conf)
    size = torch.tensor(photos.original_size, dtype=torch.float64)
    center = size.flip(-1) / 2
    centered = pixels - center.to(pixels)[:, None]
    focal = fit_focal(views.pts3d_cam, centered, views.log_conf).double().cpu()
    K = torch.zeros(len(size), 3, 3, dtype=torch.float64)
    K[:, 0, 0] = K[:, 1, 1] = torch.where(focal > 0, focal, torch.nan)
    K[:, :2, 2] = center
    K[:, 2, 2] = 1
    return K


def fit_cameras(
    world: WorldPointmaps,
    K: Float[Tensor, "n 3 3"],
    photos: Photos,
    config: InferenceConfig,
) -> CameraFits:
    """Register every image against its points in the world (a batch of one).

    An image is not registered where too few points pass, its focal length could not be fitted, or
    no camera agrees with four points.
    """
    pts3d, log_conf = world.pts3d_world[0].cpu(), world.log_conf[0].cpu()
    pixels = padded_pixels(photos, log_conf)
    cam_from_world = torch.full((len(K), 4, 4), torch.nan, dtype=torch.float64)
    rules = []
    for view, (height, width) in enumerate(photos.network_size):
        chosen, rule = choose_points(log_conf[view, : height * width], config, view)
        rules.append(rule)
        if rule == "none" or not K[view].isfinite().all():
            continue
        fit = fit_camera(
            pts3d[view, chosen],
            pixels[view, chosen],
            K[view],
            max_error_px=_max_error_px(photos, view, config),
            num_iterations=config.pnp_iterations,
            seed=config.seed,
        )
        if fit is not None:
            cam_from_world[view] = fit.cam_from_world
    registered = cam_from_world.isfinite().flatten(1).all(-1)
    return CameraFits(cam_from_world=cam_from_world, registered=registered, point_rule=rules)


def _max_error_px(photos: Photos, view: int, config: InferenceConfig) -> float:
    """RANSAC's threshold in original pixels; the network's points are no finer than its pixels."""
    window = photos.window[view]
    network_pixel = max(window.width, window.height) / max(photos.network_size[view])
    return max(config.pnp_error * max(photos.original_size[view]), network_pixel)


def choose_points(
    log_conf: Float[Tensor, " p"], config: InferenceConfig, view: int
) -> tuple[Tensor, str]:
    """Choose the points of one image for PnP.

    Those of a confidence above ``min_conf``; where fewer than ``min_points`` are, the most
    confident ``fallback_share``; of either, a random sample of ``pnp_points``.

    Returns:
        ``(indices, rule)`` with rule ``threshold``, ``quantile`` or ``none``.
    """
    confident = log_conf > torch.tensor(config.min_conf, dtype=log_conf.dtype).log()
    chosen, rule = confident.nonzero()[:, 0], "threshold"
    if len(chosen) < config.min_points:
        count = max(config.min_points, round(config.fallback_share * len(log_conf)))
        if config.fallback_share == 0 or count > len(log_conf):
            return chosen[:0], "none"
        chosen, rule = log_conf.topk(count).indices, "quantile"
    generator = torch.Generator().manual_seed(config.seed * 1_000_003 + view)
    order = torch.randperm(len(chosen), generator=generator)[: config.pnp_points]
    return chosen[order], rule


def padded_pixels(photos: Photos, like: Float[Tensor, "n p"]) -> Float[Tensor, "n p 2"]:
    """Pixel centres of each network image, in original pixels; zero where padded."""
    pixels = like.new_zeros(*like.shape, 2)
    for view, (height, width) in enumerate(photos.network_size):
        centers = window_centers(height, width, photos.window[view], like)
        pixels[view, : height * width] = centers
    return pixels
