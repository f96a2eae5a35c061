"""slurm/sweep.sh on a real cluster of two nodes: an array that does a whole sweep."""

import csv
import os
import re
import sys
import time
from pathlib import Path

import pytest

from l3r.launch.expand import expand
from l3r.launch.run_state import read_states
from tests.data.graphs import make_graph, write_folder
from tests.launch.sweeps import write_sweep_file
from tests.slurm.cluster import ROOT
from tests.slurm.processes import find_processes
from tests.train.runs import TINY

pytestmark = pytest.mark.slurm

STEPS = 200
TASK = {"nodes": 1, "ntasks_per_node": 1, "gpus_per_node": 0, "cpus_per_task": 1, "mem": "2G"}


@pytest.fixture
def sweep_file(tmp_path):
    """Two rows, two seeds; the task of an even index has the first row."""
    graphs = [make_graph(n, num_views=3, height=16, width=16) for n in range(8)]
    shards = write_folder(tmp_path / "shards", graphs)
    base = [str(ROOT / TINY[0]), *TINY[1:], f"train.max_steps={STEPS}", "train.lr=1e-4"]
    base += [f"data.{part}.hand.shards={shards}" for part in ("sources", "validation")]
    base += ["train.checkpoint_every=20", "train.validate_every=100", "logs.pictures=false"]
    rows = {"0.1": [], "1": "loss.global_weight=1"}
    return write_sweep_file(tmp_path, base=base, rows=rows, table="global_weight")


def wait_for_step(folder, step, timeout=120):
    deadline = time.monotonic() + timeout
    while True:
        if (folder / "metrics.csv").is_file():
            with (folder / "metrics.csv").open(newline="") as stream:
                if any(int(row["step"] or 0) >= step for row in csv.DictReader(stream)):
                    return
        assert time.monotonic() < deadline, f"{folder} has not come to step {step}"
        time.sleep(0.2)


def find_training(cluster, folder):
    """The process that trains in a folder; srun and the sweep have its name on their lines too."""
    for pid in find_processes(cluster.folder):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
        if "python" in words[0] and f"train.output_dir={folder}" in words:
            return pid
    raise AssertionError(f"nothing trains in {folder}")


def test_an_array_does_a_sweep_whatever_becomes_of_its_tasks(cluster, sweep_file, tmp_path):
    sweep = expand(sweep_file)
    first, second = sweep.runs[:2]
    job = cluster.sbatch(
        *(ROOT / "slurm" / "sweep.sh", str(sweep_file)),
        **{"cwd": tmp_path, "env": {"MASTER_ADDR": "127.0.0.1"}, "array": "0-1", **TASK},
    )
    # A process that is killed costs its run, and the task goes on with its next one.
    wait_for_step(first.folder, 30)
    os.kill(find_training(cluster, first.folder), 9)
    # A task near its time limit gets a signal, lets its training save, and is requeued.
    wait_for_step(second.folder, 30)
    cluster.run("scancel", "--batch", "--signal=USR1", f"{job}_1")
    cluster.release(f"{job}_1")
    cluster.wait(f"{job}_0", "FAILED", timeout=180)
    states = read_states(sweep)
    assert states[first.name].kind == "failed"
    assert states["0.1/seed_1"].kind == "scored"
    assert "failed 1 of 2" in (sweep.out / "table.md").read_text()
    finished = (sweep.out / "0.1" / "seed_1" / "model.ckpt").stat().st_mtime_ns
    cluster.requeue(f"{job}_0")
    cluster.release(f"{job}_0")
    cluster.wait(f"{job}_0", timeout=180)
    cluster.wait(f"{job}_1", timeout=180)
    assert {state.kind for state in read_states(sweep).values()} == {"scored"}
    assert (sweep.out / "0.1" / "seed_1" / "model.ckpt").stat().st_mtime_ns == finished
    table = (sweep.out / "table.md").read_text()
    assert table.count("2 of 2") == 2
    assert table in cluster.output(job)
    assert (sweep.out / "report.html").is_file()
    for run in (first, second):
        with (run.folder / "metrics.csv").open(newline="") as stream:
            steps = [int(row["step"]) for row in csv.DictReader(stream)]
        assert steps == list(range(1, STEPS + 1)), "gone on, not begun anew"
        assert (run.folder / "log.txt").read_text().count(" train ") >= 2


def test_what_is_left_is_submitted_with_options_of_sbatch(cluster, sweep_file, tmp_path):
    words = [f"--{key.replace('_', '-')}={value}" for key, value in TASK.items()]
    words += [f"--output={tmp_path}/%A_%a.log"]
    said = cluster.run(
        *(sys.executable, "-m", "l3r", "sweep", str(sweep_file), "train.max_steps=20"),
        *("--submit", f"--sbatch={' '.join(words)}"),
        **{"cwd": ROOT, "env": {"MASTER_ADDR": "127.0.0.1"}},
    )
    assert "4 tasks, a run each" in said
    job = re.search(r"batch job (\d+)", said)[1]
    for task in range(4):
        cluster.wait(f"{job}_{task}", timeout=180)
    sweep = expand(sweep_file, ["train.max_steps=20"])
    assert {state.kind for state in read_states(sweep).values()} == {"scored"}
    assert (sweep.out / "table.md").read_text().count("2 of 2") == 2
