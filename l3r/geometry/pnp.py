"""A camera from points in the world and their pixels: RANSAC-PnP through OpenCV (SQPNP)."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from l3r.geometry.rigid import rigid_from_parts


@dataclass(frozen=True)
class PnPFit:
    """A camera and how well it is supported."""

    cam_from_world: Float[Tensor, "4 4"]
    """Rigid transform, float64."""
    inlier_share: float
    """Share of the points within the threshold."""


def fit_camera(
    pts3d_world: Float[Tensor, "p 3"],
    pts2d: Float[Tensor, "p 2"],
    K: Float[Tensor, "3 3"],
    *,
    max_error_px: float,
    num_iterations: int = 200,
    seed: int = 0,
) -> PnPFit | None:
    """Fit ``cam_from_world`` by RANSAC with SQPNP, then refine on the inliers.

    Args:
        pts3d_world: Points; the world frame's unit and origin are free.
        pts2d: Their pixels, in the same convention as ``K``.
        K: Intrinsics.
        max_error_px: Reprojection error up to which a point supports a camera.
        num_iterations: RANSAC's rounds at most.
        seed: Seed of RANSAC; the same input and seed give the same camera.

    Returns:
        The fit, or None where fewer than 4 points agree on any camera.
    """
    if len(pts3d_world) < 4:
        return None
    world = pts3d_world.detach().cpu().double().numpy()
    image = pts2d.detach().cpu().double().numpy()
    intrinsics = K.detach().cpu().double().numpy()
    # OpenCV's solvers hold absolute tolerances; centred points of unit spread keep clear of them.
    center, spread = world.mean(0), max(float(world.std()), 1e-12)
    scaled = (world - center) / spread
    cv2.setRNGSeed(seed)
    try:
        found, turn, shift, inliers = cv2.solvePnPRansac(
            scaled,
            image,
            intrinsics,
            None,
            iterationsCount=num_iterations,
            reprojectionError=max_error_px,
            confidence=0.9999,
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:  # raised on point sets that admit no solution, such as coincident points
        return None
    if not found or inliers is None or len(inliers) < 4:
        return None
    chosen = inliers[:, 0]
    turn, shift = cv2.solvePnPRefineLM(scaled[chosen], image[chosen], intrinsics, None, turn, shift)
    R = cv2.Rodrigues(turn)[0]
    t = shift[:, 0] * spread - R @ center
    if not (np.isfinite(R).all() and np.isfinite(t).all()):
        return None
    cam_from_world = rigid_from_parts(torch.from_numpy(R), torch.from_numpy(t))
    return PnPFit(cam_from_world, len(chosen) / len(world))
