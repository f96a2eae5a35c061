"""``l3r eval poses``.

Score cameras against trusted ones: RRA, RTA and mAA in percent, and the error
of the camera centres (ATE). Images are matched by name; the scales and frames
of the two sides do not matter.

Examples::

  l3r eval poses --pred out/ --gt scene/cameras.json --missing fail
"""

import argparse
import json
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    source = "cameras.json, the folder of one, or a COLMAP model"
    parser.add_argument("--pred", type=Path, required=True, metavar="OUT", help=source)
    parser.add_argument("--gt", type=Path, required=True, metavar="PATH", help=source)
    parser.add_argument(
        "--missing",
        choices=("fail", "exclude_image", "exclude_scene"),
        default="fail",
        help="pairs of images without camera count as wrong (default), or are left out; or count "
        "as wrong, but a scene without any camera has no accuracy",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the scores there too")


def run(args: argparse.Namespace) -> int:
    """Print a table of scores on standard output."""
    from rich.console import Console
    from rich.table import Table

    from l3r.eval.poses import evaluate_cameras, load_cameras
    from l3r.files import write_atomic

    result = evaluate_cameras(load_cameras(args.pred), load_cameras(args.gt), args.missing)
    table = Table("metric", "value")
    table.columns[1].justify = "right"
    for name, value in result.metrics.to_dict().items():
        is_length = name.startswith("ate")
        table.add_row(name, f"{value:.4g}" if is_length else f"{value:.1f} %")
    console = Console(file=sys.stdout, width=80, highlight=False, markup=False)
    console.print(f"{args.pred} against {args.gt}")
    console.print(table)
    console.print("ate: normalised; ate_rmse: in units of the truth")
    console.print(
        f"registered {result.num_registered} of {result.num_images} images, "
        f"{result.num_images - result.num_found} not in the prediction"
    )
    console.print(f"missing: {result.missing}; near-coincident true pairs: {result.num_short}")
    if args.json:
        write_atomic(args.json, json.dumps(result.to_dict(), indent=1) + "\n")
    return 0
