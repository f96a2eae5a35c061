"""slurm/build_shards.sh on a real cluster."""

import time

import pytest

from data_prep.cli import main as prep
from tests.slurm.cluster import ROOT

pytestmark = pytest.mark.slurm

SCRIPT = ROOT / "slurm" / "build_shards.sh"
SIZES = [
    *("--num-graphs", "240", "--graphs-per-image", "4", "--graphs-per-shard", "6"),
    *("--max-views", "6", "--min-views", "4"),
]
NUM_TARS = 40
SMALL = {"cpus_per_task": 1, "mem": "1G", "exclusive": True}
"""What a task asks of the cluster: a node of its own, of the two there are."""


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    """A room of one trajectory."""
    root = tmp_path_factory.mktemp("raw")
    room = ["--views", "60", "--held-out-views", "0", "--walk-views", "0", "--size", "96x128"]
    assert prep(["render", "--raw", str(root), *room]) == 0
    return root


@pytest.fixture(scope="module")
def built(raw, tmp_path_factory):
    """The files of a build by one process."""
    out = tmp_path_factory.mktemp("alone")
    assert prep(["build", *options(raw, out)]) == 0
    assert len([*out.glob("*.tar")]) == NUM_TARS
    return read_files(out)


def options(raw, out):
    return ["tartanair", "--raw", str(raw), "--out", str(out), "--scenes", "*/P000", *SIZES]


def read_files(out):
    return {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}


def wait_for_tar(out, first, last):
    """Wait until one of these tars is there: the task that writes them is in the midst of it."""
    names = [f"tartanair-{number:06d}.tar" for number in range(first, last)]
    deadline = time.monotonic() + 90
    while not any((out / name).is_file() for name in names):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return names


def test_an_array_of_jobs_writes_the_bytes_of_one_process(cluster, raw, built, tmp_path):
    out = tmp_path / "out"
    job = cluster.sbatch(SCRIPT, *options(raw, out), cwd=tmp_path, array="0-1", **SMALL)
    cluster.wait(job, timeout=120)
    assert read_files(out) == built
    logs = [(tmp_path / f"l3r-shards-{job}_{task}.log").read_text() for task in range(2)]
    assert {"n1", "n2"} == {name for name in ("n1", "n2") for log in logs if f"on {name}:" in log}


def test_tasks_killed_and_requeued_midway_change_nothing(cluster, raw, built, tmp_path):
    out = tmp_path / "out"
    job = cluster.sbatch(SCRIPT, *options(raw, out), cwd=tmp_path, array="0-1", **SMALL)
    killed = wait_for_tar(out, 0, NUM_TARS // 2)
    cluster.signal(f"{job}_0.0", "KILL")  # its step, as the out-of-memory killer would
    requeued = wait_for_tar(out, NUM_TARS // 2, NUM_TARS)
    cluster.requeue(f"{job}_1")
    cluster.wait(f"{job}_0", "FAILED")
    for names in (killed, requeued):
        assert not all((out / name).is_file() for name in names), "ended before it was stopped"
    assert not (out / "manifest.json").exists()
    cluster.requeue(f"{job}_0")
    for task in (f"{job}_0", f"{job}_1"):
        cluster.release(task)
    cluster.wait(job, timeout=120)
    assert read_files(out) == built
    assert cluster.output(f"{job}_1").count("--task-index 1 on n") == 2
