"""The training loss and its switches."""

from dataclasses import dataclass
from typing import Literal

from l3r.config.check import require


@dataclass(kw_only=True, slots=True)
class LossConfig:
    """L = L_pair + lambda L_global."""

    alpha: float = 0.2
    """Weight of the log-confidence reward."""
    global_weight: float = 0.1
    """Lambda of the paper."""
    normalize: Literal["per_graph", "per_edge", "none"] = "per_graph"
    """Over what a scale is shared: rigid accumulation needs one per graph."""
    reduction: Literal["per_graph", "pooled"] = "per_graph"
    """Mean over graphs of means over pixels, or one mean over all pixels of the batch."""
    align_weights: Literal["uniform", "confidence"] = "uniform"
    """Weights of the fit of the prediction to the ground truth in the global term."""
    align_with_scale: bool = False
    """Fit a scale there too."""
    min_valid_pixels: int = 100
    """A graph with fewer valid pixels adds no global term."""

    def __post_init__(self) -> None:
        """Check ranges."""
        require(self.alpha >= 0, "loss.alpha", self.alpha, "0 or more")
        require(self.global_weight >= 0, "loss.global_weight", self.global_weight, "0 or more")
        require(
            self.min_valid_pixels >= 3, "loss.min_valid_pixels", self.min_valid_pixels, "3 or more"
        )
