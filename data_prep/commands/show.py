"""``l3r-prep show``: draw one stored graph.

Writes one page to open from disk: all images and their depth large, the tree over the stored
overlap, the numbers of all pairs, and for each edge of the tree numbered points of one image where
depth, intrinsics and cameras say they lie in the other. Whether cameras and depth are right can be
seen at a glance.

for example:
  l3r-prep show shards/tartanair tartanair-hospital-Easy-P012-000004
  l3r-prep show shards train/tartanair-000012.tar:KEY --out graph.html
"""

import argparse
import sys
from pathlib import Path

from l3r.errors import DataError
from l3r.files import write_atomic


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("shards", type=Path, metavar="SHARDS", help="folder of shards, or of train and val")
    add(
        "key",
        metavar="KEY",
        help="the graph's key, or shard.tar:key as messages of training name it",
    )
    add("--out", type=Path, metavar="FILE.html", help="where to write (KEY.html, here)")


def run(args: argparse.Namespace) -> int:
    """Write the page and print its path."""
    from data_prep.check.graphs import read_graph
    from data_prep.check.lookup import find_graph
    from data_prep.commands.threads import use_one_thread
    from data_prep.pages.show_page import render_show

    use_one_thread()
    if args.out is not None and args.out.suffix not in (".html", ".htm"):
        raise DataError(f"--out is {args.out}, expected a name that ends in .html")
    stored = find_graph(args.shards, args.key)
    out = args.out or Path(f"{stored.entry.key}.html")
    write_atomic(out, render_show(stored, read_graph(stored)))
    sys.stdout.write(f"{out}\n")
    return 0
