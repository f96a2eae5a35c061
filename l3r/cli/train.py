r"""``l3r train``.

Train on shards, or go on where the same run stopped. Writes into
train.output_dir: config.yaml, metrics.csv, validation.csv, last.ckpt (to go on)
and model.ckpt (weights).

Examples::

  l3r train configs/base.yaml configs/model/tiny.yaml \
      data.sources.room.shards=shards/train train.output_dir=runs/room
"""

import argparse
import sys

from l3r.config import load_config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "layers",
        nargs="+",
        metavar="FILE.yaml|key=value",
        help="merged left to right; the later one wins ('l3r config' shows the result)",
    )


def run(args: argparse.Namespace) -> int:
    """Train and print where the weights are."""
    config = load_config(args.layers)
    from l3r.train.run import train

    path = train(config)
    sys.stdout.write(f"weights: {path}\n")
    return 0
