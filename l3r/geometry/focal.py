"""Focal length of a camera from the point map it sees (Weiszfeld's algorithm)."""

import torch
from jaxtyping import Float
from torch import Tensor

NEAR_SHARE = 0.1
"""Points nearer than this share of the median depth are dropped: x / z explodes there."""
FOCAL_SHARE = 0.25
"""Points whose own focal length is less than this share of the median are dropped: the sum weighs
them by their slope, which has no bound, where those of the others are bound by the image."""


def fit_focal(
    pts3d_cam: Float[Tensor, "*b p 3"],
    pts2d_centered: Float[Tensor, "*b p 2"],
    weights: Float[Tensor, "*b p"],
    *,
    num_iterations: int = 30,
) -> Float[Tensor, "*b"]:
    """Fit one focal length [px] per item: ``argmin_f sum_p w_p |u_p - f (x_p, y_p) / z_p|``.

    Weiszfeld: the least-squares solution is reweighted by the inverse residual, from the median
    of the single points' ratios; points far too steep for it are dropped, which would drag the sum
    away from there, slowly, however many others agree.

    Args:
        pts3d_cam: Points in the frame of the camera that sees them.
        pts2d_centered: Their pixels, measured from the principal point.
        weights: Non-negative; points behind or close to the camera are dropped besides.
        num_iterations: Rounds; each halves the distance to the answer or better.

    Returns:
        Focal lengths; NaN where no point can be used.
    """
    depth = pts3d_cam[..., 2]
    ahead = (weights > 0) & (depth > 0)
    median_depth = _masked_median(depth, ahead)
    used = ahead & (depth > NEAR_SHARE * median_depth[..., None])
    slope = pts3d_cam[..., :2] / torch.where(used, depth, torch.ones_like(depth))[..., None]
    slope = torch.where(used[..., None], slope, torch.zeros_like(slope))
    weights = torch.where(used, weights, torch.zeros_like(weights))
    dot, square = (slope * pts2d_centered).sum(-1), slope.square().sum(-1)
    # A point on the optical axis says nothing of the focal length: its ratio is noise over noise.
    off_axis = used & (square > 1e-6)
    ratio = dot / torch.where(off_axis, square, torch.ones_like(square))
    focal = _masked_median(ratio, off_axis)
    least = FOCAL_SHARE * focal.abs()[..., None] * torch.linalg.vector_norm(slope, dim=-1)
    is_steep = least > torch.linalg.vector_norm(pts2d_centered, dim=-1)
    weights = torch.where(is_steep, torch.zeros_like(weights), weights)
    for _ in range(num_iterations):
        residual = torch.linalg.vector_norm(pts2d_centered - focal[..., None, None] * slope, dim=-1)
        inverse = weights / residual.clamp_min(
            1e-8 * pts2d_centered.abs().amax((-2, -1))[..., None]
        )
        focal = (inverse * dot).sum(-1) / (inverse * square).sum(-1)
    return focal


def _masked_median(values: Float[Tensor, "*b p"], mask: Tensor) -> Float[Tensor, "*b"]:
    """Median of the chosen values (the lower of two middle ones); NaN where none is."""
    return torch.where(mask, values, torch.full_like(values, torch.nan)).nanmedian(-1).values
