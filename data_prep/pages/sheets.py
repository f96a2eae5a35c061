"""One graph at a glance: its images in greedy order, their depth, its tree."""

import shlex
from dataclasses import dataclass
from pathlib import Path

import torch

from data_prep.check.tars import StoredGraph
from data_prep.pages.pictures import DepthScale, Picture, depth_picture, image_picture
from data_prep.pages.tree_plan import TreePlan, draw_tree
from data_prep.surfaces import is_scattered
from l3r.data.schema import GraphSample

THUMBNAIL = 200
"""Long side of a picture of a contact sheet [px]."""


@dataclass(frozen=True, kw_only=True)
class ViewCard:
    """One image of a graph."""

    view: int
    """Its number in greedy order."""
    file: str
    image: Picture
    depth: Picture
    size: str
    """Stored size: width x height."""
    known: float
    """Share of its pixels whose depth is known."""
    is_root: bool


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """One graph ready for a page."""

    name: str
    """``shard.tar:key``."""
    dataset: str
    scene: str
    command: str
    """What shows it larger."""
    scale: DepthScale | None
    """What the colours of depth span; None where nothing is known."""
    is_scattered: bool
    """Whether depth is drawn as dots over the image."""
    tree: TreePlan | None
    """None for a single image."""
    views: list[ViewCard]


def draw_sheet(stored: StoredGraph, sample: GraphSample, long_side: int = THUMBNAIL) -> Sheet:
    """Draw a graph.

    Args:
        stored: Where it lies.
        sample: The whole graph.
        long_side: Of its pictures [px].
    """
    tree = draw_tree(sample.pairs.iou) if sample.num_views > 1 else None
    root = 0 if tree is None else next(node.view for node in tree.nodes if node.is_root)
    known = any((depth > 0).any() for depth in sample.depth)
    scale = DepthScale.of(sample.depth, is_metric=sample.is_metric) if known else None
    return Sheet(
        name=f"{stored.shard.name}:{stored.entry.key}",
        dataset=sample.dataset,
        scene=sample.scene,
        command=show_command(stored.shard.parent, stored.entry.key),
        scale=scale,
        is_scattered=any(is_scattered(torch.from_numpy(depth)) for depth in sample.depth),
        tree=tree,
        views=[
            ViewCard(
                view=view,
                file=sample.file[view],
                image=image_picture(sample.image[view], long_side),
                depth=depth_picture(
                    sample.depth[view],
                    sample.image[view],
                    scale or DepthScale(low=1.0, high=10.0, unit=""),
                    long_side,
                ),
                size="{1} x {0}".format(*sample.image_size[view]),
                known=float((sample.depth[view] > 0).mean()),
                is_root=view == root,
            )
            for view in range(sample.num_views)
        ],
    )


def show_command(folder: Path, key: str) -> str:
    """Give the command line that shows a graph larger."""
    return shlex.join(["l3r-prep", "show", str(folder), key])
