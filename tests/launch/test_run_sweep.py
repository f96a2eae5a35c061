import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from l3r.cli.main import main
from l3r.errors import LaunchError
from l3r.launch import run_sweep
from l3r.launch.expand import expand
from l3r.launch.run_lock import RunLock
from l3r.launch.run_state import read_state, read_states
from l3r.launch.run_sweep import SweepRunner
from l3r.launch.score_file import scoring_request
from l3r.launch.sweep_report import report_sweep
from tests.data.graphs import make_graph, write_folder
from tests.launch.sweeps import train_by_hand, write_sweep_file
from tests.train.runs import TINY

ROOT = Path(__file__).parents[2]


@pytest.fixture
def two(tmp_path, monkeypatch):
    """Four runs, done by a stand-in for l3r."""
    sweep = expand(write_sweep_file(tmp_path))
    sweep.out.mkdir()
    words = ("-m", "tests.launch.stub", str(sweep.file), str(sweep.out), "")
    monkeypatch.setattr(run_sweep, "_L3R", (sys.executable, *words))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return sweep


def calls(sweep):
    return (sweep.out / "calls.txt").read_text().splitlines()


def kinds(sweep):
    return [state.kind for state in read_states(sweep).values()]


def test_every_run_is_trained_and_scored_and_none_is_done_again(two, capsys):
    assert SweepRunner(two, jobs=2).run(two.runs) == []
    assert kinds(two) == ["scored"] * 4
    assert sorted(calls(two)) == sorted(
        f"{c} {r.name}" for r in two.runs for c in ("train", "sweep")
    )
    assert SweepRunner(two).run(two.runs) == []
    assert len(calls(two)) == 8
    assert "4/4" in capsys.readouterr().err


def test_a_failure_is_explained_by_its_own_process(tmp_path):
    log = tmp_path / "log.txt"
    log.write_text("$ l3r train a\nl3r train: no room\n$ l3r train a\n")
    assert run_sweep.explain_exit(-9, log) == "killed by signal 9"
    log.write_text(log.read_text() + "l3r train: no weights\nbye\n")
    assert run_sweep.explain_exit(2, log) == "exit code 2: l3r train: no weights"


def test_a_folder_that_turns_out_to_be_another_run_fails_alone(two):
    SweepRunner(two).run(two.runs[:1])
    config = two.runs[0].folder / "config.yaml"
    config.write_text(config.read_text().replace("seed: 0", "seed: 7"))
    assert SweepRunner(two).run(two.runs[:2]) == ["none/seed_0"]
    assert read_state(two.runs[1], scoring_request(two)).kind == "scored"


def test_what_waits_for_a_checkpoint_is_not_done(tmp_path, capsys):
    place = str(tmp_path / "{seed}.ckpt")
    file = write_sweep_file(tmp_path, base=[], rows={"spt": []}, seeds=[0, 1], checkpoint=place)
    assert main(["sweep", str(file)]) == 1
    assert f"waiting: no {tmp_path}/0.ckpt yet" in capsys.readouterr().err
    assert main(["sweep", str(file), "--submit"]) == 0
    said = capsys.readouterr().out
    assert f"nothing to submit: 2 runs are waiting: no {tmp_path}/0.ckpt yet" in said
    assert main(["sweep", str(file), "--tasks", "0"]) == 2
    assert "--tasks is 0, expected 1 or more" in capsys.readouterr().err


def test_what_is_trained_is_only_scored(two):
    train_by_hand(two.runs[0])
    SweepRunner(two).run(two.runs[:1])
    assert calls(two) == ["sweep none/seed_0"]


def test_a_run_that_dies_or_diverges_ends_no_other_and_only_the_dead_is_tried_again(two):
    (two.out / "none-0.txt").write_text("die")
    (two.out / "paper-0.txt").write_text("diverge")
    assert SweepRunner(two).run(two.runs) == ["none/seed_0"]
    assert kinds(two) == ["failed", "diverged", "scored", "scored"]
    assert "exit code 1: out of luck; see" in read_states(two)["none/seed_0"].describe()
    assert "$ " in (two.runs[0].folder / "log.txt").read_text()
    (two.out / "none-0.txt").unlink()
    assert SweepRunner(two).run(two.runs) == []
    assert kinds(two) == ["scored", "diverged", "scored", "scored"]
    assert calls(two).count("train paper/seed_0") == 1


def test_a_run_whose_weights_explode_between_two_steps_is_diverged(two):
    (two.out / "none-0.txt").write_text("explode")
    assert SweepRunner(two).run(two.runs[:1]) == []
    assert read_states(two)["none/seed_0"].describe() == ("diverged: step 8: scores are not finite")


def test_a_run_that_another_process_is_at_is_left_to_it(two, capsys):
    lock = RunLock(two.runs[0].folder)
    assert lock.acquire()
    SweepRunner(two).run(two.runs[:1])
    assert "another process is at it" in capsys.readouterr().err
    assert not (two.out / "calls.txt").exists()
    lock.release()
    SweepRunner(two).run(two.runs[:1])
    assert kinds(two)[0] == "scored"


def test_ctrl_c_lets_runs_save_and_end_and_the_next_sweep_goes_on(two):
    (two.out / "none-0.txt").write_text("wait")

    def interrupt():
        while not (two.out / "waiting").exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        SweepRunner(two).run(two.runs)
    assert kinds(two) == ["begun", "new", "new", "new"]
    (two.out / "none-0.txt").unlink()
    SweepRunner(two).run(two.runs)
    assert kinds(two) == ["scored"] * 4


def test_a_job_that_goes_back_to_the_queue_marks_no_run_as_failed(two, tmp_path, monkeypatch):
    (two.out / "none-0.txt").write_text("die")
    squeue = tmp_path / "squeue"
    squeue.write_text("#!/bin/sh\necho COMPLETING\n")
    squeue.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    with pytest.raises(LaunchError, match="goes back to the queue"):
        SweepRunner(two).run(two.runs)
    assert kinds(two)[0] == "begun"
    assert calls(two) == ["train none/seed_0"]


def test_a_job_near_its_end_is_requeued_though_the_training_was_still_at_its_start(
    two, tmp_path, monkeypatch
):
    (two.out / "none-0.txt").write_text("wait")  # it knows nothing of SIGUSR1 and dies of it
    for name, says in {
        "squeue": "echo RUNNING",
        "scontrol": f'echo "$*" >> {tmp_path}/said',
    }.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{says}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("SLURM_JOB_ID", "7")

    def near_the_end():
        while not (two.out / "waiting").exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGUSR1)

    threading.Thread(target=near_the_end).start()
    with pytest.raises(LaunchError, match="job 7 is requeued"):
        SweepRunner(two).run(two.runs)
    assert (tmp_path / "said").read_text() == "requeue 7\n"
    assert kinds(two) == ["begun", "new", "new", "new"]


def test_no_run_at_a_time_is_refused_before_anything_is_written(tmp_path, capsys):
    assert main(["sweep", str(write_sweep_file(tmp_path)), "--jobs", "0"]) == 2
    assert "--jobs is 0, expected 1 or more" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_real_sweep_trains_scores_resumes_and_reports(tmp_path):
    graphs = [make_graph(n, num_views=4, height=16, width=16) for n in range(8)]
    shards = write_folder(tmp_path / "shards", graphs)
    base = [str(ROOT / TINY[0]), *TINY[1:], f"data.sources.hand.shards={shards}"]
    base += [f"data.validation.hand.shards={shards}", "data.validation.hand.span=[0.5,1]"]
    base += ["train.max_steps=12", "train.lr=1e-3"]
    rows = {"3": [], "2": ["data.num_views=2", "data.graphs_per_step=3"], "bad": "train.lr=1e30"}
    path = write_sweep_file(tmp_path, base=base, rows=rows, seeds=[0], table="graph_size")
    command = [sys.executable, "-m", "l3r", "sweep", str(path)]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    sweep = expand(path)
    states = read_states(sweep)
    assert [state.kind for state in states.values()] == ["scored", "scored", "diverged"]
    scored = [states[f"{row}/seed_0"].scores["sources"]["hand"] for row in ("3", "2")]
    for found in scored:
        assert (found["num_graphs"], found["num_views"]) == (4, 3), "the span, and the base's N"
    assert scored[0]["graphs_sha256"] == scored[1]["graphs_sha256"]
    assert done.stdout.endswith(report_sweep(sweep.out))
    assert "diverged 1 of 1" in done.stdout
    before = {p: p.stat().st_mtime_ns for p in sweep.out.rglob("*.ckpt")}
    assert subprocess.run(command, capture_output=True, text=True, env=env).returncode == 0
    assert before == {p: p.stat().st_mtime_ns for p in sweep.out.rglob("*.ckpt")}
    # Other trees for the networks that are there.
    checkpoint = f"{sweep.out}/3/seed_{{seed}}/model.ckpt"
    trees = {row: f"graph.algorithm={row}" for row in ("spt", "mst", "oracle")}
    path = write_sweep_file(
        *(tmp_path, "trees.yaml"),
        **{"base": [], "rows": trees, "seeds": [0], "checkpoint": checkpoint, "table": "graph"},
        output_dir=str(tmp_path / "trees"),
    )
    done = subprocess.run([*command[:-1], str(path)], capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("1 of 1") == 3
