"""The parts of a network without its data: what the backward pass keeps, counted and not run."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from l3r.config import GraphConfig, ModelConfig, Precision
from l3r.model import rope
from l3r.model.heads import run_head
from l3r.model.light3r import Light3R
from l3r.model.precision import reduced_precision

PartCalls = dict[str, Callable[[], object]]
"""``encoder``, ``alignment``, ``decoder`` and ``heads``, each ready to be called."""


def part_calls(model: Light3R, image: Tensor) -> PartCalls:
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


@contextmanager
def parts_without_data(
    config: ModelConfig, num_views: int, *, training: bool, recompute: bool
) -> Iterator[PartCalls]:
    """Give the parts of a network on tensors that have shapes and no data.

    Args:
        config: Sizes; images take ``image_size``.
        num_views: Images of the graph.
        training: Whether gradients are asked for.
        recompute: Whether activations are computed again instead of kept.
    """
    # The cache of tables must not mix the two kinds of tensors.
    rope._cached_tables.cache_clear()
    try:
        with FakeTensorMode():
            model = Light3R(config, GraphConfig())
            model.train(training).requires_grad_(training)
            model.recompute_activations(enabled=recompute)
            yield part_calls(model, torch.empty(num_views, 3, *config.image_size))
    finally:
        rope._cached_tables.cache_clear()


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
    with parts_without_data(config, num_views, training=True, recompute=recompute) as parts:
        for name, call in parts.items():
            storages: dict[int, torch.UntypedStorage] = {}

            def keep(
                tensor: Tensor, storages: dict[int, torch.UntypedStorage] = storages
            ) -> Tensor:
                storage = tensor.untyped_storage()
                if not isinstance(tensor, torch.nn.Parameter) and not _is_weight(tensor):
                    storages[storage._cdata] = storage
                return tensor

            hooks = torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor)
            with hooks, reduced_precision(precision, torch.device("cpu")):
                for handed_on in flatten_tensors(call()):
                    keep(handed_on)
            kept[name] = sum(storage.nbytes() for storage in storages.values())
    return kept


def flatten_tensors(result: Any) -> Iterable[Tensor]:
    """Give all tensors in nested lists."""
    if isinstance(result, Tensor):
        yield result
    else:
        for part in result:
            yield from flatten_tensors(part)


def _is_weight(tensor: Tensor) -> bool:
    """Whether a tensor is a weight seen from another side: transposed, say."""
    return isinstance(tensor._base, torch.nn.Parameter)
