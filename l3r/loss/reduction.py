"""From a loss per pixel to one number."""

from typing import Literal

from jaxtyping import Bool, Float
from torch import Tensor

Reduction = Literal["per_graph", "pooled"]


def mean_over_pixels(
    values: Float[Tensor, "b m"], valid: Bool[Tensor, "b m"], reduction: Reduction
) -> Float[Tensor, ""]:
    """Average a per-pixel loss that is 0 where not valid.

    Args:
        values: Loss of each pixel of each graph.
        valid: Pixels that count.
        reduction: ``per_graph``: a mean over each graph's pixels, then over graphs, so that sparse
            ground truth is not drowned and the number of devices does not matter. ``pooled``: one
            mean over all pixels. Without valid pixels the mean is 0.
    """
    if reduction == "pooled":
        return values.sum() / valid.sum().clamp_min(1)
    return mean_of_each_graph(values, valid).mean()


def mean_of_each_graph(
    values: Float[Tensor, "b m"], valid: Bool[Tensor, "b m"]
) -> Float[Tensor, " b"]:
    """Average a per-pixel loss, 0 where not valid, over each graph's valid pixels."""
    return values.sum(-1) / valid.sum(-1).clamp_min(1)
