"""``l3r-prep inspect``: what a folder of raw data holds, before anything is built.

Lists scenes, images, sizes, what is missing, what 'build' will leave out and why, and how much
disk the shards will take at most. Reads names and headers only: pixels that are damaged inside are
found by 'build', which leaves them out and says so. Exit code 2 where nothing can be read.

example: l3r-prep inspect tartanair --raw TartanAir/ --num-graphs 1000
"""

import argparse
import json
import sys
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_prep.commands.graph_options import GraphCounts, add_graph_arguments, graph_counts
from data_prep.converters import CONVERTERS, survey_scenes
from data_prep.stored_size import reduced_size
from data_prep.survey import SceneSurvey, quota
from l3r.errors import DataError

if TYPE_CHECKING:
    from rich.table import Table

JPEG_BYTES = 0.5
"""Bytes of a stored image's JPEG for each pixel: genuine images of TartanAir V1 and V2, Waymo, CO3D
and MegaDepth take 0.23 to 0.52."""
DEPTH_BYTES = 2
"""Bytes of a stored depth for each pixel: half floats."""

_WIDTH = 80


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("dataset", choices=sorted(CONVERTERS), help="layout of the source")
    add("--raw", type=Path, required=True, metavar="DIR", help="folder of the raw data")
    add_graph_arguments(parser)
    add("--rows", type=int, default=40, metavar="N", help="scenes to list (40; 0: all)")
    add("--json", action="store_true", help="print everything as JSON")


def run(args: argparse.Namespace) -> int:
    """Print the table, or JSON."""
    if args.rows < 0:
        raise DataError(f"--rows is {args.rows}, expected 0 or more")
    counts = graph_counts(args)
    rows = [_Row.of(scene, counts) for scene in survey_scenes(args.dataset, args.raw)]
    if args.json:
        sys.stdout.write(json.dumps(_to_plain(args, rows), indent=2) + "\n")
    else:
        _print(args, rows)
    return 0


@dataclass(frozen=True, kw_only=True)
class _Row:
    """A scene, and what ``build`` makes of it."""

    scene: SceneSurvey
    left_out: str
    """Why ``build`` leaves it out; empty where it does not."""
    max_bytes: int
    """Most that its shards take."""

    @classmethod
    def of(cls, scene: SceneSurvey, counts: GraphCounts) -> "_Row":
        left_out = scene.excluded
        if not left_out and scene.num_images < counts.min_views:
            left_out = f"fewer than {counts.min_views} images"
        size = 0
        if not left_out and scene.image_size is not None:
            height, width = reduced_size(scene.image_size)
            # Each pair of images starts one graph at most.
            num_pairs = scene.num_images * (scene.num_images - 1) // 2
            graphs = min(
                num_pairs, quota(scene.num_images, counts.num_graphs, counts.graphs_per_image)
            )
            views = min(counts.max_views, scene.num_images)
            size = round(graphs * views * height * width * (DEPTH_BYTES + JPEG_BYTES))
        return cls(scene=scene, left_out=left_out, max_bytes=size)


def _totals(rows: list[_Row]) -> dict[str, int]:
    return {
        "scenes": len(rows),
        "scenes_left_out": sum(bool(row.left_out) for row in rows),
        "images": sum(row.scene.num_images for row in rows if not row.left_out),
        "images_left_out": sum(row.scene.num_images for row in rows if row.left_out),
        "images_missing": sum(row.scene.num_missing for row in rows),
        "max_bytes": sum(row.max_bytes for row in rows),
    }


def _to_plain(args: argparse.Namespace, rows: list[_Row]) -> dict[str, Any]:
    return {
        "dataset": args.dataset,
        "raw": str(args.raw),
        "assumed": {
            "num_graphs": args.num_graphs,
            "graphs_per_image": args.graphs_per_image,
            "max_views": args.max_views,
            "jpeg_bytes_per_pixel": JPEG_BYTES,
            "depth_bytes_per_pixel": DEPTH_BYTES,
        },
        "totals": _totals(rows),
        "scenes": [
            {**asdict(row.scene), "left_out": row.left_out, "max_bytes": row.max_bytes}
            for row in rows
        ],
    }


def _print(args: argparse.Namespace, rows: list[_Row]) -> None:
    from rich.console import Console

    console = Console(width=_WIDTH, highlight=False, soft_wrap=False)
    shown = rows[: args.rows or None]
    console.print(_table(shown))
    if len(rows) > len(shown):
        console.print(f"... and {len(rows) - len(shown)} more scenes; --rows 0 lists all")
    total = _totals(rows)
    console.print(
        f"{args.dataset}: {total['scenes']} scenes, {total['scenes_left_out']} of them left out;"
        f" {total['images']} images to build from, {total['images_missing']} lack something"
    )
    for reason, number in Counter(row.left_out for row in rows if row.left_out).most_common(10):
        console.print(f"  left out: {number} scenes, {reason}", markup=False)
    console.print(
        f"shards: {_size(total['max_bytes'])} at most, with {args.graphs_per_image:g} graphs of"
        f" {args.max_views} images for each image of a scene, no more than {args.num_graphs} a"
        f" scene, every image stored anew in each of its graphs, {DEPTH_BYTES} bytes of depth and"
        f" {JPEG_BYTES} of JPEG a pixel"
    )


def _table(rows: list[_Row]) -> "Table":
    from rich.table import Table
    from rich.text import Text

    table = Table(width=_WIDTH, box=None, pad_edge=False)
    table.add_column("scene", overflow="fold", ratio=3)
    for name in ("images", "missing", "size", "shards"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("left out", overflow="fold", ratio=2)
    for row in rows:
        scene = row.scene
        size = "-" if scene.image_size is None else "{1}x{0}".format(*scene.image_size)
        table.add_row(
            Text(scene.name),
            str(scene.num_images),
            str(scene.num_missing),
            size,
            _size(row.max_bytes) if row.max_bytes else "-",
            Text(row.left_out),
        )
    return table


def _size(num_bytes: int) -> str:
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if num_bytes >= size:
            return f"{num_bytes / size:.3g} {unit}"
    return f"{num_bytes / 1e3:.3g} kB"
