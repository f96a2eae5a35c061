import builtins
import re
from pathlib import Path

import pytest

from l3r.config import load_config
from l3r.errors import ConfigError
from l3r.train.run import train
from tests.train.runs import layers, read_log

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


def test_tensorboard_shows_a_resumed_run_as_one_curve(hand_shards, tmp_path):
    accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    for steps in (7, 12):  # the checkpoint at the end of the first is what the second goes on from
        settings = layers(hand_shards, tmp_path, max_steps=steps)
        train(load_config([*settings, "logs.to=[tensorboard]"]))
    events = accumulators.EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    for tag, column in (("train/loss", "loss"), ("train/hand/loss", "hand/loss")):
        found = {event.step: event.value for event in events.Scalars(tag)}
        expected = {int(row["step"]): float(row[column]) for row in read_log(tmp_path)}
        assert found == pytest.approx(expected, rel=1e-6)
    assert [event.step for event in events.Scalars("val/rra_15")] == [5, 10]


def test_a_resumed_run_goes_on_with_its_run_of_weights_and_biases(hand_shards, tmp_path):
    for steps in (1, 2):
        settings = layers(hand_shards, tmp_path, max_steps=steps)
        train(load_config([*settings, "logs.to=[wandb]", "logs.wandb_mode=offline"]))
    name = (tmp_path / "wandb_id.txt").read_text().strip()
    runs = sorted((tmp_path / "wandb").glob("offline-run-*"))
    assert runs
    assert all(is_named(run, name) for run in runs)
    assert all((run / f"run-{name}.wandb").stat().st_size > 0 for run in runs)


def is_named(run, name):
    """Two that start in the same second are told apart by a number at the end."""
    return re.search(rf"-{name}(-\d+)?$", run.name) is not None


def test_a_run_whose_name_was_lost_goes_on_with_it(hand_shards, tmp_path):
    """A folder that was copied without ``wandb_id.txt``: the checkpoint knows the name as well."""
    place, names = tmp_path / "wandb_id.txt", []
    for steps in (1, 2):
        settings = layers(hand_shards, tmp_path, max_steps=steps)
        train(load_config([*settings, "logs.to=[wandb]", "logs.wandb_mode=offline"]))
        names.append(place.read_text())
        place.unlink()
    assert names[0] == names[1]
    runs = [*(tmp_path / "wandb").glob("offline-run-*")]
    assert len(runs) == 2
    assert all(is_named(run, names[0].strip()) for run in runs)


def test_a_missing_package_is_a_clear_error_before_anything_is_written(
    hand_shards, tmp_path, monkeypatch
):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "torch.utils.tensorboard":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    settings = layers(hand_shards, tmp_path / "run", max_steps=1)
    with pytest.raises(ConfigError, match=r"tensorboard.*pip install 'light3r\[log\]'"):
        train(load_config([*settings, "logs.to=[tensorboard]"]))
    assert not (tmp_path / "run").exists()


def test_an_unknown_place_is_refused():
    with pytest.raises(ConfigError, match=r"logs\.to is \['mlflow'\], expected a list of tensor"):
        load_config(["logs.to=[mlflow]"])
