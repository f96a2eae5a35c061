"""What is known to go wrong in training frameworks of this kind, one trap each."""

import dataclasses
import os
import signal
import sys
from types import SimpleNamespace

import lightning as L
import pytest
import torch

from l3r.config import LossConfig, load_config
from l3r.errors import LaunchError
from l3r.inference.checkpoint import read_checkpoint
from l3r.loss.joint import JointLoss
from l3r.train.run import train
from l3r.train.signals import requeue_job
from tests.data.graphs import make_graph, write_folder
from tests.loss.scenes import random_views
from tests.model.test_light3r import build
from tests.train.runs import layers, losses, read_log
from tests.train.test_checkpoints import (
    FOUR,
    assert_equal_to_the_last_bit,
    call_at,
    config,
    finished,
    in_the_repository,
)
from tests.train.test_ranks import launch

FIXTURES = (call_at, finished, in_the_repository)


@pytest.mark.parametrize("accumulate", [1, 2])
def test_a_checkpoint_counts_the_steps_trained_on_and_none_that_was_fetched(
    hand_shards, tmp_path, accumulate
):
    settings = {"max_steps": 3, "checkpoint_every": 2, "accumulate": accumulate}
    train(load_config([*layers(hand_shards, tmp_path, **settings), FOUR]))
    content = read_checkpoint(tmp_path / "previous.ckpt")
    assert content["global_step"] == 2
    assert content["loops"]["fit_loop"]["state_dict"]["combined_loader"] == [{"step": 2}]


def test_the_length_of_the_schedule_is_never_asked_of_the_trainer(
    hand_shards, tmp_path, monkeypatch
):
    """Asking makes lightning forget the loader's state at resume, without a word."""

    def refuse(trainer):
        raise AssertionError("estimated_stepping_batches was asked for")

    monkeypatch.setattr(L.Trainer, "estimated_stepping_batches", property(refuse))
    for steps in (1, 2):  # fresh, and resumed
        settings = {"max_steps": steps, "schedule": "constant", "warmup_steps": 1}
        train(load_config(layers(hand_shards, tmp_path, **settings)))


@pytest.mark.slow
def test_torchs_generators_change_nothing_that_is_learnt(hand_shards, finished, tmp_path, call_at):
    """A resumed run finds them in another state, and lightning restores none."""
    call_at(4, lambda: torch.manual_seed(99))
    train(config(hand_shards, tmp_path))
    assert_equal_to_the_last_bit(tmp_path, finished)


def views_without_pixels(num_valid):
    """Two graphs: one without a valid pixel, one with a few."""
    views = random_views(3)
    keep = torch.zeros_like(views.valid)
    keep[1, 0].view(-1)[:num_valid] = True
    return dataclasses.replace(views, valid=keep, depth=views.depth.clamp_min(1.0) * keep)


def assert_every_parameter_has_a_finite_gradient(model, views):
    prediction = model(views.image.double(), views.true_shape)
    JointLoss(LossConfig())(prediction, views).total.backward()
    missing = [name for name, p in model.named_parameters() if p.grad is None]
    assert not missing
    assert all(p.grad.isfinite().all() for p in model.parameters())


@pytest.mark.parametrize("num_valid", [0, 9, 99])
def test_graphs_with_few_valid_pixels_leave_no_parameter_without_a_gradient(num_valid):
    """DDP waits for each of them; a skipped loss must be a zero, not a gap."""
    assert_every_parameter_has_a_finite_gradient(build(), views_without_pixels(num_valid))


def test_points_that_fall_into_one_leave_every_gradient_finite():
    """A fit between maps without extent has no answer, and of a naive one no gradient is finite."""
    model = build()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "head" in name:
                parameter.zero_()
    views = random_views(3)
    pairs = model(views.image.double(), views.true_shape).pairs
    assert not pairs.child_pts3d.any()
    assert_every_parameter_has_a_finite_gradient(model, views)


@pytest.mark.slow
def test_processes_with_and_without_valid_pixels_wait_for_no_gradient(tmp_path):
    """Recomputed activations and unused parameters are each how DDP comes to hang or refuse."""
    graphs = [make_graph(n, num_views=3, height=16, width=16) for n in range(8)]
    blind = [
        dataclasses.replace(g, depth=[0 * depth for depth in g.depth]) if n % 2 else g
        for n, g in enumerate(graphs)
    ]
    shards = write_folder(tmp_path / "shards", blind)
    options = {"max_steps": 8, "lr": 1e-3, "timeout_minutes": 1}
    launch(shards, tmp_path / "run", **options, devices=2, gradient_checkpointing="true")
    rows = read_log(tmp_path / "run")
    assert len(rows) == 8
    assert all(float(row["grad_norm"]) < float("inf") for row in rows)
    assert not (tmp_path / "run" / "bad_steps.jsonl").exists()


def test_without_scontrol_the_script_of_the_job_is_asked(tmp_path, monkeypatch):
    asked = tmp_path / "asked"
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("SLURM_JOB_ID", "70")
    monkeypatch.setenv("L3R_REQUEUE_FILE", str(asked))
    assert requeue_job() == "job 70 is to be requeued by its script and goes on from there"
    assert asked.exists()
    monkeypatch.setenv("L3R_REQUEUE_FILE", str(tmp_path / "nowhere" / "asked"))
    assert "cannot be requeued" in requeue_job()


REFUSES = "#!/bin/sh\necho 'no such job' >&2\nexit 1\n"


@pytest.mark.parametrize("scontrol", [None, pytest.param(REFUSES, marks=pytest.mark.slow)])
def test_a_job_that_cannot_be_requeued_has_saved_and_goes_on(
    hand_shards, finished, tmp_path, call_at, monkeypatch, scontrol
):
    """In containers there is often no ``scontrol``."""
    tools = tmp_path / "bin"
    tools.mkdir()
    if scontrol:
        (tools / "scontrol").write_text(scontrol)
        (tools / "scontrol").chmod(0o755)
    with monkeypatch.context() as patch:
        patch.setenv("PATH", str(tools))
        patch.setenv("SLURM_JOB_ID", "70")
        call_at(5, lambda: os.kill(os.getpid(), signal.SIGUSR1))
        reason = "no such job" if scontrol else "No such file"
        match = rf"step 5 is saved .*job 70 cannot be requeued .*{reason}.*same command again"
        with pytest.raises(LaunchError, match=match):
            train(config(hand_shards, tmp_path))
    assert read_checkpoint(tmp_path / "last.ckpt")["global_step"] == 5
    call_at(0, None)
    train(config(hand_shards, tmp_path))
    assert_equal_to_the_last_bit(tmp_path, finished)


class FakeWandb:
    """Writes down what it is told."""

    def __init__(self):
        self.started, self.axes, self.rows, self.Settings = [], [], [], SimpleNamespace

    def init(self, **options):
        self.started.append(options)
        return self

    def define_metric(self, name, step_metric=None):
        self.axes.append((name, step_metric))

    def log(self, row):
        self.rows.append(row)

    def finish(self):
        pass


def test_curves_stand_over_the_optimisation_step_in_one_run_however_often_it_stops(
    hand_shards, tmp_path, monkeypatch
):
    """Lightning's own logger counts its calls, and a resumed run would begin another curve."""
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    for steps in (2, 4):
        settings = layers(hand_shards, tmp_path, max_steps=steps)
        train(load_config([*settings, "logs.to=[wandb]", "data.validation={}"]))
    assert [options["resume"] for options in fake.started] == ["allow", "allow"]
    assert [options["mode"] for options in fake.started] == ["offline", "offline"]
    assert len({options["id"] for options in fake.started}) == 1
    assert fake.axes == [("step", None), ("*", "step")] * 2
    assert [row["step"] for row in fake.rows] == [1, 2, 3, 4]
    assert sorted(losses(tmp_path)) == [1, 2, 3, 4], "the CSV files are written in any case"
