"""What an edge between two views costs; the switches are in ``l3r/config/graph.py``."""

import numpy as np
from jaxtyping import Float

from l3r.config import GraphConfig


def edge_costs(similarity: Float[np.ndarray, "b n n"], config: GraphConfig) -> np.ndarray:
    """Turn similarities into positive costs; infinite on the diagonal.

    The paper's cost -S has no shortest paths (negative cycles). 1 - S orders edges alike and is
    floored at 1e-6, so that no path through duplicates is free. On overlaps, where 1 - S gives
    nothing but the star around the root, ``oracle`` takes -log S: the path of largest product.
    """
    if config.algorithm == "oracle" or config.cost == "neg_log":
        costs: np.ndarray = -np.log(np.clip(similarity, 1e-6, 1 - 1e-6))
    else:
        costs = np.maximum(1 - similarity, 1e-6) ** config.cost_power
    view = np.arange(costs.shape[-1])
    costs[:, view, view] = np.inf
    return costs
