"""The dense prediction transformer's head: four stages of tokens, fused from coarse to fine."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from l3r.config.model import DptConfig

NUM_CHANNELS = 4
"""x, y, z and confidence."""


class Reassemble(nn.Module):
    """Lay the tokens of one stage out as an image of one scale and of the common width.

    Args:
        width: Token width ``d``.
        channels: Channels at this scale.
        common_width: Channels that all scales share in the fusion.
        scale: Rows out per row of tokens: 4, 2, 1 or 0.5 (rounded up).
    """

    def __init__(self, width: int, channels: int, common_width: int, scale: float) -> None:
        super().__init__()
        self.project = nn.Conv2d(width, channels, kernel_size=1)
        self.resample: nn.Module = nn.Identity()
        if scale > 1:
            step = int(scale)
            self.resample = nn.ConvTranspose2d(channels, channels, kernel_size=step, stride=step)
        elif scale < 1:
            self.resample = nn.Conv2d(channels, channels, kernel_size=3, stride=2, padding=1)
        self.reduce = nn.Conv2d(channels, common_width, kernel_size=3, padding=1, bias=False)

    def forward(
        self, tokens: Float[Tensor, "m t d"], grid: tuple[int, int]
    ) -> Float[Tensor, "m c h w"]:
        """Turn row-major tokens of a ``grid`` into an image."""
        # Tokens are an image with its channels last already: nothing is copied.
        image = tokens.reshape(len(tokens), *grid, tokens.shape[2]).permute(0, 3, 1, 2)
        out: Tensor = self.reduce(self.resample(self.project(image)))
        return out


class ResidualConv(nn.Module):
    """Two 3x3 convolutions, each after a ReLU, added to the input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, kernel_size=3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, kernel_size=3, padding=1)

    def forward(self, x: Float[Tensor, "m c h w"]) -> Float[Tensor, "m c h w"]:
        """Refine; the sum takes ``x`` as it came, not rectified."""
        out: Tensor = x + self.conv2(F.relu(self.conv1(F.relu(x))))
        return out


class Fusion(nn.Module):
    """Merge a coarser image with a finer one, refine, and double the size.

    Args:
        channels: Of both.
        has_skip: Whether a finer image joins; at the coarsest scale none does.
    """

    def __init__(self, channels: int, *, has_skip: bool) -> None:
        super().__init__()
        self.skip = ResidualConv(channels) if has_skip else None
        self.refine = ResidualConv(channels)
        self.project = nn.Conv2d(channels, channels, kernel_size=1)

    def forward(
        self, x: Float[Tensor, "m c h w"], finer: Float[Tensor, "m c h w"] | None = None
    ) -> Float[Tensor, "m c h2 w2"]:
        """Fuse two images of one size to one of twice the size."""
        if self.skip is not None and finer is not None:
            x = x + self.skip(finer)
        # The 1x1 convolution commutes with the interpolation, whose weights sum to one, and costs
        # a quarter before it.
        return double(self.project(self.refine(x)))


class DptHead(nn.Module):
    """Convolutions over four stages: the tokens that came in and three of the decoder's.

    Ranftl et al., "Vision Transformers for Dense Prediction" (ICCV 2021), in DUSt3R's form: no
    batch norm, 16x16 patches, four output channels.

    Args:
        config: Channels of every scale.
        encoder_width: Width of the first stage's tokens.
        decoder_width: Width of the others' tokens.
        decoder_depth: Blocks of the decoder, which place the stages.
    """

    def __init__(
        self, config: DptConfig, encoder_width: int, decoder_width: int, decoder_depth: int
    ) -> None:
        super().__init__()
        self.hooks = (0, decoder_depth * 2 // 4, decoder_depth * 3 // 4, decoder_depth)
        """The entries of the decoder's stream that the head reads."""
        widths = (encoder_width, decoder_width, decoder_width, decoder_width)
        scales = (4.0, 2.0, 1.0, 0.5)
        self.stages = nn.ModuleList(
            Reassemble(width, channels, config.fusion_channels, scale)
            for width, channels, scale in zip(widths, config.stage_channels, scales, strict=True)
        )
        # In the order of the stages; the coarsest, which is the last, has nothing to join.
        self.fusions = nn.ModuleList(
            Fusion(config.fusion_channels, has_skip=index < 3) for index in range(4)
        )
        self.reduce = nn.Conv2d(config.fusion_channels, config.out_channels, 3, padding=1)
        self.refine = nn.Conv2d(config.out_channels, config.out_channels, 3, padding=1)
        self.out = nn.Conv2d(config.out_channels, NUM_CHANNELS, kernel_size=1)
        for weight in self.parameters():
            if weight.dim() == 4:
                weight.data = weight.data.contiguous(memory_format=torch.channels_last)

    def forward(
        self, grid: tuple[int, int], *hooked: Float[Tensor, "m t _"]
    ) -> Float[Tensor, "m 4 h w"]:
        """Compute the raw outputs of images of one shape, in their own orientation.

        Args:
            grid: (rows, columns) of the tokens.
            hooked: The entries named by ``hooks``.

        Returns:
            Channels x, y, z and confidence before their activations, 16 pixels per token.
        """
        finest, fine, middle, coarse = (
            stage(tokens, grid) for stage, tokens in zip(self.stages, hooked, strict=True)
        )
        # An odd side was rounded up on the way down: what lies beyond the grid is cut off. (A slice
        # would make compiled code depend on whether there is anything.)
        x = self.fusions[3](coarse).narrow(2, 0, grid[0]).narrow(3, 0, grid[1])
        x = self.fusions[2](x, middle)
        x = self.fusions[1](x, fine)
        x = double(self.reduce(self.fusions[0](x, finest)))
        out: Tensor = self.out(F.relu(self.refine(x)))
        return out


def double(x: Float[Tensor, "m c h w"]) -> Float[Tensor, "m c h2 w2"]:
    """Double both sides bilinearly; corner pixels keep their values."""
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)
