"""Colour jitter beside Pillow's enhancers, which torchvision's ColorJitter calls."""

import colorsys
from typing import get_args

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageEnhance

from l3r.config import DataConfig
from l3r.data.color import ColorChange, ColorStep, Kind, change_colors, draw_color_changes
from l3r.data.stages import KeyedGraph, jitter_colors
from l3r.errors import ConfigError
from tests.data.graphs import make_graph

ENHANCERS = {
    "brightness": ImageEnhance.Brightness,
    "contrast": ImageEnhance.Contrast,
    "saturation": ImageEnhance.Color,
}
PAPER = (0.5, 0.5, 0.5, 0.1)


def colorful(seed=0, size=(60, 80)):
    """Smooth patches of strong colours, black and white included."""
    noise = np.random.default_rng(seed).integers(0, 256, (*size, 3)).astype(np.float32)
    return np.clip((cv2.GaussianBlur(noise, (0, 0), 3) - 128) * 8 + 128, 0, 255).astype(np.uint8)


def draw(seed, strengths=PAPER):
    """The change of one image."""
    (change,) = draw_color_changes(np.random.default_rng(seed), strengths, 1)
    return change


def only(kind, amount):
    return ColorChange(steps=(ColorStep(kind, amount),))


def by_pillow(image, step):
    if step.kind == "hue":
        hue, saturation, value = Image.fromarray(image).convert("HSV").split()
        turned = (np.asarray(hue).astype(int) + round(step.amount * 256)) % 256
        bands = (Image.fromarray(turned.astype(np.uint8)), saturation, value)
        return np.asarray(Image.merge("HSV", bands).convert("RGB"))
    return np.asarray(ENHANCERS[step.kind](Image.fromarray(image)).enhance(step.amount))


def difference(one, other):
    return np.abs(one.astype(int) - other.astype(int))


@pytest.mark.parametrize("kind", list(ENHANCERS))
@pytest.mark.parametrize("factor", [0.0, 0.3, 0.5, 0.9, 1.2, 1.5, 2.0])
def test_a_blend_is_pillows_but_for_rounding(kind, factor):
    """Pillow cuts fractions off, here they are rounded: at most one step of a byte."""
    image = colorful()
    found = change_colors(image, only(kind, factor))
    assert difference(found, by_pillow(image, ColorStep(kind, factor))).max() <= 1


@pytest.mark.parametrize("turn", [-0.5, -0.1, -0.03, 0.02, 0.1, 0.4])
def test_a_turn_of_hue_is_the_exact_one_but_for_rounding(turn):
    """HSV in bytes: hue is off by half a step of 1/256, which moves a colour by 3 at most."""
    image = colorful(size=(20, 30))
    found = change_colors(image, only("hue", turn))
    exact = [colorsys.rgb_to_hsv(*(pixel / 255)) for pixel in image.reshape(-1, 3)]
    exact = [colorsys.hsv_to_rgb((hue + turn) % 1, s, v) for hue, s, v in exact]
    error = difference(found, np.round(255 * np.array(exact)).reshape(image.shape))
    # The turn itself is rounded too: another half step.
    assert error.max() <= 8
    assert error.mean() < 1.5


def test_all_four_in_a_row_are_pillows_in_that_order():
    for seed in range(8):
        image = colorful(seed)
        change = draw(seed)
        expected = image
        for step in change.steps:
            expected = by_pillow(expected, step)
        assert difference(change_colors(image, change), expected).mean() < 2
        backwards = ColorChange(steps=change.steps[::-1])
        # What the bound above is worth: the order shows.
        if seed == 0:
            assert difference(change_colors(image, backwards), expected).mean() > 4


@given(st.integers(0, 2**32), st.lists(st.floats(0, 2), min_size=3, max_size=3), st.floats(0, 0.5))
def test_draws_stay_in_range_and_come_in_any_order(seed, strengths, hue):
    change = draw(seed, [*strengths, hue])
    by_kind = {step.kind: step.amount for step in change.steps}
    wanted = dict(zip(get_args(Kind), [*strengths, hue], strict=True))
    assert set(by_kind) == {kind for kind, strength in wanted.items() if strength}
    for kind, amount in by_kind.items():
        strength = wanted[kind]
        if kind == "hue":
            assert -strength <= amount <= strength
        else:
            assert max(0, 1 - strength) <= amount <= 1 + strength


@given(st.integers(0, 2**16), st.integers(1, 9))
def test_an_image_takes_the_same_draw_however_many_follow(seed, num_views):
    ten = draw_color_changes(np.random.default_rng(seed), PAPER, 10)
    assert draw_color_changes(np.random.default_rng(seed), PAPER, num_views) == ten[:num_views]
    still = draw_color_changes(np.random.default_rng(seed), (0.5, 0.0, 0.5, 0.1), 10)
    for one, other in zip(ten, still, strict=True):
        assert [step for step in one.steps if step.kind != "contrast"] == list(other.steps)


def test_draws_fill_their_range_evenly_and_every_order_comes():
    changes = [draw(seed) for seed in range(2000)]
    for kind, (least, greatest) in {"brightness": (0.5, 1.5), "hue": (-0.1, 0.1)}.items():
        amounts = [s.amount for change in changes for s in change.steps if s.kind == kind]
        shares = (np.array(amounts) - least) / (greatest - least)
        counts, _ = np.histogram(shares, bins=5, range=(0, 1))
        assert (abs(counts / len(changes) - 0.2) < 0.04).all()
    assert len({tuple(step.kind for step in change.steps) for change in changes}) == 24


@given(st.integers(0, 2**16))
def test_no_strength_and_no_amount_are_the_identity(seed):
    image = colorful(seed, size=(8, 9))
    change = draw(seed, (0.0, 0.0, 0.0, 0.0))
    assert change.steps == ()
    idle = [ColorStep(kind, 1.0) for kind in ENHANCERS]
    for steps in ((), tuple(idle), (ColorStep("hue", 0.0),), (ColorStep("hue", 1e-4),)):
        assert np.array_equal(change_colors(image, ColorChange(steps=steps)), image)


def test_the_stage_changes_each_image_by_its_own_draw_and_edits_nothing():
    graph = make_graph(num_views=3)
    before = [image.copy() for image in graph.image]
    changes = [only("brightness", 0.5), ColorChange(steps=()), only("saturation", 0.0)]
    (sample,) = jitter_colors([KeyedGraph(key="k", graph=graph)], changes=changes)
    found = sample.graph.image
    assert all(np.array_equal(a, b) for a, b in zip(graph.image, before, strict=True))
    assert found[0].mean() == pytest.approx(before[0].mean() / 2, abs=1)
    assert np.array_equal(found[1], before[1])
    assert difference(found[2][..., 0], found[2][..., 1]).max() == 0
    assert np.array_equal(sample.graph.K, graph.K)
    (same,) = jitter_colors([KeyedGraph(key="k", graph=graph)], changes=())
    assert same.graph is graph


@pytest.mark.parametrize("jitter", [[0.5], [0.5, 0.5, 0.5, 0.6], [-0.1, 0.0, 0.0, 0.0]])
def test_strengths_out_of_range_are_refused(jitter):
    with pytest.raises(ConfigError, match=r"data\.color_jitter"):
        DataConfig(color_jitter=jitter)
