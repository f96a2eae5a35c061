"""The moving average of the weights: its law, its place in validation and in checkpoints."""

from pathlib import Path

import pytest
import torch

import l3r
from l3r.config import load_config
from l3r.errors import ConfigError
from l3r.inference.checkpoint import build_untrained, read_checkpoint
from l3r.train.checkpointing import CheckpointFiles
from l3r.train.run import train
from tests.train.runs import layers, losses, read_log
from tests.train.test_run import BrokenLoss

ROOT = Path(__file__).parents[2]
DECAY = 0.8


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


def weights_and_average(folder):
    content = read_checkpoint(folder / "last.ckpt")
    return content["state_dict"], content["average"]


def assert_same(one, other):
    assert one.keys() == other.keys()
    assert all(torch.equal(one[key], other[key]) for key in other)


def test_the_average_is_the_weighted_sum_of_the_weights_of_all_steps(
    hand_shards, tmp_path, monkeypatch
):
    saved = []
    save = CheckpointFiles.save_checkpoint

    def record(self, checkpoint, path, storage_options=None):
        names = ("state_dict", "average")
        saved.append([{k: v.clone() for k, v in checkpoint[name].items()} for name in names])
        save(self, checkpoint, path, storage_options)

    monkeypatch.setattr(CheckpointFiles, "save_checkpoint", record)
    settings = layers(
        hand_shards, tmp_path, max_steps=4, ema_decay=DECAY, checkpoint_every=1, validate_every=2
    )
    train(load_config(settings))
    saved = saved[:4]  # the end is saved once more
    start, _ = build_untrained(settings)
    for key, first in start.state_dict().items():
        steps = [first, *(weights[f"model.{key}"] for weights, _ in saved)]
        for count in range(1, 5):
            shares = [DECAY**count, *((1 - DECAY) * DECAY**i for i in reversed(range(count)))]
            expected = sum(share * step for share, step in zip(shares, steps, strict=False))
            torch.testing.assert_close(saved[count - 1][1][f"model.{key}"], expected)


def test_the_average_is_what_is_delivered_and_resumed_exactly(hand_shards, tmp_path):
    for name, stops in (("straight", (7,)), ("stopped", (3, 7))):
        for step in stops:
            settings = {"max_steps": step, "ema_decay": DECAY, "validate_every": 2}
            train(load_config(layers(hand_shards, tmp_path / name, **settings)))
    straight, stopped = (tmp_path / name for name in ("straight", "stopped"))
    for one, other in zip(*map(weights_and_average, (stopped, straight)), strict=True):
        assert_same(one, other)
    assert losses(stopped) == losses(straight)
    assert read_log(stopped, "validation.csv") == read_log(straight, "validation.csv")
    weights, average = weights_and_average(straight)
    assert_same(read_checkpoint(straight / "model.ckpt")["state_dict"], average)
    assert any(not torch.equal(weights[key], average[key]) for key in average)
    # A checkpoint of a run that goes on is taken for its average, too.
    delivered, running = (l3r.load_model(straight / f"{name}.ckpt") for name in ("model", "last"))
    assert_same(running.state_dict(), delivered.state_dict())
    with pytest.raises(ConfigError, match=r"train\.ema_decay=0.8, this run has None"):
        train(load_config(layers(hand_shards, straight, max_steps=7, validate_every=2)))


@pytest.mark.slow
def test_validation_sees_the_average_and_training_does_not(hand_shards, tmp_path):
    settings = {"max_steps": 5, "validate_every": 2}
    decays = {"off": "null", "nothing_moves": 1 - 1e-12}
    for name, decay in decays.items():
        train(load_config(layers(hand_shards, tmp_path / name, ema_decay=decay, **settings)))
    assert losses(tmp_path / "nothing_moves") == losses(tmp_path / "off")
    rows = {name: read_log(tmp_path / name, "validation.csv") for name in decays}
    first, second = ({**row, "step": 0} for row in rows["nothing_moves"])
    assert first == second
    assert rows["off"][0]["loss"] != rows["off"][1]["loss"]


@pytest.mark.slow
def test_a_skipped_step_leaves_the_average_alone(hand_shards, tmp_path, monkeypatch):
    monkeypatch.setattr("l3r.train.run.JointLoss", BrokenLoss)
    for name, bad, steps in (("bad", (4,), 4), ("good", (), 3)):
        monkeypatch.setattr(BrokenLoss, "bad_calls", bad)
        settings = {"max_steps": steps, "ema_decay": DECAY}
        train(load_config(layers(hand_shards, tmp_path / name, **settings)))
    assert (tmp_path / "bad" / "bad_steps.jsonl").exists()
    for one, other in zip(
        *(weights_and_average(tmp_path / n) for n in ("bad", "good")), strict=True
    ):
        assert_same(one, other)
