"""From decoder tokens to points and confidences."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle

from l3r.config.model import ModelConfig

NUM_CHANNELS = 4
MIN_NORM = 1e-8


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
        self, hooked: Sequence[Float[Tensor, "m t d"]], grid: tuple[int, int]
    ) -> Float[Tensor, "m 4 h w"]:
        """Lay the outputs of all tokens out as images.

        Runs in float32 outside autocast (float64 tokens stay float64): half precision shows in
        points that are exponentials of what comes out here.

        Args:
            hooked: The entries named by ``hooks``: the last, normalised.
            grid: (rows, columns) of the tokens.

        Returns:
            Channels x, y, z and confidence before their activations.
        """
        (tokens,) = hooked
        with torch.autocast(tokens.device.type, enabled=False):
            patches = self.proj(at_least_float32(tokens))
        # Channel c * patch^2 + patch * row + column of a token is channel c at that sub-pixel.
        image = patches.transpose(1, 2).reshape(*patches.shape[::2], *grid)
        return pixel_shuffle(image, self.patch_size)


def build_head(config: ModelConfig) -> LinearHead:
    """Build the head that a configuration names; one is needed for each stream."""
    match config.head:
        case "linear":
            return LinearHead(config.decoder.width, config.encoder.patch_size)


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


def at_least_float32(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Raise half precision to float32; float64 stays."""
    return x if x.dtype == torch.float64 else x.float()
