"""How the tokens of a batch of images lie: their grid, and which images are stored transposed."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l3r.errors import DataError
from l3r.model.rope import RopeTables, rope_tables


@dataclass(frozen=True)
class TokenGrid:
    """Rows and columns of the tokens of images that share one shape in memory.

    Tokens always stand row by row in the image's own orientation, and positions are those of that
    orientation; so an image that is stored transposed has ``columns`` rows of ``rows`` tokens.
    """

    rows: int
    """Rows of tokens as the images are stored."""
    columns: int
    """Columns of tokens as the images are stored."""
    transposed: Bool[Tensor, " m"] | None = None
    """Which images are stored transposed, on the host; None where none can be."""

    def select(self, images: Int[Tensor, " k"]) -> "TokenGrid":
        """Describe a choice of the images, given by their numbers on the host."""
        chosen = None if self.transposed is None else self.transposed[images]
        return TokenGrid(self.rows, self.columns, chosen)

    def groups(self, num_images: int) -> list[tuple[tuple[int, int], list[int]]]:
        """Group images by orientation: ``((rows, columns) as photographed, their numbers)``."""
        if self.transposed is None:
            return [((self.rows, self.columns), list(range(num_images)))]
        upright = (~self.transposed).nonzero()[:, 0].tolist()
        turned = self.transposed.nonzero()[:, 0].tolist()
        both = [((self.rows, self.columns), upright), ((self.columns, self.rows), turned)]
        return [(grid, images) for grid, images in both if images]

    def rope(self, head_dim: int, like: Tensor) -> RopeTables:
        """Tabulate the rotations: one table for all, or one for each where some are transposed."""
        upright = rope_tables(self.rows, self.columns, head_dim, like)
        if self.transposed is None:
            return upright
        turned = rope_tables(self.columns, self.rows, head_dim, like)
        choice = self.transposed.long().to(like.device, non_blocking=True)
        return RopeTables(
            cos=torch.stack((upright.cos, turned.cos))[choice],
            sin=torch.stack((upright.sin, turned.sin))[choice],
        )


def find_transposed(
    true_shape: Int[Tensor, "m 2"], height: int, width: int
) -> Bool[Tensor, " m"] | None:
    """Find the images that are stored transposed in a batch of one shape in memory.

    Args:
        true_shape: (height, width) of each image as it was photographed, on the host.
        height: As stored.
        width: As stored.

    Returns:
        Which are; None for square images, where it makes no difference to shapes.

    Raises:
        DataError: A shape is neither the stored one nor the stored one transposed.
    """
    shapes = true_shape.cpu()
    upright = (shapes == shapes.new_tensor([height, width])).all(-1)
    turned = (shapes == shapes.new_tensor([width, height])).all(-1)
    if not bool((upright | turned).all()):
        odd = shapes[~(upright | turned)][0].tolist()
        raise DataError(
            f"an image of true shape {odd} (height, width) in a batch stored as {[height, width]}; "
            f"expected {[height, width]}, or {[width, height]} stored transposed"
        )
    return None if height == width else turned


def gather_groups(parts: list[Float[Tensor, "_ ..."]], images: list[int]) -> Float[Tensor, "_ ..."]:
    """Join what was computed group by group, in the order of the images.

    Args:
        parts: One tensor for each group.
        images: Numbers of the images of all groups, one after another.
    """
    if len(parts) == 1:
        return parts[0]
    joined = torch.cat(parts)
    place = torch.tensor(images).argsort().to(joined.device, non_blocking=True)
    return joined[place]
