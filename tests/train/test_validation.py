"""Validation is shared out over the processes, and what it finds does not depend on how many."""

import dataclasses
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from l3r.config import load_config
from l3r.data.source import ShardFolder
from l3r.loss.joint import LossTerms
from l3r.metrics.cameras import CameraMetrics
from l3r.train.datamodule import ValidationGraphs, ValidationShare
from l3r.train.run import train
from l3r.train.validation import ValidationScores
from tests.data.graphs import make_graph, write_folder
from tests.train.runs import layers, read_log
from tests.train.test_ranks import launch
from tests.train.threads import run_together

ROOT = Path(__file__).parents[2]
STILL = {"lr": 1e-30, "weight_decay": 0, "max_steps": 2, "validate_every": 2}
"""Weights stay those of the seed: what several processes learn differs by rounding."""


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.fixture(scope="module")
def other_shards(tmp_path_factory):
    """Five graphs of another data set."""
    graphs = [make_graph(n, num_views=3, height=16, width=16) for n in range(20, 25)]
    named = [dataclasses.replace(graph, dataset="other") for graph in graphs]
    return write_folder(tmp_path_factory.mktemp("other"), named)


NUMBERS = st.floats(-1e6, 1e6) | st.just(float("nan"))


def score(graphs, world_size):
    """The means that each process gets; a graph is a data set and a number."""

    def run(rank, agreement):
        scores = ValidationScores(agreement)
        for name, value in graphs[rank::world_size]:
            total = torch.tensor(value, dtype=torch.float64)
            terms = LossTerms(total=total, parts={"pair_error": total / 3}, graphs={})
            cameras = CameraMetrics(**{f.name: value / 7 for f in fields(CameraMetrics)})
            scores.add(name, terms, cameras)
        return scores.take()

    return run_together(run, world_size)


@given(st.lists(st.tuples(st.sampled_from("abc"), NUMBERS), min_size=1), st.integers(1, 6))
def test_means_do_not_depend_on_the_number_of_processes_to_the_last_bit(graphs, world_size):
    (expected,) = score(graphs, 1)
    found = score(graphs, world_size)
    assert all(repr(means) == repr(expected) for means in found)  # NaN where NaN
    assert {name.partition("/")[0] for name in expected if "/" in name} == dict(graphs).keys()
    values = [value for _, value in graphs]
    # A loss that is not finite is not hidden.
    mean = pytest.approx(sum(values) / len(values), abs=1e-6, nan_ok=True)
    assert expected["loss"] == mean


def test_each_data_set_gives_as_many_graphs_whatever_stands_beside_it(hand_shards, other_shards):
    hand, other = (ShardFolder(shards, 3) for shards in (hand_shards, other_shards))

    def keys(folders, count):
        graphs = ValidationGraphs(folders, (16, 16), count)
        return [graphs[number].key[0].rpartition("-")[2] for number in range(len(graphs))]

    assert keys([hand, other], 4) == [
        *("000000", "000002", "000004", "000006"),
        *("000000", "000001", "000002", "000003"),
    ]
    assert keys([other], 4) == keys([hand, other], 4)[4:]
    assert keys([other, hand], 7)[:5] == keys([other], 5), "all of one that has fewer"


@pytest.mark.parametrize("world_size", [1, 2, 3, 4, 7, 13])
def test_every_graph_is_scored_by_exactly_one_process(hand_shards, world_size):
    graphs = ValidationGraphs([ShardFolder(hand_shards, 3)], (16, 16), 5)
    shares = [ValidationShare(graphs, rank, world_size) for rank in range(world_size)]
    keys = [views.key[0] for share in shares for views in share]
    assert sorted(keys) == [graphs[number].key[0] for number in range(5)]
    assert next(iter(shares[0])).key == graphs[0].key, "the first process draws the first graph"


@pytest.mark.slow
@pytest.mark.parametrize("num_graphs", [1, 3], ids=["fewer than processes", "unequal shares"])
def test_two_processes_write_the_very_figures_of_one(
    hand_shards, other_shards, tmp_path, num_graphs
):
    """One graph of one data set, or three and two of two."""
    other = [f"data.validation.other.shards={other_shards}", "data.validation.other.span=[0,0.4]"]
    extra = other if num_graphs > 1 else []
    texts = []
    for devices in (1, 2):
        folder = tmp_path / str(devices)
        changes = {"validation_graphs": num_graphs, "devices": devices, **STILL}
        launch(hand_shards, folder, *extra, **changes)
        texts.append((folder / "validation.csv").read_text())
        assert [p.name for p in (folder / "pictures").iterdir()] == ["step_000002.png"]
    assert texts[0] == texts[1]
    (row,) = read_log(tmp_path / "2", "validation.csv")
    assert float(row["hand/loss"]) > 0
    assert ("other/loss" in row) == bool(extra)


def test_checkpoints_are_made_where_nothing_is_validated(hand_shards, tmp_path):
    """Both fall due at the same step, and a checkpoint waits for the validation."""
    settings = {"validation_graphs": 0, "validate_every": 2, "checkpoint_every": 2, "max_steps": 3}
    train(load_config(layers(hand_shards, tmp_path, **settings)))
    assert not (tmp_path / "validation.csv").exists()
    assert (tmp_path / "previous.ckpt").exists(), "the one of step 2, before that of the end"
