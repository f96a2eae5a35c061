"""A network's matrix products, attention, convolutions, norms and activations, and nothing else.

What a run of the network dispatches is recorded, and those operations are replayed on tensors of
the same shapes: no rotary embedding, no residuals, no interpolation, no reshaping. Their time is
what the arithmetic costs on this machine; the rest of the network's time is ours to answer for.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map

KEPT = {
    "linear",
    "scaled_dot_product_attention",
    "conv2d",
    "conv_transpose2d",
    "layer_norm",
    "gelu",
    "relu",
}
"""Operations that are replayed, by their names in torch."""


class _Recorder(TorchDispatchMode):
    def __init__(self, weights: set[int]) -> None:
        super().__init__()
        self.weights = weights
        self.calls: list[tuple[Any, Any, Any]] = []
        self.pool: dict[object, Tensor] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.overloadpacket.__name__ in KEPT:
            kept = tree_map(self._stand_in, (args, kwargs or {}))
            self.calls.append((func, *kept))
        return func(*args, **(kwargs or {}))

    def _stand_in(self, value: Any) -> Any:
        """Keep weights as they are, and one tensor for all activations of a shape."""
        if not isinstance(value, Tensor) or value.untyped_storage().data_ptr() in self.weights:
            return value
        key = (value.shape, value.stride(), value.dtype)
        if key not in self.pool:
            self.pool[key] = torch.randn(value.shape, device=value.device).to(value.dtype)
            self.pool[key] = torch.empty_strided(
                value.shape, value.stride(), dtype=value.dtype, device=value.device
            ).copy_(self.pool[key])
        return self.pool[key]


def record_bare(model: torch.nn.Module, call: Callable[[], object]) -> Callable[[], None]:
    """Record what a call of a network computes and give the bare operations as a call.

    Args:
        model: Its weights are used where they are.
        call: Runs the network; both under ``torch.inference_mode``, which keeps operations whole.
    """
    weights = {parameter.untyped_storage().data_ptr() for parameter in model.parameters()}
    with _Recorder(weights) as recorder:
        call()

    def replay() -> None:
        for func, args, kwargs in recorder.calls:
            func(*args, **kwargs)

    return replay
