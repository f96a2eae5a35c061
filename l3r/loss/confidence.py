"""The confidence-weighted point error."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def point_error(
    pts3d: Float[Tensor, "*b p 3"], target: Float[Tensor, "*b p 3"], valid: Bool[Tensor, "*b p"]
) -> Float[Tensor, "*b p"]:
    """Euclidean distance at valid pixels; 0 without a gradient elsewhere, NaN or not."""
    difference = torch.where(valid[..., None], pts3d - target, torch.zeros_like(pts3d))
    error: Tensor = torch.linalg.vector_norm(difference, dim=-1)
    return error


def confidence_loss(
    error: Float[Tensor, "*b p"],
    log_conf: Float[Tensor, "*b p"],
    valid: Bool[Tensor, "*b p"],
    alpha: float,
) -> Float[Tensor, "*b p"]:
    """``C error - alpha log C`` per pixel; 0 at pixels that are not valid.

    The paper prints ``- alpha C``, which has no lower bound wherever the error is below alpha;
    with the logarithm the best confidence is ``alpha / error``.
    """
    loss = log_conf.exp() * error - alpha * log_conf
    return torch.where(valid, loss, torch.zeros_like(loss))
