"""Reduced precision as a switch."""

from collections.abc import Iterator
from contextlib import contextmanager

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


@contextmanager
def true_float32(device: torch.device) -> Iterator[None]:
    """Compute in float32 as it is written, out of autocast and without TensorFloat-32.

    Args:
        device: Where it runs.
    """
    products, convolutions = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    set_tf32(products=False, convolutions=False)
    try:
        with torch.autocast(device.type, enabled=False):
            yield
    finally:
        set_tf32(products=products, convolutions=convolutions)


def set_tf32(*, products: bool, convolutions: bool) -> None:
    """Choose whether NVIDIA GPUs round the factors of float32 products to 10 bits of mantissa.

    Args:
        products: Of matrices.
        convolutions: Of cuDNN.
    """
    # Not by the newer ``fp32_precision``: with it torch.compile of 2.13 cannot read the state.
    torch.backends.cuda.matmul.allow_tf32 = products
    torch.backends.cudnn.allow_tf32 = convolutions
