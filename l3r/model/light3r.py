"""The network: images of a graph to point maps in one frame."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l3r.config import GraphConfig, ModelConfig
from l3r.errors import ConfigError
from l3r.graph.accumulate import accumulate
from l3r.graph.scores import similarity_scores
from l3r.graph.trees import build_tree
from l3r.model.alignment import CrossBlock, LatentAlignment
from l3r.model.blocks import DecoderBlock, EncoderBlock, at_least_float32
from l3r.model.decoder import PairDecoder
from l3r.model.dpt import DptHead
from l3r.model.encoder import Encoder
from l3r.model.grid import TokenGrid, find_transposed
from l3r.model.heads import build_head, pointmap_from_raw, run_head
from l3r.model.precision import true_float32
from l3r.model.pretrained import Pretrained
from l3r.types import PairPointmaps, Prediction, SceneTree

MAX_VARIANTS = 32
"""How often a kind of block may be compiled."""


@dataclass(frozen=True, kw_only=True)
class EdgePointmaps:
    """The decoder's answer for m edges; parents share one shape, children another."""

    parent_pts3d: Float[Tensor, "m p1 3"]
    """Points of the parent image, in the parent's camera frame."""
    child_pts3d: Float[Tensor, "m p2 3"]
    """Points of the child image, in the parent's camera frame."""
    parent_log_conf: Float[Tensor, "m p1"]
    """Logarithm of the confidence C >= 1."""
    child_log_conf: Float[Tensor, "m p2"]
    """Logarithm of the confidence C >= 1."""


class Light3R(Pretrained):
    """Encode, align latently, connect by a tree, decode its edges, chain them.

    ``forward`` takes a batch of graphs of one image shape; its parts take tokens and shapes, so
    that inference can work through photos of any shapes in chunks.

    Args:
        model: Sizes of the network.
        graph: The tree and the accumulation.
    """

    def __init__(self, model: ModelConfig, graph: GraphConfig) -> None:
        super().__init__()
        self.config = model
        self.graph = graph
        self.encoder = Encoder(model.encoder)
        self.alignment = LatentAlignment(model.alignment, model.encoder.width)
        self.decoder = PairDecoder(model.decoder, model.encoder.width)
        self.parent_head = build_head(model)
        self.child_head = build_head(model)

    def forward(
        self,
        image: Float[Tensor, "b n 3 h w"],
        true_shape: Int[Tensor, "b n 2"],
        scores: Float[Tensor, "b n n"] | None = None,
    ) -> Prediction:
        """Predict the point maps of a batch of graphs.

        The parts may run under autocast; trees, heads and accumulation leave it.

        Args:
            image: RGB in [0, 1], all stored in one shape; sides are multiples of the patch.
            true_shape: (height, width) of each image as it was photographed, on the host: (h, w),
                or (w, h) for one that is stored with its pixel axes swapped.
            scores: Ground-truth overlap of each pair; required by ``graph.algorithm=oracle`` and
                ignored by the others, which compare mean encoder tokens.

        Returns:
            Tree, pairwise and global point maps, pixels in the order they are stored. The world
            is the root's camera.

        Raises:
            ConfigError: The oracle tree is asked for without scores.
            DataError: An image of another shape than the stored one, upright or swapped.
        """
        num_graphs, num_views, _, height, width = image.shape
        transposed = find_transposed(true_shape.flatten(0, 1), height, width)
        tokens = self.encode(image.flatten(0, 1), transposed)
        grid = self.encoder.token_grid(height, width, transposed)
        tokens = tokens.reshape(num_graphs, num_views, *tokens.shape[1:])
        scores, tree = self.connect(tokens.mean(dim=2), scores)
        pairs = self._decode_edges(self.alignment(tokens), tree, grid)
        with true_float32(image.device):
            world = accumulate(pairs, tree, self.graph)
        return Prediction(tree=tree, scores=scores, pairs=pairs, world=world)

    def encode(
        self, image: Float[Tensor, "m 3 h w"], transposed: Bool[Tensor, " m"] | None = None
    ) -> Float[Tensor, "m t d"]:
        """Encode images of one shape, RGB in [0, 1]; see :meth:`Encoder.forward`."""
        tokens: Tensor = self.encoder(image * 2 - 1, transposed)
        return tokens

    def connect(
        self, mean_tokens: Float[Tensor, "b n d"], scores: Float[Tensor, "b n n"] | None
    ) -> tuple[Float[Tensor, "b n n"], SceneTree]:
        """Score all pairs and build the trees; no gradient flows through this choice.

        Args:
            mean_tokens: Mean encoder token of each view.
            scores: See :meth:`forward`.

        Raises:
            ConfigError: The oracle tree is asked for without scores.
        """
        with torch.no_grad(), true_float32(mean_tokens.device):
            if self.graph.algorithm == "oracle":
                if scores is None:
                    raise ConfigError(
                        "graph.algorithm is oracle, which needs ground-truth overlap and found "
                        "none; use spt or mst"
                    )
            else:
                scores = similarity_scores(at_least_float32(mean_tokens))
            return scores, build_tree(scores, self.graph)

    def decode(
        self,
        parent_tokens: Float[Tensor, "m t1 d"],
        child_tokens: Float[Tensor, "m t2 d"],
        parent_grid: TokenGrid,
        child_grid: TokenGrid,
    ) -> EdgePointmaps:
        """Decode m edges to point maps.

        Args:
            parent_tokens: Aligned tokens of the parents.
            child_tokens: Aligned tokens of the children.
            parent_grid: How the parents' tokens lie, from :meth:`Encoder.token_grid`.
            child_grid: How the children's tokens lie.
        """
        hooks = self.parent_head.hooks
        parent, child = self.decoder(
            parent_tokens, child_tokens, parent_grid, child_grid, hooks=hooks
        )
        again = self.decoder.recompute
        parent_raw = run_head(self.parent_head, parent, parent_grid, recompute=again)
        child_raw = run_head(self.child_head, child, child_grid, recompute=again)
        parent_pts3d, parent_log_conf = pointmap_from_raw(parent_raw)
        child_pts3d, child_log_conf = pointmap_from_raw(child_raw)
        return EdgePointmaps(
            parent_pts3d=parent_pts3d,
            child_pts3d=child_pts3d,
            parent_log_conf=parent_log_conf,
            child_log_conf=child_log_conf,
        )

    def recompute_activations(self, *, enabled: bool) -> None:
        """Choose what the backward pass needs: memory for all activations, or a second forward.

        With it, only the input of every transformer block and of every head is kept.
        """
        self.encoder.recompute = enabled
        self.alignment.recompute = enabled
        self.decoder.recompute = enabled

    def compile_blocks(self, **options: Any) -> None:
        """Compile every transformer block and DPT head, in place and with dynamic shapes.

        Blocks of one kind share their code, so that the compiler works once a kind rather than
        once a layer, and shapes are symbols, so that another image shape costs nothing. What is
        left between the blocks is reshaping. A kind is compiled anew for a lone image, for several,
        for each parity of a DPT head's grid, and without gradients: never for a shape as such.

        Args:
            options: Passed to :func:`torch.compile`, such as ``backend``.
        """
        # A DPT head can come in 16 variants (see above); past the limit, compilation fails.
        limits = torch._dynamo.config
        limits.recompile_limit = max(limits.recompile_limit, MAX_VARIANTS)
        for module in self.modules():
            if isinstance(module, EncoderBlock | DecoderBlock | CrossBlock | DptHead):
                module.compile(fullgraph=True, dynamic=True, **options)

    def _decode_edges(
        self, tokens: Float[Tensor, "b n t d"], tree: SceneTree, grid: TokenGrid
    ) -> PairPointmaps:
        """Decode all edges of all graphs in one batch."""
        num_graphs, num_edges = tree.parent.shape
        first = torch.arange(num_graphs)[:, None] * tokens.shape[1]
        parent, child = (first + tree.parent).flatten(), (first + tree.child).flatten()
        flat = tokens.flatten(0, 1)
        edges = self.decode(
            flat[parent.to(flat.device, non_blocking=True)],
            flat[child.to(flat.device, non_blocking=True)],
            grid.select(parent),
            grid.select(child),
        )
        batch = (num_graphs, num_edges, -1)
        return PairPointmaps(
            parent_pts3d=edges.parent_pts3d.reshape(*batch, 3),
            child_pts3d=edges.child_pts3d.reshape(*batch, 3),
            parent_log_conf=edges.parent_log_conf.reshape(batch),
            child_log_conf=edges.child_log_conf.reshape(batch),
        )
