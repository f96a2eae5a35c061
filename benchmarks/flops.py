"""What a network costs without running it, counted: operations of its parts.

Operations are those of matrix products, attention and convolutions, 2 for each product and sum.
"""

from collections.abc import Callable

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from l3r.config import ModelConfig
from l3r.model.activations import flatten_tensors, parts_without_data


def count_flops(config: ModelConfig, num_views: int, *, training: bool = False) -> dict[str, float]:
    """Count the operations of each part for one graph.

    Args:
        config: Sizes; images take ``image_size``.
        num_views: Images of the graph.
        training: With the backward pass.
    """
    outline = parts_without_data(config, num_views, training=training, recompute=False)
    with outline as parts, sdpa_kernel(SDPBackend.MATH):
        return {name: flops_of(call, training=training) for name, call in parts.items()}


def flops_of(call: Callable[[], object], *, training: bool = False) -> float:
    """Count the operations of a call, and of the backward pass from the sum of its results."""
    with FlopCounterMode(display=False) as counter:
        result = call()
        if training:
            backward_from(result)
    return float(counter.get_total_flops())


def backward_from(result: object) -> None:
    """Run the backward pass from the sum of all tensors in nested lists."""
    tensors = [tensor.float().sum() for tensor in flatten_tensors(result)]
    torch.stack(tensors).sum().backward()
