"""What a sweep asks of SLURM."""

import os
import subprocess


def job_is_leaving() -> bool:
    """Tell whether this process is part of a SLURM job that no longer runs: requeued, cancelled."""
    job = os.environ.get("SLURM_JOB_ID")
    if job is None:
        return False
    command = ["squeue", "--noheader", f"--jobs={job}", "--format=%T"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0 and done.stdout.strip() != "RUNNING"
