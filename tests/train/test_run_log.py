import csv

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from l3r.train.csv_table import append_row, drop_rows_after
from l3r.train.ranks import Agreement
from l3r.train.run_log import DatasetMeans
from tests.train.threads import run_together

GRAPHS = st.lists(st.tuples(st.sampled_from(["a", "b/c", "d"]), st.integers(-9, 9)), min_size=1)


@given(GRAPHS, st.integers(1, 4))
def test_means_of_data_sets_do_not_depend_on_how_graphs_came_in_batches(graphs, size):
    means = DatasetMeans(Agreement())
    for first in range(0, len(graphs), size):
        part = graphs[first : first + size]
        values = torch.tensor([float(value) for _, value in part])
        means.add([name for name, _ in part], {"loss": values, "error": 2 * values})
        # A checkpoint between any two batches changes nothing.
        copy = DatasetMeans(Agreement())
        copy.load_state_dict(means.state_dict(), 0, 1)
        means = copy
    found = means.take()
    for name in {name for name, _ in graphs}:
        own = [value for other, value in graphs if other == name]
        assert found[f"{name}/loss"] == pytest.approx(sum(own) / len(own), abs=1e-5)
        assert found[f"{name}/error"] == pytest.approx(2 * sum(own) / len(own), abs=1e-5)
    assert len(found) == 2 * len({name for name, _ in graphs})
    assert means.take() == {}


@given(GRAPHS, GRAPHS, st.integers(1, 4), st.integers(1, 4))
def test_sums_of_all_processes_go_on_in_another_number_of_them(first, second, before, after):
    """Lightning gives every process the state that the first one wrote."""

    def add(means, graphs):
        for name, value in graphs:
            means.add([name], {"loss": torch.tensor([float(value)])})

    def stop(rank, agreement):
        means = DatasetMeans(agreement)
        add(means, first[rank::before])
        return means.state_dict()

    def go_on(rank, agreement):
        means = DatasetMeans(agreement)
        means.load_state_dict(state, rank, after)
        add(means, second[rank::after])
        return means.take()

    state, *others = run_together(stop, before)
    assert all(other == state for other in others)
    straight = DatasetMeans(Agreement())
    add(straight, first + second)
    expected = straight.take()
    for found in run_together(go_on, after):
        assert found == pytest.approx(expected, abs=1e-5)


def test_graphs_of_skipped_steps_do_not_count():
    means = DatasetMeans(Agreement())
    means.add(["a", "a", "b"], {"loss": torch.tensor([1.0, torch.nan, torch.inf])})
    means.add(["a"], {"loss": torch.tensor([2.0])})
    assert means.take() == {"a/loss": 1.5}


def read(path):
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_column_that_appears_later_is_empty_above_and_where_it_is_not_met(tmp_path):
    path = tmp_path / "metrics.csv"
    append_row(path, {"step": 1.0, "loss": 0.5})
    append_row(path, {"step": 2.0, "loss": 0.25, "new/loss": 3.0})
    append_row(path, {"step": 3.0, "loss": 0.125})
    assert [row["new/loss"] for row in read(path)] == ["", "3", ""]
    assert [row["loss"] for row in read(path)] == ["0.5", "0.25", "0.125"]


def test_rows_after_a_checkpoint_and_half_a_row_are_forgotten(tmp_path):
    path = tmp_path / "metrics.csv"
    for step in range(1, 5):
        append_row(path, {"step": float(step), "loss": 0.5})
    whole = path.read_text()
    path.write_text(whole + "5,")
    path.write_text(path.read_text()[:-1])
    drop_rows_after(path, 4)
    assert path.read_text() == whole
    drop_rows_after(path, 2)
    assert [row["step"] for row in read(path)] == ["1", "2"]
    drop_rows_after(tmp_path / "absent.csv", 2)
    assert not (tmp_path / "absent.csv").exists()
