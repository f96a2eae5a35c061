"""The image encoder: a vision transformer shared by all images."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from l3r.config.model import EncoderConfig
from l3r.errors import DataError
from l3r.model.blocks import EncoderBlock, at_least_float32, build_norm, run_block
from l3r.model.grid import TokenGrid, gather_groups


class Encoder(nn.Module):
    """Patches to tokens, each image by itself.

    Args:
        config: Sizes.
    """

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.patch_size = config.patch_size
        self.head_dim = config.width // config.num_heads
        self.recompute = False
        self.patch_embed = nn.Conv2d(
            3, config.width, kernel_size=config.patch_size, stride=config.patch_size
        )
        # As the matrix from a patch to a token that it is.
        nn.init.xavier_uniform_(self.patch_embed.weight.view(config.width, -1))
        self.blocks = nn.ModuleList(
            EncoderBlock(config.width, config.num_heads) for _ in range(config.depth)
        )
        self.norm = build_norm(config.width)

    def forward(
        self,
        image: Float[Tensor, "m 3 h w"],
        transposed: Bool[Tensor, " m"] | None = None,
    ) -> Float[Tensor, "m t d"]:
        """Encode images of one shape in memory.

        Args:
            image: RGB in [-1, 1].
            transposed: Which images are stored with their pixel axes swapped, on the host; None
                where none is.

        Returns:
            Normalised tokens, one per patch, row by row in the image's own orientation.

        Raises:
            DataError: A side is not a multiple of the patch.
        """
        grid = self.token_grid(image.shape[2], image.shape[3], transposed)
        # The sum that all blocks add to stays in float32 under autocast.
        x = at_least_float32(self._embed(image, grid))
        rope = grid.rope(self.head_dim, x)
        for block in self.blocks:
            x = run_block(block, x, rope, recompute=self.recompute)
        out: Tensor = self.norm(x)
        return out

    def token_grid(
        self, height: int, width: int, transposed: Bool[Tensor, " m"] | None = None
    ) -> TokenGrid:
        """Count the rows and columns of tokens of images.

        Args:
            height: Of the images as stored [px].
            width: Of the images as stored [px].
            transposed: See :meth:`forward`.

        Raises:
            DataError: A side is not a positive multiple of the patch.
        """
        patch = self.patch_size
        if height % patch or width % patch or not height or not width:
            raise DataError(
                f"image of {height} x {width} pixels (height x width), expected multiples of the "
                f"patch size {patch}; scale or crop it"
            )
        return TokenGrid(height // patch, width // patch, transposed)

    def _embed(self, image: Float[Tensor, "m 3 h w"], grid: TokenGrid) -> Float[Tensor, "m t d"]:
        """Project patches, each image in its own orientation."""
        groups = grid.groups(len(image))
        if len(groups) == 1 and groups[0][0] == (grid.rows, grid.columns):
            return _row_major(self.patch_embed(image))
        parts = []
        for shape, images in groups:
            index = torch.tensor(images).to(image.device, non_blocking=True)
            chosen = image[index]
            upright = chosen if shape == (grid.rows, grid.columns) else chosen.transpose(2, 3)
            parts.append(_row_major(self.patch_embed(upright)))
        return gather_groups(parts, [number for _, images in groups for number in images])


def _row_major(image: Float[Tensor, "m d rows columns"]) -> Float[Tensor, "m t d"]:
    # Every block adds to these tokens: what layout they have here, they keep.
    return image.flatten(2).transpose(1, 2).contiguous()
