"""slurm/sweep.sh without a cluster, and what ``--submit`` would submit."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from l3r.cli.main import main
from l3r.errors import LaunchError
from l3r.launch.expand import expand
from l3r.launch.measure import main as measure
from l3r.launch.measure import measure_rows
from l3r.launch.run_state import read_states
from l3r.launch.score_file import scoring_request
from l3r.launch.slurm import job_is_leaving, submit_sweep
from tests.launch.sweeps import score_by_hand, train_by_hand, write_sweep_file
from tests.slurm.cluster import ROOT

SWEEP = ROOT / "slurm" / "sweep.sh"


@pytest.fixture
def tools(tmp_path):
    """A folder of programs that print how they were called, one word a line."""
    folder = tmp_path / "tools"
    folder.mkdir()
    for name in ("l3r", "sbatch"):
        (folder / name).write_text('#!/bin/sh\nfor word in "$@"; do echo "$word"; done\n')
    (folder / "scontrol").write_text('#!/bin/sh\n[ "$*" = "show hostnames n[4-5]" ] && echo n4\n')
    (folder / "python").write_text("#!/bin/sh\necho 0.25 8\n")
    for path in folder.iterdir():
        path.chmod(0o755)
    return folder


def run_task(tools, *args, **variables):
    env = {
        "PATH": f"{tools}:/usr/bin:/bin",
        "SLURM_JOB_ID": "7",
        "SLURM_SUBMIT_DIR": str(tools.parent),
        "SLURM_JOB_NODELIST": "n[4-5]",
        "SLURM_CPUS_PER_TASK": "3",
        **variables,
    }
    command = ["bash", str(SWEEP), *args]
    return subprocess.run(command, env=env, capture_output=True, text=True)


def array(task, first, last, count):
    values = {"ID": task, "MIN": first, "MAX": last, "COUNT": count}
    return {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in values.items()}


def test_a_task_does_its_share_with_srun(tools):
    done = run_task(tools, "own.yaml", "train.note=two words", **array(5, 1, 9, 5))
    assert done.stdout.splitlines() == [
        *("sweep", "--tasks", "5", "--task-index", "2"),
        *("--launcher", "srun --kill-on-bad-exit=1 --cpus-per-task=3"),
        *("own.yaml", "train.note=two words"),
    ]


def test_with_tasks_given_an_id_is_the_number_of_a_task(tools):
    done = run_task(tools, "own.yaml", "--tasks", "12", **array(7, 3, 7, 2))
    assert done.stdout.splitlines()[1:3] == ["--task-index", "7"]


def test_arrays_with_gaps_and_a_script_outside_slurm_are_refused(tools):
    uneven = run_task(tools, "own.yaml", **array(3, 0, 7, 3))
    assert (uneven.returncode, uneven.stdout) == (2, "")
    assert "not evenly spaced" in uneven.stderr
    for done in (run_task(tools, "own.yaml", SLURM_JOB_ID=""), run_task(tools)):
        assert done.returncode == 2
        assert "sbatch --array=0-8 slurm/sweep.sh" in done.stderr


@pytest.fixture
def sweep(tmp_path):
    sweep = expand(write_sweep_file(tmp_path), ["train.note=a b"])
    train_by_hand(sweep.runs[1])
    score_by_hand(sweep.runs[1], scoring_request(sweep))
    return sweep


def test_a_task_is_submitted_for_each_run_that_is_left(sweep, tools, monkeypatch, capsys):
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")
    monkeypatch.chdir(ROOT)
    assert main(["sweep", str(sweep.file), "train.note=a b", "--submit"]) == 0
    words = capsys.readouterr().out
    expected = ["--array=0,2,3", "slurm/sweep.sh", str(sweep.file), "train.note=a b"]
    assert "\n".join([*expected, "--out", str(sweep.out), "--tasks", "4: 3 tasks"]) in words
    assert (sweep.out / "sweep.json").is_file()
    for run in sweep.runs:
        train_by_hand(run)
        score_by_hand(run, scoring_request(sweep))
    assert "nothing to submit" in submit_sweep(sweep, read_states(sweep))


def test_what_cannot_be_submitted_says_why(sweep, tools, monkeypatch):
    states = read_states(sweep)
    monkeypatch.chdir(sweep.out)
    with pytest.raises(LaunchError, match="in the folder of the project"):
        submit_sweep(sweep, states)
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("PATH", str(sweep.out))
    with pytest.raises(LaunchError, match="where jobs are submitted"):
        submit_sweep(sweep, states)
    (tools / "sbatch").write_text(
        "#!/bin/sh\necho 'sbatch: error: no such partition' >&2\nexit 1\n"
    )
    monkeypatch.setenv("PATH", f"{tools}:/usr/bin:/bin")
    with pytest.raises(LaunchError, match="refuses the job: sbatch: error: no such partition"):
        submit_sweep(sweep, states)
    (tools / "sbatch").write_text("#!/bin/sh\nexit 3\n")
    with pytest.raises(LaunchError, match="refuses the job: exit code 3"):
        submit_sweep(sweep, states)


def test_a_task_that_shares_its_id_with_its_array_asks_for_itself_alone(tools, monkeypatch):
    squeue = tools / "squeue"
    squeue.write_text(
        '#!/bin/sh\ncase "$*" in *jobs=7_2*) echo RUNNING;; *) echo PENDING; echo RUNNING;; esac\n'
    )
    squeue.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:/usr/bin:/bin")
    for name, value in {"JOB_ID": "7", "ARRAY_JOB_ID": "7", "ARRAY_TASK_ID": "2"}.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    assert not job_is_leaving()
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "1")
    assert job_is_leaving()


def test_rows_that_were_never_measured_are_rehearsed(sweep, tools, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(tools / "python"))
    assert measure_rows(sweep, read_states(sweep)) == {"none": (0.25, 8)}, "the other row has begun"


def test_a_rehearsal_gives_its_seconds(monkeypatch, capsys):
    memory, ranks = SimpleNamespace(capacity=2**30), SimpleNamespace(world_size=4)
    found = SimpleNamespace(step_seconds=0.125, memory=memory, ranks=ranks)
    module = SimpleNamespace(rehearse=lambda config: found if config.train.seed == 3 else None)
    monkeypatch.setitem(sys.modules, "l3r.train.dry_run", module)
    assert measure(["train.seed=3"]) == 0
    assert capsys.readouterr().out == "0.125 4\n"
    memory.capacity = 0
    assert measure(["train.seed=3"]) == 0
    assert capsys.readouterr().out == "0.125 0\n"


def test_a_rehearsal_that_is_refused_says_so(capsys):
    assert measure(["train.lr=-1"]) == 2
    assert "rehearsal: layers: train.lr is -1.0" in capsys.readouterr().err
