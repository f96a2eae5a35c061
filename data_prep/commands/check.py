"""``l3r-prep check``: do the shards hold what they claim?

Moves pixels between the images of stored graphs and back, by the stored depth, intrinsics and
cameras. Exit code 2, naming the quantity, where they disagree: a principal point half a pixel
off, other camera axes, inverted cameras, range in place of depth, images of another frame.

example: l3r-prep check shards/tartanair
"""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from l3r.errors import DataError

if TYPE_CHECKING:
    from data_prep.check import CheckReport


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("shards", type=Path, metavar="SHARDS", help="folder that holds manifest.json")
    add("--max-graphs", type=int, default=24, metavar="N", help="graphs to measure (24)")
    add("--digests", action="store_true", help="also compare every tar's SHA-256")
    add("--json", action="store_true", help="print the quantities as JSON")


def run(args: argparse.Namespace) -> int:
    """Print what was measured; raise where it is out of range."""
    from data_prep.check import LIMITS, NOISY, check_shards
    from data_prep.commands.threads import use_one_thread

    use_one_thread()
    if args.max_graphs < 1:
        raise DataError(f"--max-graphs is {args.max_graphs}, expected 1 or more")
    report = check_shards(args.shards, max_graphs=args.max_graphs, digests=args.digests)
    text = json.dumps(report.to_plain(), indent=2) if args.json else _describe(report)
    sys.stdout.write(text + "\n")
    faults = report.find_faults(LIMITS.get(report.dataset, NOISY))
    if faults:
        raise DataError(
            f"{args.shards}: {'; '.join(faults)}; look at the converter's intrinsics, camera"
            " axes, direction of the cameras and kind of depth, then build again"
        )
    return 0


def _describe(report: "CheckReport") -> str:
    unit = " m" if report.is_metric else ""
    rows = {
        "graphs": f"{report.num_graphs}, measured {report.num_measured}",
        "known depth": f"{report.valid_depth:.1%} of pixels",
        "rotations": f"orthonormal to {report.rotation_error:.0e}",
        "connected": f"{report.connected:.1%} of the pairs stored as overlapping,"
        f" {report.connected_all:.1%} of {report.num_pairs}",
        "round trip": f"{report.round_trip:.3f} px",
        "depth": f"{report.depth_error:.4%} disagreement, {report.depth_bias:.4%} bias",
        "brightness": f"{report.color:.2f} correlation",
        "covisible": f"{report.covisible_gap:.3f} off the stored share",
        "scale": f"depth {report.median_depth:.3g}{unit}, between cameras"
        f" {report.median_step:.3g}{unit}",
    }
    return "\n".join([report.dataset, *(f"  {name:<12} {text}" for name, text in rows.items())])
