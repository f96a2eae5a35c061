"""What breaks around a run: shards, disks, loader processes, other processes."""

import io
import json
import logging
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from l3r.config import load_config
from l3r.errors import DataError, LaunchError
from l3r.inference.checkpoint import read_checkpoint
from l3r.train.run import train
from tests.data.test_loader import spoil
from tests.train.runs import layers, losses, read_log
from tests.train.test_checkpoints import (
    FOUR,
    assert_equal_to_the_last_bit,
    call_at,
    config,
    finished,
    in_the_repository,
)
from tests.train.test_ranks import launch, seen

ROOT = Path(__file__).parents[2]
FIXTURES = (call_at, finished, in_the_repository)


def spoil_second_shard(shards):
    for number in range(4, 8):
        spoil(shards, number)


@pytest.fixture
def own_shards(hand_shards, tmp_path):
    return Path(shutil.copytree(hand_shards, tmp_path / "shards"))


@pytest.mark.slow
def test_a_shard_that_is_damaged_in_a_run_is_replaced_sample_by_sample(
    own_shards, tmp_path, call_at, caplog
):
    call_at(3, lambda: spoil_second_shard(own_shards))
    with caplog.at_level(logging.WARNING):
        train(
            load_config(
                [
                    *layers(own_shards, tmp_path / "run", lr=1e-3, max_steps=8),
                    FOUR,
                    "data.max_skip_rate=0.5",
                    "data.validation={}",
                ]
            )
        )
    assert len(losses(tmp_path / "run")) == 8
    assert "sample skipped (1 so far): shards/hand-000001.tar:hand-00000" in caplog.text


@pytest.mark.slow
def test_a_run_over_the_rate_of_damaged_samples_stops_and_goes_on_once_they_are_mended(
    own_shards, hand_shards, finished, tmp_path, call_at
):
    call_at(3, lambda: spoil_second_shard(own_shards))
    broken = config(own_shards, tmp_path / "run", checkpoint_every=1)
    broken.data.max_skip_rate = 0.0
    with pytest.raises(DataError, match=r"max_skip_rate=0\.0 .*last: shards/hand-000001\.tar"):
        train(broken)
    step = read_checkpoint(tmp_path / "run" / "last.ckpt")["global_step"]
    assert 3 <= step < 9
    call_at(0, None)
    train(config(hand_shards, tmp_path / "run", checkpoint_every=1))
    assert_equal_to_the_last_bit(tmp_path / "run", finished)


@pytest.mark.slow
def test_a_run_whose_loader_process_is_killed_says_so_and_goes_on(
    hand_shards, finished, tmp_path, call_at
):
    def kill_loader():
        (worker,) = multiprocessing.active_children()
        os.kill(worker.pid, signal.SIGKILL)

    run = config(hand_shards, tmp_path, checkpoint_every=1)
    run.data.num_workers, run.data.prefetch_factor = 1, 1
    call_at(3, kill_loader)
    with pytest.raises(LaunchError, match=r"exited.*data\.num_workers.*same command"):
        train(run)
    assert 3 <= read_checkpoint(tmp_path / "last.ckpt")["global_step"] < 9
    call_at(0, None)
    train(run)
    assert_equal_to_the_last_bit(tmp_path, finished)


def test_a_signal_in_the_middle_of_a_checkpoint_leaves_it_whole(
    hand_shards, finished, tmp_path, monkeypatch
):
    real, found = torch.save, []

    def save(content, stream):
        whole = io.BytesIO()
        real(content, whole)
        half = whole.tell() // 2
        stream.write(whole.getvalue()[:half])
        stream.flush()
        if content["global_step"] == 4:
            os.kill(os.getpid(), signal.SIGTERM)
            found.append(read_checkpoint(tmp_path / "last.ckpt")["global_step"])
        stream.write(whole.getvalue()[half:])

    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", save)
        with pytest.raises(LaunchError, match="SIGTERM: step 5 is saved"):
            train(config(hand_shards, tmp_path, checkpoint_every=2))
    assert found == [2], "the last one stays until the next is whole"
    steps = [read_checkpoint(tmp_path / f"{n}.ckpt")["global_step"] for n in ("previous", "last")]
    assert steps == [4, 5]
    assert not [*tmp_path.glob(".*.tmp")]
    train(config(hand_shards, tmp_path, checkpoint_every=2))
    assert_equal_to_the_last_bit(tmp_path, finished)


def command(shards, folder, **changes):
    rate = {"schedule": "cosine", "warmup_steps": 3, "max_steps": 9, "lr": 1e-3, **changes}
    return [sys.executable, "-m", "tests.train.recorded", *layers(shards, folder, **rate), FOUR]


@pytest.mark.slow
def test_a_kill_in_the_middle_of_a_checkpoint_costs_the_steps_since_the_one_before(
    hand_shards, finished, tmp_path
):
    again = command(hand_shards, tmp_path, checkpoint_every=2)
    done = subprocess.run(again, env={**os.environ, "DIE_IN_SAVE": "6"}, capture_output=True)
    assert done.returncode == -signal.SIGKILL
    (half,) = tmp_path.glob(".last.ckpt.*.tmp")
    assert half.stat().st_size > 1000
    assert read_checkpoint(tmp_path / "last.ckpt")["global_step"] == 4
    subprocess.run(again, check=True, capture_output=True)
    assert not half.exists()
    assert_equal_to_the_last_bit(tmp_path, finished)


@pytest.mark.slow
def test_a_full_disk_costs_rows_of_the_log_and_neither_steps_nor_the_last_checkpoint(
    hand_shards, finished, tmp_path
):
    """Not even a row fits from step 4 to step 7."""
    done = subprocess.run(
        command(hand_shards, tmp_path, checkpoint_every=3),
        env={**os.environ, "FULL": "4:7"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    for step in (4, 5, 6):
        assert f"row of step {step} in metrics.csv is lost: File too large" in done.stderr
    assert "row of step 5 in validation.csv is lost" in done.stderr
    assert "picture of step 5 is lost" in done.stderr
    assert "step 6 cannot be saved" in done.stderr
    assert [int(row["step"]) for row in read_log(tmp_path)] == [1, 2, 3, 7, 8, 9]
    assert losses(tmp_path).items() <= losses(finished).items()
    weights = [read_checkpoint(f / "model.ckpt")["state_dict"] for f in (tmp_path, finished)]
    assert all(torch.equal(weights[0][key], value) for key, value in weights[1].items())


@pytest.mark.slow
def test_bad_steps_now_of_one_process_and_now_of_the_other_are_in_a_row(hand_shards, tmp_path):
    told = launch(
        *(hand_shards, tmp_path, FOUR),
        devices=2,
        max_steps=9,
        env={"NAN_AT": "3:1,4:0,5:1"},
        code=2,
    )
    assert "step 5: " in told
    assert "3 such steps in a row" in told
    assert "lost another one" not in told, "all stop for the same reason"
    rows = [json.loads(line) for line in (tmp_path / "bad_steps.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [3, 4, 5]
    for row in rows:
        assert sorted(row["keys"]) == seen(tmp_path)[0][row["step"]]
        assert len(row["keys"]) == 4


@pytest.mark.slow
def test_a_signal_to_one_process_saves_and_ends_all(hand_shards, tmp_path):
    options = {"devices": 2, "max_steps": 6, "lr": 1e-3}
    launch(hand_shards, tmp_path / "straight", FOUR, **options)
    term = {"TERM_AT": "3:1"}
    told = launch(hand_shards, tmp_path / "run", FOUR, **options, env=term, code=2)
    assert "SIGTERM: step 3 is saved" in told
    assert max(seen(tmp_path / "run")[0]) == 3
    launch(hand_shards, tmp_path / "run", FOUR, **options)
    assert_equal_to_the_last_bit(tmp_path / "run", tmp_path / "straight")
