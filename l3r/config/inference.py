"""How photos are reconstructed."""

from dataclasses import dataclass
from typing import Literal

from l3r.config.check import require
from l3r.config.model import Precision

Crop = Literal["whole", "official"]


@dataclass(kw_only=True, slots=True)
class InferenceConfig:
    """Symmetrisation, point selection and camera fitting."""

    crop: Crop = "whole"
    """``whole``: nothing is cut off; the long side becomes that of ``model.image_size``, each side
    then the nearest multiple of the patch. ``official``: DUSt3R's and MASt3R's released loader; the
    photo is scaled as it is and cut, about its centre, to a square where ``model.image_size`` is
    one, else to multiples of the patch (square photos to 4:3)."""
    chunk_size: int = 32
    """Images encoded, and edges decoded, at once."""
    precision: Precision = "fp32"
    """Of encoder, alignment and decoder; heads and Procrustes stay in float32."""
    symmetrize: Literal["child", "both", "off"] = "child"
    """Decode each edge both ways and average; the fit uses the child's map, or both maps."""
    min_conf: float = 3.0
    """Points of a confidence above this go to PnP."""
    fallback_share: float = 0.1
    """Share of most confident points taken where fewer than ``min_points`` pass; 0: no fallback."""
    min_points: int = 32
    """Points PnP needs."""
    pnp_points: int = 2000
    """Points sampled for PnP."""
    pnp_error: float = 0.01
    """RANSAC's inlier threshold as a share of the photo's long side; at least one of the pixels
    that the network sees."""
    pnp_iterations: int = 200
    """RANSAC's rounds at most."""
    seed: int = 0
    """Seed of RANSAC and of the point sample."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for key in ("chunk_size", "pnp_iterations"):
            require(getattr(self, key) >= 1, f"inference.{key}", getattr(self, key), "1 or more")
        for key in ("min_points", "pnp_points"):
            require(getattr(self, key) >= 4, f"inference.{key}", getattr(self, key), "4 or more")
        require(self.min_conf >= 0, "inference.min_conf", self.min_conf, "0 or more")
        share = self.fallback_share
        require(0 <= share <= 1, "inference.fallback_share", share, "0 to 1")
        require(self.pnp_error > 0, "inference.pnp_error", self.pnp_error, "more than 0")
