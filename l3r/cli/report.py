"""``l3r report``.

Draw how a training run goes, or went: curves, validation, speed, skipped steps,
configuration. Takes any run's folder, also of one that is running or was
killed, and writes one HTML file that needs no network and no script. Of the
folder of a sweep it prints the tables, the paper's numbers beside ours, and
writes table.md and the page.

Examples::

  l3r report runs/first
  l3r report runs/first --out first.html
  l3r report runs/sweep/num_layers
"""

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "run", type=Path, metavar="RUN", help="train.output_dir of a run, or folder of a sweep"
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="where it goes; default: RUN/report.html"
    )


def run(args: argparse.Namespace) -> int:
    """Write the report and print its verdict, or a sweep's tables."""
    out = args.out or args.run / "report.html"
    if (args.run / "sweep.json").is_file():
        from l3r.launch.sweep_report import report_sweep

        sys.stdout.write(report_sweep(args.run, out))
        sys.stderr.write(f"report: {out}\n")
        return 0
    from l3r.export.run_folder import read_run_folder
    from l3r.export.run_report import judge_run, render_run_report
    from l3r.files import write_atomic

    found = read_run_folder(args.run)
    write_atomic(out, render_run_report(found))
    sys.stdout.write(f"{judge_run(found)}\nreport: {out}\n")
    return 0
