"""How many images found their place."""

import math

from jaxtyping import Bool
from torch import Tensor


def registration_rate(registered: Bool[Tensor, " n"]) -> float:
    """Percent of images that are registered; NaN without images."""
    if not len(registered):
        return math.nan
    return 100 * int(registered.sum()) / len(registered)
