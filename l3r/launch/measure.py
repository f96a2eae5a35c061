"""Seconds of a step of a sweep's rows, rehearsed; ``python -m l3r.launch.measure LAYER ...``.

A program of its own, because a rehearsal on several devices starts its other processes by the
command line of this one.
"""

import subprocess
import sys
from collections.abc import Mapping, Sequence

from l3r.config import load_config
from l3r.errors import L3RError
from l3r.launch.expand import Sweep
from l3r.launch.run_state import RunState


def measure_rows(sweep: Sweep, states: Mapping[str, RunState]) -> dict[str, float]:
    """Rehearse a run of every row of which no step was measured.

    Args:
        sweep: The sweep.
        states: Of its runs, by name.

    Returns:
        Seconds of a step by row; rows that cannot be rehearsed are left out, with a line on
        standard error that says why.
    """
    known = {run.row for run in sweep.runs if states[run.name].step_seconds is not None}
    measured: dict[str, float] = {}
    for row in sweep.spec.rows:
        run = next(run for run in sweep.runs if run.row == row)
        if row in known or run.config is None:
            continue
        command = [sys.executable, "-m", "l3r.launch.measure", *run.layers]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
        if done.returncode == 0:
            measured[row] = float(done.stdout.split()[-1])
    return measured


def main(layers: Sequence[str]) -> int:
    """Rehearse one run and print the seconds of a step."""
    try:
        config = load_config(layers)
        # It brings torch, which the rest of this module does not need.
        from l3r.train.dry_run import rehearse

        seconds = rehearse(config).step_seconds
    except L3RError as error:
        sys.stderr.write(f"rehearsal: {error}\n")
        return 2
    sys.stdout.write(f"{seconds}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
