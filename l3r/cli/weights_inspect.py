"""``l3r weights inspect``.

Say what a file of weights is: a Light3R checkpoint or folder, or an official
DUSt3R, MASt3R or CroCo v2 file or folder, and what an import would take of it.
Nothing in the file is executed.

Examples::

  l3r weights inspect runs/room/last.ckpt
  l3r weights inspect DUSt3R_ViTLarge_BaseDecoder_512_dpt.pth
"""

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("file", type=Path, metavar="FILE", help="file or folder of weights")


def run(args: argparse.Namespace) -> int:
    """Print a description."""
    from l3r.inference.weights import describe_weights

    sys.stdout.write(describe_weights(args.file))
    return 0
