"""Trees, and exact point maps that chain along them."""

import torch

from l3r.config import GraphConfig
from l3r.geometry.rigid import invert_rigid, transform_points
from l3r.graph.trees import build_tree
from l3r.types import PairPointmaps
from tests.geometry.scenes import generator, random_rigid


def random_scores(seed, num_graphs=2, num_views=6):
    scores = torch.rand(num_graphs, num_views, num_views, generator=generator(seed)).double()
    scores = (scores + scores.transpose(1, 2)) / 2
    view = torch.arange(num_views)
    scores[:, view, view] = 1
    return scores


def exact_scene(seed, num_graphs=2, num_views=6, num_pixels=20, config=None):
    """Random cameras that all see points of their own, and the true maps of every edge."""
    draw = generator(seed)
    config = config or GraphConfig()
    tree = build_tree(random_scores(seed, num_graphs, num_views), config)
    cam_from_world = random_rigid(num_graphs, num_views, draw=draw)
    shape = (num_graphs, num_views, num_pixels, 3)
    pts3d_world = 4 * torch.randn(shape, generator=draw, dtype=torch.float64)
    graph = torch.arange(num_graphs)[:, None]
    parent_from_world = cam_from_world[graph, tree.parent]
    confs = torch.rand(2, num_graphs, num_views - 1, num_pixels, generator=draw).double() + 0.1
    pairs = PairPointmaps(
        parent_pts3d=transform_points(parent_from_world, pts3d_world[graph, tree.parent]),
        child_pts3d=transform_points(parent_from_world, pts3d_world[graph, tree.child]),
        parent_log_conf=confs[0],
        child_log_conf=confs[1],
    )
    root_from_world = cam_from_world[torch.arange(num_graphs), tree.root]
    in_root = transform_points(root_from_world[:, None], pts3d_world)
    return tree, pairs, in_root, cam_from_world @ invert_rigid(root_from_world)[:, None]


def noisy(pairs, seed, strength=0.3):
    draw = generator(seed)

    def disturb(points):
        return points + strength * torch.randn(points.shape, generator=draw, dtype=points.dtype)

    return PairPointmaps(
        parent_pts3d=disturb(pairs.parent_pts3d),
        child_pts3d=disturb(pairs.child_pts3d),
        parent_log_conf=pairs.parent_log_conf,
        child_log_conf=pairs.child_log_conf,
    )
