"""Half precision as a switch."""

import torch

from l3r.config import Precision


def reduced_precision(precision: Precision, device: torch.device) -> torch.autocast:
    """Run the transformer in bfloat16 where asked, inside a ``with`` statement.

    Matrix products and attention then take bfloat16; weights, norms and the sum that all blocks
    add to stay in float32, and so do heads, tree and accumulation, which leave autocast.

    Args:
        precision: ``fp32`` or ``bf16``.
        device: Where it runs.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16")
