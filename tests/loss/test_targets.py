"""Ground truth does not depend on how images lie in memory."""

import dataclasses

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from l3r.config import GraphConfig
from l3r.geometry.camera import transpose_K
from l3r.graph.trees import build_tree
from l3r.loss.targets import build_targets
from tests.geometry.scenes import generator
from tests.loss.scenes import HEIGHT, random_views


def square_views(seed):
    """Square, so that any of the views can be transposed among others."""
    views = random_views(seed)
    side = slice(0, HEIGHT)
    return dataclasses.replace(
        views,
        image=views.image[..., side],
        depth=views.depth[..., side],
        valid=views.valid[..., side],
        true_shape=torch.full_like(views.true_shape, HEIGHT),
    )


def transpose_some(views, chosen):
    """Lay the chosen views out with pixel axes swapped."""

    def swap(pixels):
        return torch.where(chosen.reshape(*chosen.shape, 1, 1), pixels.mT, pixels)

    return dataclasses.replace(
        views,
        depth=swap(views.depth),
        valid=swap(views.valid),
        K=torch.where(chosen[..., None, None], transpose_K(views.K), views.K),
    )


def swap_back(pixels, chosen):
    """Undo the layout for flattened pixels of the chosen maps."""
    grid = pixels.unflatten(2, (HEIGHT, HEIGHT))
    keep = chosen.reshape(*chosen.shape, *[1] * (grid.ndim - 2))
    return torch.where(keep, grid.transpose(2, 3), grid).flatten(2, 3)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_targets_of_transposed_views_are_those_of_upright_ones_transposed(seed):
    views = square_views(seed)
    chosen = torch.rand(views.depth.shape[:2], generator=generator(seed)) < 0.5
    tree = build_tree(views.scores, GraphConfig())
    pairs, world = build_targets(views, tree)
    turned = transpose_some(views, chosen)
    turned_pairs, turned_world = build_targets(turned, tree)
    of_parent, of_child = chosen.gather(1, tree.parent), chosen.gather(1, tree.child)
    for found, expected, which in (
        (turned_pairs.parent_pts3d, pairs.parent_pts3d, of_parent),
        (turned_pairs.child_pts3d, pairs.child_pts3d, of_child),
        (turned_world.pts3d_world, world.pts3d_world, chosen),
    ):
        torch.testing.assert_close(swap_back(found, which), expected, rtol=1e-9, atol=1e-9)
    graph = torch.arange(len(tree.parent))[:, None]
    own_depth = turned.depth.flatten(-2)[graph, tree.parent]
    torch.testing.assert_close(turned_pairs.parent_pts3d[..., 2], own_depth)
    assert torch.equal(swap_back(turned_pairs.parent_valid, of_parent), pairs.parent_valid)
    assert torch.equal(swap_back(turned_pairs.child_valid, of_child), pairs.child_valid)
    assert torch.equal(swap_back(turned_world.valid, chosen), world.valid)
