"""Training that starts from a file of weights."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import l3r
from l3r.config import load_config
from l3r.errors import CheckpointError
from l3r.inference.checkpoint import read_checkpoint
from l3r.inference.weights import describe_weights
from l3r.model.weight_files import write_checkpoint
from l3r.model.weights import own_key
from l3r.train.run import train
from tests.model.official_files import SMALL, SMALL_DPT, call, official_state, write_pth
from tests.train.runs import layers, read_log

ROOT = Path(__file__).parents[2]
NO_STEPS = {"lr": 1e-30, "weight_decay": 0}  # weights stay, but for zeros that move by so much


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.fixture
def official(tmp_path):
    return write_pth(tmp_path / "official.pth", official_state(seed=8))


def start(shards, folder, *overrides, **options):
    config = [*layers(shards, folder, **options), "model.encoder.patch_size=16", *overrides]
    return l3r.load_model(train(load_config(config))).state_dict()


def test_a_run_starts_from_an_official_file(hand_shards, tmp_path, official, capsys):
    found = start(hand_shards, tmp_path / "run", init=official, max_steps=2, **NO_STEPS)
    state = official_state(seed=8)
    del state["mask_token"]
    for key, value in state.items():
        assert (found[own_key(key)] - value).abs().max() < 1e-20
    assert len(read_log(tmp_path / "run")) == 2
    told = capsys.readouterr().err
    assert f"train.init={official}: DUSt3R, linear heads" in told
    assert "mask_token" in told
    assert "CC BY-NC-SA 4.0" in told
    assert load_config([str(tmp_path / "run" / "config.yaml")]).train.init == str(official)


def test_a_run_starts_from_another_run_but_for_what_differs(hand_shards, tmp_path, capsys):
    first = start(hand_shards, tmp_path / "a", max_steps=2)
    again = start(
        hand_shards, tmp_path / "b", init=tmp_path / "a" / "model.ckpt", max_steps=1, **NO_STEPS
    )
    assert all((again[key] - value).abs().max() < 1e-20 for key, value in first.items())
    assert "alignment    loaded" in capsys.readouterr().err
    deeper = start(
        hand_shards,
        tmp_path / "c",
        "model.alignment.num_blocks=2",
        init=tmp_path / "a" / "last.ckpt",
        max_steps=1,
        **NO_STEPS,
    )
    told = capsys.readouterr().err
    assert "Light3R training checkpoint" in told
    assert "alignment              fresh" in told
    assert "identity until trained" in told
    for key, value in first.items():
        if not key.startswith("alignment."):
            assert (deeper[key] - value).abs().max() < 1e-20
    # Of a fresh alignment the last map is zero, of the trained one it is not.
    assert deeper["alignment.out.weight"].abs().max() < 1e-20
    assert first["alignment.out.weight"].abs().max() > 1e-6


def test_dpt_heads_start_fresh_on_a_network_with_linear_ones(hand_shards, tmp_path, capsys):
    config = replace(SMALL, decoder=SMALL_DPT.decoder)
    linear = official_state(config, seed=8)
    path = write_pth(tmp_path / "linear.pth", linear, call(config))
    small = ["stage_channels=[4,4,4,4]", "fusion_channels=4", "out_channels=4"]
    found = start(
        hand_shards,
        tmp_path / "run",
        "model.head=dpt",
        "model.decoder.depth=4",
        *[f"model.dpt.{setting}" for setting in small],
        init=path,
        max_steps=1,
        **NO_STEPS,
    )
    assert torch.equal(found["encoder.norm.weight"], linear["enc_norm.weight"])
    told = capsys.readouterr().err
    assert "the file's is linear" in told
    assert "parent head of the file  ignored" in told


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("train.init=nowhere.pth", "nowhere.pth: no such file or folder"),
        ("model.decoder.depth=2", r"official\.pth: its decoder has .*depth 1.* has .*depth 2"),
        ("model.encoder.num_heads=1", r"official\.pth: its encoder has .*num_heads 2"),
    ],
)
def test_a_file_that_does_not_fit_stops_the_run_before_anything_is_written(
    hand_shards, tmp_path, official, override, message
):
    with pytest.raises(CheckpointError, match=message):
        start(hand_shards, tmp_path / "run", f"train.init={official}", override)
    assert not (tmp_path / "run").exists()


def test_a_resumed_run_does_not_read_its_initial_weights_again(
    hand_shards, tmp_path, official, capsys
):
    straight = start(hand_shards, tmp_path / "a", init=official, max_steps=4)
    start(hand_shards, tmp_path / "b", init=official, max_steps=2)
    official.unlink()
    capsys.readouterr()
    resumed = start(hand_shards, tmp_path / "b", init=official, max_steps=4)
    assert "train.init" not in capsys.readouterr().err
    assert all(torch.equal(resumed[key], value) for key, value in straight.items())
    assert "training checkpoint" in (shown := describe_weights(tmp_path / "b" / "last.ckpt"))
    assert "step        4" in shown


def test_a_checkpoint_from_before_a_key_existed_resumes_with_its_default(hand_shards, tmp_path):
    start(hand_shards, tmp_path / "run", max_steps=2)
    last = tmp_path / "run" / "last.ckpt"
    content = read_checkpoint(last)
    del content["l3r_config"]["train"]["init"]
    write_checkpoint(last, content)
    start(hand_shards, tmp_path / "run", max_steps=3)
    assert [int(row["step"]) for row in read_log(tmp_path / "run")] == [1, 2, 3]
