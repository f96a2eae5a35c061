"""The pairwise decoder: two streams of tokens that read each other."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from l3r.config.model import DecoderConfig
from l3r.model.blocks import DecoderBlock, at_least_float32, build_linear, build_norm, run_block
from l3r.model.grid import TokenGrid


class PairDecoder(nn.Module):
    """Decode the two images of an edge together.

    The parent's stream and the child's have blocks of their own, since both are to describe points
    in the parent's frame; they share the embedding and the final norm.

    Args:
        config: Sizes.
        encoder_width: Width of the tokens that come in.
    """

    def __init__(self, config: DecoderConfig, encoder_width: int) -> None:
        super().__init__()
        self.depth = config.depth
        self.head_dim = config.width // config.num_heads
        self.recompute = False
        self.embed = build_linear(encoder_width, config.width)
        self.parent_blocks = nn.ModuleList(
            DecoderBlock(config.width, config.num_heads) for _ in range(config.depth)
        )
        self.child_blocks = nn.ModuleList(
            DecoderBlock(config.width, config.num_heads) for _ in range(config.depth)
        )
        self.norm = build_norm(config.width)

    def forward(
        self,
        parent_tokens: Float[Tensor, "m t1 d"],
        child_tokens: Float[Tensor, "m t2 d"],
        parent_grid: TokenGrid,
        child_grid: TokenGrid,
        *,
        hooks: Sequence[int] = (-1,),
    ) -> tuple[list[Float[Tensor, "m t1 _"]], list[Float[Tensor, "m t2 _"]]]:
        """Decode edges whose parents share one token count and whose children share one.

        Args:
            parent_tokens: Of the parent image of each edge.
            child_tokens: Of the child image of each edge.
            parent_grid: How the parents' tokens lie.
            child_grid: How the children's tokens lie.
            hooks: Which entries of [tokens that came in, after block 1, .., after block depth] to
                keep, as indices into that list; negative ones count from its end. The last entry
                is normalised, the others are not.

        Returns:
            The entries of the parent's stream and those of the child's, in the order of ``hooks``.
        """
        # The sums that all blocks add to stay in float32 under autocast.
        parent = at_least_float32(self.embed(parent_tokens))
        child = at_least_float32(self.embed(child_tokens))
        parent_rope = parent_grid.rope(self.head_dim, parent)
        child_rope = child_grid.rope(self.head_dim, child)
        wanted = [range(self.depth + 1)[hook] for hook in hooks]
        kept = {0: (parent_tokens, child_tokens)}
        again = self.recompute
        blocks = zip(self.parent_blocks, self.child_blocks, strict=True)
        for index, (parent_block, child_block) in enumerate(blocks, start=1):
            # One statement, so that both streams read what the other was before this step.
            parent, child = (
                run_block(parent_block, parent, child, parent_rope, child_rope, recompute=again),
                run_block(child_block, child, parent, child_rope, parent_rope, recompute=again),
            )
            if index in wanted:
                kept[index] = (parent, child)
        if self.depth in kept:
            kept[self.depth] = (self.norm(parent), self.norm(child))
        return [kept[index][0] for index in wanted], [kept[index][1] for index in wanted]
