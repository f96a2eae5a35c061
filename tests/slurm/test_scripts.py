"""Job scripts without a cluster: what they would run, and what they refuse."""

import os
import shutil
import subprocess

import pytest

from tests.slurm import programs
from tests.slurm.cluster import ROOT

SCRIPTS = sorted((ROOT / "slurm").glob("*.sh"))
BUILD = ROOT / "slurm" / "build_shards.sh"
OPTIONS = ("tartanair", "--raw", "raw data", "--out", "out", "--scenes", "*/P00?")


@pytest.fixture
def run_job(tmp_path):
    """Run a script as SLURM would, with an srun that prints its arguments."""
    (tmp_path / "srun").write_text('#!/bin/sh\nfor word in "$@"; do echo "$word"; done\n')
    (tmp_path / "srun").chmod(0o755)

    def run(script, *args, **variables):
        env = {
            "PATH": f"{tmp_path}:/usr/bin:/bin",
            "SLURM_JOB_ID": "7",
            "SLURM_SUBMIT_DIR": str(tmp_path),
            **variables,
        }
        command = ["bash", str(script), *args]
        return subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, text=True)

    return run


def array(task, ids, step="1"):
    """What SLURM tells a task of an array."""
    return {
        "SLURM_ARRAY_TASK_ID": str(task),
        "SLURM_ARRAY_TASK_MIN": str(min(ids)),
        "SLURM_ARRAY_TASK_MAX": str(max(ids)),
        "SLURM_ARRAY_TASK_COUNT": str(len(ids)),
        "SLURM_ARRAY_TASK_STEP": step,
        "SLURM_CPUS_PER_TASK": "3",
    }


def share_of(done):
    words = done.stdout.split("\n")
    assert done.returncode == 0, done.stderr
    return int(words[words.index("--task-index") + 1]), int(words[words.index("--tasks") + 1])


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_job_scripts_are_sound(path):
    done = subprocess.run(["bash", "-n", str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert path.stat().st_mode & 0o111
    if shutil.which("shellcheck"):
        done = subprocess.run(["shellcheck", str(path)], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a git checkout")
def test_git_ignores_the_site_and_knows_its_example():
    command = ["git", "check-ignore", "slurm/site.env", "slurm/site.env.example"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.split() == ["slurm/site.env"]


def test_the_build_runs_one_step_with_the_options_as_given(run_job):
    done = run_job(BUILD, *OPTIONS, **array(1, [0, 1]))
    assert done.stdout.splitlines() == [
        *("--nodes=1", "--ntasks=1", "--cpus-per-task=3"),
        *("l3r-prep", "build", "--workers", "3", "--tasks", "2", "--task-index", "1"),
        *OPTIONS,
    ]


@pytest.mark.parametrize(
    "ids", [range(16), range(1, 9), range(0, 12, 4), [3, 7], [5]], ids=lambda ids: str([*ids])
)
def test_the_tasks_of_an_array_share_the_work(run_job, ids):
    shares = [share_of(run_job(BUILD, *OPTIONS, **array(i, ids))) for i in ids]
    assert shares == [(index, len(ids)) for index in range(len(ids))]


@pytest.mark.parametrize("ids", [[0, 1, 5], [1, 2, 3, 7], [0, 2, 3]], ids=str)
def test_ids_with_gaps_are_refused_by_a_task_at_least(run_job, ids):
    done = [run_job(BUILD, *OPTIONS, **array(i, ids)) for i in ids]
    assert any(one.returncode == 2 and "--tasks 16" in one.stderr for one in done)


@pytest.mark.parametrize("tasks", [["--tasks", "16"], ["--tasks=16"]], ids=str)
def test_single_tasks_of_an_array_can_be_redone(run_job, tasks):
    done = run_job(BUILD, *OPTIONS, *tasks, **array(7, [3, 4, 7]))
    words = done.stdout.splitlines()
    assert words[words.index("--task-index") + 1] == "7"
    assert words.count("--tasks") + words.count("--tasks=16") == 1


def test_a_job_that_is_no_array_is_one_task(run_job):
    assert share_of(run_job(BUILD, *OPTIONS)) == (0, 1)


def test_the_site_is_found_where_the_job_was_submitted(run_job, tmp_path):
    (tmp_path / "slurm").mkdir()
    (tmp_path / "slurm" / "site.env").write_text('echo "site $UNSET"\n')
    assert run_job(BUILD, *OPTIONS).stdout.startswith("site \n")
    (tmp_path / "other.env").write_text("echo other\n")
    named = run_job(BUILD, *OPTIONS, L3R_SITE_ENV=str(tmp_path / "other.env"))
    assert named.stdout.startswith("other\n")


def test_a_named_site_that_is_absent_is_refused(run_job):
    done = run_job(BUILD, *OPTIONS, L3R_SITE_ENV="/nowhere/site.env")
    assert (done.returncode, done.stdout) == (2, "")
    assert "/nowhere/site.env" in done.stderr


@pytest.mark.parametrize(("args", "job"), [(OPTIONS, ""), ((), "7")], ids=["no job", "no options"])
def test_outside_slurm_the_build_says_how_to_submit(run_job, args, job):
    done = run_job(BUILD, *args, SLURM_JOB_ID=job)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert "sbatch --array=0-15 slurm/build_shards.sh" in done.stderr


def test_a_machine_without_slurm_is_told_what_to_install(monkeypatch):
    monkeypatch.setattr(programs, "SEARCH_PATH", "/nowhere")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    reason = programs.provide_programs()
    assert "slurmctld" in reason
    assert "slurm-wlm and munge" in reason
    assert "\n" not in reason


def test_an_installation_that_fails_is_told_with_its_reason(monkeypatch, tmp_path):
    monkeypatch.setattr(programs, "SEARCH_PATH", "/nowhere")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    (tmp_path / "apt-get").write_text(
        "#!/bin/sh\necho W: odd >&2\necho E: no network >&2\nexit 100\n"
    )
    (tmp_path / "apt-get").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    reason = programs.provide_programs()
    assert "apt-get failed: E: no network" in reason
    assert "\n" not in reason
