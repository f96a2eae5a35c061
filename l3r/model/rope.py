"""Rotary position embedding in two dimensions, base 100."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

BASE = 100.0
MAX_CACHED_TABLES = 64


@dataclass(frozen=True)
class RopeTables:
    """Factors of every token's channels; one axis of length 1 stands for the heads.

    Either the same for all items of a batch, or one table for each.
    """

    cos: Float[Tensor, "*items t 1 dim"]
    """Cosine of the angle by which each channel turns."""
    sin: Float[Tensor, "*items t 1 dim"]
    """Sine of it, negative for the first channel of a pair."""


def rope_tables(grid_height: int, grid_width: int, head_dim: int, like: Tensor) -> RopeTables:
    """Tabulate the rotations of a grid of tokens in row-major order.

    Args:
        grid_height: Rows of tokens.
        grid_width: Columns of tokens.
        head_dim: Width of an attention head, a multiple of 4.
        like: Any tensor of the model: gives the device, and float64 where it is float64.

    Returns:
        Tables in float64 for a float64 model, else in float32, whatever autocast is in force.
    """
    dtype = torch.float64 if like.dtype == torch.float64 else torch.float32
    # The compiler would trace through the cache with a warning, and make the tables all the same.
    build = _build_tables if torch.compiler.is_compiling() else _cached_tables
    return build(grid_height, grid_width, head_dim, dtype, like.device)


def apply_rope(
    x: Float[Tensor, "m t heads dim"], tables: RopeTables
) -> Float[Tensor, "m t heads dim"]:
    """Rotate queries or keys by their positions.

    The channels of a head are four equal runs [uy | vy | ux | vx]; each pair (u, v) turns by its
    angle. Dot products of rotated queries and keys depend on differences of positions alone.

    Args:
        x: Queries or keys.
        tables: Of the same ``t`` tokens and head width.

    Returns:
        Rotated, in the dtype of ``x``; the rotation itself runs in the dtype of the tables.
    """
    runs = x.reshape(*x.shape[:-1], 2, 2, -1)
    # Three passes over memory in all, which is what this costs on a CPU.
    swapped = torch.cat((runs[..., 1, :], runs[..., 0, :]), dim=-1).flatten(-2)
    return torch.addcmul(x * tables.cos, swapped.to(tables.sin.dtype), tables.sin).to(x.dtype)


def _build_tables(
    grid_height: int, grid_width: int, head_dim: int, dtype: torch.dtype, device: torch.device
) -> RopeTables:
    quarter = head_dim // 4
    # Angles are float32 in every model, as in the released ones: a float64 model that made them
    # in float64 would differ from theirs by 1e-7.
    exponent = torch.arange(quarter, device=device, dtype=torch.float32) / quarter
    frequency = 1.0 / BASE**exponent
    rows = torch.arange(grid_height, device=device, dtype=torch.float32)
    columns = torch.arange(grid_width, device=device, dtype=torch.float32)
    positions = torch.cartesian_prod(rows, columns)
    angles = (positions[:, :, None] * frequency).to(dtype)
    cos, sin = angles.cos(), angles.sin()
    return RopeTables(
        cos=torch.stack((cos, cos), dim=-2).flatten(1)[:, None],
        sin=torch.stack((-sin, sin), dim=-2).flatten(1)[:, None],
    )


@lru_cache(maxsize=MAX_CACHED_TABLES)
def _cached_tables(
    grid_height: int, grid_width: int, head_dim: int, dtype: torch.dtype, device: torch.device
) -> RopeTables:
    # A table first made while predicting must serve a later training step: autograd refuses
    # tensors made in inference mode.
    with torch.inference_mode(mode=False):
        return _build_tables(grid_height, grid_width, head_dim, dtype, device)
