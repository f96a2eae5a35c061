import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_prep.graph_sampling import SamplingOptions, sample_graphs
from l3r.errors import DataError

OPTIONS = SamplingOptions(min_views=4, max_views=6)


def tables(seed, n=40, linked=0.6):
    """Symmetric overlap, score and angle of a scene that never was."""
    rng = np.random.default_rng(seed)
    iou, angle = rng.random((n, n)), rng.random((n, n)) * 1.8
    iou *= rng.random((n, n)) < linked
    iou, angle = np.maximum(iou, iou.T), np.maximum(angle, angle.T)
    np.fill_diagonal(iou, 1)
    np.fill_diagonal(angle, 0)
    score = np.maximum(iou * 4 * np.cos(angle) * (1 - np.cos(angle)), 0)
    return [table.astype(np.float32) for table in (iou, score, angle)]


def greedy_by_loop(iou, score, angle, start, options):
    """The rule word by word for one start pair."""
    angle = np.minimum(angle, np.float32(math.pi / 2))
    members = list(start)
    while len(members) < options.max_views:
        levels = [(options.min_iou, options.min_score)]
        if len(members) < options.min_views:
            levels += [(options.min_iou, -1.0), (options.min_iou / 2, -1.0)]
        for t_iou, t_score in levels:
            candidates = [
                k
                for k in range(len(iou))
                if k not in members
                and max(iou[k, m] for m in members) <= options.max_iou
                and max(iou[k, m] for m in members) >= t_iou
                and max(score[k, m] for m in members) >= t_score
            ]
            if candidates:
                break
        else:
            break
        members.append(
            max(
                candidates,
                key=lambda k: (
                    min(angle[k, m] for m in members),
                    max(score[k, m] for m in members),
                    -k,
                ),
            )
        )
    return members


seeds = st.integers(0, 2**16)
links = st.sampled_from([0.1, 0.3, 0.8])


@given(seeds, links)
def test_graphs_equal_the_rule_applied_by_a_loop(seed, linked):
    made = tables(seed, linked=linked)
    for graph in sample_graphs(*made, 10, seed=seed, options=OPTIONS):
        assert graph == greedy_by_loop(*made, graph[:2], OPTIONS)


@given(seeds, links)
def test_no_graph_holds_near_duplicates_and_every_image_is_linked(seed, linked):
    iou, score, angle = tables(seed, linked=linked)
    for graph in sample_graphs(iou, score, angle, 20, seed=seed, options=OPTIONS):
        assert len(set(graph)) == len(graph)
        assert OPTIONS.min_views <= len(graph) <= OPTIONS.max_views
        assert score[graph[0], graph[1]] >= OPTIONS.min_score
        for at in range(1, len(graph)):
            overlap = iou[graph[at], graph[:at]]
            assert overlap.max() <= OPTIONS.max_iou
            if at > 1:
                assert overlap.max() >= OPTIONS.min_iou / 2


@given(seeds)
def test_the_first_images_are_the_graph_of_fewer_images(seed):
    made = tables(seed)
    large = sample_graphs(*made, 20, seed=seed, options=OPTIONS)
    small = sample_graphs(*made, 20, seed=seed, options=SamplingOptions(min_views=4, max_views=4))
    assert [graph[:4] for graph in large] == small


@given(seeds)
def test_the_same_seed_draws_the_same_graphs_and_more_keep_the_first(seed):
    made = tables(seed)
    ten = sample_graphs(*made, 10, seed=seed, options=OPTIONS)
    assert ten == sample_graphs(*made, 10, seed=seed, options=OPTIONS)
    assert ten == sample_graphs(*made, 30, seed=seed, options=OPTIONS)[:10]


def test_another_seed_draws_other_graphs():
    made = tables(0)
    assert sample_graphs(*made, 10, seed=1) != sample_graphs(*made, 10, seed=2)


def test_start_pairs_are_drawn_in_proportion_to_their_score():
    # Two pairs only, one three times as good; each is worth a graph of two images.
    iou = np.eye(4, dtype=np.float32)
    score = np.zeros((4, 4), np.float32)
    for i, j, s in ((0, 1, 0.3), (2, 3, 0.1)):
        iou[i, j] = iou[j, i] = 0.5
        score[i, j] = score[j, i] = s
    options = SamplingOptions(min_views=2, max_views=2)
    first = [
        set(sample_graphs(iou, score, score, 1, seed=seed, options=options)[0])
        for seed in range(800)
    ]
    share = first.count({0, 1}) / len(first)
    assert share == pytest.approx(0.75, abs=0.05)


def test_a_scene_without_overlap_gives_no_graph():
    nothing = np.eye(20, dtype=np.float32)
    assert sample_graphs(nothing, 0 * nothing, 0 * nothing, 5) == []


def test_a_scene_has_as_many_graphs_as_start_pairs():
    iou, score, angle = tables(1, n=12)
    starts = np.triu((score >= 0.02) & (iou <= 0.75), 1).sum()
    graphs = sample_graphs(iou, score, angle, 10**6, options=OPTIONS)
    assert 0 < len(graphs) <= starts
    assert len({tuple(sorted(graph[:2])) for graph in graphs}) == len(graphs)


@pytest.mark.parametrize("bad", [{"min_views": 1}, {"max_views": 3}, {"min_iou": 0.9}])
def test_thresholds_out_of_range_are_refused(bad):
    with pytest.raises(DataError, match="expected 2 <= min_views"):
        SamplingOptions(**bad)
