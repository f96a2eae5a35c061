import math
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from l3r.config import load_config
from l3r.train.optim import build_optimizer, build_schedule, lr_factor
from l3r.train.run import train
from tests.train.runs import layers, read_log


def test_rate_scales_with_images_and_small_parameters_do_not_decay():
    config = load_config(["data.graphs_per_step=4", "train.lr=1e-3"])
    model = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.LayerNorm(4))
    optimizer = build_optimizer(model, config)
    decayed, free = optimizer.param_groups
    assert [tuple(p.shape) for p in decayed["params"]] == [(4, 3)]
    assert len(free["params"]) == 3
    assert (decayed["weight_decay"], free["weight_decay"]) == (5e-4, 0.0)
    assert decayed["lr"] == pytest.approx(1e-3 * 32 / 64)
    assert decayed["betas"] == (0.9, 0.95)


@given(st.integers(0, 50), st.integers(51, 200), st.floats(0, 0.5))
def test_warm_up_rises_and_the_cosine_falls_to_its_floor(warmup, steps, floor):
    config = load_config(
        [
            f"train.warmup_steps={warmup}",
            f"train.max_steps={steps}",
            f"train.min_lr_ratio={floor}",
            "train.schedule=cosine",
        ]
    )
    factors = [lr_factor(step, config) for step in range(steps + 1)]
    assert factors[:warmup] == sorted(factors[:warmup])
    assert factors[warmup:] == sorted(factors[warmup:], reverse=True)
    assert factors[warmup] == pytest.approx(1)
    assert factors[-1] == pytest.approx(floor, abs=1e-12)
    middle = warmup + (steps - warmup) / 2
    if middle == int(middle):
        assert factors[int(middle)] == pytest.approx((1 + floor) / 2)


def test_constant_stays_at_one():
    config = load_config(["train.warmup_steps=4"])
    assert [lr_factor(step, config) for step in (0, 3, 4, 99_999)] == [0.25, 1, 1, 1]
    assert math.isfinite(lr_factor(10**9, config))


def test_the_schedule_sets_the_rate_of_each_step():
    config = load_config(["train.warmup_steps=2", "train.lr=1e-2"])
    model = torch.nn.Linear(2, 2)
    optimizer = build_optimizer(model, config)
    schedule = build_schedule(optimizer, config)
    assert optimizer.param_groups[0]["lr"] == pytest.approx(5e-3)
    optimizer.step()
    schedule.step()
    assert optimizer.param_groups[0]["lr"] == pytest.approx(1e-2)


@pytest.mark.parametrize("accumulate", [1, 2])
def test_the_log_has_the_rate_that_a_step_was_taken_at(
    hand_shards, tmp_path, monkeypatch, accumulate
):
    monkeypatch.chdir(Path(__file__).parents[2])
    settings = {"max_steps": 3, "warmup_steps": 2, "accumulate": accumulate}
    config = load_config(layers(hand_shards, tmp_path, **settings))
    train(config)
    full = config.train.lr * 2 * 3 / 64
    expected = [full * lr_factor(step, config) for step in range(3)]
    assert [float(row["lr"]) for row in read_log(tmp_path)] == pytest.approx(expected)
