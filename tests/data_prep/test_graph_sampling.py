import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from data_prep.graph_sampling import (
    Relations,
    SamplingOptions,
    grow_graphs,
    sample_graphs,
)
from data_prep.survey import quota
from l3r.errors import DataError
from tests.data_prep.relations import table_of

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


def draw(made, *args, **kwargs):
    """Draw from a table of all pairs; cameras do not matter then."""
    return sample_graphs(table_of(*made), np.tile(np.eye(3), (len(made[0]), 1, 1)), *args, **kwargs)


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
    for graph in draw(made, 10, seed=seed, options=OPTIONS):
        assert graph == greedy_by_loop(*made, graph[:2], OPTIONS)


@given(seeds, links)
def test_no_graph_holds_near_duplicates_and_every_image_is_linked(seed, linked):
    iou, score, angle = tables(seed, linked=linked)
    for graph in draw((iou, score, angle), 20, seed=seed, options=OPTIONS):
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
    large = draw(made, 20, seed=seed, options=OPTIONS)
    small = draw(made, 20, seed=seed, options=SamplingOptions(min_views=4, max_views=4))
    assert [graph[:4] for graph in large] == small


@given(seeds)
def test_the_same_seed_draws_the_same_graphs_and_more_keep_the_first(seed):
    made = tables(seed)
    ten = draw(made, 10, seed=seed, options=OPTIONS)
    assert ten == draw(made, 10, seed=seed, options=OPTIONS)
    assert ten == draw(made, 30, seed=seed, options=OPTIONS)[:10]


def test_another_seed_draws_other_graphs():
    made = tables(0)
    assert draw(made, 10, seed=1) != draw(made, 10, seed=2)


def test_start_pairs_are_drawn_in_proportion_to_their_score():
    # Two pairs only, one three times as good; each is worth a graph of two images.
    iou = np.eye(4, dtype=np.float32)
    score = np.zeros((4, 4), np.float32)
    for i, j, s in ((0, 1, 0.3), (2, 3, 0.1)):
        iou[i, j] = iou[j, i] = 0.5
        score[i, j] = score[j, i] = s
    options = SamplingOptions(min_views=2, max_views=2)
    first = [
        set(draw((iou, score, score), 1, seed=seed, options=options)[0]) for seed in range(800)
    ]
    share = first.count({0, 1}) / len(first)
    assert share == pytest.approx(0.75, abs=0.05)


def test_a_scene_without_overlap_gives_no_graph():
    nothing = np.eye(20, dtype=np.float32)
    assert draw((nothing, 0 * nothing, 0 * nothing), 5) == []


def test_a_scene_has_as_many_graphs_as_start_pairs():
    iou, score, angle = tables(1, n=12)
    starts = np.triu((score >= 0.02) & (iou <= 0.75), 1).sum()
    graphs = draw((iou, score, angle), 10**6, options=OPTIONS)
    assert 0 < len(graphs) <= starts
    assert len({tuple(sorted(graph[:2])) for graph in graphs}) == len(graphs)


def cameras(seed, n=40):
    """Rotations of a scene, and the angles between them."""
    R = Rotation.random(n, rng=seed).as_matrix()
    # Half of them alike, as those of a vehicle's front camera are.
    R[: n // 2] = R[0]
    cos = (np.einsum("iab,jab->ij", R, R) - 1) / 2
    return R, np.arccos(cos.round(12).clip(-1, 1))


def sparse_case(seed):
    """All pairs of a scene, and which of them are candidates: all links, and some others."""
    iou, score, angle = tables(seed, linked=0.2)
    R, rotation = cameras(seed)
    angle = np.where(iou > 0, angle, rotation).astype(np.float32)
    keep = (iou > 0) | (np.random.default_rng(seed).random(iou.shape) < 0.1)
    return (iou, score, angle), R, keep | keep.T


@given(seeds)
def test_pairs_that_share_nothing_need_not_stand_in_the_table(seed):
    made, R, keep = sparse_case(seed)
    found = sample_graphs(table_of(*made, keep), R, 20, seed=seed, options=OPTIONS)
    assert found == draw(made, 20, seed=seed, options=OPTIONS)


@given(seeds)
def test_a_near_duplicate_is_never_added_though_the_table_lacks_the_pair(seed):
    (iou, score, angle), R, _ = sparse_case(seed)
    # No link is lost, and no near-duplicate is known.
    table = table_of(iou, score, angle, (iou > 0) & (iou <= OPTIONS.max_iou))
    asked = []

    def overlap_of(pairs):
        assert (table.find(pairs) < 0).all()
        asked.extend(map(tuple, pairs))
        return iou[pairs[:, 0], pairs[:, 1]]

    found = sample_graphs(table, R, 20, seed=seed, options=OPTIONS, overlap_of=overlap_of)
    for graph in found:
        assert np.triu(iou[np.ix_(graph, graph)], 1).max() <= OPTIONS.max_iou
        for j, k in combinations(graph, 2):
            assert table.find(np.array([[j, k]])) >= 0 or {(j, k), (k, j)} & set(asked)
    # The answer is that of all pairs but for the parallax of those that the table lacks.
    known = np.minimum(angle, np.float32(math.pi / 2))
    away = (iou == 0) | (iou > OPTIONS.max_iou)
    known = np.where(away, np.minimum(cameras(seed)[1], math.pi / 2), known).astype(np.float32)
    assert found == draw((iou, score, known), 20, seed=seed, options=OPTIONS)


@given(seeds, st.randoms(use_true_random=False))
def test_the_numbers_of_the_images_do_not_matter(seed, random):
    made = tables(seed)
    order = list(range(40))
    random.shuffle(order)
    moved = [table[np.ix_(order, order)] for table in made]
    for first, second in ((0, 7), (3, 21), (30, 5)):
        pair = np.array([[order.index(first), order.index(second)]])
        (here,) = grow(made, np.array([[first, second]]))
        (there,) = grow(moved, pair)
        assert [order[view] for view in there] == here


def grow(made, starts):
    relations = Relations(table_of(*made), np.tile(np.eye(3), (40, 1, 1)), None)
    return grow_graphs(relations, starts, np.zeros(40, dtype=bool), OPTIONS)


@given(seeds)
def test_ties_go_to_the_higher_score_then_to_the_lower_number(seed):
    iou, score, angle = tables(seed, linked=0.8)
    made = iou, np.round(score * 3).astype(np.float32) / 3, np.round(angle * 2) / 2
    for graph in draw(made, 10, seed=seed, options=OPTIONS):
        assert graph == greedy_by_loop(*made, graph[:2], OPTIONS)


@given(seeds, st.integers(1, 4))
def test_no_image_is_used_more_often_than_allowed(seed, max_uses):
    made = tables(seed, linked=0.3)
    options = replace(OPTIONS, max_uses=max_uses)
    graphs = draw(made, 200, seed=seed, options=options)
    assert graphs
    uses = np.zeros(40, dtype=int)
    for graph in graphs:
        barred = np.flatnonzero(uses == max_uses)
        assert not set(graph) & set(barred)
        # It is the greedy graph of the scene without the images used up before.
        iou = made[0].copy()
        iou[barred] = iou[:, barred] = 0
        assert graph == greedy_by_loop(iou, *made[1:], graph[:2], options)
        uses[graph] += 1
    assert graphs[:3] == draw(made, 3, seed=seed, options=options)


def test_images_that_see_much_are_used_less_where_uses_are_bounded():
    made = tables(5, linked=0.3)
    free = np.bincount(np.concatenate(draw(made, 15, options=OPTIONS)), minlength=40)
    options = replace(OPTIONS, max_uses=3)
    bounded = np.bincount(np.concatenate(draw(made, 15, options=options)), minlength=40)
    assert bounded.max() == 3 < free.max()


def test_no_graphs_are_drawn_where_none_are_wanted():
    assert draw(tables(0), 0, options=OPTIONS) == []


@given(st.integers(1, 10**5), st.integers(0, 10**5), st.floats(1e-3, 100))
def test_the_quota_follows_the_images_up_to_the_limit(num_images, num_graphs, share):
    found = quota(num_images, num_graphs, share)
    assert found <= num_graphs
    assert found in (num_graphs, 1) or abs(found - share * num_images) <= 1
    assert quota(num_images + 1, num_graphs, share) >= found


def test_the_quota_is_rounded_up_and_not_by_the_last_bit():
    assert quota(30, 1000, 0.1) == 3
    assert quota(31, 1000, 0.1) == 4
    assert quota(2, 1000, 0.1) == 1
    assert quota(500, 100, 1.0) == 100


@pytest.mark.parametrize("bad", [{"max_uses": 0}, {"candidates_per_image": 0}])
def test_bounds_below_one_are_refused(bad):
    with pytest.raises(DataError, match="of 1 or more"):
        SamplingOptions(**bad)


@pytest.mark.parametrize("bad", [{"min_views": 1}, {"max_views": 3}, {"min_iou": 0.9}])
def test_thresholds_out_of_range_are_refused(bad):
    with pytest.raises(DataError, match="expected 2 <= min_views"):
        SamplingOptions(**bad)
