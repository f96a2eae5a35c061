"""``l3r-prep check``: do the shards hold what they claim?

Holds every tar against the manifest, decodes graphs fully, and moves pixels between their images
and back, by the stored depth, intrinsics and cameras. Broken tars, graphs, images and cameras are
named and counted. Exit code 2 where a tar is not as the manifest says, where too many graphs
cannot be used, and, naming the quantity, where pixels disagree: a principal point half a pixel
off, other camera axes, inverted cameras, range in place of depth, images of another frame.

Besides it writes report.html, one page to open from disk: verdict, faults, histograms of overlap,
angles, scores and depth, and some graphs with their images, depth and tree.

for example:
  l3r-prep check shards/tartanair
  l3r-prep check shards --digests --all
  l3r-prep check shards/a shards/b --report both.html
"""

import argparse
import json
import logging
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from l3r.errors import DataError
from l3r.files import write_atomic

if TYPE_CHECKING:
    from data_prep.pages.check_page import Section

_LOG = logging.getLogger(__name__)
_NAME = "report.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add(
        "shards",
        type=Path,
        nargs="+",
        metavar="SHARDS",
        help="folder that holds manifest.json, or train and val that do",
    )
    add("--max-graphs", type=int, default=24, metavar="N", help="graphs to measure (24)")
    add("--all", action="store_true", help="also read and decode every other graph")
    add("--digests", action="store_true", help="also compare every tar's SHA-256")
    add(
        "--max-bad-share",
        type=float,
        metavar="SHARE",
        help="share of graphs that may be unusable (0.01, as training's data.max_skip_rate)",
    )
    add("--json", action="store_true", help="print one line of JSON for each folder")
    page = parser.add_mutually_exclusive_group()
    page.add_argument(
        "--report",
        type=Path,
        metavar="PATH",
        help=f"write one page of all folders there: a .html file, or a folder that gets {_NAME}"
        f" (SHARDS/{_NAME})",
    )
    page.add_argument("--no-report", action="store_true", help="write no page")


def run(args: argparse.Namespace) -> int:
    """Print what was measured and write the page; raise where something is out of range."""
    from data_prep.check import find_folders
    from data_prep.commands.threads import use_one_thread

    use_one_thread()
    if args.max_bad_share is not None and not 0 <= args.max_bad_share <= 1:
        raise DataError(f"--max-bad-share is {args.max_bad_share}, expected 0 to 1")
    if args.max_graphs < 1:
        raise DataError(f"--max-graphs is {args.max_graphs}, expected 1 or more")
    page = None if args.report is None else _page_path(args.report)
    folders = {path: find_folders(path) for path in args.shards}
    num_folders = (
        max(map(len, folders.values())) if page is None else sum(map(len, folders.values()))
    )
    sections = {
        path: [_check(args, folder, num_folders) for folder in parts]
        for path, parts in folders.items()
    }
    everything = [section for parts in sections.values() for section in parts]
    pages: list[Path | None] = []
    if page is not None:
        pages = [_write(page, everything)]
    elif not args.no_report:
        pages = [_write_beside(path / _NAME, parts) for path, parts in sections.items()]
    sys.stdout.write("".join(_describe(section, as_json=args.json) for section in everything))
    if not args.json:
        sys.stdout.write("".join(f"{written}\n" for written in pages if written))
    failed = [_complain(section) for section in everything if not section.passed]
    if failed:
        raise DataError("; ".join(failed))
    return 0


def _page_path(given: Path) -> Path:
    """Turn ``--report`` into a file, before hours of reading."""
    page = given if given.suffix in (".html", ".htm") else given / _NAME
    if not page.parent.is_dir():
        raise DataError(f"--report: no folder {page.parent}; make it, or name another")
    return page


def _check(args: argparse.Namespace, folder: Path, num_folders: int) -> "Section":
    from data_prep.check import CheckOptions, check_shards
    from data_prep.check.tars import StoredGraph
    from data_prep.commands.progress import show_progress
    from data_prep.pages.check_page import NUM_SHEETS, Section, limits_of
    from data_prep.pages.sheets import Sheet, draw_sheet
    from l3r.data.schema import GraphSample

    sheets: list[Sheet] = []

    def show(stored: StoredGraph, sample: GraphSample) -> None:
        sheets.append(draw_sheet(stored, sample))

    options = CheckOptions(
        max_graphs=args.max_graphs,
        decode_all=args.all,
        digests=args.digests,
        num_shown=0 if args.no_report else max(2, NUM_SHEETS // num_folders),
    )
    with show_progress() as progress:
        report = check_shards(folder, options, progress=progress, show=show)
    limits = limits_of(report.dataset)
    if args.max_bad_share is not None:
        limits = replace(limits, max_bad_share=args.max_bad_share)
    return Section(report=report, limits=limits, sheets=sheets)


def _write(page: Path, sections: list["Section"]) -> Path:
    from data_prep.pages.check_page import render_check

    write_atomic(page, render_check(sections))
    return page


def _write_beside(page: Path, sections: list["Section"]) -> Path | None:
    """Write the page that nobody asked for; shards may lie where nobody may write."""
    try:
        return _write(page, sections)
    except OSError as error:
        _LOG.warning("%s: not written (%s); --report PATH writes it elsewhere", page, error)
        return None


def _complain(section: "Section") -> str:
    report, limits = section.report, section.limits
    wrong = [str(verdict) for verdict in report.verdicts(limits) if not verdict.passed]
    advice = []
    if any(not verdict.passed for verdict in report.file_verdicts(limits)):
        first = "; ".join(str(report.faults.first(kind)) for kind in report.faults.counts)
        advice.append(f"first of each kind: {first}")
    if report.num_measured and any(not v.passed for v in report.geometry_verdicts(limits)):
        advice.append(
            "look at the converter's intrinsics, camera axes, direction of the cameras and kind of"
            " depth, then build again"
        )
    return f"{report.folder}: {'; '.join(wrong + advice)}"


def _describe(section: "Section", *, as_json: bool) -> str:
    report = section.report
    if as_json:
        return json.dumps(report.to_plain(section.limits), allow_nan=False) + "\n"
    unit = " m" if report.is_metric else ""
    rows = {
        "graphs": f"{report.num_graphs} in {report.num_shards} tars, read {report.num_read},"
        f" measured {report.num_measured}",
        "checksums": "compared" if report.digests_compared else "not compared (--digests)",
        "bad": f"{report.bad_share:.2%} of graphs, damaged tars {report.num_damaged_tars}",
    }
    if report.num_measured:
        rows |= {
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
    rows |= {kind: f"{count}" for kind, count in sorted(report.faults.counts.items())}
    lines = [f"  {name:<12} {text}" for name, text in rows.items()]
    listed = [f"    {fault}" for fault in report.faults.listed]
    return "\n".join([f"{report.folder} ({report.dataset})", *lines, *listed, ""])
