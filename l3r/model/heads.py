"""From decoder tokens to points and confidences."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle

from l3r.config.model import ModelConfig
from l3r.model.blocks import at_least_float32, run_block
from l3r.model.dpt import NUM_CHANNELS, DptHead
from l3r.model.grid import TokenGrid, gather_groups

MIN_NORM = 1e-8
CHUNK_TOKENS = 4096
"""Tokens a head works on at once: five images of 384x512 in patches of 16."""


class LinearHead(nn.Module):
    """One linear map from a token to the pixels of its patch.

    Args:
        width: Token width ``d`` of the decoder.
        patch_size: Side of a patch [px].
    """

    hooks: tuple[int, ...] = (-1,)
    """The entries of the decoder's stream that the head reads."""

    def __init__(self, width: int, patch_size: int) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.proj = nn.Linear(width, NUM_CHANNELS * patch_size**2)

    def forward(
        self, grid: tuple[int, int], tokens: Float[Tensor, "m t d"]
    ) -> Float[Tensor, "m 4 h w"]:
        """Lay the outputs of all tokens out as images.

        Args:
            grid: (rows, columns) of the tokens.
            tokens: The entry named by ``hooks``: the last, normalised.

        Returns:
            Channels x, y, z and confidence before their activations.
        """
        patches = self.proj(tokens)
        # Channel c * patch^2 + patch * row + column of a token is channel c at that sub-pixel.
        image = patches.transpose(1, 2).reshape(*patches.shape[::2], *grid)
        return pixel_shuffle(image, self.patch_size)


def build_head(config: ModelConfig) -> LinearHead | DptHead:
    """Build the head that a configuration names; one is needed for each stream."""
    match config.head:
        case "linear":
            return LinearHead(config.decoder.width, config.encoder.patch_size)
        case "dpt":
            decoder = config.decoder
            return DptHead(config.dpt, config.encoder.width, decoder.width, decoder.depth)


def run_head(
    head: nn.Module, hooked: Sequence[Float[Tensor, "m t _"]], grid: TokenGrid, *, recompute: bool
) -> Float[Tensor, "m 4 h w"]:
    """Run a head over any number of images, a chunk of one orientation at a time.

    Chunks bound the memory where nothing is kept for a backward pass: a DPT head holds 0.3 GiB
    for each image of 384x512 that it works on.
    It runs in float32 outside autocast (float64 stays): half precision shows in points that are
    exponentials of what comes out here.

    Args:
        head: What :func:`build_head` made.
        hooked: The entries of the decoder's stream that the head asked for.
        grid: How the tokens lie.
        recompute: See :func:`l3r.model.blocks.run_block`.

    Returns:
        Raw channels, the pixel axes as the images are stored.
    """
    groups = grid.groups(len(hooked[0]))
    results = []
    with torch.autocast(hooked[0].device.type, enabled=False):
        for shape, images in groups:
            for chunk in _chunks(images, shape):
                raw = _run_chunk(head, hooked, chunk, shape, recompute=recompute)
                results.append(raw if shape == (grid.rows, grid.columns) else raw.transpose(2, 3))
    return gather_groups(results, [number for _, images in groups for number in images])


def _chunks(images: list[int], shape: tuple[int, int]) -> list[list[int]]:
    """Cut a list of images into near-equal runs of at most ``CHUNK_TOKENS`` tokens each."""
    count = -(-len(images) // max(1, CHUNK_TOKENS // (shape[0] * shape[1])))
    bounds = [len(images) * part // count for part in range(count + 1)]
    return [images[start:stop] for start, stop in pairwise(bounds)]


def _run_chunk(
    head: nn.Module,
    hooked: Sequence[Tensor],
    chunk: list[int],
    shape: tuple[int, int],
    *,
    recompute: bool,
) -> Tensor:
    if len(chunk) == len(hooked[0]):
        chosen = list(hooked)
    else:  # copies, not slices: compiled code would depend on where a slice begins
        index = torch.tensor(chunk).to(hooked[0].device, non_blocking=True)
        chosen = [entry[index] for entry in hooked]
    tokens = [at_least_float32(entry) for entry in chosen]
    raw: Tensor = run_block(head, shape, *tokens, recompute=recompute)
    return raw


def pointmap_from_raw(
    raw: Float[Tensor, "m 4 h w"],
) -> tuple[Float[Tensor, "m p 3"], Float[Tensor, "m p"]]:
    """Apply the output activations and flatten the pixels row by row.

    With n = norm(xyz) a point is xyz / n * (exp(n) - 1), in the parent's frame. The confidence is
    C = 1 + exp(raw), of which the logarithm is returned: it neither overflows nor loses digits.

    Args:
        raw: What a head returned.

    Returns:
        ``(pts3d, log_conf)``, float32, or float64 for float64 input. Points overflow float32
        where n exceeds 88.
    """
    pixels = at_least_float32(raw).flatten(2).transpose(1, 2)
    xyz, logit = pixels[..., :3], pixels[..., 3]
    norm = torch.linalg.vector_norm(xyz, dim=-1, keepdim=True)
    pts3d = xyz / norm.clamp(min=MIN_NORM) * torch.expm1(norm)
    # softplus turns linear above a threshold, which float64 can tell from the truth.
    return pts3d, torch.logaddexp(logit, torch.zeros_like(logit))
