"""slurm/train.sh on a real cluster of two nodes, over gloo."""

import csv
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from l3r.inference.checkpoint import read_checkpoint
from tests.data.graphs import make_graph, write_folder
from tests.slurm.cluster import ROOT
from tests.slurm.processes import find_processes
from tests.train.runs import TINY

pytestmark = pytest.mark.slurm

SCRIPT = ROOT / "slurm" / "train.sh"
STEPS = 300
TWO = {"nodes": 2, "ntasks_per_node": 1, "gpus_per_node": 0, "cpus_per_task": 1, "mem": "2G"}
LOCAL = {"MASTER_ADDR": "127.0.0.1"}


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """Twelve graphs of three 16 x 16 images."""
    graphs = [make_graph(n, num_views=3, height=16, width=16) for n in range(12)]
    return write_folder(tmp_path_factory.mktemp("shards"), graphs)


def layers(shards, out, **train):
    base, *rest = TINY
    changes = [f"train.{key}={value}" for key, value in train.items()]
    return [
        *(str(ROOT / base), *rest, f"data.sources.hand.shards={shards}"),
        *(f"train.output_dir={out}", f"train.max_steps={STEPS}", "train.lr=1e-4"),
        *("train.checkpoint_every=1000", *changes),
    ]


@pytest.fixture(scope="module")
def straight(shards, tmp_path_factory):
    """The same run by one process, never stopped."""
    out = tmp_path_factory.mktemp("straight")
    command = [sys.executable, "-m", "l3r", "train", *layers(shards, out, accumulate=2)]
    env = {key: value for key, value in os.environ.items() if not key.startswith("SLURM")}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return out


def submit(cluster, shards, tmp_path, *, options=TWO, **train):
    arguments = layers(shards, tmp_path / "out", **train)
    return cluster.sbatch(SCRIPT, *arguments, cwd=tmp_path, env=LOCAL, **options)


def read_rows(out):
    with (out / "metrics.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def wait_for_step(cluster, job, step):
    cluster.wait_output(job, f"train {step}/{STEPS}", timeout=90)


def assert_same_run(out, straight):
    rows, expected = read_rows(out), read_rows(straight)
    assert [int(row["step"]) for row in rows] == list(range(1, STEPS + 1))
    for row, true in zip(rows, expected, strict=True):
        assert float(row["loss"]) == pytest.approx(float(true["loss"]), rel=1e-3)
    found, weights = (read_checkpoint(f / "model.ckpt")["state_dict"] for f in (out, straight))
    for key, value in weights.items():
        torch.testing.assert_close(found[key], value, rtol=1e-2, atol=1e-4)


def test_a_dry_run_takes_its_steps_on_all_nodes_and_leaves_nothing_but_its_answer(
    cluster, shards, tmp_path
):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    env = {**LOCAL, "TMPDIR": str(temporary)}

    def rehearse(place):
        arguments = [*layers(place, tmp_path / "out"), "--dry-run"]
        return cluster.sbatch(SCRIPT, *arguments, cwd=tmp_path, env=env, **TWO)

    job = rehearse(shards)
    cluster.wait(job, timeout=120)
    said = cluster.output(job)
    assert said.count(f"ready: {STEPS} steps to take") == 1
    assert "CPU, 2 processes" in said
    assert said.count("dry run: step 1 ") == 1
    job = rehearse(tmp_path / "nowhere")
    cluster.wait(job, "FAILED", timeout=120)
    assert cluster.output(job).count("nowhere/manifest.json: no such file") == 1
    assert not (tmp_path / "out").exists()
    assert not [*temporary.glob("l3r-*")]


def test_a_job_that_is_signalled_requeues_itself_and_ends_as_if_it_had_not_stopped(
    cluster, shards, straight, tmp_path
):
    job = submit(cluster, shards, tmp_path)
    wait_for_step(cluster, job, 60)
    cluster.signal(job, "USR1")
    cluster.release(job)
    cluster.wait(job, timeout=120)
    said = cluster.output(job)
    assert f"job {job} is requeued" in said
    assert said.count("2 processes on n[1-2]") == 2
    assert (tmp_path / "out" / "previous.ckpt").exists(), "the one that the signal asked for"
    assert_same_run(tmp_path / "out", straight)


def test_a_run_without_scontrol_as_in_a_container_is_requeued_by_its_script(
    cluster, shards, straight, tmp_path
):
    tools = tmp_path / "bin"
    tools.mkdir()
    # What starts a container stands in the path under the command's name.
    inside = f"PATH=/nowhere exec {sys.executable} -m l3r"
    (tools / "l3r").write_text(f'#!/bin/sh\n{inside} "$@"\n')
    (tools / "l3r").chmod(0o755)
    site = tmp_path / "site.env"
    site.write_text(f"export PATH={tools}:$PATH\n")
    command = [SCRIPT, *layers(shards, tmp_path / "out")]
    job = cluster.sbatch(*command, cwd=tmp_path, env={**LOCAL, "L3R_SITE_ENV": str(site)}, **TWO)
    wait_for_step(cluster, job, 60)
    cluster.signal(job, "USR1")
    cluster.release(job)
    cluster.wait(job, timeout=120)
    assert f"job {job} is to be requeued by its script" in cluster.output(job)
    assert not list(tmp_path.glob(".l3r-requeue-*"))
    assert_same_run(tmp_path / "out", straight)


def test_a_job_that_is_told_to_end_saves_and_the_same_command_goes_on(
    cluster, shards, straight, tmp_path
):
    job = submit(cluster, shards, tmp_path)
    wait_for_step(cluster, job, 60)
    cluster.signal(job, "TERM")
    cluster.wait(job, "FAILED", timeout=90)
    assert re.search(r"SIGTERM: step \d+ is saved .*the same command", cluster.output(job))
    saved = read_checkpoint(tmp_path / "out" / "last.ckpt")["global_step"]
    assert 60 <= saved < STEPS
    job = submit(cluster, shards, tmp_path)
    cluster.wait(job, timeout=120)
    assert_same_run(tmp_path / "out", straight)


def test_a_process_that_is_killed_ends_the_job_and_the_requeued_one_goes_on(
    cluster, shards, straight, tmp_path
):
    job = submit(cluster, shards, tmp_path, checkpoint_every=40)
    wait_for_step(cluster, job, 60)
    kill_training(cluster, "n2")
    cluster.wait(job, "FAILED", timeout=90)
    # Which of the two is first to notice is a race: the other process, or srun.
    said = cluster.output(job)
    assert "process 0 of 2 lost another one" in said or "Killed" in said
    cluster.requeue(job)
    cluster.release(job)
    cluster.wait(job, timeout=120)
    assert_same_run(tmp_path / "out", straight)


def kill_training(cluster, node):
    """``kill -9`` of the process that trains on a node."""
    found = []
    for pid in find_processes(cluster.folder, node):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        if b"train" in words and any(word.endswith(b"/l3r") for word in words[:2]):
            found.append(pid)
    assert len(found) == 1, found
    os.kill(found[0], 9)


def test_a_node_that_goes_away_leaves_one_that_takes_the_same_steps(
    cluster, shards, straight, tmp_path
):
    job = submit(cluster, shards, tmp_path, checkpoint_every=40)
    wait_for_step(cluster, job, 60)
    cluster.kill_node("n2")
    cluster.cancel(job)
    cluster.wait(job, "CANCELLED")
    alone = {**TWO, "nodes": 1}
    job = submit(cluster, shards, tmp_path, options=alone, accumulate=2)
    cluster.wait(job, timeout=120)
    assert_same_run(tmp_path / "out", straight)
    cluster.restore_node("n2")
