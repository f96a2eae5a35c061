import logging
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array

from data_prep.candidates import choose_pairs
from data_prep.converters.synthetic import intrinsics
from data_prep.covisibility import read_own_overlap, relate_pairs
from data_prep.depth_views import prepare_views
from data_prep.draw import draw_graphs
from data_prep.graph_sampling import SamplingOptions
from data_prep.overlap_table import all_pairs
from data_prep.scene import Frame, Scene
from data_prep.street import REACH, build_street, draw_stroll, street_depth
from tests.data_prep.relations import relate_all, square
from tests.data_prep.scattered import scatter

SIZE = (48, 64)
OPTIONS = SamplingOptions(min_views=5, max_views=8, candidates_per_image=40)


@pytest.fixture(scope="module")
def street():
    """160 images of a walk up and down a street of 100 m."""
    made = build_street(1, length=100.0)
    cameras = draw_stroll(made, 160, seed=1)
    K = intrinsics(SIZE)
    depth = street_depth(made, torch.from_numpy(K), cameras, SIZE)
    assert 0 < depth[depth > 0].min() < depth.max() <= REACH
    frames = [
        Frame(
            name=f"{view}.png",
            image_size=SIZE,
            K=K,
            world_from_cam=cameras[view].numpy(),
            read_image=partial(np.zeros, (*SIZE, 3), np.uint8),
            read_depth=partial(np.asarray, depth[view].numpy()),
        )
        for view in range(160)
    ]
    return Scene(dataset="synthetic", name="street", is_metric=True, frames=frames)


@pytest.fixture(scope="module")
def table(street):
    return relate_all(street)


def choose(scene, options=OPTIONS):
    return choose_pairs(scene, prepare_views(scene), read_own_overlap(scene), options)


def useful(table):
    return (table.iou >= OPTIONS.min_iou) & (table.score >= OPTIONS.min_score)


def recall(table, pairs):
    """Share of the useful pairs of a table of all pairs that were chosen."""
    return np.isin(np.flatnonzero(useful(table)), table.find(pairs)).mean()


def test_few_pairs_hold_nearly_all_that_are_useful(street, table):
    pairs = choose(street)
    assert 10 < 2 * useful(table).sum() / 160 < 40
    assert len(pairs) <= 160 * 40 / 2
    assert recall(table, pairs) > 0.95


def test_pairs_far_apart_in_time_are_found(street, table):
    # The walker comes back on the other side of the street.
    far = useful(table) & (table.views[:, 1] - table.views[:, 0] > 60)
    assert far.sum() > 20
    assert np.isin(np.flatnonzero(far), table.find(choose(street))).mean() > 0.9


def test_the_choice_is_a_list_of_pairs_each_once(street):
    pairs = choose(street)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    np.testing.assert_array_equal(pairs, np.unique(pairs, axis=0))
    np.testing.assert_array_equal(pairs, choose(street))


@pytest.mark.parametrize("bound", [1, 4, 10, 100])
def test_the_bound_holds_in_the_mean(street, bound):
    pairs = choose(street, replace(OPTIONS, candidates_per_image=bound))
    assert len(pairs) <= 160 * bound / 2


def test_neighbours_in_time_are_always_chosen(street):
    dark = replace(street.frames[80], read_depth=partial(np.zeros, SIZE, np.float32))
    scene = replace(street, frames=[*street.frames[:80], dark, *street.frames[81:]])
    chosen = set(map(tuple, choose(scene).tolist()))
    assert {(k, k + step) for step in (1, 2) for k in range(160 - step)} <= chosen
    # Nothing else is known of an image without depth.
    assert {pair for pair in chosen if 80 in pair} == {(78, 80), (79, 80), (80, 81), (80, 82)}


def test_a_small_scene_has_all_its_pairs_related(street):
    few = street.take(range(41))
    np.testing.assert_array_equal(choose(few), all_pairs(41))
    assert len(choose(street.take(range(42)))) <= 42 * 40 / 2


def test_scattered_depth_serves_as_well(street):
    scene = scatter(street, dataset="waymo", share=0.15)
    assert recall(relate_all(scene), choose(scene)) > 0.95


def test_a_scenes_own_overlap_says_which_pairs_there_are(street, table):
    own = square(table, "iou")
    # A third of the pairs shares no point, whatever depth says.
    own[np.add.outer(np.arange(160), np.arange(160)) % 3 == 1] = 0
    np.fill_diagonal(own, 1)
    scene = replace(street, read_overlap=lambda: csr_array(own))
    pairs = choose(scene)
    apart = pairs[:, 1] - pairs[:, 0] > 2
    assert (own[pairs[:, 0], pairs[:, 1]][apart] > 0).all()
    assert recall(relate_all(scene), pairs) > 0.95


def test_points_far_away_do_not_blur_the_rest(street, table):
    def spoiled(read):
        depth = read().copy()
        depth[::9, ::7] = 6e4
        return depth

    frames = [replace(f, read_depth=partial(spoiled, f.read_depth)) for f in street.frames]
    assert recall(table, choose(replace(street, frames=frames))) > 0.9


def test_one_camera_repeated_gives_no_graph(street, caplog):
    scene = replace(street, frames=[street.frames[3]] * 60)
    with caplog.at_level(logging.WARNING):
        graphs = draw_graphs(scene, prepare_views(scene), 5, 0, OPTIONS)
    assert graphs == []
    assert "0 graphs of 5 views or more" in caplog.text


@pytest.mark.parametrize("num_views", [1, 2, 4])
def test_a_scene_of_too_few_images_gives_no_graph(street, num_views):
    few = street.take(range(num_views))
    assert draw_graphs(few, prepare_views(few), 5, 0, OPTIONS) == []


@pytest.fixture(scope="module")
def plans(street):
    # So few candidates that most graphs hold pairs that are none.
    options = replace(OPTIONS, candidates_per_image=12)
    return draw_graphs(street, prepare_views(street), 60, 0, options)


def test_stored_tables_do_not_depend_on_the_choice(street, plans):
    views = prepare_views(street)
    for plan in plans[:20]:
        pairs = np.sort(np.array(plan.views)[all_pairs(len(plan.views))], axis=1)
        direct = relate_pairs(street, views, pairs).among(plan.views)
        for name in ("iou", "covisible", "score", "rotation", "axis", "parallax"):
            np.testing.assert_array_equal(getattr(plan.pairs, name), getattr(direct, name))


def test_stored_tables_are_in_the_order_of_the_graph(table, plans):
    for plan in plans[:20]:
        for name in ("iou", "covisible", "score", "rotation", "axis", "parallax"):
            expected = square(table, name)[np.ix_(plan.views, plan.views)]
            np.testing.assert_array_equal(getattr(plan.pairs, name), expected)


def test_graphs_of_few_candidates_keep_every_condition(plans):
    assert len(plans) == 60
    for plan in plans:
        for at in range(1, len(plan.views)):
            overlap = plan.pairs.iou[at, :at]
            assert overlap.max() <= OPTIONS.max_iou
            assert overlap.max() >= (OPTIONS.min_iou if at >= 5 else OPTIONS.min_iou / 2)
            if at >= OPTIONS.min_views:
                assert plan.pairs.score[at, :at].max() >= OPTIONS.min_score


def test_more_graphs_of_a_large_scene_keep_the_first(street, plans):
    options = replace(OPTIONS, candidates_per_image=12)
    few = draw_graphs(street, prepare_views(street), 9, 0, options)
    assert [plan.views for plan in few] == [plan.views for plan in plans[:9]]
