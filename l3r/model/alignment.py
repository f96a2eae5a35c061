"""Latent global alignment: images learn of each other through one token each.

Equations 2 and 3 of the paper. Every image is summarised by its mean token g(0). The summaries of
all images attend to each other L times; the tokens F of an image then read the summaries of each
step in turn. Summaries never read F again, so once they are known the rest is local to an image.
"""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from l3r.config.model import AlignmentConfig
from l3r.model.blocks import (
    CrossAttention,
    EncoderBlock,
    Mlp,
    at_least_float32,
    build_norm,
    run_block,
)


class CrossBlock(nn.Module):
    """Pre-norm cross-attention to summaries, then an MLP with its residual.

    Args:
        width: Token width ``d``.
        num_heads: Attention heads; divides ``width``.
        attention_residual: Whether the attention is added to the tokens or replaces them.
    """

    def __init__(self, width: int, num_heads: int, *, attention_residual: bool) -> None:
        super().__init__()
        self.attention_residual = attention_residual
        self.norm1 = build_norm(width)
        self.norm_y = build_norm(width)
        self.cross_attn = CrossAttention(width, num_heads)
        self.norm2 = build_norm(width)
        self.mlp = Mlp(width)

    def forward(
        self, tokens: Float[Tensor, "b q d"], summaries: Float[Tensor, "b n d"]
    ) -> Float[Tensor, "b q d"]:
        """Update every token from the summaries of its graph; tokens do not see each other."""
        gathered: Tensor = self.cross_attn(self.norm1(tokens), self.norm_y(summaries))
        x = tokens + gathered if self.attention_residual else at_least_float32(gathered)
        out: Tensor = x + self.mlp(self.norm2(x))
        return out


class LatentAlignment(nn.Module):
    """Make the tokens of every image aware of all images of its graph.

    No step compares the tokens of two images, and nothing depends on the order of the images:
    permuting them permutes the output. With ``zero_linear`` a new alignment is the identity, so
    that a pretrained pairwise network gives its own answer before the first training step.

    Args:
        config: Number of blocks L, heads and the form of the last step.
        width: Token width ``d`` of the encoder.
    """

    def __init__(self, config: AlignmentConfig, width: int) -> None:
        super().__init__()
        self.recompute = False
        is_paper = config.output == "paper"
        self.self_blocks = nn.ModuleList(
            EncoderBlock(width, config.num_heads) for _ in range(config.num_blocks)
        )
        self.cross_blocks = nn.ModuleList(
            CrossBlock(width, config.num_heads, attention_residual=not is_paper)
            for _ in range(config.num_blocks)
        )
        self.out: nn.Linear | None = None
        if config.num_blocks and not is_paper:
            self.out = nn.Linear(width, width, bias=False)
            nn.init.zeros_(self.out.weight)

    def forward(self, tokens: Float[Tensor, "b n t d"]) -> Float[Tensor, "b n t d"]:
        """Align all images of every graph at once.

        Args:
            tokens: F(0), the encoder's tokens of n images of equal token count.

        Returns:
            Aligned tokens; the very input where L is 0.
        """
        levels = self.update_summaries(tokens.mean(dim=2))
        return self.align(tokens.flatten(1, 2), levels).reshape(tokens.shape)

    def update_summaries(self, summaries: Float[Tensor, "b n d"]) -> list[Float[Tensor, "b n d"]]:
        """Let the summaries of each graph attend to each other (equation 2).

        Args:
            summaries: g(0), the mean token of every image.

        Returns:
            g(1) .. g(L).
        """
        levels = []
        for block in self.self_blocks:
            summaries = block(summaries)
            levels.append(summaries)
        return levels

    def align(
        self, tokens: Float[Tensor, "b q d"], levels: Sequence[Float[Tensor, "b n d"]]
    ) -> Float[Tensor, "b q d"]:
        """Let tokens read the summaries, level by level (equation 3).

        Args:
            tokens: F(0) of any of the graph's images, concatenated: each token is updated by
                itself, so one image or all of them at once give the same values. Keys and values
                are projected anew in every call: give it several images where there are many.
            levels: What ``update_summaries`` returned for the same graphs.

        Returns:
            F(0) + W F(L), or F(0) + F(L) as the paper prints it; the very input where L is 0.
        """
        if not self.cross_blocks:
            return tokens
        x = tokens
        for block, summaries in zip(self.cross_blocks, levels, strict=True):
            x = run_block(block, x, summaries, recompute=self.recompute)
        update: Tensor = x if self.out is None else self.out(x)
        return tokens + update
