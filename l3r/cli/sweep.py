r"""``l3r sweep``.

Train and score the runs of a sweep file, base x rows x seeds, and print the
table of the paper with ours beside it. Runs that are finished stay, others go
on where they stopped. docs/sweeps.md says how to write a sweep.

Examples::

  l3r sweep configs/sweep/tiny_num_layers.yaml --jobs 2
  l3r sweep configs/sweep/num_layers.yaml --list \
      data.sources.waymo.shards=shards/waymo \
      data.validation.waymo.shards=shards/waymo_val
"""

import argparse
import shlex
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("sweep", type=Path, metavar="SWEEP.yaml", help="the sweep file")
    add("layers", nargs="*", metavar="FILE.yaml|key=value", help="on top of its base")
    add("--out", type=Path, metavar="DIR", help="folder of all runs (output_dir of the file)")
    add("--list", action="store_true", help="print the runs and what they cost; run nothing")
    add("--measure", action="store_true", help="first rehearse rows of which no step is measured")
    add("--submit", action="store_true", help="submit an array of SLURM jobs for what is left")
    add("--sbatch", default="", metavar="WORDS", help="for --submit: --sbatch='--mem=64G'")
    add("--jobs", type=int, default=1, metavar="K", help="runs at a time (1)")
    add("--tasks", type=int, default=1, metavar="K", help="tasks that share the runs (1)")
    add("--task-index", type=int, default=0, metavar="I", help="which of them this is, from 0")
    add("--launcher", default="", metavar="WORDS", help="before 'l3r train', such as 'srun ...'")
    add("--score", metavar="ROW/seed_S", help="score one trained run again, and nothing else")


def run(args: argparse.Namespace) -> int:
    """Run, submit, or only say what would run."""
    from l3r.launch import sweep_job

    sweep = sweep_job.expand(args.sweep, args.layers, args.out)
    if args.score:
        from l3r.launch.score import score_run

        score_run(sweep, sweep.find(args.score))
        return 0
    sys.stdout.write(sweep_job.list_runs(sweep, measure=args.measure))
    if args.list:
        return 0
    if args.submit:
        sys.stdout.write(sweep_job.submit(sweep, shlex.split(args.sbatch)))
        return 0
    share = sweep.share(args.task_index, args.tasks)
    launcher = shlex.split(args.launcher)
    text, left = sweep_job.run_share(sweep, share, jobs=args.jobs, launcher=launcher)
    sys.stdout.write(f"\n{text}")
    return 1 if left else 0
