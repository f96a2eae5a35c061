import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from l3r.config import GraphConfig
from l3r.geometry.similarity import Similarity, fit_residual, fit_similarity
from l3r.graph.accumulate import accumulate, compose_along_tree
from l3r.types import PairPointmaps, SceneTree
from tests.geometry.scenes import generator, random_rotation
from tests.graph.scenes import exact_scene, noisy

SEEDS = st.integers(0, 2**32 - 1)
SIZES = st.integers(2, 9)
CONFIGS = st.builds(
    GraphConfig,
    algorithm=st.sampled_from(["spt", "mst", "oracle"]),
    confidence=st.sampled_from(["symmetric", "running"]),
    with_scale=st.booleans(),
)


def accumulate_edge_by_edge(pairs, tree, config, order=None):
    """The definition, read aloud: one graph, one edge at a time, in the world frame."""
    root, num_edges = int(tree.root[0]), tree.num_edges
    parent, child = tree.parent[0].tolist(), tree.child[0].tolist()
    points = {root: pairs.parent_pts3d[0, 0], child[0]: pairs.child_pts3d[0, 0]}
    arrived = {root: pairs.parent_log_conf[0, 0], child[0]: pairs.child_log_conf[0, 0]}
    seen = {view: [log_conf] for view, log_conf in arrived.items()}
    running = dict(arrived)
    residual = torch.zeros(num_edges, dtype=pairs.parent_pts3d.dtype)
    for edge in order or range(1, num_edges):
        k, new = parent[edge], child[edge]
        own = pairs.parent_log_conf[0, edge]
        running[k] = (running[k] + own) / 2
        weights = (arrived[k] + own) / 2 if config.confidence == "symmetric" else running[k]
        fit = fit_similarity(
            points[k], pairs.parent_pts3d[0, edge], weights, with_scale=config.with_scale
        )
        residual[edge] = fit_residual(fit, points[k], pairs.parent_pts3d[0, edge], weights)
        points[new] = fit.transform(pairs.child_pts3d[0, edge])
        arrived[new] = running[new] = pairs.child_log_conf[0, edge]
        seen[k].append(own)
        seen[new] = [arrived[new]]
    final = running
    if config.confidence == "symmetric":
        final = {view: torch.stack(values).mean(0) for view, values in seen.items()}
    views = range(num_edges + 1)
    stacked = [torch.stack([table[view] for view in views]) for table in (points, final)]
    return *stacked, residual


def one_graph(pairs, tree, graph):
    rows = slice(graph, graph + 1)
    cut = PairPointmaps(**{name: value[rows] for name, value in vars(pairs).items()})
    return cut, SceneTree(**{name: value[rows] for name, value in vars(tree).items()})


@settings(max_examples=30)
@given(SEEDS, SIZES, CONFIGS)
def test_batched_accumulation_equals_the_edge_by_edge_definition(seed, num_views, config):
    tree, pairs, _, _ = exact_scene(seed, 3, num_views, config=config)
    pairs = noisy(pairs, seed)
    world = accumulate(pairs, tree, config)
    for graph in range(3):
        points, log_conf, residual = accumulate_edge_by_edge(*one_graph(pairs, tree, graph), config)
        torch.testing.assert_close(world.pts3d_world[graph], points, rtol=1e-8, atol=1e-8)
        torch.testing.assert_close(world.log_conf[graph], log_conf)
        # A scale in a chain stretches what is left further down.
        if not config.with_scale:
            torch.testing.assert_close(world.residual[graph], residual, rtol=1e-7, atol=1e-7)


@settings(max_examples=15)
@given(SEEDS, st.booleans())
def test_gradients_equal_those_of_the_edge_by_edge_definition(seed, with_scale):
    config = GraphConfig(algorithm="mst", with_scale=with_scale)
    tree, pairs, _, _ = exact_scene(seed, 1, 6, config=config)
    pairs = noisy(pairs, seed)
    leaves = [value.requires_grad_() for value in vars(pairs).values()]
    upstream = torch.randn(1, 6, 20, 3, generator=generator(seed), dtype=torch.float64)
    world = accumulate(pairs, tree, config)
    points, log_conf, _ = accumulate_edge_by_edge(pairs, tree, config)
    batched = (world.pts3d_world * upstream).sum() + world.log_conf.square().sum()
    naive = (points * upstream[0]).sum() + log_conf.square().sum()
    for ours, theirs in zip(
        torch.autograd.grad(batched, leaves), torch.autograd.grad(naive, leaves), strict=True
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-7, atol=1e-8)


@given(SEEDS, SIZES, CONFIGS)
def test_exact_maps_of_any_tree_give_back_the_exact_world(seed, num_views, config):
    tree, pairs, in_root, _ = exact_scene(seed, 2, num_views, config=config)
    world = accumulate(pairs, tree, config)
    torch.testing.assert_close(world.pts3d_world, in_root, rtol=1e-7, atol=1e-7)
    assert float(world.residual.max()) < 1e-6


@settings(max_examples=20)
@given(SEEDS)
def test_any_topological_order_gives_the_same_answer(seed):
    config = GraphConfig(algorithm="mst")
    tree, pairs, _, _ = exact_scene(seed, 1, 8, config=config)
    pairs = noisy(pairs, seed)
    # Depth first, last child first.
    order, stack = [], [-1]
    while stack:
        above = stack.pop()
        order.append(above)
        stack += [e for e in range(7) if int(tree.parent_edge[0, e]) == above]
    order = [edge for edge in order if edge > 0]
    points, log_conf, _ = accumulate_edge_by_edge(pairs, tree, config, order)
    world = accumulate(pairs, tree, config)
    torch.testing.assert_close(world.pts3d_world[0], points, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(world.log_conf[0], log_conf)


def test_padded_pixels_change_nothing():
    config = GraphConfig()
    tree, pairs, _, _ = exact_scene(5, 2, 6)
    pairs = noisy(pairs, 5)
    pad = torch.nn.functional.pad
    padded = PairPointmaps(
        parent_pts3d=pad(pairs.parent_pts3d, (0, 0, 0, 7)),
        child_pts3d=pad(pairs.child_pts3d, (0, 0, 0, 7)),
        parent_log_conf=pad(pairs.parent_log_conf, (0, 7)),
        child_log_conf=pad(pairs.child_log_conf, (0, 7)),
    )
    world, expected = accumulate(padded, tree, config), accumulate(pairs, tree, config)
    torch.testing.assert_close(world.pts3d_world[:, :, :20], expected.pts3d_world)


def test_two_views_need_no_fit():
    tree, pairs, in_root, _ = exact_scene(1, 2, 2)
    world = accumulate(pairs, tree, GraphConfig())
    torch.testing.assert_close(world.pts3d_world, in_root)
    assert world.residual.tolist() == [[0], [0]]


def test_running_confidence_forgets_by_halves():
    """A star of three edges: the root's confidence ends at a/4 + b/4 + c/2."""
    one = torch.ones(1, 3, 1, dtype=torch.float64)
    points = torch.zeros(1, 3, 1, 3, dtype=torch.float64)
    tree = SceneTree(
        root=torch.tensor([0]),
        parent=torch.tensor([[0, 0, 0]]),
        child=torch.tensor([[1, 2, 3]]),
        level=torch.tensor([[1, 1, 1]]),
        parent_edge=torch.tensor([[-1, -1, -1]]),
        cost=torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64),
    )
    pairs = PairPointmaps(
        parent_pts3d=points,
        child_pts3d=points,
        parent_log_conf=torch.tensor([[[4.0], [8.0], [16.0]]], dtype=torch.float64),
        child_log_conf=one,
    )
    running = accumulate(pairs, tree, GraphConfig(confidence="running"))
    assert running.log_conf[0, :, 0].tolist() == [4 / 4 + 8 / 4 + 16 / 2, 1, 1, 1]
    symmetric = accumulate(pairs, tree, GraphConfig())
    assert symmetric.log_conf[0, 0, 0] == pytest.approx((4 + 8 + 16) / 3)


def test_composition_multiplies_down_a_chain():
    draw = generator(2)
    shape = (1, 4)
    steps = Similarity(
        torch.rand(shape, generator=draw, dtype=torch.float64) + 0.5,
        random_rotation(*shape, draw=draw),
        torch.randn((*shape, 3), generator=draw, dtype=torch.float64),
    )
    chain = compose_along_tree(
        steps, torch.tensor([[-1, 0, 1, 2]]), torch.tensor([[1, 2, 3, 4]]), 4
    )

    def pick(similarity, edge):
        return Similarity(similarity.scale[:, edge], similarity.R[:, edge], similarity.t[:, edge])

    expected = pick(steps, 0)
    for edge in range(1, 4):
        expected = expected.compose(pick(steps, edge))
    torch.testing.assert_close(pick(chain, 3).R, expected.R)
    torch.testing.assert_close(pick(chain, 3).t, expected.t)
