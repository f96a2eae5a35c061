"""``l3r reconstruct``.

Reconstruct a folder of photos: cameras, dense points and a report to look at.
Writes into OUT: sparse/0 (COLMAP), points.ply, cameras.json, run.json and
report.html.

Examples::

  l3r reconstruct photos/ --checkpoint l3r.ckpt --out out/
  l3r reconstruct photos/ --checkpoint l3r.ckpt --out out/ inference.min_conf=5
"""

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("photos", type=Path, metavar="PHOTOS", help="folder of photos")
    parser.add_argument("--checkpoint", type=Path, required=True, help="made by 'l3r train'")
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--device", default="auto", help="auto (default), cpu or cuda")
    parser.add_argument(
        "settings",
        nargs="*",
        metavar="inference.key=value|graph.key=value",
        help="override the checkpoint's configuration",
    )


def run(args: argparse.Namespace) -> int:
    """Reconstruct and print a summary."""
    from l3r.inference.job import reconstruct_folder

    summary = reconstruct_folder(
        args.photos, args.checkpoint, args.out, device=args.device, settings=args.settings
    )
    sys.stdout.write(summary)
    return 0
