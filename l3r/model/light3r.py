"""The network: images of a graph to point maps in one frame."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from l3r.config import GraphConfig, ModelConfig
from l3r.errors import ConfigError, DataError
from l3r.graph.accumulate import accumulate
from l3r.graph.scores import similarity_scores
from l3r.graph.trees import build_tree
from l3r.model.alignment import LatentAlignment
from l3r.model.decoder import PairDecoder
from l3r.model.encoder import Encoder
from l3r.model.heads import build_head, pointmap_from_raw
from l3r.types import PairPointmaps, Prediction, SceneTree


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


class Light3R(nn.Module):
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

        Args:
            image: RGB in [0, 1]; sides are multiples of the patch.
            true_shape: (height, width) of each image as it was photographed: (h, w) throughout.
            scores: Ground-truth overlap of each pair; required by ``graph.algorithm=oracle`` and
                ignored by the others, which compare mean encoder tokens.

        Returns:
            Tree, pairwise and global point maps. The world is the root's camera.

        Raises:
            ConfigError: The oracle tree is asked for without scores.
            DataError: An image is laid out otherwise than it was photographed.
        """
        _check_upright(true_shape, image.shape[-2], image.shape[-1])
        num_graphs, num_views, _, *size = image.shape
        tokens = self.encode(image.flatten(0, 1))
        tokens = tokens.reshape(num_graphs, num_views, *tokens.shape[1:])
        scores, tree = self.connect(tokens.mean(dim=2), scores)
        aligned = self.alignment(tokens)
        pairs = self._decode_edges(aligned, tree, (size[0], size[1]))
        world = accumulate(pairs, tree, self.graph)
        return Prediction(tree=tree, scores=scores, pairs=pairs, world=world)

    def encode(self, image: Float[Tensor, "m 3 h w"]) -> Float[Tensor, "m t d"]:
        """Encode images of one shape, RGB in [0, 1]."""
        tokens: Tensor = self.encoder(image * 2 - 1)
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
        with torch.no_grad():
            if self.graph.algorithm == "oracle":
                if scores is None:
                    raise ConfigError(
                        "graph.algorithm is oracle, which needs ground-truth overlap and found "
                        "none; use spt or mst"
                    )
            else:
                scores = similarity_scores(mean_tokens)
            return scores, build_tree(scores, self.graph)

    def decode(
        self,
        parent_tokens: Float[Tensor, "m t1 d"],
        child_tokens: Float[Tensor, "m t2 d"],
        parent_size: tuple[int, int],
        child_size: tuple[int, int],
    ) -> EdgePointmaps:
        """Decode m edges to point maps.

        Args:
            parent_tokens: Aligned tokens of the parents.
            child_tokens: Aligned tokens of the children.
            parent_size: (height, width) of the parents' images.
            child_size: (height, width) of the children's images.
        """
        parent_grid = self.encoder.token_grid(*parent_size)
        child_grid = self.encoder.token_grid(*child_size)
        hooks = self.parent_head.hooks
        parent, child = self.decoder(
            parent_tokens, child_tokens, parent_grid, child_grid, hooks=hooks
        )
        parent_pts3d, parent_log_conf = pointmap_from_raw(self.parent_head(parent, parent_grid))
        child_pts3d, child_log_conf = pointmap_from_raw(self.child_head(child, child_grid))
        return EdgePointmaps(
            parent_pts3d=parent_pts3d,
            child_pts3d=child_pts3d,
            parent_log_conf=parent_log_conf,
            child_log_conf=child_log_conf,
        )

    def _decode_edges(
        self, tokens: Float[Tensor, "b n t d"], tree: SceneTree, size: tuple[int, int]
    ) -> PairPointmaps:
        """Decode all edges of all graphs in one batch."""
        num_graphs, num_edges = tree.parent.shape
        graph = torch.arange(num_graphs, device=tokens.device)[:, None]
        parent = tree.parent.to(tokens.device, non_blocking=True)
        child = tree.child.to(tokens.device, non_blocking=True)
        edges = self.decode(
            tokens[graph, parent].flatten(0, 1), tokens[graph, child].flatten(0, 1), size, size
        )
        batch = (num_graphs, num_edges, -1)
        return PairPointmaps(
            parent_pts3d=edges.parent_pts3d.reshape(*batch, 3),
            child_pts3d=edges.child_pts3d.reshape(*batch, 3),
            parent_log_conf=edges.parent_log_conf.reshape(batch),
            child_log_conf=edges.child_log_conf.reshape(batch),
        )


def _check_upright(true_shape: Int[Tensor, "b n 2"], height: int, width: int) -> None:
    """Refuse transposed images, where looking at the values costs no wait for the device."""
    if true_shape.device.type == "cpu":
        other = (true_shape != true_shape.new_tensor([height, width])).any(-1)
        if other.any():
            raise DataError(
                f"an image of true shape {true_shape[other][0].tolist()} (height, width) in a "
                f"batch of {[height, width]}; expected images in their own orientation"
            )
