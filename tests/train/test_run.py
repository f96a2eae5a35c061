import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import pytest
import torch

import l3r
from l3r.cli.main import main
from l3r.config import from_plain, load_config
from l3r.errors import CheckpointError, ConfigError, LaunchError
from l3r.export.graph_sheet import CELL
from l3r.inference.checkpoint import load_model_and_config, read_checkpoint
from l3r.loss.joint import JointLoss
from l3r.train.run import train
from tests.train.runs import layers, losses, read_log

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.fixture(scope="module")
def finished(hand_shards, tmp_path_factory):
    """A run of 12 steps that never stopped."""
    folder = tmp_path_factory.mktemp("finished")
    os.chdir(ROOT)
    train(load_config(layers(hand_shards, folder, max_steps=12)))
    return folder


def test_a_run_leaves_its_log_its_configuration_and_its_weights(finished, hand_shards):
    rows = read_log(finished)
    assert [int(row["step"]) for row in rows] == list(range(1, 13))
    expected = {
        "step",
        "lr",
        "loss",
        "pairwise",
        "global",
        "pair_error",
        "global_error",
        "grad_norm",
        "graphs_per_second",
        "data_wait",
        *(f"grad_norm_{room}" for room in ("encoder", "alignment", "decoder", "heads")),
        "log_conf",
        "confident",
        "root_degree",
        "root_degree_max",
        "tree_depth",
        "hand/loss",
        "hand/pair_error",
    }
    assert set(rows[0]) == expected
    validation = read_log(finished, "validation.csv")
    assert [int(row["step"]) for row in validation] == [5, 10]
    assert {"loss", "rra_15", "rta_15", "ate", "reg"} <= set(validation[0])
    model, config = load_model_and_config(finished / "model.ckpt")
    assert config == load_config(layers(hand_shards, finished, max_steps=12))
    assert not model.training
    assert load_config([str(finished / "config.yaml")]) == config


def test_each_validation_draws_its_first_graph(finished):
    names = ["step_000005.png", "step_000010.png"]
    assert sorted(path.name for path in (finished / "pictures").iterdir()) == names
    sheet = cv2.imread(str(finished / "pictures" / names[1]))
    assert sheet.shape == (4 * (CELL + 4), 76 + 3 * (CELL + 4), 3)


def test_a_finished_run_has_a_report_with_its_pictures(finished, tmp_path, capsys):
    page = tmp_path / "page.html"
    assert main(["report", str(finished), "--out", str(page)]) == 0
    assert capsys.readouterr().out.startswith("finished: step 12 of 12")
    text = page.read_text()
    assert all(f"<h3>Step {step}</h3>" in text for step in (5, 10))
    assert f"threads</td><td>{torch.get_num_threads()}" in text
    # All that was logged can be drawn: no file is missing or damaged.
    assert "Missing or damaged" not in text
    for title in ("RRA", "Norm of the gradient", "Trees", "Mean log-confidence"):
        assert title in text


def test_checkpoints_read_without_pickles_and_carry_the_configuration(finished):
    plain = torch.load(finished / "last.ckpt", weights_only=True)
    assert plain["global_step"] == 12
    config = from_plain(plain["l3r_config"], "last.ckpt")
    assert config.data.num_views == 3
    trained, final = (l3r.load_model(finished / name) for name in ("last.ckpt", "model.ckpt"))
    for one, two in zip(trained.parameters(), final.parameters(), strict=True):
        assert torch.equal(one, two)


def test_a_finished_run_started_again_does_nothing_more(finished, hand_shards):
    before = (finished / "metrics.csv").read_bytes()
    train(load_config(layers(hand_shards, finished, max_steps=12)))
    assert (finished / "metrics.csv").read_bytes() == before


def test_another_configuration_in_the_same_folder_is_refused(finished, hand_shards):
    with pytest.raises(ConfigError, match=r"train\.seed=0, this run has 1; .*output_dir"):
        train(load_config(layers(hand_shards, finished, max_steps=12, seed=1)))
    with pytest.raises(CheckpointError, match=r"past train\.max_steps=11"):
        train(load_config(layers(hand_shards, finished, max_steps=11)))


def wait_for_step(folder, step, process):
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if (folder / "metrics.csv").exists() and len(read_log(folder)) >= step:
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    raise TimeoutError


@pytest.mark.parametrize("num_workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_killed_run_goes_on_as_if_it_had_never_stopped(
    hand_shards, finished, tmp_path, num_workers
):
    """kill -9 somewhere after the checkpoint of step 5; then the same command again."""
    extra = [f"data.num_workers={num_workers}"]
    arguments = [*layers(hand_shards, tmp_path, max_steps=12), *extra]
    command = [sys.executable, "-m", "l3r", "train", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    wait_for_step(tmp_path, 7, process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    interrupted = read_checkpoint(tmp_path / "last.ckpt")["global_step"]
    assert interrupted in (5, 10)
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert losses(tmp_path) == losses(finished)
    assert len(read_log(tmp_path, "validation.csv")) == 2
    first, second = (read_checkpoint(f / "model.ckpt")["state_dict"] for f in (tmp_path, finished))
    assert all(torch.equal(first[key], second[key]) for key in second)


def test_a_run_may_move_with_its_shards(hand_shards, finished, tmp_path):
    train(load_config(layers(hand_shards, tmp_path / "a", max_steps=5)))
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    shutil.copytree(hand_shards, tmp_path / "shards")
    train(load_config(layers(tmp_path / "shards", tmp_path / "b", max_steps=12, note="moved")))
    assert losses(tmp_path / "b") == losses(finished)


def test_a_run_of_an_older_version_goes_on_with_more_columns(hand_shards, tmp_path):
    train(load_config(layers(hand_shards, tmp_path, max_steps=5)))
    log = tmp_path / "metrics.csv"
    log.write_text(log.read_text().replace("pair_error", "old_error"))
    train(load_config(layers(hand_shards, tmp_path, max_steps=6)))
    rows = read_log(tmp_path)
    assert len(rows) == 6
    assert rows[4]["old_error"]
    assert rows[4]["pair_error"] == "" != rows[5]["pair_error"]
    assert rows[5]["old_error"] == ""


def test_a_gpu_that_is_not_there_is_a_clear_error(hand_shards, tmp_path, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"train\.accelerator is gpu"):
        train(load_config(layers(hand_shards, tmp_path, accelerator="gpu")))


def test_half_a_written_row_is_dropped_at_resume(finished, hand_shards, tmp_path):
    train(load_config(layers(hand_shards, tmp_path, max_steps=5)))
    log = tmp_path / "metrics.csv"
    log.write_text(log.read_text() + "6,0.01,3.")
    train(load_config(layers(hand_shards, tmp_path, max_steps=12)))
    assert losses(tmp_path) == losses(finished)


class BrokenLoss(JointLoss):
    """Not finite at chosen calls of the training step."""

    bad_calls = ()

    def __init__(self, config):
        super().__init__(config)
        self.calls = 0

    def forward(self, prediction, views):
        terms = super().forward(prediction, views)
        if self.training:
            self.calls += 1
            if self.calls in self.bad_calls:
                object.__setattr__(terms, "total", terms.total * torch.nan)
        return terms


def test_a_step_that_is_not_finite_is_skipped_and_written_down(hand_shards, tmp_path, monkeypatch):
    monkeypatch.setattr(BrokenLoss, "bad_calls", (3, 4))
    monkeypatch.setattr("l3r.train.run.JointLoss", BrokenLoss)
    train(load_config(layers(hand_shards, tmp_path, max_steps=6)))
    rows = (tmp_path / "bad_steps.jsonl").read_text().splitlines()
    assert len(rows) == 2
    assert "hand-" in rows[0]
    model = l3r.load_model(tmp_path / "model.ckpt")
    assert all(p.isfinite().all() for p in model.parameters())


def test_three_bad_steps_in_a_row_stop_the_run(hand_shards, tmp_path, monkeypatch):
    monkeypatch.setattr(BrokenLoss, "bad_calls", (2, 3, 4))
    monkeypatch.setattr("l3r.train.run.JointLoss", BrokenLoss)
    with pytest.raises(LaunchError, match=r"3 such steps in a row.*bad_steps\.jsonl"):
        train(load_config(layers(hand_shards, tmp_path, max_steps=6)))


def test_a_bad_step_leaves_the_weights_alone(hand_shards, tmp_path, monkeypatch):
    monkeypatch.setattr("l3r.train.run.JointLoss", BrokenLoss)
    monkeypatch.setattr(BrokenLoss, "bad_calls", (4,))
    train(load_config(layers(hand_shards, tmp_path / "bad", max_steps=4)))
    monkeypatch.setattr(BrokenLoss, "bad_calls", ())
    train(load_config(layers(hand_shards, tmp_path / "good", max_steps=3)))
    bad, good = (l3r.load_model(tmp_path / name / "model.ckpt") for name in ("bad", "good"))
    for one, two in zip(bad.parameters(), good.parameters(), strict=True):
        assert torch.equal(one, two)


def test_training_learns_something(hand_shards, tmp_path):
    train(load_config(layers(hand_shards, tmp_path, max_steps=40)))
    rows = read_log(tmp_path)
    first, last = (sum(float(r["pair_error"]) for r in part) for part in (rows[:5], rows[-5:]))
    assert last < 0.8 * first
