"""What a network costs without running it: operations counted, and bytes the backward pass keeps.

Operations are those of matrix products, attention and convolutions, 2 for each product and sum.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from l3r.config import GraphConfig, ModelConfig, Precision
from l3r.model import rope
from l3r.model.heads import run_head
from l3r.model.light3r import Light3R
from l3r.model.precision import reduced_precision

PARTS = ("encoder", "alignment", "decoder", "heads")


def part_calls(model: Light3R, image: Tensor) -> dict[str, Callable[[], object]]:
    """Give each part as a call on inputs of the shapes that a graph of these images brings.

    Args:
        model: The network; inputs ask for gradients where it is in training.
        image: (n, 3, h, w) in [0, 1]; the n - 1 edges join neighbours.
    """
    config, hooks = model.config, model.parent_head.hooks
    grid = model.encoder.token_grid(image.shape[2], image.shape[3])
    num_views, num_tokens = len(image), grid.rows * grid.columns

    def tokens(count: int, width: int) -> Tensor:
        shape = (count, num_tokens, width)
        return torch.randn(shape, device=image.device, requires_grad=model.training)

    encoded = tokens(num_views, config.encoder.width)
    widths = [config.encoder.width if hook == 0 else config.decoder.width for hook in hooks]
    hooked = [tokens(num_views - 1, width) for width in widths]
    recompute = model.decoder.recompute
    return {
        "encoder": lambda: model.encode(image),
        "alignment": lambda: model.alignment(encoded[None]),
        "decoder": lambda: model.decoder(encoded[:-1], encoded[1:], grid, grid, hooks=hooks),
        "heads": lambda: [
            run_head(head, hooked, grid, recompute=recompute)
            for head in (model.parent_head, model.child_head)
        ],
    }


def count_flops(config: ModelConfig, num_views: int, *, training: bool = False) -> dict[str, float]:
    """Count the operations of each part for one graph.

    Args:
        config: Sizes; images take ``image_size``.
        num_views: Images of the graph.
        training: With the backward pass.
    """
    with _without_data(), sdpa_kernel(SDPBackend.MATH):
        parts = _fake_parts(config, num_views, training=training, recompute=False)
        return {name: flops_of(call, training=training) for name, call in parts.items()}


def flops_of(call: Callable[[], object], *, training: bool = False) -> float:
    """Count the operations of a call, and of the backward pass from the sum of its results."""
    with FlopCounterMode(display=False) as counter:
        result = call()
        if training:
            backward_from(result)
    return float(counter.get_total_flops())


def count_kept(
    config: ModelConfig, num_views: int, *, precision: Precision, recompute: bool
) -> dict[str, int]:
    """Count the bytes that each part keeps for the backward pass of one graph, or hands on.

    Weights are left out.

    Args:
        config: Sizes; images take ``image_size``.
        num_views: Images of the graph.
        precision: Of the transformer.
        recompute: Whether activations are computed again instead.
    """
    kept = {}
    with _without_data():
        parts = _fake_parts(config, num_views, training=True, recompute=recompute)
        for name, call in parts.items():
            storages: dict[int, object] = {}

            def keep(tensor: Tensor, storages: dict[int, object] = storages) -> Tensor:
                storage = tensor.untyped_storage()
                if not isinstance(tensor, torch.nn.Parameter) and not _is_weight(tensor):
                    storages[storage._cdata] = storage
                return tensor

            hooks = torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor)
            with hooks, reduced_precision(precision, torch.device("cpu")):
                for handed_on in _flatten(call()):
                    keep(handed_on)
            kept[name] = sum(storage.nbytes() for storage in storages.values())
    return kept


def backward_from(result: object) -> None:
    """Run the backward pass from the sum of all tensors in nested lists."""
    torch.stack([tensor.float().sum() for tensor in _flatten(result)]).sum().backward()


@contextmanager
def _without_data() -> Iterator[None]:
    """Work on tensors that have shapes and no data; the cache of tables must not mix the two."""
    rope._cached_tables.cache_clear()
    try:
        with FakeTensorMode():
            yield
    finally:
        rope._cached_tables.cache_clear()


def _flatten(result: object) -> Iterable[Tensor]:
    if isinstance(result, Tensor):
        yield result
    else:
        for part in result:
            yield from _flatten(part)


def _is_weight(tensor: Tensor) -> bool:
    """Whether a tensor is a weight seen from another side: transposed, say."""
    return isinstance(tensor._base, torch.nn.Parameter)


def _fake_parts(
    config: ModelConfig, num_views: int, *, training: bool, recompute: bool
) -> dict[str, Callable[[], object]]:
    model = Light3R(config, GraphConfig())
    model.train(training).requires_grad_(training)
    model.recompute_activations(enabled=recompute)
    return part_calls(model, torch.empty(num_views, 3, *config.image_size))
