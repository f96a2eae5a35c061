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
from l3r.launch.run_table import StepCost


def measure_rows(sweep: Sweep, states: Mapping[str, RunState]) -> dict[str, StepCost]:
    """Rehearse a run of every row of which no step was measured.

    Args:
        sweep: The sweep.
        states: Of its runs, by name.

    Returns:
        What a step takes by row; rows that cannot be rehearsed are left out, with a line on
        standard error that says why.
    """
    known = {run.row for run in sweep.runs if states[run.name].step_seconds is not None}
    measured: dict[str, StepCost] = {}
    for row in sweep.spec.rows:
        run = next(run for run in sweep.runs if run.row == row)
        if row in known or run.config is None:
            continue
        command = [sys.executable, "-m", "l3r.launch.measure", *run.layers]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
        if done.returncode == 0:
            seconds, num_devices = done.stdout.split()[-2:]
            measured[row] = StepCost(float(seconds), int(num_devices) or None)
    return measured


def main(layers: Sequence[str]) -> int:
    """Rehearse one run and print the seconds of a step, and of how many GPUs; 0: on a CPU."""
    try:
        config = load_config(layers)
        # It brings torch, which the rest of this module does not need.
        from l3r.train.dry_run import rehearse

        found = rehearse(config)
    except L3RError as error:
        sys.stderr.write(f"rehearsal: {error}\n")
        return 2
    num_devices = found.ranks.world_size if found.memory.capacity else 0
    sys.stdout.write(f"{found.step_seconds} {num_devices}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
