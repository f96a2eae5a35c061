import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from l3r.config import LossConfig
from l3r.loss.confidence import confidence_loss, point_error
from l3r.loss.joint import JointLoss
from l3r.loss.reduction import mean_of_each_graph, mean_over_pixels
from l3r.loss.scale import scale_factors
from l3r.loss.targets import build_targets
from l3r.types import PairPointmaps
from tests.graph.scenes import noisy
from tests.loss.scenes import perfect_prediction, predict, random_views

SEEDS = st.integers(0, 2**32 - 1)
few = settings(max_examples=10)


def scaled(pairs, factor):
    return dataclasses.replace(
        pairs,
        parent_pts3d=pairs.parent_pts3d * factor,
        child_pts3d=pairs.child_pts3d * factor,
    )


def loss_of(prediction, views, **switches):
    return JointLoss(LossConfig(**switches))(prediction, views)


def noisy_prediction(views, seed):
    perfect = perfect_prediction(views)
    return predict(noisy(perfect.pairs, seed, 0.1), perfect.tree, views.scores)


@few
@given(SEEDS, st.booleans())
def test_a_perfect_prediction_pays_only_the_confidence_term(seed, metric):
    views = random_views(seed, metric=metric)
    terms = loss_of(perfect_prediction(views, log_conf=0.5), views, alpha=0.2)
    assert float(terms.parts["pair_error"]) < 1e-9
    assert float(terms.parts["global_error"]) < 1e-9
    # Two views pay -alpha log C each, and lambda times that once for the world.
    assert float(terms.total) == pytest.approx(-0.2 * 0.5 * (2 + 0.1), abs=1e-8)


@few
@given(SEEDS, st.floats(0.1, 10))
def test_without_metres_the_scale_of_the_prediction_does_not_matter(seed, factor):
    views = random_views(seed, metric=False)
    prediction = noisy_prediction(views, seed)
    stretched = predict(scaled(prediction.pairs, factor), prediction.tree, views.scores)
    first, second = loss_of(prediction, views), loss_of(stretched, views)
    assert float(second.total) == pytest.approx(float(first.total), rel=1e-6)


@few
@given(SEEDS)
def test_with_metres_a_wrong_scale_is_an_error(seed):
    views = random_views(seed, metric=True)
    perfect = perfect_prediction(views)
    doubled = predict(scaled(perfect.pairs, 2.0), perfect.tree, views.scores)
    # Everything is off by its own distance, whose mean is the factor itself.
    per_pixel = loss_of(doubled, views, reduction="pooled").parts["pair_error"]
    assert float(per_pixel) == pytest.approx(1.0, abs=0.3)


@few
@given(SEEDS)
def test_one_scale_holds_for_all_edges_of_a_graph(seed):
    """Per edge a wrong scale of one edge goes unseen; per graph it does not."""
    views = random_views(seed, metric=False)
    perfect = perfect_prediction(views)
    factor = torch.ones(2, 3, 1, 1, dtype=torch.float64)
    factor[:, 1] = 2
    bent = predict(scaled(perfect.pairs, factor), perfect.tree, views.scores)
    assert float(loss_of(bent, views, normalize="per_edge").parts["pair_error"]) < 1e-9
    assert float(loss_of(bent, views).parts["pair_error"]) > 0.05


@few
@given(SEEDS)
def test_the_global_term_ignores_where_the_world_stands(seed):
    views = random_views(seed)
    prediction = noisy_prediction(views, seed)
    moved = dataclasses.replace(
        views, world_from_cam=views.world_from_cam[:, :1].inverse() @ views.world_from_cam
    )
    first, second = loss_of(prediction, views), loss_of(prediction, moved)
    assert float(first.total) == pytest.approx(float(second.total), rel=1e-8)


@few
@given(SEEDS)
def test_per_graph_reduction_is_the_mean_of_single_graphs(seed):
    views = random_views(seed, num_graphs=3)
    prediction = noisy_prediction(views, seed)
    totals = []
    for graph in range(3):
        row = slice(graph, graph + 1)
        alone = {f.name: getattr(views, f.name)[row] for f in dataclasses.fields(views)}
        pairs = PairPointmaps(**{k: v[row] for k, v in vars(prediction.pairs).items()})
        tree = dataclasses.replace(
            prediction.tree, **{k: v[row] for k, v in vars(prediction.tree).items()}
        )
        single = dataclasses.replace(views, **alone)
        totals.append(loss_of(predict(pairs, tree, single.scores), single).total)
    assert float(loss_of(prediction, views).total) == pytest.approx(float(sum(totals)) / 3)


def test_garbage_at_invalid_pixels_changes_nothing_and_gets_no_gradient():
    views = random_views(1)
    prediction = noisy_prediction(views, 1)
    target, _ = build_targets(views, prediction.tree)
    spoiled = torch.where(
        target.child_valid[..., None], prediction.pairs.child_pts3d, torch.nan
    ).requires_grad_()
    pairs = dataclasses.replace(prediction.pairs, child_pts3d=spoiled)
    world = dataclasses.replace(prediction.world)
    both = dataclasses.replace(prediction, pairs=pairs, world=world)
    terms = loss_of(both, views)
    expected = float(loss_of(prediction, views).total)
    assert float(terms.total.detach()) == pytest.approx(expected)
    terms.total.backward()
    assert (spoiled.grad[~target.child_valid] == 0).all()
    assert spoiled.grad.isfinite().all()


def test_a_graph_of_few_valid_pixels_adds_no_global_term_but_keeps_every_gradient():
    views = random_views(2, num_graphs=2)
    keep = torch.zeros_like(views.valid)
    keep[0] = views.valid[0]
    keep[1, 0, 0, :9] = True
    views = dataclasses.replace(views, valid=keep, depth=views.depth.clamp_min(1.0) * keep)
    prediction = noisy_prediction(views, 2)
    leaf = prediction.world.pts3d_world.detach().clone().requires_grad_()
    world = dataclasses.replace(prediction.world, pts3d_world=leaf)
    terms = loss_of(dataclasses.replace(prediction, world=world), views)
    terms.total.backward()
    assert leaf.grad.isfinite().all()
    assert (leaf.grad[1] == 0).all()
    assert (leaf.grad[0] != 0).any()


def test_a_batch_without_any_valid_pixel_gives_zero_and_finite_gradients():
    views = random_views(3, invalid=1.1)
    prediction = noisy_prediction(random_views(3), 3)
    leaf = prediction.pairs.parent_pts3d.clone().requires_grad_()
    pairs = dataclasses.replace(prediction.pairs, parent_pts3d=leaf)
    terms = loss_of(predict(pairs, prediction.tree, views.scores), views)
    assert float(terms.total.detach()) == 0
    terms.total.backward()
    assert leaf.grad.isfinite().all()


@pytest.mark.parametrize("align_weights", ["uniform", "confidence"])
@pytest.mark.parametrize("align_with_scale", [False, True])
@pytest.mark.parametrize("normalize", ["per_graph", "per_edge", "none"])
@pytest.mark.parametrize("reduction", ["per_graph", "pooled"])
def test_every_switch_gives_finite_gradients(align_weights, align_with_scale, normalize, reduction):
    views = random_views(4, metric=False)
    perfect = perfect_prediction(views)
    disturbed = noisy(perfect.pairs, 4, 0.1)
    leaves = {k: v.clone().requires_grad_() for k, v in vars(disturbed).items()}
    prediction = predict(PairPointmaps(**leaves), perfect.tree, views.scores)
    terms = loss_of(
        prediction,
        views,
        align_weights=align_weights,
        align_with_scale=align_with_scale,
        normalize=normalize,
        reduction=reduction,
    )
    terms.total.backward()
    for leaf in leaves.values():
        assert leaf.grad.isfinite().all()
        assert (leaf.grad != 0).any()


def test_a_free_scale_in_the_global_fit_forgives_a_wrong_scale():
    views = random_views(5)
    perfect = perfect_prediction(views)
    doubled = predict(scaled(perfect.pairs, 2.0), perfect.tree, views.scores)
    assert float(loss_of(doubled, views, align_with_scale=True).parts["global_error"]) < 1e-9
    assert float(loss_of(doubled, views).parts["global_error"]) > 0.1


def test_lambda_weighs_the_global_term():
    views = random_views(6)
    prediction = noisy_prediction(views, 6)
    terms = loss_of(prediction, views, global_weight=0.3)
    expected = terms.parts["pairwise"] + 0.3 * terms.parts["global"]
    assert float(terms.total) == pytest.approx(float(expected))
    names = {"val/loss", "val/pairwise", "val/global", "val/pair_error", "val/global_error"}
    assert set(terms.scalars("val")) == names


def test_the_best_confidence_is_alpha_over_the_error():
    error = torch.tensor([0.05], dtype=torch.float64)
    log_conf = torch.linspace(0, 3, 3001, dtype=torch.float64)
    loss = confidence_loss(
        error.expand(3001), log_conf, torch.ones(3001, dtype=torch.bool), alpha=0.2
    )
    assert float(log_conf[loss.argmin()].exp()) == pytest.approx(0.2 / 0.05, rel=1e-3)


def test_pieces_by_hand():
    points = torch.tensor([[3.0, 4, 0], [torch.nan, 0, 0]])
    valid = torch.tensor([True, False])
    assert point_error(points, torch.zeros(2, 3), valid).tolist() == [5, 0]
    values = torch.tensor([[1.0, 2, 3], [9, 0, 0]])
    counted = torch.tensor([[True, True, True], [True, False, False]])
    assert float(mean_over_pixels(values, counted, "per_graph")) == (2 + 9) / 2
    assert float(mean_over_pixels(values, counted, "pooled")) == 15 / 4
    assert float(mean_over_pixels(values * 0, counted & False, "per_graph")) == 0
    assert mean_of_each_graph(values, counted).tolist() == [2, 9]


@few
@given(SEEDS)
def test_the_loss_is_the_mean_of_the_losses_of_its_graphs(seed):
    views = random_views(seed, metric=True)
    terms = loss_of(noisy_prediction(views, seed), views)
    assert len(terms.graphs["loss"]) == len(views.key) > 1
    assert float(terms.graphs["loss"].mean()) == pytest.approx(float(terms.total), rel=1e-9)
    error = terms.parts["pair_error"]
    assert float(terms.graphs["pair_error"].mean()) == pytest.approx(float(error), rel=1e-9)


def test_targets_of_an_edge_are_in_the_parents_frame():
    views = random_views(7, num_graphs=1)
    prediction = perfect_prediction(views)
    pairs, world = build_targets(views, prediction.tree)
    parent, child = int(prediction.tree.parent[0, 2]), int(prediction.tree.child[0, 2])
    parent_from_world = torch.linalg.inv(views.world_from_cam[0, parent])
    moved = world.pts3d_world[0, child] @ parent_from_world[:3, :3].T + parent_from_world[:3, 3]
    torch.testing.assert_close(pairs.child_pts3d[0, 2], moved)
    factors = scale_factors(prediction.pairs, pairs, views.is_metric, "none")
    assert factors.prediction.tolist() == factors.target.tolist() == [[1.0]]
