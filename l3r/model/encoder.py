"""The image encoder: a vision transformer shared by all images."""

from jaxtyping import Float
from torch import Tensor, nn

from l3r.config.model import EncoderConfig
from l3r.errors import DataError
from l3r.model.blocks import EncoderBlock, build_norm
from l3r.model.rope import rope_tables


class Encoder(nn.Module):
    """Patches to tokens, each image by itself.

    Args:
        config: Sizes.
    """

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.patch_size = config.patch_size
        self.head_dim = config.width // config.num_heads
        self.patch_embed = nn.Conv2d(
            3, config.width, kernel_size=config.patch_size, stride=config.patch_size
        )
        # As the matrix from a patch to a token that it is.
        nn.init.xavier_uniform_(self.patch_embed.weight.view(config.width, -1))
        self.blocks = nn.ModuleList(
            EncoderBlock(config.width, config.num_heads) for _ in range(config.depth)
        )
        self.norm = build_norm(config.width)

    def forward(self, image: Float[Tensor, "m 3 h w"]) -> Float[Tensor, "m t d"]:
        """Encode images of one shape.

        Args:
            image: RGB in [-1, 1], upright, in their own orientation.

        Returns:
            Normalised tokens, one per patch, row by row.

        Raises:
            DataError: A side is not a multiple of the patch.
        """
        grid_height, grid_width = self.token_grid(image.shape[2], image.shape[3])
        x: Tensor = self.patch_embed(image).flatten(2).transpose(1, 2)
        rope = rope_tables(grid_height, grid_width, self.head_dim, x)
        for block in self.blocks:
            x = block(x, rope)
        out: Tensor = self.norm(x)
        return out

    def token_grid(self, height: int, width: int) -> tuple[int, int]:
        """Count the rows and columns of tokens of an image.

        Args:
            height: Of the image [px].
            width: Of the image [px].

        Returns:
            (rows, columns).

        Raises:
            DataError: A side is not a positive multiple of the patch.
        """
        patch = self.patch_size
        if height % patch or width % patch or not height or not width:
            raise DataError(
                f"image of {height} x {width} pixels (height x width), expected multiples of the "
                f"patch size {patch}; scale or crop it"
            )
        return height // patch, width // patch
