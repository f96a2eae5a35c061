"""What a sweep asks of SLURM."""

import os
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from l3r.errors import LaunchError
from l3r.launch.expand import Sweep
from l3r.launch.run_state import RunState
from l3r.train.signals import name_job

SCRIPT = Path("slurm/sweep.sh")


def submit_sweep(sweep: Sweep, states: Mapping[str, RunState], options: Sequence[str] = ()) -> str:
    """Submit an array with a task for each run that is not over.

    Args:
        sweep: The sweep.
        states: Of its runs, by name.
        options: Of ``sbatch``, in place of those in the script.

    Returns:
        What ``sbatch`` said, or that there is nothing to do.

    Raises:
        LaunchError: There is no script or no SLURM here, or it refuses the job.
    """
    left = [
        number
        for number, run in enumerate(sweep.runs)
        if states[run.name].kind in ("new", "begun", "trained", "failed")
    ]
    if not left:
        waiting = [state.describe() for state in states.values() if state.kind == "waiting"]
        why = f"{len(waiting)} runs are {waiting[0]}" if waiting else "no run is left to do"
        return f"nothing to submit: {why}"
    if not SCRIPT.is_file():
        raise LaunchError(f"{SCRIPT}: no such file; run this in the folder of the project")
    array = ",".join(map(str, left))
    sweep_words = (str(sweep.file), *sweep.extra, "--out", str(sweep.out))
    command = ["sbatch", f"--array={array}", *options, str(SCRIPT), *sweep_words]
    try:
        done = subprocess.run(
            [*command, "--tasks", str(len(sweep.runs))], capture_output=True, text=True
        )
    except OSError as error:
        raise LaunchError(f"sbatch: {error.strerror}; run this where jobs are submitted") from error
    if done.returncode:
        said = done.stderr.strip() or f"exit code {done.returncode}"
        raise LaunchError(f"sbatch refuses the job: {said.splitlines()[-1]}")
    return f"{done.stdout.strip()}: {len(left)} tasks, a run each"


def job_is_leaving() -> bool:
    """Tell whether this process is part of a SLURM job that no longer runs: requeued, cancelled."""
    if "SLURM_JOB_ID" not in os.environ:
        return False
    command = ["squeue", "--noheader", f"--jobs={name_job()}", "--format=%T"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0 and done.stdout.strip() != "RUNNING"
