"""The types that flow between rooms.

Dimension letters used in every annotation:

    b  graphs in a batch        h w  pixels of an image
    n  views of a graph         p    pixels of an image, flattened row by row
    e  edges of a tree (n - 1)  t    tokens of an image
    m  any flat number of items d    width of a token

Point maps are kept with their pixels flattened: fits, losses and accumulation treat pixels as a
set, and images of different shapes stack by padding with points at zero of log-confidence zero,
which carry no weight anywhere.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(kw_only=True)
class Views:
    """A training batch: graphs of views with ground truth, images of one shape.

    Not frozen, because lightning's device transfer writes the fields.
    """

    image: Float[Tensor, "b n 3 h w"]
    """RGB in [0, 1]."""
    true_shape: Int[Tensor, "b n 2"]
    """(height, width) of each image as it was photographed: that of ``image``, or swapped where the
    image is stored with its pixel axes swapped. Stays on the host, where shapes are decided."""
    K: Float[Tensor, "b n 3 3"]
    """Intrinsics in pixels of ``image``; centre of the top-left pixel at (0.5, 0.5)."""
    world_from_cam: Float[Tensor, "b n 4 4"]
    """The world is the camera of the graph's first image; metres where ``is_metric``."""
    depth: Float[Tensor, "b n h w"]
    """z in the camera, 0 where not ``valid``."""
    valid: Bool[Tensor, "b n h w"]
    """Pixels whose depth is known."""
    is_metric: Bool[Tensor, " b"]
    """Whether lengths are metres."""
    dataset: list[str]
    """Name of the data set of each graph."""
    scores: Float[Tensor, "b n n"]
    """Ground-truth overlap (IoU) of each pair, for the oracle tree; 1 on the diagonal."""
    key: list[str]
    """Shard and sample key of each graph, for error messages."""

    def pin_memory(self) -> "Views":
        """Pin every tensor; torch's loader passes a plain dataclass through unpinned otherwise."""
        return self._map(lambda tensor: tensor.pin_memory())

    def to(self, device: torch.device | str) -> "Views":
        """Move every tensor but ``true_shape``; from pinned memory without waiting."""
        moved = self._map(lambda tensor: tensor.to(device, non_blocking=tensor.is_pinned()))
        return replace(moved, true_shape=self.true_shape)

    def _map(self, function: Callable[[Tensor], Tensor]) -> "Views":
        changed: dict[str, Any] = {
            f.name: function(value)
            for f in fields(self)
            if isinstance(value := getattr(self, f.name), Tensor)
        }
        return replace(self, **changed)


class Window(NamedTuple):
    """A rectangle of an image, in the image's pixels; its sides may fall between pixels."""

    left: float
    top: float
    width: float
    height: float

    @classmethod
    def whole(cls, height: int, width: int) -> "Window":
        """The window that is all of an image."""
        return cls(left=0.0, top=0.0, width=float(width), height=float(height))


@dataclass(frozen=True, kw_only=True)
class Photos:
    """Photos of any shapes, in their own orientation and in the user's order."""

    image: list[Float[Tensor, "3 _h _w"]]
    """RGB in [0, 1], what the network sees; sides are multiples of the model's patch."""
    original_size: list[tuple[int, int]]
    """(height, width) of each photo, upright, before scaling and cropping."""
    window: list[Window]
    """The part of each photo that ``image`` shows, in pixels of the photo."""
    file: list[str]
    """Name of each photo, relative to the folder it was read from."""

    @property
    def network_size(self) -> list[tuple[int, int]]:
        """(height, width) of each ``image``."""
        return [(image.shape[1], image.shape[2]) for image in self.image]


@dataclass(frozen=True, kw_only=True)
class SceneTree:
    """Rooted spanning trees, one per graph of a batch; all tensors live on the host.

    Edges stand in breadth-first order, children of one parent by ascending cost, ties by index.
    So edge 0 is the root's cheapest edge: the "first edge", which sets the root's own map.
    """

    root: Int[Tensor, " b"]
    """View at the root."""
    parent: Int[Tensor, "b e"]
    """View nearer the root."""
    child: Int[Tensor, "b e"]
    """View farther from the root; every view but the root is the child of exactly one edge."""
    level: Int[Tensor, "b e"]
    """1 for edges at the root; never decreases along e."""
    parent_edge: Int[Tensor, "b e"]
    """The edge whose child is this edge's parent; -1 at the root."""
    cost: Float[Tensor, "b e"]
    """Cost of the edge, float64."""

    @property
    def num_edges(self) -> int:
        """Edges of each tree."""
        return self.parent.shape[1]

    @property
    def num_levels(self) -> int:
        """Depth of the deepest tree of the batch."""
        return int(self.level.max()) if self.level.numel() else 0


@dataclass(frozen=True, kw_only=True)
class PairPointmaps:
    """What the decoder says of every edge; both maps are in the PARENT's camera frame."""

    parent_pts3d: Float[Tensor, "b e p 3"]
    """Points seen by the parent image."""
    child_pts3d: Float[Tensor, "b e p 3"]
    """Points seen by the child image, in the parent's camera frame."""
    parent_log_conf: Float[Tensor, "b e p"]
    """Logarithm of the confidence C >= 1 of ``parent_pts3d``."""
    child_log_conf: Float[Tensor, "b e p"]
    """Logarithm of the confidence C >= 1 of ``child_pts3d``."""


@dataclass(frozen=True, kw_only=True)
class WorldPointmaps:
    """Every view's points in one frame, the root camera's."""

    pts3d_world: Float[Tensor, "b n p 3"]
    """Points seen by each view."""
    log_conf: Float[Tensor, "b n p"]
    """Logarithm of their confidence."""
    residual: Float[Tensor, "b e"]
    """Weighted root mean square distance left by each edge's fit; 0 for the first edge."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """All a training step needs of the model's answer."""

    tree: SceneTree
    scores: Float[Tensor, "b n n"]
    """Cosine similarity of the views' mean encoder tokens, or the scores given."""
    pairs: PairPointmaps
    world: WorldPointmaps


@dataclass(frozen=True, kw_only=True)
class Cameras:
    """Cameras of named images, in pixels of the images at their own size."""

    file: list[str]
    """Image names."""
    image_size: list[tuple[int, int]]
    """(height, width)."""
    K: Float[Tensor, "n 3 3"]
    """Intrinsics, float64; centre of the top-left pixel at (0.5, 0.5)."""
    cam_from_world: Float[Tensor, "n 4 4"]
    """Rigid transforms, float64; NaN where not ``registered``."""
    registered: Bool[Tensor, " n"]
    """Whether the camera could be found."""
    component: Int[Tensor, " n"]
    """Number of the connected part of the scene each image belongs to, 0 the root's."""


@dataclass(frozen=True, kw_only=True)
class Reconstruction:
    """A finished reconstruction."""

    cameras: Cameras
    image: list[Float[Tensor, "3 _h _w"]]
    """The photos as the network saw them."""
    window: list[Window]
    """The part of each photo that the network saw, in pixels of the photo at its own size."""
    pts3d_world: list[Float[Tensor, "_h _w 3"]]
    """Dense points of each image, in the root camera's frame."""
    conf: list[Float[Tensor, "_h _w"]]
    """Confidence C >= 1 of each point."""
    tree: SceneTree
    """The tree, a batch of one."""
    scores: Float[Tensor, "n n"]
    """Similarity of the images."""
    residual: Float[Tensor, " e"]
    """What each edge's fit left, in units of the reconstruction."""
    point_rule: list[str]
    """How each image's points were chosen for PnP: ``threshold``, ``quantile`` or ``none``."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of every stage."""
    peak_mib: dict[str, float] = field(default_factory=dict)
    """Peak memory of every stage: the accelerator's where there is one, else the process's."""

    @property
    def cam_from_world(self) -> Float[Tensor, "n 4 4"]:
        """Cameras' rigid transforms; NaN where not registered."""
        return self.cameras.cam_from_world
