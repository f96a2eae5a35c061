import os

import pytest
import torch

from l3r.errors import ConfigError
from l3r.launch.expand import expand
from l3r.launch.run_state import FAILURE, read_state, read_states
from l3r.launch.run_table import StepCost, estimate_steps, format_runs
from l3r.launch.score_file import digest_checkpoint, scoring_request
from tests.launch.sweeps import note_bad_steps, score_by_hand, train_by_hand, write_sweep_file


@pytest.fixture
def state(sweep):
    """How the first run stands; its folder may be filled in between."""
    return lambda: read_state(sweep.runs[0], scoring_request(sweep))


def test_a_run_goes_from_new_over_begun_and_trained_to_scored(sweep, state):
    run, request = sweep.runs[0], scoring_request(sweep)
    assert state().describe() == "new"
    train_by_hand(run, steps=340)
    assert state().describe() == "goes on, reached step 340 of 100,000"
    train_by_hand(run)
    assert state().describe() == "trained, not scored"
    score_by_hand(run, request)
    assert state().kind == "scored"


def test_scores_of_other_graphs_or_other_weights_do_not_count(sweep, state):
    run, request = sweep.runs[0], scoring_request(sweep)
    train_by_hand(run)
    score_by_hand(run, {**request, "num_views": 5})
    assert state().kind == "trained"
    score_by_hand(run, {**request, "sources": {"hand": ["elsewhere", 0.0, 1.0]}})
    assert state().kind == "trained"
    score_by_hand(run, request)
    assert state().kind == "scored"
    # Copied scores are new files, of old weights.
    before = (run.folder / "scores.json").stat().st_mtime
    run.checkpoint.write_bytes(b"other weights")
    os.utime(run.checkpoint, (before - 10, before - 10))
    assert state().kind == "trained"
    (run.folder / "scores.json").write_text("{")
    assert state().kind == "trained"


def test_a_sweep_that_was_copied_without_its_times_is_as_it_was(sweep, state):
    run = sweep.runs[0]
    train_by_hand(run)
    score_by_hand(run, scoring_request(sweep))
    (run.folder / "last.ckpt").write_bytes(b"all")
    written = run.checkpoint.stat().st_mtime
    os.utime(run.folder / "last.ckpt", (written + 5, written + 5))
    os.utime(run.folder / "scores.json", (written - 5, written - 5))
    assert state().kind == "scored"


def test_checkpoints_are_told_apart_by_their_weights_and_not_by_their_names(tmp_path):
    def digest(name, value):
        torch.save({"weight": torch.full((1000,), value), "step": 1}, tmp_path / name)
        return digest_checkpoint(tmp_path / name)

    assert digest("a.ckpt", 1.0) == digest("b.ckpt", 1.0) != digest("c.ckpt", 2.0)


def test_scores_outlive_the_checkpoint_and_a_training_that_was_cut_short_does_not(sweep, state):
    run = sweep.runs[0]
    train_by_hand(run)
    score_by_hand(run, scoring_request(sweep))
    run.checkpoint.unlink()
    assert state().kind == "scored"
    train_by_hand(run, steps=50)
    assert state().kind == "begun"


@pytest.mark.parametrize("has_weights", [True, False])
def test_a_longer_training_that_was_killed_before_it_wrote_its_weights_is_not_scored(
    sweep, has_weights
):
    run = sweep.runs[0]
    train_by_hand(run)
    score_by_hand(run, scoring_request(sweep))
    longer = expand(sweep.file, ["train.max_steps=200000"])
    train_by_hand(longer.runs[0], steps=200_000)
    (run.folder / "last.ckpt").write_bytes(b"all")
    later = run.checkpoint.stat().st_mtime + 5
    os.utime(run.folder / "last.ckpt", (later, later))
    if not has_weights:
        run.checkpoint.unlink()
    state = read_states(longer)[run.name]
    assert state.describe() == "goes on, reached step 200,000 of 200,000"


def test_a_folder_whose_configuration_cannot_be_read_is_refused(sweep):
    train_by_hand(sweep.runs[0])
    config = sweep.runs[0].folder / "config.yaml"
    config.write_text(config.read_text().replace("weight_decay", "weight_decoy"))
    with pytest.raises(ConfigError, match=r"config\.yaml: .*weight_decoy.*give --out"):
        read_states(sweep)


def test_what_is_validated_on_may_change_and_is_scored_anew(sweep, state):
    run = sweep.runs[0]
    train_by_hand(run)
    score_by_hand(run, scoring_request(sweep))
    assert state().kind == "scored"
    other = expand(sweep.file, ["data.validation.own.shards=own", "data.validation.own.span=[0,1]"])
    assert read_states(other)[run.name].kind == "trained"


def test_a_finished_run_with_another_start_is_not_taken_for_this_one(tmp_path):
    rows = {"scratch": [], "start": "train.init=weights/start"}
    sweep = expand(write_sweep_file(tmp_path, rows=rows))
    train_by_hand(sweep.runs[1])
    rows = {"scratch": [], "start": "train.init=weights/other"}
    other = expand(write_sweep_file(tmp_path, rows=rows))
    with pytest.raises(ConfigError, match=r"train\.init=weights/start, this sweep has weights/oth"):
        read_states(other)


def test_a_run_that_gave_up_is_diverged_and_one_that_went_on_is_not(sweep, state):
    run = sweep.runs[0]
    train_by_hand(run, steps=40)
    note_bad_steps(run, [10, 20, 39, 40, 41])
    assert "3 steps in a row were not finite, the last one 41 (loss nan" in state().describe()
    note_bad_steps(run, [10, 20, 21, 40])
    assert state().kind == "begun"
    note_bad_steps(run, [10, 11, 12])
    assert state().kind == "begun", "it is at step 40"
    # Resumed, it comes to the same end and writes it down again.
    note_bad_steps(run, [39, 40, 41, 39, 40, 41])
    assert state().kind == "diverged"


def test_weights_that_are_not_finite_are_diverged(sweep, state):
    train_by_hand(sweep.runs[0])
    score_by_hand(sweep.runs[0], scoring_request(sweep), problem="weights are not finite")
    assert state().describe() == "diverged: weights are not finite"


def test_a_failed_run_says_where_its_log_is(sweep, state):
    run = sweep.runs[0]
    train_by_hand(run, steps=3)
    (run.folder / FAILURE).write_text("exit code 137: Killed\n")
    assert state().describe() == f"failed: exit code 137: Killed; see {run.folder / 'log.txt'}"


def test_a_longer_training_goes_on_and_another_one_is_refused(sweep, tmp_path):
    run = sweep.runs[0]
    train_by_hand(run)
    score_by_hand(run, scoring_request(sweep))
    longer = expand(sweep.file, ["train.max_steps=200000"])
    assert read_states(longer)[run.name].describe() == "goes on, reached step 100,000 of 200,000"
    other = expand(sweep.file, ["train.lr=1"])
    with pytest.raises(
        ConfigError, match=r"made with train\.lr=1e-06, this sweep has 1\.0; .*--out"
    ):
        read_states(other)
    assert {
        state.kind for state in read_states(expand(sweep.file, out=tmp_path / "b" / "c")).values()
    } == {"new"}


def test_a_sweep_over_checkpoints_waits_for_them_and_scores_each_row_anew(tmp_path):
    checkpoint = tmp_path / "seed_{seed}.ckpt"
    rows = {"mst": "graph.algorithm=mst", "spt": "graph.algorithm=spt"}
    path = write_sweep_file(tmp_path, base=[], rows=rows, checkpoint=str(checkpoint))
    sweep = expand(path)
    (tmp_path / "seed_0.ckpt").write_bytes(b"weights")
    kinds = {name: state.kind for name, state in read_states(sweep).items()}
    assert kinds == {
        **{"mst/seed_0": "trained", "spt/seed_0": "trained"},
        **{"mst/seed_1": "waiting", "spt/seed_1": "waiting"},
    }
    score_by_hand(sweep.runs[0], scoring_request(sweep))
    assert read_states(sweep)["mst/seed_0"].kind == "scored"
    (tmp_path / "seed_0.ckpt").rename(tmp_path / "kept")
    assert read_states(sweep)["mst/seed_0"].kind == "scored", "as seen from another folder"
    (tmp_path / "kept").rename(tmp_path / "seed_0.ckpt")
    # The same row of other checkpoints is another one, whatever their age.
    (tmp_path / "other_0.ckpt").write_bytes(b"other weights")
    os.utime(tmp_path / "other_0.ckpt", (0, 0))
    place = str(tmp_path / "other_{seed}.ckpt")
    path = write_sweep_file(tmp_path, base=[], rows=rows, checkpoint=place)
    assert read_states(expand(path))["mst/seed_0"].kind == "trained"
    (tmp_path / "other_0.ckpt").unlink()
    assert read_states(expand(path))["mst/seed_0"].kind == "waiting"
    other = {**rows, "mst": ["graph.algorithm=mst", "graph.knn=3"]}
    path = write_sweep_file(tmp_path, base=[], rows=other, checkpoint=str(checkpoint))
    assert read_states(expand(path))["mst/seed_0"].kind == "trained"


def test_the_table_of_runs_has_hours_from_the_steps_of_the_same_row(sweep):
    runs = {run.name: run for run in sweep.runs}
    train_by_hand(runs["0.01/seed_0"], steps=50_000, rate=8.0, machine="NVIDIA H200")
    train_by_hand(runs["0.1/seed_1"], rate=16.0)
    states = read_states(sweep)
    assert estimate_steps(sweep, states, {"0.1": StepCost(9.0, 1)}) == {"0.01": 1.0, "0.1": 0.5}
    assert estimate_steps(
        sweep, {}.fromkeys(states, states["0.1/seed_0"]), {"0.1": StepCost(9.0, 1)}
    ) == {"0.1": 9.0}
    lines = format_runs(sweep, states).splitlines()
    assert lines[1].split()[-2:] == ["28", "222"]
    assert lines[4].split("  ")[0] == "0.1/seed_1"
    assert "trained, not scored" in lines[4]
    assert lines[4].split()[-2:] == ["14", "-"]
    # Half of one run and two whole ones of a row, and two of the other; the one on a CPU is done.
    assert lines[-1].endswith("left: 97 hours, 778 GPU hours")
    rehearsed = format_runs(
        sweep, {}.fromkeys(states, states["0.1/seed_0"]), {"0.1": StepCost(0.36, 8)}
    )
    assert "left: 30 hours, 240 GPU hours, and 3 runs of which" in rehearsed
    assert format_runs(sweep, {}.fromkeys(states, states["0.1/seed_0"])).endswith(
        "6 runs (6 new); left: 0.00 hours, and 6 runs of which no step was measured\n"
    )
