"""A run that is stopped, by a signal or by a full disk, goes on as if it had not been."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from l3r.config import load_config
from l3r.errors import CheckpointError, LaunchError
from l3r.inference.checkpoint import read_checkpoint
from l3r.train.checkpointing import FREE_TO_CHANGE, find_resume
from l3r.train.module import TrainModule
from l3r.train.run import train
from tests.train.runs import layers, losses, read_log
from tests.train.test_ranks import FOUR, assert_same_run, launch

ROOT = Path(__file__).parents[2]
STEP = TrainModule.training_step


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)
    for name in [name for name in os.environ if name.startswith("SLURM_")]:
        monkeypatch.delenv(name)


def config(shards, folder, **changes):
    rate = {
        "schedule": "cosine",
        "warmup_steps": 3,
        "max_steps": 9,
        "checkpoint_every": 100,
        "lr": 1e-3,
    }
    return load_config([*layers(shards, folder, **{**rate, **changes}), FOUR])


@pytest.fixture(scope="module")
def finished(hand_shards, tmp_path_factory):
    """Nine steps of four graphs that never stopped."""
    folder = tmp_path_factory.mktemp("finished")
    os.chdir(ROOT)
    train(config(hand_shards, folder))
    return folder


@pytest.fixture
def call_at(monkeypatch):
    """Call something in the middle of a step."""

    def install(step, action):
        def training_step(self, batch, batch_idx):
            if self.trainer.global_step + 1 == step:
                action()
            return STEP(self, batch, batch_idx)

        monkeypatch.setattr(TrainModule, "training_step", training_step)

    return install


def assert_equal_to_the_last_bit(one, other):
    assert losses(one) == losses(other)
    found, expected = (read_checkpoint(f / "model.ckpt")["state_dict"] for f in (one, other))
    assert all(torch.equal(found[key], value) for key, value in expected.items())


def test_sigterm_saves_the_step_and_the_same_command_goes_on(
    hand_shards, finished, tmp_path, call_at
):
    before = signal.getsignal(signal.SIGTERM)
    call_at(4, lambda: os.kill(os.getpid(), signal.SIGTERM))
    with pytest.raises(LaunchError, match=r"SIGTERM: step 4 is saved .*goes on from there"):
        train(config(hand_shards, tmp_path))
    assert signal.getsignal(signal.SIGTERM) is before
    assert not (tmp_path / "model.ckpt").exists()
    call_at(0, None)
    train(config(hand_shards, tmp_path))
    assert_equal_to_the_last_bit(tmp_path, finished)


def test_sigusr1_saves_and_requeues_the_job(hand_shards, finished, tmp_path, call_at, monkeypatch):
    tools = tmp_path / "bin"
    tools.mkdir()
    (tools / "scontrol").write_text(f'#!/bin/sh\necho "$*" > {tmp_path}/asked\n')
    (tools / "scontrol").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")
    monkeypatch.setenv("SLURM_JOB_ID", "70")
    monkeypatch.setenv("SLURM_ARRAY_JOB_ID", "68")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "3")
    call_at(5, lambda: os.kill(os.getpid(), signal.SIGUSR1))
    with pytest.raises(LaunchError, match=r"SIGUSR1: step 5 is saved .*job 68_3 is requeued"):
        train(config(hand_shards, tmp_path))
    assert (tmp_path / "asked").read_text() == "requeue 68_3\n"
    call_at(0, None)
    train(config(hand_shards, tmp_path))
    assert_equal_to_the_last_bit(tmp_path, finished)


def test_sigusr1_outside_slurm_saves_and_goes_on(hand_shards, finished, tmp_path, call_at):
    call_at(5, lambda: os.kill(os.getpid(), signal.SIGUSR1))
    train(config(hand_shards, tmp_path))
    saved = read_checkpoint(tmp_path / "previous.ckpt")["global_step"]
    assert saved == 5
    assert_equal_to_the_last_bit(tmp_path, finished)


@pytest.mark.parametrize(("kill_at", "saved"), [("validation", 3), ("training", 6)])
def test_no_validation_is_lost_or_made_twice(
    hand_shards, finished, tmp_path, monkeypatch, kill_at, saved
):
    """A run that ends in or after the validation of step 6, where a checkpoint is due as well."""
    name = f"{kill_at}_step"
    step = getattr(TrainModule, name)

    def fail(self, batch, batch_idx):
        if self.trainer.global_step == 6:
            raise KeyError("gone")
        return step(self, batch, batch_idx)

    often = {"validate_every": 3, "checkpoint_every": 3}
    train(config(hand_shards, tmp_path / "straight", **often))
    with monkeypatch.context() as patch:
        patch.setattr(TrainModule, name, fail)
        with pytest.raises(KeyError, match="gone"):
            train(config(hand_shards, tmp_path / "stopped", **often))
    assert read_checkpoint(tmp_path / "stopped" / "last.ckpt")["global_step"] == saved
    train(config(hand_shards, tmp_path / "stopped", **often))
    logs = [(tmp_path / n / "validation.csv").read_text() for n in ("straight", "stopped")]
    assert logs[0] == logs[1]
    assert_equal_to_the_last_bit(tmp_path / "stopped", finished)


def test_a_checkpoint_is_made_when_its_minutes_are_over(hand_shards, tmp_path, call_at):
    call_at(3, lambda: time.sleep(1))
    train(config(hand_shards, tmp_path, checkpoint_minutes=1e-9, max_steps=4))
    steps = [read_checkpoint(tmp_path / f"{n}.ckpt")["global_step"] for n in ("previous", "last")]
    assert steps == [4, 4]


@pytest.mark.parametrize("damage", ["cut", "spoilt", "empty"])
def test_a_damaged_checkpoint_is_passed_over_for_the_one_before(
    hand_shards, finished, tmp_path, damage, caplog
):
    train(config(hand_shards, tmp_path, max_steps=9))
    (tmp_path / "model.ckpt").unlink()
    with pytest.raises(LaunchError):
        stop_at_three(hand_shards, tmp_path / "half")
    shutil.copy(tmp_path / "half" / "last.ckpt", tmp_path / "previous.ckpt")
    last = tmp_path / "last.ckpt"
    content = bytearray(last.read_bytes())
    content[len(content) // 2] ^= 1
    last.write_bytes({"cut": content[:-1000], "spoilt": content, "empty": b""}[damage])
    caplog.clear()
    train(config(hand_shards, tmp_path))
    assert f"going on from {tmp_path / 'previous.ckpt'}" in caplog.text
    assert_equal_to_the_last_bit(tmp_path, finished)


def stop_at_three(shards, folder):
    def training_step(self, batch, batch_idx):
        if self.trainer.global_step == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return STEP(self, batch, batch_idx)

    TrainModule.training_step = training_step
    try:
        train(config(shards, folder))
    finally:
        TrainModule.training_step = STEP


def test_where_no_checkpoint_can_be_read_nothing_is_begun_anew(hand_shards, tmp_path):
    for name in ("last.ckpt", "previous.ckpt"):
        (tmp_path / name).write_bytes(b"PK")
    with pytest.raises(CheckpointError, match=r"last\.ckpt.*move it away"):
        find_resume(tmp_path / "last.ckpt", config(hand_shards, tmp_path))


def test_a_kill_between_two_renames_loses_nothing(hand_shards, finished, tmp_path):
    with pytest.raises(LaunchError):
        stop_at_three(hand_shards, tmp_path)
    (tmp_path / "last.ckpt").rename(tmp_path / "previous.ckpt")
    (tmp_path / ".last.ckpt.1-0.tmp").write_bytes(b"half")
    train(config(hand_shards, tmp_path))
    assert_equal_to_the_last_bit(tmp_path, finished)
    assert not [*tmp_path.glob(".*.tmp")]


def test_a_full_disk_costs_no_checkpoint_and_no_step(hand_shards, finished, tmp_path):
    with pytest.raises(LaunchError):
        stop_at_three(hand_shards, tmp_path)
    good = (tmp_path / "last.ckpt").read_bytes()
    # The kernel refuses to write a file of more than half a checkpoint, as a full disk would.
    limit = len(good) // 2
    rate = {
        "schedule": "cosine",
        "warmup_steps": 3,
        "max_steps": 9,
        "checkpoint_every": 5,
        "lr": 1e-3,
    }
    done = subprocess.run(
        [sys.executable, "-m", "l3r", "train", *layers(hand_shards, tmp_path, **rate), FOUR],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "step 5 cannot be saved" in done.stderr
    assert "the end cannot be saved" in done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "last.ckpt").read_bytes() == good
    assert losses(tmp_path) == losses(finished)
    assert not [*tmp_path.glob(".*.tmp")]
    train(config(hand_shards, tmp_path))
    assert_equal_to_the_last_bit(tmp_path, finished)


@pytest.mark.parametrize(("before", "after"), [(1, 2), (2, 4), (4, 1)])
def test_a_resumed_run_may_take_its_steps_in_other_batches(
    hand_shards, finished, tmp_path, before, after, call_at
):
    call_at(4, lambda: os.kill(os.getpid(), signal.SIGTERM))
    with pytest.raises(LaunchError, match="step 4 is saved"):
        train(config(hand_shards, tmp_path, accumulate=before))
    call_at(0, None)
    train(config(hand_shards, tmp_path, accumulate=after))
    assert_same_run(tmp_path, finished)
    validations = [[r["step"] for r in read_log(f, "validation.csv")] for f in (tmp_path, finished)]
    assert validations[0] == validations[1]


@pytest.mark.slow
def test_a_run_of_two_processes_resumes_to_the_last_bit(hand_shards, tmp_path):
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    # Rows of three steps: the checkpoint of step 2 cuts one in two, and its sums go on as well.
    options = {"devices": 2, "lr": 1e-3, "checkpoint_every": 2, "log_every": 3}
    launch(hand_shards, straight, FOUR, max_steps=6, **options)
    died = {"DIE_AT": "4:1"}
    launch(hand_shards, stopped, FOUR, max_steps=6, **options, env=died, code=2)
    launch(hand_shards, stopped, FOUR, max_steps=6, **options)
    assert_equal_to_the_last_bit(stopped, straight)
    sums = [[(row["step"], row["hand/loss"]) for row in read_log(f)] for f in (stopped, straight)]
    assert sums[0] == sums[1]


def test_what_may_change_at_resume_exists():
    train_keys = {key.split(".")[1] for key in FREE_TO_CHANGE if key.startswith("train.")}
    assert train_keys <= set(load_config(["train.seed=0"]).train.__slots__)
