"""Where the host waits for the device in a training step, on a device that only pretends."""

from collections import Counter
from contextlib import suppress
from pathlib import Path

import pytest
import torch

from benchmarks.step_clock import StepClock
from l3r.config import load_config
from l3r.train.run import train
from tests.train.pretend_device import PretendDevice, UnknownLengthError
from tests.train.runs import layers


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])


def waits_of_a_step(shards, folder, monkeypatch, **settings):
    """Count them in a real run, in steps without a row, validation or checkpoint."""
    rare = dict.fromkeys(("log_every", "checkpoint_every", "validate_every"), 1000)
    config = load_config(layers(shards, folder, max_steps=1000, **rare, **settings))
    accumulate = config.train.accumulate
    clock = StepClock(torch.device("cpu"), accumulate, warmup=1, steps=1, observed=2)
    with PretendDevice().in_use(monkeypatch), clock.attached():
        train(config)
    return Counter({place: number / 2 for place, number in clock.waits.items()})


@pytest.mark.parametrize(("accumulate", "ema_decay"), [(1, "null"), (2, 0.9)])
def test_the_host_waits_for_the_scores_of_a_batch_and_once_a_step_for_the_flag(
    hand_shards, tmp_path, monkeypatch, accumulate, ema_decay
):
    settings = {"accumulate": accumulate, "ema_decay": ema_decay}
    assert waits_of_a_step(hand_shards, tmp_path, monkeypatch, **settings) == {
        "l3r/graph/trees.py:build_tree": accumulate,
        "l3r/train/guard.py:on_before_optimizer_step": 1,
    }


NEEDLESS = {
    "item": lambda x: x.sum().item(),
    "bool": lambda x: bool((x > 0).any()),
    "list": lambda x: x.tolist(),
    "to the host": lambda x: x.cpu(),
    "in place on the host": lambda x: torch.zeros(3, 3).copy_(x),
    "a number to the device": lambda x: torch.tensor(1.0, device=x.device),
    "pageable memory to the device": lambda x: torch.zeros(3).to(x.device),
    "a checked inverse": lambda x: torch.linalg.inv(x),
    "indices of a mask": lambda x: (x > 0).nonzero(),
    "a mask as an index": lambda x: x[x > 0],
}


@pytest.mark.parametrize("mistake", NEEDLESS.values(), ids=NEEDLESS)
def test_what_waits_is_seen(monkeypatch, mistake):
    device, waits = PretendDevice(), Counter()
    x = torch.rand(3, 3, device="meta")
    with device.in_use(monkeypatch), device.observe(waits):
        torch.where(x > 0, x, x.flip(0)).sum()
        x + torch.zeros(3, 3).to("meta", non_blocking=True)
        torch.linalg.inv_ex(x)
        assert not waits
        with suppress(UnknownLengthError):
            mistake(x)
    assert waits.total() == 1
