"""Options that say how many graphs of how many images there shall be, of ``build`` and inspect."""

import argparse
import math
from dataclasses import dataclass

from l3r.errors import DataError


@dataclass(frozen=True, kw_only=True)
class GraphCounts:
    """How many graphs, of how many images."""

    num_graphs: int
    """Most graphs of a scene."""
    graphs_per_image: float
    """Most graphs of a scene for each of its images."""
    min_views: int
    """Fewest images of a graph."""
    max_views: int
    """Most images of a graph."""


def add_graph_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare them."""
    add = parser.add_argument
    add("--num-graphs", type=int, default=1000, metavar="N", help="most graphs a scene (1000)")
    add(
        "--graphs-per-image",
        type=float,
        default=1.0,
        metavar="X",
        help="most graphs of a scene for each of its images (1)",
    )
    add("--max-views", type=int, default=10, metavar="N", help="most images of a graph (10)")
    add("--min-views", type=int, metavar="N", help="fewest images of a graph (8, or --max-views)")


def graph_counts(args: argparse.Namespace) -> GraphCounts:
    """Read them.

    Raises:
        DataError: One is out of range.
    """
    counts = GraphCounts(
        num_graphs=args.num_graphs,
        graphs_per_image=args.graphs_per_image,
        min_views=min(8, args.max_views) if args.min_views is None else args.min_views,
        max_views=args.max_views,
    )
    if counts.num_graphs < 1 or not 0 < counts.graphs_per_image < math.inf:
        raise DataError(
            f"--num-graphs is {counts.num_graphs} and --graphs-per-image"
            f" {counts.graphs_per_image}, expected 1 or more, and more than 0"
        )
    if not 2 <= counts.min_views <= counts.max_views:
        raise DataError(
            f"--min-views is {counts.min_views} and --max-views {counts.max_views}, expected"
            " 2 <= min_views <= max_views"
        )
    return counts
