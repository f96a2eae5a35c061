"""Everything a reconstruction leaves behind, in one folder that appears whole."""

import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from l3r.errors import DataError
from l3r.export.cameras_json import write_cameras
from l3r.export.colmap import write_colmap
from l3r.export.folder import check_output, list_files, staged_folder
from l3r.export.ply import write_ply
from l3r.export.points import PointSelection
from l3r.export.report import write_report
from l3r.export.run_json import RunRecord, write_run
from l3r.types import Reconstruction

__all__ = ["COLMAP_POINTS", "PLY_POINTS", "check_output", "write_reconstruction"]

COLMAP_POINTS = 100_000
"""Points in the COLMAP model, where each costs an observation."""
PLY_POINTS = 2_000_000
"""Points in the cloud: 38 MB."""


def write_reconstruction(
    out: Path,
    reconstruction: Reconstruction,
    *,
    diagnostics: dict[str, Any],
    config: dict[str, Any],
    command: list[str],
    skipped: list[tuple[str, str]],
    warnings: list[str],
    upright: Mapping[str, Path | bytes] | None = None,
    device: str = "",
) -> dict[str, float]:
    """Write ``sparse/0``, ``points.ply``, ``cameras.json``, ``run.json`` and ``report.html``.

    All goes to a hidden folder beside ``out`` first, so that ``out`` is the former reconstruction
    or the new one, and never half of it.

    Args:
        out: New, empty, or a former reconstruction, which is replaced.
        reconstruction: What to write.
        diagnostics: Of the tree, builtins.
        config: The whole configuration, builtins; ``inference`` holds the point rules.
        command: The command line.
        skipped: (file, reason) of images that could not be used.
        warnings: What a user should know.
        upright: JPEGs of the photos that EXIF turns, by file, for ``out/images``.
        device: Where it ran; empty: the accelerator there is, else the processor.

    Returns:
        Seconds of every stage, those of this one named ``export_...``.

    Raises:
        DataError: ``out`` holds other files, or cannot be written.
    """
    record = RunRecord(
        command=command,
        config=config,
        diagnostics=diagnostics,
        skipped=skipped,
        warnings=warnings,
        device=device,
    )
    seconds = dict(reconstruction.seconds)
    for_colmap = _selection(config, COLMAP_POINTS)
    for_ply = _selection(config, PLY_POINTS)
    with staged_folder(out) as folder:
        if upright:
            _timed(seconds, "images", lambda: _write_upright(folder / "images", upright))
        model = folder / "sparse" / "0"
        _timed(seconds, "colmap", lambda: write_colmap(model, reconstruction, for_colmap))
        _timed(seconds, "ply", lambda: write_ply(folder / "points.ply", reconstruction, for_ply))
        cameras = reconstruction.cameras
        _timed(seconds, "cameras", lambda: write_cameras(folder / "cameras.json", cameras))
        shown = dict(seconds)
        page = folder / "report.html"
        _timed(seconds, "report", lambda: write_report(page, reconstruction, record, shown))
        written = sorted([*list_files(folder), "run.json"])
        record = replace(record, files=written)
        write_run(folder / "run.json", reconstruction, record, seconds)
    return seconds


def _selection(config: Mapping[str, Any], max_points: int) -> PointSelection:
    """Take the numbers of PnP's point rule; the defaults where the configuration is silent."""
    inference = config.get("inference", {})
    known = {k: inference[k] for k in ("min_conf", "fallback_share") if k in inference}
    return PointSelection(max_points=max_points, **known)


def _timed(seconds: dict[str, float], name: str, write: Callable[[], object]) -> None:
    start = time.perf_counter()
    write()
    seconds[f"export_{name}"] = time.perf_counter() - start


def _write_upright(folder: Path, upright: Mapping[str, Path | bytes]) -> None:
    for file, source in upright.items():
        parts = PurePosixPath(file)
        if parts.is_absolute() or ".." in parts.parts:
            raise DataError(f"{file!r}: points out of the output folder; expected a relative name")
        target = folder / parts
        target.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(source, bytes):
            target.write_bytes(source)
        else:
            shutil.copyfile(source, target)
