"""Transformer layers: attention, MLP and the pre-norm blocks made of them."""

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from l3r.model.rope import RopeTables, apply_rope

MLP_RATIO = 4
NORM_EPS = 1e-6


def build_linear(in_width: int, out_width: int) -> nn.Linear:
    """Build a linear layer with Xavier-uniform weights and zero bias."""
    linear = nn.Linear(in_width, out_width)
    nn.init.xavier_uniform_(linear.weight)
    nn.init.zeros_(linear.bias)
    return linear


def build_norm(width: int) -> nn.LayerNorm:
    """Build the network's layer norm (epsilon 1e-6)."""
    return nn.LayerNorm(width, eps=NORM_EPS)


class Mlp(nn.Module):
    """Two linear layers with the exact (erf) GELU between, four times as wide inside.

    Args:
        width: Token width ``d``.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1 = build_linear(width, MLP_RATIO * width)
        self.fc2 = build_linear(MLP_RATIO * width, width)

    def forward(self, x: Float[Tensor, "m t d"]) -> Float[Tensor, "m t d"]:
        """Map every token by itself."""
        out: Tensor = self.fc2(F.gelu(self.fc1(x)))
        return out


class SelfAttention(nn.Module):
    """Multi-head attention of a set of tokens to itself.

    Args:
        width: Token width ``d``.
        num_heads: Attention heads; divides ``width``.
    """

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.qkv = build_linear(width, 3 * width)
        self.proj = build_linear(width, width)

    def forward(
        self, x: Float[Tensor, "m t d"], rope: RopeTables | None = None
    ) -> Float[Tensor, "m t d"]:
        """Attend.

        Args:
            x: Tokens.
            rope: Rotations of queries and keys; None where tokens have no position, and then
                permuting them permutes the output.

        Returns:
            What each token gathered, without a residual.
        """
        width = x.shape[-1]
        qkv = self.qkv(x)
        # Queries and keys turn by the same angles: in one go.
        qk = rotate(split_heads(qkv[..., : 2 * width], 2 * self.num_heads), rope)
        q, k = qk.chunk(2, dim=2)
        v = split_heads(qkv[..., 2 * width :], self.num_heads)
        out: Tensor = self.proj(attend(q, k, v))
        return out


class CrossAttention(nn.Module):
    """Multi-head attention of queries to the tokens of a memory.

    Args:
        width: Token width ``d`` of both.
        num_heads: Attention heads; divides ``width``.
    """

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.projq = build_linear(width, width)
        self.projk = build_linear(width, width)
        self.projv = build_linear(width, width)
        self.proj = build_linear(width, width)

    def forward(
        self,
        query: Float[Tensor, "m q d"],
        memory: Float[Tensor, "m k d"],
        rope_query: RopeTables | None = None,
        rope_memory: RopeTables | None = None,
    ) -> Float[Tensor, "m q d"]:
        """Attend.

        Args:
            query: Tokens that ask.
            memory: Tokens that answer.
            rope_query: Rotations of the queries, by their own positions.
            rope_memory: Rotations of the keys, by the memory's positions.

        Returns:
            What each query gathered, without a residual.
        """
        q = rotate(split_heads(self.projq(query), self.num_heads), rope_query)
        k = rotate(split_heads(self.projk(memory), self.num_heads), rope_memory)
        v = split_heads(self.projv(memory), self.num_heads)
        out: Tensor = self.proj(attend(q, k, v))
        return out


class EncoderBlock(nn.Module):
    """Pre-norm self-attention and MLP, each with its residual.

    Args:
        width: Token width ``d``.
        num_heads: Attention heads; divides ``width``.
    """

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.norm1 = build_norm(width)
        self.attn = SelfAttention(width, num_heads)
        self.norm2 = build_norm(width)
        self.mlp = Mlp(width)

    def forward(
        self, x: Float[Tensor, "m t d"], rope: RopeTables | None = None
    ) -> Float[Tensor, "m t d"]:
        """Update the tokens; ``rope`` as in :class:`SelfAttention`."""
        x = x + self.attn(self.norm1(x), rope)
        out: Tensor = x + self.mlp(self.norm2(x))
        return out


class DecoderBlock(nn.Module):
    """Pre-norm self-attention, cross-attention to the other stream, and MLP, with residuals.

    Args:
        width: Token width ``d`` of both streams.
        num_heads: Attention heads; divides ``width``.
    """

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.norm1 = build_norm(width)
        self.attn = SelfAttention(width, num_heads)
        self.norm2 = build_norm(width)
        self.norm_y = build_norm(width)
        self.cross_attn = CrossAttention(width, num_heads)
        self.norm3 = build_norm(width)
        self.mlp = Mlp(width)

    def forward(
        self,
        x: Float[Tensor, "m t1 d"],
        memory: Float[Tensor, "m t2 d"],
        rope_x: RopeTables,
        rope_memory: RopeTables,
    ) -> Float[Tensor, "m t1 d"]:
        """Update the tokens of one stream.

        Args:
            x: The stream's tokens.
            memory: The other stream's tokens, not normalised.
            rope_x: Rotations of the stream's positions.
            rope_memory: Rotations of the other stream's positions.

        Returns:
            The stream's new tokens; the memory is only read.
        """
        x = x + self.attn(self.norm1(x), rope_x)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(memory), rope_x, rope_memory)
        out: Tensor = x + self.mlp(self.norm3(x))
        return out


def split_heads(x: Float[Tensor, "m t d"], num_heads: int) -> Float[Tensor, "m t heads dim"]:
    """Split channels into heads; head i is the i-th run of channels."""
    return x.reshape(*x.shape[:2], num_heads, -1)


def rotate(
    x: Float[Tensor, "m t heads dim"], rope: RopeTables | None
) -> Float[Tensor, "m t heads dim"]:
    """Apply RoPE where the tokens have positions."""
    return x if rope is None else apply_rope(x, rope)


def attend(
    q: Float[Tensor, "m q heads dim"],
    k: Float[Tensor, "m k heads dim"],
    v: Float[Tensor, "m k heads dim"],
) -> Float[Tensor, "m q d"]:
    """Softmax attention, scaled by the root of the head width; heads concatenated."""
    q, k, v = (x.transpose(1, 2) for x in (q, k, v))
    return F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)


def run_block(block: nn.Module, *inputs: Any, recompute: bool) -> Any:
    """Run a block; with ``recompute`` its activations are not kept for the backward pass.

    The backward pass then computes the block again: memory for one more forward pass.
    """
    if recompute and torch.is_grad_enabled():
        # Nothing in a block draws random numbers.
        return checkpoint(block, *inputs, use_reentrant=False, preserve_rng_state=False)
    return block(*inputs)


def at_least_float32(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Raise half precision to float32; float64 stays."""
    return x if x.dtype == torch.float64 else x.float()
