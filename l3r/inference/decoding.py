"""Photos of any shapes through the network's parts, in chunks."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l3r.model.light3r import EdgePointmaps, Light3R
from l3r.types import PairPointmaps, Photos

Size = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class DirectedEdges:
    """Pairs of images to decode, the first one giving the frame."""

    parent: Int[Tensor, " e"]
    child: Int[Tensor, " e"]


def encode_photos(model: Light3R, photos: Photos, chunk_size: int) -> list[Float[Tensor, "_t d"]]:
    """Encode every photo once; images of one shape go in chunks together."""
    device = next(model.parameters()).device
    tokens: list[Tensor] = [torch.empty(0)] * len(photos.image)
    for views in _chunks_by_key(photos.network_size, chunk_size):
        image = torch.stack([photos.image[view] for view in views]).to(device)
        for view, encoded in zip(views, model.encode(image), strict=True):
            tokens[view] = encoded
    return tokens


def align_photos(
    model: Light3R, tokens: Sequence[Float[Tensor, "_t d"]], chunk_size: int
) -> list[Float[Tensor, "_t d"]]:
    """Align the tokens of all images; the global tokens run first, the rest is local to a chunk."""
    summaries = torch.stack([image.mean(0) for image in tokens])[None]
    levels = model.alignment.update_summaries(summaries)
    aligned: list[Tensor] = []
    for start in range(0, len(tokens), chunk_size):
        chunk = tokens[start : start + chunk_size]
        joined = model.alignment.align(torch.cat(list(chunk))[None], levels)[0]
        aligned.extend(torch.split(joined, [len(image) for image in chunk]))
    return aligned


def decode_photos(
    model: Light3R,
    tokens: Sequence[Float[Tensor, "_t d"]],
    sizes: Sequence[Size],
    edges: DirectedEdges,
    chunk_size: int,
) -> PairPointmaps:
    """Decode directed edges; those whose two shapes agree go in chunks together.

    Returns:
        Maps of all edges as one graph. Pixels are padded to the largest image with points at zero
        of log-confidence zero.
    """
    pairs = list(zip(edges.parent.tolist(), edges.child.tolist(), strict=True))
    num_pixels = max(height * width for height, width in sizes)
    maps = _empty_maps(len(pairs), num_pixels, tokens[0])
    shapes = [(sizes[parent], sizes[child]) for parent, child in pairs]
    for chunk in _chunks_by_key(shapes, chunk_size):
        parent_size, child_size = shapes[chunk[0]]
        parent_tokens = torch.stack([tokens[pairs[edge][0]] for edge in chunk])
        child_tokens = torch.stack([tokens[pairs[edge][1]] for edge in chunk])
        grids = [model.encoder.token_grid(*size) for size in (parent_size, child_size)]
        decoded = model.decode(parent_tokens, child_tokens, *grids)
        _store(maps, decoded, torch.tensor(chunk, device=parent_tokens.device))
    return maps


def _chunks_by_key(keys: Sequence[object], chunk_size: int) -> Iterator[list[int]]:
    """Group indices whose keys are equal, in order of appearance, in chunks."""
    groups: dict[object, list[int]] = {}
    for index, key in enumerate(keys):
        groups.setdefault(key, []).append(index)
    for group in groups.values():
        for start in range(0, len(group), chunk_size):
            yield group[start : start + chunk_size]


def _empty_maps(num_edges: int, num_pixels: int, like: Tensor) -> PairPointmaps:
    dtype = like.dtype if like.dtype == torch.float64 else torch.float32
    points = torch.zeros(1, num_edges, num_pixels, 3, dtype=dtype, device=like.device)
    return PairPointmaps(
        parent_pts3d=points,
        child_pts3d=points.clone(),
        parent_log_conf=points[..., 0].clone(),
        child_log_conf=points[..., 0].clone(),
    )


def _store(maps: PairPointmaps, decoded: EdgePointmaps, edge: Tensor) -> None:
    for name in ("parent_pts3d", "child_pts3d", "parent_log_conf", "child_log_conf"):
        values = getattr(decoded, name)
        getattr(maps, name)[0, edge, : values.shape[1]] = values
