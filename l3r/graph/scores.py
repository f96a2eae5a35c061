"""How alike two views are; what an edge then costs is in ``edge_costs``."""

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def similarity_scores(mean_tokens: Float[Tensor, "b n d"]) -> Float[Tensor, "b n n"]:
    """Cosine of the views' mean encoder tokens, for every pair (the paper's matrix S)."""
    unit = F.normalize(mean_tokens.float(), dim=-1)
    return unit @ unit.transpose(-1, -2)
