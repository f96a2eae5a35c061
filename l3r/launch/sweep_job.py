"""The whole job behind ``l3r sweep``."""

from collections.abc import Sequence

from l3r.launch.expand import Run, Sweep, expand
from l3r.launch.measure import measure_rows
from l3r.launch.run_state import read_states
from l3r.launch.run_sweep import SweepRunner
from l3r.launch.run_table import format_runs
from l3r.launch.slurm import submit_sweep
from l3r.launch.sweep_file import write_sweep
from l3r.launch.sweep_report import report_sweep

__all__ = ["expand", "list_runs", "run_share", "submit"]


def list_runs(sweep: Sweep, *, measure: bool) -> str:
    """Give the table of runs; first rehearse what was never measured, where asked."""
    states = read_states(sweep)
    return format_runs(sweep, states, measure_rows(sweep, states) if measure else None)


def submit(sweep: Sweep, options: Sequence[str]) -> str:
    """Submit what is left as an array of SLURM jobs, and give what to do next.

    Args:
        sweep: The sweep.
        options: Of ``sbatch``, in place of those in the script.
    """
    write_sweep(sweep)
    said = submit_sweep(sweep, read_states(sweep), options)
    return f"{said}\nthe tables, now and later: l3r report {sweep.out}\n"


def run_share(
    sweep: Sweep, share: Sequence[Run], *, jobs: int, launcher: Sequence[str]
) -> tuple[str, list[str]]:
    """Do a share of a sweep's runs and write its tables.

    Args:
        sweep: The sweep.
        share: Some of its runs.
        jobs: Runs at a time.
        launcher: Words before ``l3r train``.

    Returns:
        The table, and the names of runs that are not over.
    """
    runner = SweepRunner(sweep, jobs=jobs, launcher=launcher)
    write_sweep(sweep)
    left = runner.run(share)
    return report_sweep(sweep.out), left
