"""How views are connected and chained."""

from dataclasses import dataclass
from typing import Literal

from l3r.config.check import require


@dataclass(kw_only=True, slots=True)
class GraphConfig:
    """The tree over the views and the accumulation along it."""

    algorithm: Literal["spt", "mst", "oracle"] = "spt"
    """Shortest-path tree, minimum spanning tree, or shortest paths over ground-truth overlap."""
    cost: Literal["one_minus", "neg_log"] = "one_minus"
    """Cost of an edge of similarity S: 1 - S, or -log S. ``oracle`` always takes ``neg_log``."""
    cost_power: float = 1.0
    """Exponent on the ``one_minus`` cost."""
    knn: int = 0
    """Keep each view's k most similar neighbours; 0 keeps the complete graph."""
    confidence: Literal["symmetric", "running"] = "symmetric"
    """How a parent's confidences combine: one mean, or the paper's running halves."""
    with_scale: bool = False
    """Fit a scale at every edge; the paper is rigid."""
    min_similarity: float | None = None
    """Images joined only through an edge below this form a component of their own."""
    max_residual: float | None = None
    """Images joined only through an edge whose fit leaves more form a component of their own."""

    def __post_init__(self) -> None:
        """Check ranges."""
        require(self.cost_power > 0, "graph.cost_power", self.cost_power, "more than 0")
        require(self.knn >= 0, "graph.knn", self.knn, "0 or more")
