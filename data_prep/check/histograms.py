"""Histograms that are filled graph by graph, so that a million pairs take no memory."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64


@dataclass(kw_only=True)
class Histogram:
    """How often a quantity fell where."""

    title: str
    """What is counted, for a reader."""
    unit: str
    """Unit of the quantity; empty for a plain number."""
    of: str
    """What one count is: ``pairs``, ``images``."""
    edges: Float64[np.ndarray, " bins_plus_1"]
    """Rising; the first and the last bin take what lies outside."""
    is_log: bool = False
    """Whether the bins widen by a constant factor."""
    counts: Int64[np.ndarray, " bins"] = field(init=False)
    """Values in each bin."""
    num_unknown: int = 0
    """Values that were NaN."""
    lowest: float = float("inf")
    """Smallest value."""
    highest: float = float("-inf")
    """Largest value."""

    def __post_init__(self) -> None:
        """Begin empty."""
        self.counts = np.zeros(len(self.edges) - 1, dtype=np.int64)

    def add(self, values: Float64[np.ndarray, " m"]) -> None:
        """Count values; NaN is counted apart."""
        known = values[~np.isnan(values)]
        self.num_unknown += len(values) - len(known)
        if not len(known):
            return
        self.lowest = min(self.lowest, float(known.min()))
        self.highest = max(self.highest, float(known.max()))
        inside = known.clip(self.edges[0], self.edges[-1])
        self.counts += np.histogram(inside, self.edges)[0]

    @property
    def total(self) -> int:
        """Values counted, NaN left out."""
        return int(self.counts.sum())

    def median(self) -> float:
        """Give the median to within a bin; NaN where nothing was counted."""
        if not self.total:
            return float("nan")
        below = np.concatenate([[0], np.cumsum(self.counts)]) / self.total
        # Where several edges stand at one half, the values lie above the last of them.
        bin_ = min(int(np.searchsorted(below, 0.5, side="right")), len(self.counts)) - 1
        share = (0.5 - below[bin_]) / (below[bin_ + 1] - below[bin_])
        low, high = self.edges[bin_], self.edges[bin_ + 1]
        middle = low * (high / low) ** share if self.is_log else low + share * (high - low)
        return float(np.clip(middle, self.lowest, self.highest))

    def to_plain(self) -> dict[str, Any]:
        """Give builtins only."""
        empty = not self.total
        return {
            "unit": self.unit,
            "of": self.of,
            "edges": [float(f"{edge:.6g}") for edge in self.edges],
            "counts": self.counts.tolist(),
            "unknown": self.num_unknown,
            "lowest": None if empty else self.lowest,
            "median": None if empty else self.median(),
            "highest": None if empty else self.highest,
        }
