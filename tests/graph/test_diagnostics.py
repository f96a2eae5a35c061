import torch

from l3r.config import GraphConfig
from l3r.graph.diagnostics import diagnose_tree, split_components, summarise_trees
from l3r.graph.trees import build_tree
from tests.graph.scenes import random_scores


def star(num_views):
    scores = torch.full((1, num_views, num_views), 0.1, dtype=torch.float64)
    scores[0, 0, 1:] = scores[0, 1:, 0] = torch.linspace(0.9, 0.5, num_views - 1).double()
    return build_tree(scores, GraphConfig()), scores[0]


def test_depths_degrees_and_the_weakest_edge_are_counted():
    tree, scores = star(5)
    found = diagnose_tree(tree, scores, torch.tensor([0.0, 1.0, 2.0, 3.0]))
    assert found.views_at_depth == [1, 4]
    assert (found.root, found.root_degree, found.largest_degree) == (0, 4, 4)
    assert found.weakest_edge == [0, 4]
    assert found.weakest_similarity == 0.5
    assert [edge["residual"] for edge in found.edges] == [0, 1, 2, 3]
    assert found.to_plain()["edges"][0] == {
        "parent": 0,
        "child": 1,
        "similarity": float(scores[0, 1]),
        "cost": tree.cost[0, 0].item(),
        "residual": 0.0,
    }


def test_a_large_star_is_warned_of_and_a_small_one_is_not():
    for num_views, expected in ((20, 0), (21, 1)):
        tree, scores = star(num_views)
        warnings = diagnose_tree(tree, scores, torch.zeros(num_views - 1)).warnings()
        assert len(warnings) == expected


def test_by_default_everything_is_one_component():
    scores = random_scores(0, 1, 8)
    tree = build_tree(scores, GraphConfig())
    component = split_components(tree, scores[0], torch.full((7,), 1e9), GraphConfig())
    assert component.tolist() == [0] * 8


def test_a_weak_edge_cuts_off_everything_behind_it():
    scores = torch.full((1, 5, 5), 0.01, dtype=torch.float64)
    for a, b, s in ((0, 1, 0.9), (1, 2, 0.9), (2, 3, 0.3), (3, 4, 0.9)):
        scores[0, a, b] = scores[0, b, a] = s
    config = GraphConfig(algorithm="mst", min_similarity=0.5)
    tree = build_tree(scores, config)
    component = split_components(tree, scores[0], torch.zeros(4), config)
    assert component[0] == component[1] == component[2]
    assert component[3] == component[4]
    assert component[2] != component[3]
    assert component[tree.root[0]] == 0


def test_a_large_residual_cuts_too():
    tree, scores = star(4)
    config = GraphConfig(max_residual=0.5)
    component = split_components(tree, scores, torch.tensor([0.0, 0.9, 0.1]), config)
    assert component.tolist() == [0, 0, 1, 0]


def test_a_batch_of_stars_and_chains_is_told_apart():
    chain = torch.eye(5, dtype=torch.float64)
    for view in range(4):
        chain[view, view + 1] = chain[view + 1, view] = 0.9
    both = torch.stack([chain, star(5)[1]])
    found = summarise_trees(build_tree(both, GraphConfig()))
    assert found == {"root_degree": 3.0, "root_degree_max": 4.0, "tree_depth": 2.0}
