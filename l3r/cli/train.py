r"""``l3r train``.

Train on shards, or go on where the same run stopped. Writes into
train.output_dir: config.yaml, metrics.csv, validation.csv, last.ckpt (to go on)
and model.ckpt (weights).

--dry-run reads from every source, takes a few steps as the run would, says what
they took in time and memory, and writes nothing; one line and exit code 2 if
the run would fail.

Examples::

  l3r train configs/base.yaml configs/model/tiny.yaml \
      data.sources.room.shards=shards/train train.output_dir=runs/room

  l3r train configs/base.yaml configs/model/l3r_512.yaml \
      data.sources.room.shards=shards/train train.devices=8 --dry-run
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
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="try data, memory and a few steps; write nothing",
    )


def run(args: argparse.Namespace) -> int:
    """Train and print where the weights are, or print what a dry run found."""
    config = load_config(args.layers)
    if args.dry_run:
        from l3r.train.dry_run import rehearse

        rehearsal = rehearse(config)
        if rehearsal.ranks.is_first:
            sys.stdout.write(rehearsal.to_table())
        return 0
    from l3r.train.run import train

    path = train(config)
    sys.stdout.write(f"weights: {path}\n")
    return 0
