import sys
from pathlib import Path

import pytest

from l3r.launch import run_sweep
from l3r.launch.expand import expand
from l3r.launch.results import collect_results
from l3r.launch.run_state import read_states
from l3r.launch.run_sweep import SweepRunner
from l3r.launch.run_table import format_runs
from l3r.launch.score_file import scoring_request
from l3r.launch.sweep_markdown import render_markdown
from tests.launch.sweeps import score_by_hand, train_by_hand, write_sweep_file

ROOT = Path(__file__).parents[2]


@pytest.fixture
def first(tmp_path):
    """A sweep whose two rows are trained, the first of them scored as well."""
    rows = {"4": [], "8": "model.alignment.num_blocks=8"}
    file = write_sweep_file(
        *(tmp_path, "layers.yaml"), rows=rows, seeds=[0], output_dir=str(tmp_path / "layers")
    )
    sweep = expand(file)
    for run in sweep.runs:
        run.folder.mkdir(parents=True)
        (run.folder / "last.ckpt").write_bytes(b"all")
        train_by_hand(run)
    score_by_hand(sweep.runs[0], scoring_request(sweep))
    return sweep


def second(tmp_path, monkeypatch, extra=(), **content):
    """Its neighbour, whose row 0.1 is the first one's row 4; done by a stand-in for l3r."""
    rows = {"0.1": [], "1": "loss.global_weight=1"}
    content = {"rows": rows, "seeds": [0], "output_dir": str(tmp_path / "weight"), **content}
    sweep = expand(write_sweep_file(tmp_path, "weight.yaml", **content), extra)
    sweep.out.mkdir(exist_ok=True)
    words = ("-m", "tests.launch.stub", str(sweep.file), str(sweep.out), " ".join(extra))
    monkeypatch.setattr(run_sweep, "_L3R", (sys.executable, *words))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return sweep


def test_a_training_that_a_neighbouring_sweep_has_done_is_taken_from_there(
    first, tmp_path, monkeypatch
):
    sweep = second(tmp_path, monkeypatch)
    states = read_states(sweep)
    assert states["0.1/seed_0"].describe() == "trained, not scored, of layers/4"
    assert states["1/seed_0"].describe() == "new"
    assert "1 trained, 1 new" in format_runs(sweep, states)
    SweepRunner(sweep).run(sweep.runs)
    states = read_states(sweep)
    assert states["0.1/seed_0"].describe() == "scored, of layers/4"
    assert (sweep.out / "calls.txt").read_text() == "train 1/seed_0\nsweep 1/seed_0\n"
    assert states["0.1/seed_0"].scores == read_states(first)["4/seed_0"].scores
    text = render_markdown(collect_results(sweep, states))
    assert "Row 0.1, seed 0: trained as layers/4, with the same configuration." in text
    own, other = sweep.runs[0].checkpoint, first.runs[0].checkpoint
    assert own.samefile(other)
    # What is taken stays, whatever becomes of where it was.
    (first.runs[0].folder / "config.yaml").unlink()
    other.unlink()
    assert read_states(sweep)["0.1/seed_0"].describe() == "scored, of layers/4"


def test_scores_of_other_weights_than_the_twin_has_now_are_not_taken(first, tmp_path, monkeypatch):
    first.runs[0].checkpoint.write_bytes(b"weights of more steps")
    sweep = second(tmp_path, monkeypatch)
    SweepRunner(sweep).run(sweep.runs[:1])
    assert (sweep.out / "calls.txt").read_text() == "sweep 0.1/seed_0\n"


def test_what_goes_on_is_no_longer_what_it_was_taken_from(first, tmp_path, monkeypatch):
    sweep = second(tmp_path, monkeypatch)
    SweepRunner(sweep).run(sweep.runs[:1])
    longer = second(tmp_path, monkeypatch, ["train.max_steps=200000"])
    SweepRunner(longer).run(longer.runs[:1])
    assert read_states(longer)["0.1/seed_0"].describe() == "scored"


def test_what_is_taken_is_scored_on_the_graphs_of_its_own_sweep(first, tmp_path, monkeypatch):
    sweep = second(tmp_path, monkeypatch, evaluate={"num_views": 5})
    SweepRunner(sweep).run(sweep.runs[:1])
    assert (sweep.out / "calls.txt").read_text() == "sweep 0.1/seed_0\n"


@pytest.mark.parametrize("change", ["train.lr=1e-5", "data.sources.hand.shards=other"])
def test_another_configuration_is_no_twin(first, tmp_path, monkeypatch, change):
    sweep = second(tmp_path, monkeypatch, [change])
    assert {state.kind for state in read_states(sweep).values()} == {"new"}


@pytest.mark.parametrize("spoilt", ["unfinished", "seed", "version", "damaged"])
def test_what_is_not_finished_or_of_another_seed_or_version_is_no_twin(
    first, tmp_path, monkeypatch, spoilt
):
    sweep = second(tmp_path, monkeypatch, seeds=[1] if spoilt == "seed" else [0])
    if spoilt == "unfinished":
        train_by_hand(first.runs[0], steps=99)
    if spoilt == "damaged":
        (first.runs[0].folder / "machine.json").write_text("[")
    if spoilt == "version":
        path = first.runs[0].folder / "machine.json"
        path.write_text(path.read_text().replace('"light3r": "', '"light3r": "9'))
    assert {state.kind for state in read_states(sweep).values()} == {"new"}
