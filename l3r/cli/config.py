"""``l3r config``.

Print the configuration that the given layers make, as YAML.

Examples::

  l3r config configs/base.yaml configs/model/tiny.yaml train.seed=1
"""

import argparse
import sys

from l3r.config import load_config, to_yaml


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "layers",
        nargs="*",
        metavar="FILE.yaml|key=value",
        help="merged left to right; the later one wins",
    )


def run(args: argparse.Namespace) -> int:
    """Print the merged configuration on standard output."""
    sys.stdout.write(to_yaml(load_config(args.layers)))
    return 0
