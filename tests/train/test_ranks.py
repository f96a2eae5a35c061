"""Several processes train as one does; gloo on this machine's CPU."""

import json
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest
import torch

from l3r.config import load_config
from l3r.errors import ConfigError
from l3r.inference.checkpoint import read_checkpoint
from l3r.train.ranks import find_ranks
from tests.train.runs import layers, read_log

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


def launch(shards, folder, *settings, code=0, env=None, **train):
    """Train in processes of their own; they write down what they see in ``folder/seen``."""
    (folder / "seen").mkdir(parents=True, exist_ok=True)
    changes = layers(shards, folder, **{"validate_every": 100, **train})
    done = subprocess.run(
        [sys.executable, "-m", "tests.train.recorded", *changes, *settings],
        env={**os.environ, "RECORD": str(folder / "seen"), **(env or {})},
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == code, done.stderr
    return done.stderr


def seen(folder):
    """The graphs of each step, over all processes, and how many processes there were."""
    steps = defaultdict(list)
    files = sorted((folder / "seen").glob("*.jsonl"))
    for path in files:
        for line in path.read_text().splitlines():
            row = json.loads(line)
            steps[row["step"]] += row["keys"]
    return {step: sorted(keys) for step, keys in steps.items()}, len(files)


def assert_same_run(one, other, first_step=1):
    rows, expected = (
        [r for r in read_log(f) if int(r["step"]) >= first_step] for f in (one, other)
    )
    assert [row["step"] for row in rows] == [row["step"] for row in expected]
    for row, true in zip(rows, expected, strict=True):
        for name in ("loss", "pairwise", "global", "pair_error", "grad_norm", "lr"):
            assert float(row[name]) == pytest.approx(float(true[name]), rel=1e-4, abs=1e-6)
    found, weights = (read_checkpoint(f / "model.ckpt")["state_dict"] for f in (one, other))
    for key, value in weights.items():
        torch.testing.assert_close(found[key], value, rtol=1e-3, atol=1e-5)


FOUR = "data.graphs_per_step=4"


@pytest.fixture(scope="module")
def alone(hand_shards, tmp_path_factory):
    """Six steps of four graphs in one process and one batch."""
    folder = tmp_path_factory.mktemp("alone")
    os.chdir(ROOT)
    launch(hand_shards, folder, FOUR, max_steps=6, lr=1e-3)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("devices", "accumulate"), [(1, 2), (2, 1), (2, 2)])
def test_devices_and_batches_change_neither_samples_nor_losses_nor_weights(
    hand_shards, alone, tmp_path, devices, accumulate
):
    launch(
        hand_shards, tmp_path, FOUR, devices=devices, accumulate=accumulate, max_steps=6, lr=1e-3
    )
    steps, num_processes = seen(tmp_path)
    assert num_processes == devices
    assert steps == seen(alone)[0]
    assert_same_run(tmp_path, alone)
    rows = map(json.loads, (tmp_path / "seen" / "0.jsonl").read_text().splitlines())
    # After the fifth comes a checkpoint, which all wait for.
    assert len({row["collectives"] for row in rows if row["step"] <= 5}) == 1


@pytest.mark.slow
def test_shares_of_a_step_that_are_not_equal_weigh_by_their_graphs(hand_shards, tmp_path):
    runs = tmp_path / "alone", tmp_path / "uneven"
    for folder, train in zip(runs, ({}, {"devices": 2, "accumulate": 2}), strict=True):
        launch(hand_shards, folder, "data.graphs_per_step=5", max_steps=6, lr=1e-3, **train)
    one, other = (seen(folder)[0] for folder in runs)
    assert one == other
    assert {len(keys) for keys in one.values()} == {5}
    assert_same_run(*runs[::-1])


@pytest.mark.slow
def test_a_loss_that_is_not_finite_in_one_process_skips_the_step_in_all(hand_shards, tmp_path):
    for name, env in (("bad", {"NAN_AT": "3:1"}), ("good", {})):
        told = launch(hand_shards, tmp_path / name, devices=2, max_steps=4, lr=1e-3, env=env)
        assert told.count("train 4/4") == 1, "one process shows progress"
    lines = (tmp_path / "bad" / "bad_steps.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    assert [row["step"] for row in rows] == [3]
    assert sorted(rows[0]["keys"]) == seen(tmp_path / "bad")[0][3]
    assert len(rows[0]["keys"]) == 2
    state = read_checkpoint(tmp_path / "bad" / "model.ckpt")["state_dict"]
    assert all(value.isfinite().all() for value in state.values())
    bad, good = (read_log(tmp_path / name) for name in ("bad", "good"))
    assert bad[1] | {"graphs_per_second": 0, "data_wait": 0} == good[1] | {
        "graphs_per_second": 0,
        "data_wait": 0,
    }
    assert bad[3]["loss"] != good[3]["loss"]


@pytest.mark.slow
@pytest.mark.parametrize("fate", ["HANG_AT", "DIE_AT"])
def test_a_process_that_hangs_or_dies_ends_the_run_with_a_line(hand_shards, tmp_path, fate):
    told = launch(
        *(hand_shards, tmp_path),
        devices=2,
        max_steps=4,
        timeout_minutes=0.25,
        env={fate: "3:1"},
        code=2,
    )
    assert "process 0 of 2 lost another one" in told
    assert "train.timeout_minutes=0.25" in told
    assert "Traceback" not in told


def config(**train):
    changes = [f"train.{key}={value}" for key, value in train.items()]
    return load_config(["data.graphs_per_step=8", *changes])


SRUN = {
    "SLURM_STEP_NUM_TASKS": "8",
    "SLURM_STEP_TASKS_PER_NODE": "4(x2)",
    "SLURM_NTASKS_PER_NODE": "4",
    "SLURM_PROCID": "5",
}


def test_ranks_come_from_srun():
    ranks = find_ranks(config(), SRUN)
    assert (ranks.rank, ranks.devices, ranks.num_nodes, ranks.world_size) == (5, 4, 2, 8)
    assert ranks.is_srun
    assert not ranks.is_first


def test_without_srun_there_is_one_process_unless_said():
    assert find_ranks(config(), {"SLURM_JOB_ID": "7"}).world_size == 1
    ranks = find_ranks(config(devices=4, num_nodes=2), {"NODE_RANK": "1", "LOCAL_RANK": "2"})
    assert (ranks.rank, ranks.world_size, ranks.is_srun) == (6, 8, False)


@pytest.mark.parametrize(
    ("train", "env", "message"),
    [
        ({"devices": 8}, SRUN, r"train\.devices=8, .*srun started 4 .*2 nodes"),
        ({}, SRUN | {"SLURM_STEP_TASKS_PER_NODE": "5,3"}, "--ntasks-per-node"),
        ({"accumulate": 9}, {}, "expected at least 9: 1 devices, train.accumulate=9"),
        ({"devices": 3, "accumulate": 3}, {}, "graphs_per_step is 8, expected at least 9"),
    ],
)
def test_processes_that_do_not_fit_are_refused(train, env, message):
    with pytest.raises(ConfigError, match=message):
        find_ranks(config(**train), env)
