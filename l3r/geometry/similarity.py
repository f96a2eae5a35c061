"""Similarity transforms and their weighted closed-form fit (Procrustes, Umeyama 1991)."""

from dataclasses import dataclass

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from l3r.geometry.rigid import rigid_from_parts


@dataclass(frozen=True)
class Similarity:
    """``x_b = scale R x_a + t``: a ``b_from_a`` with a scale."""

    scale: Float[Tensor, "*b"]
    R: Float[Tensor, "*b 3 3"]
    t: Float[Tensor, "*b 3"]

    def transform(self, pts3d: Float[Tensor, "*b p 3"]) -> Float[Tensor, "*b p 3"]:
        """Move points from frame a to frame b."""
        turned = pts3d @ self.R.transpose(-1, -2)
        return self.scale[..., None, None] * turned + self.t[..., None, :]

    def compose(self, b_from_c: "Similarity") -> "Similarity":
        """``a_from_b.compose(b_from_c)`` is ``a_from_c``."""
        moved = (self.R @ b_from_c.t[..., None])[..., 0]
        return Similarity(
            self.scale * b_from_c.scale,
            self.R @ b_from_c.R,
            self.scale[..., None] * moved + self.t,
        )

    def invert(self) -> "Similarity":
        """``a_from_b``."""
        R = self.R.transpose(-1, -2)
        t = -(R @ self.t[..., None])[..., 0] / self.scale[..., None]
        return Similarity(1 / self.scale, R, t)

    def rigid(self) -> Float[Tensor, "*b 4 4"]:
        """Rotation and translation alone, as a 4x4 matrix."""
        return rigid_from_parts(self.R, self.t)


def identity_similarity(*batch: int, like: Tensor) -> Similarity:
    """Identities of the given batch shape, in the dtype and on the device of ``like``."""
    R = torch.eye(3, dtype=like.dtype, device=like.device).expand(*batch, 3, 3)
    return Similarity(like.new_ones(batch), R, like.new_zeros(*batch, 3))


def fit_similarity(
    pts3d_b: Float[Tensor, "*b p 3"],
    pts3d_a: Float[Tensor, "*b p 3"],
    weights: Float[Tensor, "*b p"],
    *,
    with_scale: bool = False,
) -> Similarity:
    """Fit ``b_from_a`` minimising ``sum_p w_p |x_b - (s R x_a + t)|^2``.

    Differentiable in points and weights; one batched closed form (Horn's, through roma), no SVD
    and no wait for the device. Points of weight 0 have no influence
    and a zero gradient even where they are NaN. A batch item without any weight, or whose points
    coincide, gets a finite answer and a finite gradient: R is then a rotation that nothing
    determines.

    Args:
        pts3d_b: Points in frame b.
        pts3d_a: The same points in frame a.
        weights: Non-negative.
        with_scale: Fit s too; else s = 1, a rigid transform.
    """
    used = weights > 0
    weights = torch.where(used, weights, torch.zeros_like(weights))
    # Normalised to sum 1, so that the answer does not depend on the weights' unit.
    total = weights.sum(-1, keepdim=True)
    weights = weights / torch.where(total > 0, total, torch.ones_like(total))
    b, center_b = _centered(pts3d_b, used, weights)
    a, center_a = _centered(pts3d_a, used, weights)
    # roma's gradient guard is absolute and its scale divides by the spread, so both sets go in
    # with a spread of one. The factors are constants: their gradient cancels exactly.
    # Coincident points are divided by infinity: rounding noise must not choose a rotation.
    spread_b, spread_a = _spread(b, center_b, weights), _spread(a, center_a, weights)
    b, a = b / spread_b[..., None, None], a / spread_a[..., None, None]
    covariance = (b * weights[..., None]).transpose(-1, -2) @ a
    # roma keeps constants from its first call: made in inference mode, they would fail in training.
    with torch.inference_mode(mode=False):
        R = roma.special_procrustes(covariance)
    scale = torch.ones_like(spread_b)
    if with_scale:
        # Umeyama's trace(D S) / variance, the trace being that of R^T times the covariance.
        variance = (weights * a.square().sum(-1)).sum(-1)
        fitted = (R * covariance).sum((-2, -1)) / variance.clamp_min(1e-12)
        spread = torch.isfinite(spread_b) & torch.isfinite(spread_a)
        ratio = torch.where(spread, spread_b, scale) / torch.where(spread, spread_a, scale)
        scale = torch.where(spread, fitted * ratio, scale)
    t = center_b - scale[..., None] * (R @ center_a[..., None])[..., 0]
    return Similarity(scale, R, t)


def fit_residual(
    b_from_a: Similarity,
    pts3d_b: Float[Tensor, "*b p 3"],
    pts3d_a: Float[Tensor, "*b p 3"],
    weights: Float[Tensor, "*b p"],
) -> Float[Tensor, "*b"]:
    """Weighted root mean square distance that a fit leaves; 0 without any weight."""
    error = (pts3d_b - b_from_a.transform(pts3d_a)).square().sum(-1)
    error = torch.where(weights > 0, error * weights, torch.zeros_like(error)).sum(-1)
    total = weights.sum(-1)
    return torch.where(total > 0, error / total.clamp_min(1e-30), torch.zeros_like(error)).sqrt()


def _centered(
    pts3d: Float[Tensor, "*b p 3"], used: Tensor, weights: Float[Tensor, "*b p"]
) -> tuple[Tensor, Tensor]:
    # where, not a product: 0 * NaN is NaN.
    pts3d = torch.where(used[..., None], pts3d, torch.zeros_like(pts3d))
    center = (weights[..., None] * pts3d).sum(-2)
    return pts3d - center[..., None, :], center


def _spread(centered: Float[Tensor, "*b p 3"], center: Tensor, weights: Tensor) -> Tensor:
    """Root mean square distance from the centre, a constant; infinite where the points coincide."""
    variance = (weights * centered.detach().square().sum(-1)).sum(-1).detach()
    rounding = (8 * torch.finfo(center.dtype).eps) ** 2 * center.detach().square().sum(-1)
    return torch.where(variance > rounding, variance.sqrt(), torch.full_like(variance, torch.inf))
