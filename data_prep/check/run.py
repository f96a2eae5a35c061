"""Check one folder of shards: files, then graphs, then geometry."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from data_prep.check.faults import Faults
from data_prep.check.graphs import GraphError, read_graph
from data_prep.check.report import CheckReport
from data_prep.check.survey import Survey, camera_distances, median_depths
from data_prep.check.tars import StoredGraph, Tars, check_tars
from data_prep.ledger import PROBLEMS
from data_prep.roundtrip import PairMeasure, measure_graph, median
from l3r.data.schema import GraphSample, Manifest, read_manifest
from l3r.errors import DataError

CONNECTED = 0.1
"""Two images are connected when so large a share of known pixels agrees within 5%."""
OVERLAPPING = 0.3
"""Pairs stored with so large a covisible share should be connected."""


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """How much is read."""

    max_graphs: int = 24
    """Graphs whose geometry is measured, spread evenly over all."""
    decode_all: bool = False
    """Read and decode the other graphs too."""
    digests: bool = False
    """Read every tar and compare its SHA-256 with the manifest's."""
    num_shown: int = 0
    """Graphs handed on to be drawn, spread evenly over those measured."""


Progress = Callable[[str, int, int], None]
"""Called with what is under way, the steps done and the steps in all."""
Show = Callable[[StoredGraph, GraphSample], None]
"""Called with each graph that shall be drawn."""


def check_shards(
    folder: Path,
    options: CheckOptions | None = None,
    *,
    progress: Progress = lambda name, done, total: None,
    show: Show = lambda stored, sample: None,
) -> CheckReport:
    """Read a folder of shards and measure it; what is broken is collected, not raised.

    Args:
        folder: Holds ``manifest.json`` and the tars.
        options: How much is read.
        progress: Told about the progress.
        show: Takes ``options.num_shown`` of the graphs measured.

    Raises:
        DataError: There is no manifest, or it lists no graph.
    """
    options = options or CheckOptions()
    manifest = read_manifest(folder)
    if not manifest.num_graphs:
        raise DataError(f"{folder}: the manifest lists no graph; rebuild it with l3r-prep")
    tars = _join_tars(folder, manifest, options, progress)
    found = _Found()
    for fault in tars.faults:
        found.faults.add(fault)
    measured = _spread(len(tars.graphs), options.max_graphs)
    shown = {measured[k] for k in _spread(len(measured), options.num_shown)}
    chosen = range(len(tars.graphs)) if options.decode_all else measured
    to_measure = set(measured)
    for done, number in enumerate(chosen, start=1):
        stored = tars.graphs[number]
        try:
            sample = read_graph(stored)
        except GraphError as error:
            found.faults.add(error.fault)
            found.num_bad += 1
        else:
            found.survey.add(sample)
            if number in to_measure:
                found.measure(sample)
            if number in shown:
                show(stored, sample)
        progress(f"{folder.name}: graphs", done, len(chosen))
    return _summarize(folder, manifest, tars, found, options)


def _join_tars(folder: Path, manifest: Manifest, options: CheckOptions, progress: Progress) -> Tars:
    tars = Tars()
    parts = check_tars(folder, manifest, digests=options.digests)
    for done, part in enumerate(parts, start=1):
        tars.graphs += part.graphs
        tars.faults += part.faults
        tars.num_lost += part.num_lost
        progress(f"{folder.name}: tars", done, len(manifest.shards))
    return tars


def _spread(total: int, wanted: int) -> list[int]:
    """Give ``wanted`` numbers below ``total``, spread evenly, or all of them."""
    if not total or not wanted:
        return []
    return sorted({int(x) for x in np.linspace(0, total - 1, min(total, wanted)).round()})


@dataclass(kw_only=True)
class _Found:
    """What the graphs read so far gave."""

    faults: Faults = field(default_factory=Faults)
    survey: Survey = field(default_factory=Survey)
    num_bad: int = 0
    num_measured: int = 0
    measures: list[PairMeasure] = field(default_factory=list)
    valid: list[float] = field(default_factory=list)
    depth: list[float] = field(default_factory=list)
    step: list[float] = field(default_factory=list)
    rotation_error: float = 0.0

    def measure(self, sample: GraphSample) -> None:
        """Measure the geometry of a graph."""
        self.num_measured += 1
        self.measures += measure_graph(sample)
        self.valid += [float((depth > 0).mean()) for depth in sample.depth]
        self.depth += median_depths(sample).tolist()
        self.step += camera_distances(sample).tolist()
        R = sample.cam_from_world[:, :3, :3]
        error = float(np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max())
        self.rotation_error = max(self.rotation_error, error)


def _summarize(
    folder: Path, manifest: Manifest, tars: Tars, found: _Found, options: CheckOptions
) -> CheckReport:
    measures, survey = found.measures, found.survey
    survey.finish()
    connected = [m for m in measures if m.share >= CONNECTED]
    overlapping = [m for m in measures if m.stored_covisible >= OVERLAPPING]
    problems = manifest.request.get(PROBLEMS, {})
    return CheckReport(
        folder=str(folder),
        dataset=manifest.dataset,
        num_graphs=manifest.num_graphs,
        num_shards=len(manifest.shards),
        num_bytes=manifest.num_bytes,
        digests_compared=options.digests,
        num_damaged_tars=len(tars.faults),
        num_lost=tars.num_lost,
        num_read=survey.graph_sizes.total() + found.num_bad,
        num_bad=found.num_bad,
        num_measured=found.num_measured,
        num_pairs=len(measures),
        valid_depth=_share(sum(found.valid), len(found.valid)),
        rotation_error=found.rotation_error,
        connected=_share(sum(m.share >= CONNECTED for m in overlapping), len(overlapping)),
        connected_all=_share(len(connected), len(measures)),
        round_trip=median([m.pixels for m in connected]),
        depth_error=median([m.depth for m in connected]),
        depth_bias=median([abs(m.bias) for m in connected]),
        color=median([m.color for m in connected]),
        covisible_gap=median([abs(m.share - m.stored_covisible) for m in measures]),
        is_metric=survey.is_metric,
        median_depth=median(found.depth),
        median_step=median(found.step),
        problems={str(kind): int(count) for kind, count in problems.items()},
        faults=found.faults,
        survey=survey,
    )


def _share(part: float | int, whole: int) -> float:
    return part / whole if whole else float("nan")
