"""Batches with ground truth, and predictions of any quality."""

import torch

from l3r.config import GraphConfig
from l3r.graph.accumulate import accumulate
from l3r.graph.trees import build_tree
from l3r.loss.targets import build_targets
from l3r.types import PairPointmaps, Prediction, Views
from tests.geometry.scenes import generator, random_K, random_rigid
from tests.graph.scenes import random_scores

HEIGHT, WIDTH = 12, 16


def random_views(
    seed, height=HEIGHT, width=WIDTH, *, num_graphs=2, num_views=4, metric=True, invalid=0.2
):
    draw = generator(seed)
    shape = (num_graphs, num_views, height, width)
    depth = 1 + 3 * torch.rand(shape, generator=draw, dtype=torch.float64)
    valid = torch.rand(shape, generator=draw) > invalid
    return Views(
        image=torch.rand((num_graphs, num_views, 3, height, width), generator=draw),
        true_shape=torch.tensor([height, width]).expand(num_graphs, num_views, 2),
        K=random_K(num_graphs, num_views, draw=draw, width=width, height=height),
        world_from_cam=random_rigid(num_graphs, num_views, draw=draw),
        depth=torch.where(valid, depth, torch.zeros_like(depth)),
        valid=valid,
        is_metric=torch.full((num_graphs,), metric),
        dataset=["random"] * num_graphs,
        scores=random_scores(seed, num_graphs, num_views),
        key=[f"graph{i}" for i in range(num_graphs)],
    )


def perfect_prediction(views, config=None, log_conf=0.5):
    """What a flawless network would say, in metres."""
    config = config or GraphConfig()
    tree = build_tree(views.scores, config)
    target, _ = build_targets(views, tree)
    confidence = torch.full(target.parent_pts3d.shape[:-1], log_conf, dtype=torch.float64)
    pairs = PairPointmaps(
        parent_pts3d=target.parent_pts3d,
        child_pts3d=target.child_pts3d,
        parent_log_conf=confidence,
        child_log_conf=confidence.clone(),
    )
    return predict(pairs, tree, views.scores, config)


def predict(pairs, tree, scores, config=None):
    world = accumulate(pairs, tree, config or GraphConfig())
    return Prediction(tree=tree, scores=scores, pairs=pairs, world=world)
