"""Steps that are not finite, over a stop and a resume."""

import json
from pathlib import Path

import pytest
import torch

from l3r.config import load_config
from l3r.errors import LaunchError, NotFiniteError
from l3r.train.module import TrainModule
from l3r.train.run import train
from tests.train.runs import layers, losses, read_log

ROOT = Path(__file__).parents[2]
STEP = TrainModule.training_step


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.fixture
def spoil(monkeypatch):
    """Make the loss of some steps not finite, and end the run in one."""

    def install(bad, end=0):
        def training_step(self, batch, batch_idx):
            step = self.trainer.global_step + 1
            if step == end:
                raise KeyError("gone")
            outputs = STEP(self, batch, batch_idx)
            return {**outputs, "loss": outputs["loss"] * (torch.nan if step in bad else 1)}

        monkeypatch.setattr(TrainModule, "training_step", training_step)

    return install


def test_weights_that_leave_the_finite_in_one_update_are_written_down(hand_shards, tmp_path):
    with pytest.raises(NotFiniteError, match="similarity scores"):
        run(hand_shards, tmp_path, lr=1e30)
    row = json.loads((tmp_path / "bad_steps.jsonl").read_text().splitlines()[-1])
    assert row["problem"].startswith("similarity scores are not finite")
    assert row["keys"]


def listed(folder):
    rows = (folder / "bad_steps.jsonl").read_text().splitlines()
    return [json.loads(row)["step"] for row in rows]


def run(shards, folder, **changes):
    rate = {"lr": 1e-3, "checkpoint_every": 3, "max_steps": 7, **changes}
    return train(load_config(layers(shards, folder, **rate)))


def test_bad_steps_in_a_row_are_counted_over_a_resume(hand_shards, tmp_path, spoil):
    spoil({2, 3, 4}, end=4)
    with pytest.raises(KeyError, match="gone"):
        run(hand_shards, tmp_path)
    spoil({2, 3, 4})
    with pytest.raises(LaunchError, match=r"step 4: .*3 such steps in a row"):
        run(hand_shards, tmp_path)
    assert listed(tmp_path) == [2, 3, 4]


def test_good_steps_before_a_stop_end_the_row(hand_shards, tmp_path, spoil):
    spoil({1, 2, 4, 5}, end=4)
    with pytest.raises(KeyError, match="gone"):
        run(hand_shards, tmp_path)
    spoil({1, 2, 4, 5})
    run(hand_shards, tmp_path)
    assert listed(tmp_path) == [1, 2, 4, 5]


def test_bad_steps_that_a_resumed_run_repeats_are_listed_once(hand_shards, tmp_path, spoil):
    for name, ends in (("straight", [0]), ("stopped", [6, 0])):
        for end in ends:
            spoil({2, 4, 5}, end)
            if end:
                with pytest.raises(KeyError, match="gone"):
                    run(hand_shards, tmp_path / name)
                assert listed(tmp_path / name) == [2, 4, 5]
                # A kill in the middle of a write leaves half a row.
                with (tmp_path / name / "bad_steps.jsonl").open("a") as stream:
                    stream.write('{"step": 6, "lo')
            else:
                run(hand_shards, tmp_path / name)
    texts = [(tmp_path / name / "bad_steps.jsonl").read_text() for name in ("straight", "stopped")]
    assert texts[0] == texts[1]
    assert listed(tmp_path / "stopped") == [2, 4, 5]


def test_bad_steps_have_the_number_they_have_in_the_log(hand_shards, tmp_path, spoil):
    spoil({3})
    run(hand_shards, tmp_path, max_steps=4)
    norms = {int(row["step"]): row["grad_norm"] for row in read_log(tmp_path)}
    assert [step for step, norm in norms.items() if norm == "nan"] == listed(tmp_path) == [3]


def test_a_run_that_stopped_at_bad_steps_goes_on_where_more_are_borne(hand_shards, tmp_path, spoil):
    spoil({2, 3, 4})
    with pytest.raises(LaunchError, match=r"train\.max_bad_steps"):
        run(hand_shards, tmp_path)
    run(hand_shards, tmp_path, max_bad_steps=4)
    assert listed(tmp_path) == [2, 3, 4]
    assert max(losses(tmp_path)) == 7
