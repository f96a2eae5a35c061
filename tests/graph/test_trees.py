import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree, shortest_path

from l3r.config import GraphConfig
from l3r.errors import GeometryError
from l3r.graph.edge_costs import edge_costs
from l3r.graph.scores import similarity_scores
from l3r.graph.trees import build_tree, find_root, sparsify
from tests.geometry.scenes import generator
from tests.graph.scenes import random_scores

SEEDS = st.integers(0, 2**32 - 1)
SIZES = st.integers(2, 12)
ALGORITHMS = st.sampled_from(["spt", "mst", "oracle"])


def path_costs(tree, graph):
    """Cost from the root to every view along the tree."""
    reached = {int(tree.root[graph]): 0.0}
    rows = zip(tree.parent[graph], tree.child[graph], tree.cost[graph], strict=True)
    for parent, child, cost in rows:
        reached[int(child)] = reached[int(parent)] + float(cost)
    return np.array([reached[view] for view in range(len(reached))])


@given(SEEDS, SIZES, ALGORITHMS, st.integers(0, 4))
def test_edges_form_a_spanning_tree_in_breadth_first_order(seed, num_views, algorithm, knn):
    scores = random_scores(seed, 3, num_views)
    tree = build_tree(scores, GraphConfig(algorithm=algorithm, knn=knn))
    for graph in range(3):
        position = {int(tree.root[graph]): -1}
        for edge in range(num_views - 1):
            parent, child = int(tree.parent[graph, edge]), int(tree.child[graph, edge])
            assert child not in position
            above = position[parent]  # the parent came before
            assert int(tree.parent_edge[graph, edge]) == above
            level = 1 if above < 0 else int(tree.level[graph, above]) + 1
            assert int(tree.level[graph, edge]) == level
            position[child] = edge
        keys = [
            (int(tree.level[graph, e]), int(tree.parent_edge[graph, e]), float(tree.cost[graph, e]))
            for e in range(num_views - 1)
        ]
        assert keys == sorted(keys)
        assert len(position) == num_views


@given(SEEDS, SIZES, st.sampled_from(["one_minus", "neg_log"]), st.sampled_from([0.5, 1.0, 3.0]))
def test_spt_paths_are_the_shortest(seed, num_views, cost, power):
    config = GraphConfig(cost=cost, cost_power=power)
    scores = random_scores(seed, 2, num_views)
    tree = build_tree(scores, config)
    costs = edge_costs(scores.numpy(), config)
    for graph in range(2):
        expected = shortest_path(costs[graph], indices=int(tree.root[graph]))
        np.testing.assert_allclose(path_costs(tree, graph), expected, rtol=1e-12)


@given(SEEDS, SIZES)
def test_mst_has_the_least_total_cost(seed, num_views):
    scores = random_scores(seed, 2, num_views)
    config = GraphConfig(algorithm="mst")
    tree = build_tree(scores, config)
    costs = edge_costs(scores.numpy(), config)
    for graph in range(2):
        finite = np.where(np.isfinite(costs[graph]), costs[graph], 0)
        expected = minimum_spanning_tree(finite).sum()
        assert float(tree.cost[graph].sum()) == pytest.approx(expected, rel=1e-12)


@given(SEEDS, SIZES, ALGORITHMS)
def test_permuting_the_views_permutes_the_tree(seed, num_views, algorithm):
    scores = random_scores(seed, 1, num_views)
    order = torch.randperm(num_views, generator=generator(seed))
    config = GraphConfig(algorithm=algorithm)
    tree, permuted = build_tree(scores, config), build_tree(scores[:, order][:, :, order], config)
    if num_views > 2:  # of two views, both have the same sum
        assert int(order[permuted.root[0]]) == int(tree.root[0])
        assert torch.equal(order[permuted.parent], tree.parent)
        assert torch.equal(order[permuted.child], tree.child)


@given(SEEDS, st.integers(5, 12), st.integers(1, 3))
def test_knn_keeps_the_nearest_and_joins_the_rest_cheaply(seed, num_views, knn):
    scores = random_scores(seed, 1, num_views)
    costs = edge_costs(scores.numpy(), GraphConfig())
    sparse = sparsify(costs, knn)[0]
    assert connected_components(np.isfinite(sparse))[0] == 1
    nearest = np.argsort(costs[0], axis=1)[:, :knn]
    for view, neighbours in enumerate(nearest):
        assert np.isfinite(sparse[view, neighbours]).all()
    # Whatever else was kept joins two parts, and no cheaper edge would have joined them.
    own = np.zeros_like(sparse, dtype=bool)
    np.put_along_axis(own, nearest, True, axis=1)
    own |= own.T
    parts, label = connected_components(own)
    extra = np.triu(np.isfinite(sparse) & ~own)
    assert extra.sum() == parts - 1
    between = np.full((parts, parts), np.inf)
    np.minimum.at(
        between,
        (label[:, None].repeat(num_views, 1), label[None].repeat(num_views, 0)),
        np.where(label[:, None] != label[None], costs[0], np.inf),
    )
    expected = minimum_spanning_tree(np.where(np.isfinite(between), between, 0)).sum()
    assert costs[0][extra].sum() == pytest.approx(expected)


def test_equal_similarities_are_broken_by_index():
    scores = torch.full((1, 5, 5), 0.5)
    for algorithm in ("spt", "mst"):
        tree = build_tree(scores, GraphConfig(algorithm=algorithm))
        assert tree.root.tolist() == [0]
        assert tree.parent.tolist() == [[0, 0, 0, 0]]
        assert tree.child.tolist() == [[1, 2, 3, 4]]


def test_duplicates_cost_something_so_no_path_detours_through_them():
    scores = torch.tensor([[[1.0, 1.0, 0.9], [1.0, 1.0, 0.9], [0.9, 0.9, 1.0]]])
    tree = build_tree(scores, GraphConfig())
    assert tree.level.tolist() == [[1, 1]]
    assert float(tree.cost[0, 0]) == pytest.approx(1e-6)


def test_overlap_trees_reach_beyond_the_star_where_one_minus_cannot():
    """A chain of views: neighbours share 0.6, others little."""
    view = torch.arange(6)
    scores = 0.6 ** (view[:, None] - view[None]).abs().double()
    star = build_tree(scores[None], GraphConfig(cost="one_minus"))
    # One minus the overlap of a detour is never less; -log of it is exactly as much here.
    assert star.num_levels == 1
    assert build_tree(scores[None].sqrt(), GraphConfig(algorithm="oracle")).num_levels <= 5
    weak = scores.clone()
    weak[(view[:, None] - view[None]).abs() > 1] = 0.01
    assert build_tree(weak[None], GraphConfig(algorithm="oracle")).num_levels == 3


def test_the_root_has_the_largest_summed_similarity_to_others():
    scores = torch.eye(3)[None].numpy() * 100
    scores[0, 1, 2] = scores[0, 2, 1] = 0.5
    scores[0, 0, 1] = scores[0, 1, 0] = 0.2
    assert find_root(scores).tolist() == [1]


def test_a_single_view_and_scores_that_are_not_finite_are_refused():
    with pytest.raises(GeometryError, match="expected 2 or more"):
        build_tree(torch.ones(1, 1, 1), GraphConfig())
    with pytest.raises(GeometryError, match="not finite"):
        build_tree(torch.full((1, 3, 3), torch.nan), GraphConfig())


def test_scores_are_cosines():
    tokens = torch.tensor([[[1.0, 0.0], [0.0, 3.0], [2.0, 2.0]]])
    s = 2**-0.5
    expected = torch.tensor([[[1, 0, s], [0, 1, s], [s, s, 1]]])
    torch.testing.assert_close(similarity_scores(tokens), expected)
