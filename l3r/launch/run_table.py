"""The runs of a sweep as a table: what they are, how far, how long."""

from collections import Counter
from collections.abc import Mapping
from statistics import median
from typing import NamedTuple

from l3r.launch.expand import Sweep
from l3r.launch.run_state import RunState


class StepCost(NamedTuple):
    """What a training step takes."""

    seconds: float
    num_devices: int | None
    """GPUs; None on a CPU."""


def estimate_steps(
    sweep: Sweep, states: Mapping[str, RunState], measured: Mapping[str, StepCost] | None = None
) -> dict[str, float]:
    """Give the seconds of a step of each row, where known.

    Args:
        sweep: The sweep.
        states: Of its runs, by name: the median of the seeds that have begun.
        measured: By row, where none of a row has begun.
    """
    known = {row: cost.seconds for row, cost in (measured or {}).items()}
    for row in sweep.spec.rows:
        own = [states[run.name].step_seconds for run in sweep.runs if run.row == row]
        if found := [seconds for seconds in own if seconds is not None]:
            known[row] = median(found)
    return known


def format_runs(
    sweep: Sweep, states: Mapping[str, RunState], measured: Mapping[str, StepCost] | None = None
) -> str:
    """Lay out all runs, and what is left to do.

    Args:
        sweep: The sweep.
        states: Of its runs, by name.
        measured: What a step takes by row, for rows of which no run has begun.
    """
    step_seconds = estimate_steps(sweep, states, measured)
    devices_of = [state.num_devices for state in states.values()]
    devices_of += [cost.num_devices for cost in (measured or {}).values()]
    known = [found for found in devices_of if found is not None]
    header = ("run", "differs from the base in", "state", "hours", "GPU hours")
    rows = [header]
    left, gpu_left, unknown = 0.0, 0.0, 0
    for run in sweep.runs:
        state = states[run.name]
        # A run that has not begun will have as many GPUs as others had.
        is_begun = state.step_seconds is not None
        devices = state.num_devices if is_begun else max(known, default=None)
        changed = sweep.changes[run.row]
        words = ", ".join(f"{key}={new}" for key, (_, new) in changed.items()) or "nothing"
        whole = _hours(state, step_seconds.get(run.row), 0)
        rest = _hours(state, step_seconds.get(run.row), state.step)
        if state.kind in ("new", "begun", "failed"):
            unknown += rest is None
            left += rest or 0.0
            gpu_left += (rest or 0.0) * (devices or 0)
        gpu = None if whole is None or devices is None else whole * devices
        rows.append((run.name, words, state.describe(), _cell(whole), _cell(gpu)))
    widths = [max(len(row[column]) for row in rows) for column in range(len(header))]
    lines = [
        "  ".join(
            cell.rjust(width) if column > 2 else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
    counts = Counter(state.kind for state in states.values())
    tally = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    lines.append(f"{len(sweep.runs)} runs ({tally}); left: {_left(left, gpu_left, unknown)}")
    return "\n".join(lines) + "\n"


def _hours(state: RunState, seconds: float | None, begun_at: int) -> float | None:
    if seconds is None or state.max_steps is None:
        return None
    return (state.max_steps - begun_at) * seconds / 3600


def _cell(hours: float | None) -> str:
    return "-" if hours is None else f"{hours:.2f}" if hours < 10 else f"{hours:,.0f}"


def _left(hours: float, gpu_hours: float, unknown: int) -> str:
    text = f"{_cell(hours)} hours"
    if gpu_hours:
        text += f", {_cell(gpu_hours)} GPU hours"
    return text + (f", and {unknown} runs of which no step was measured" if unknown else "")
