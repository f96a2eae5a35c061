"""Throughput and the wait for data, with a clock that the test moves."""

from types import SimpleNamespace
from unittest.mock import Mock

import lightning as L

from l3r.data.loader import StepLoader
from l3r.train.callbacks import StepProgress, StepTimer

VIEWS = None  # the callbacks look at no batch


class Run:
    """A trainer whose steps last as long as they are told to."""

    def __init__(self, monkeypatch, *, every, accumulate=1):
        self.now = 100.0
        clock = SimpleNamespace(perf_counter=lambda: self.now)
        monkeypatch.setattr("l3r.train.callbacks.time", clock)
        self.trainer = Mock(spec=L.Trainer)
        self.trainer.configure_mock(
            global_step=7, max_steps=1000, accumulate_grad_batches=accumulate, callback_metrics={}
        )
        self.trainer.is_global_zero = True
        self.trainer.train_dataloader = Mock(spec=StepLoader, waited=0.0)
        self.module = Mock(spec=L.LightningModule)
        self.timer = StepTimer(every, 8)
        self.timer.on_train_start(self.trainer, self.module)
        self.batches = 0

    def batch(self, seconds, waited):
        """One batch and its end, without the callback's annotation of a batch."""
        self.now += seconds
        self.trainer.train_dataloader.waited += waited
        self.batches += 1
        self.trainer.global_step = 7 + self.batches // self.trainer.accumulate_grad_batches
        end = StepTimer.on_train_batch_end.__wrapped__
        end(self.timer, self.trainer, self.module, None, VIEWS, self.batches - 1)

    def rows(self):
        calls = self.module.log_dict.call_args_list
        return [
            tuple(round(float(call.args[0][f"train/{name}"]), 6) for name in FIGURES)
            for call in calls
        ]


FIGURES = ("graphs_per_second", "data_wait")


def test_figures_span_the_steps_since_the_row_before(monkeypatch):
    run = Run(monkeypatch, every=3)
    run.batch(2.0, 1.5)  # step 8: its wait is the loader starting
    run.batch(2.0, 0.5)  # step 9: a row
    for waited in (0.0, 0.3, 0.0):
        run.batch(1.0, waited)
    assert run.rows() == [(2 * 8 / 4.0, 2.0 / 4.0), (3 * 8 / 3.0, 0.1)]


def test_a_step_in_several_batches_counts_once_and_validation_not_at_all(monkeypatch):
    run = Run(monkeypatch, every=1, accumulate=2)
    run.batch(1.0, 0.1)
    assert run.rows() == []
    run.batch(1.0, 0.1)
    run.timer.on_validation_start(run.trainer, run.module)
    run.now += 50.0
    run.timer.on_validation_end(run.trainer, run.module)
    run.batch(1.5, 0.0)
    run.batch(0.5, 0.5)
    assert run.rows() == [(4.0, 0.1), (4.0, 0.25)]


def test_the_note_spans_the_steps_since_the_note_before(monkeypatch, capsys):
    run = Run(monkeypatch, every=500)
    progress = StepProgress(run.timer)
    progress.on_train_start(run.trainer, run.module)
    end = StepProgress.on_train_batch_end.__wrapped__
    run.trainer.max_steps = 40  # a line every two steps
    for waited in (0.5, 0.0, 0.0, 0.02, 0.0, 0.0):
        run.batch(0.5, waited)
        end(progress, run.trainer, run.module, None, VIEWS, run.batches - 1)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split("graphs/s  ")[1] for line in lines] == [
        "data 100%  16 s left",
        "data 0%  15 s left",
        "data 2%  14 s left",
    ]
    assert "16.0 graphs/s" in lines[1]
