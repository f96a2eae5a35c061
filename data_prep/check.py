"""Do the shards hold what they claim? Measured on the stored pixels, not taken from the meta.

Every quantity looks at geometry alone, so the verdict does not depend on which mistake was made:
a principal point half a pixel off, camera axes of another convention, inverted cameras and ranges
in place of depth all leave the two views of a pair in disagreement.
"""

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.roundtrip import PairMeasure, measure_graph, median
from l3r.data.schema import (
    GraphSample,
    Manifest,
    decode_graph,
    load_index,
    read_manifest,
    read_members,
)
from l3r.errors import DataError

CONNECTED = 0.1
"""Two images are connected when so large a share of known pixels agrees within 5%."""
OVERLAPPING = 0.3
"""Pairs stored with so large a covisible share should be connected."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What shards of exact depth stay within.

    Clean data gives 0.017 to 0.020% of depth, which is what half floats leave, and 0.004 to
    0.07 px; half a pixel in the principal point gives 0.04% and more. Measured on a genuine
    TartanAir trajectory and on rendered rooms from 48x48 to 640x480.
    """

    max_depth_error: float = 0.00035
    """Median relative difference of depth: twice what half floats leave."""
    max_round_trip: float = 0.25
    """Median distance after a round trip [px]."""
    min_connected: float = 0.35
    """Share of the pairs stored as overlapping that are connected."""
    min_color: float = 0.5
    """Median correlation of brightness at what both see."""
    min_valid_depth: float = 0.01
    """Share of pixels whose depth is known."""


EXACT = Limits()
"""For rendered depth."""
MEASURED = Limits(max_depth_error=0.01, max_round_trip=2.0, min_color=0.3, min_valid_depth=0.001)
"""For depth from sensors or stereo, whose own noise hides half a pixel."""

LIMITS = {"tartanair": EXACT, "synthetic": EXACT}
"""Limits by data set; :data:`MEASURED` for any other."""


@dataclass(frozen=True, kw_only=True)
class CheckReport:
    """What was found in one folder of shards."""

    dataset: str
    """Name of the data set."""
    num_graphs: int
    """Graphs in the folder."""
    num_measured: int
    """Graphs measured, spread evenly."""
    num_pairs: int
    """Ordered pairs measured."""
    valid_depth: float
    """Share of pixels whose depth is known."""
    rotation_error: float
    """Largest entry of R R^T - I."""
    connected: float
    """Share of the pairs stored as overlapping that are connected; NaN where there are none."""
    connected_all: float
    """Share of all pairs that are connected."""
    round_trip: float
    """Median over connected pairs of the median distance after a round trip [px]."""
    depth_error: float
    """Median over connected pairs of the median relative difference of depth."""
    color: float
    """Median over connected pairs of the correlation of brightness."""
    covisible_gap: float
    """Median difference of covisible share, measured against stored; only reported."""

    def find_faults(self, limits: Limits) -> list[str]:
        """Say what is out of range: quantity, what was found, what was expected.

        Args:
            limits: What to hold the quantities against.
        """
        # NaN passes no comparison, so what could not be measured is a fault as well.
        checks = {
            f"share of overlapping pairs that connect {self.connected:.2f}, expected"
            f" {limits.min_connected} or more": self.connected >= limits.min_connected,
            f"depth disagreement {self.depth_error:.4%}, expected {limits.max_depth_error:.3%} or"
            " less": self.depth_error <= limits.max_depth_error,
            f"round trip error {self.round_trip:.3f} px, expected {limits.max_round_trip} or"
            " less": self.round_trip <= limits.max_round_trip,
            f"brightness correlation {self.color:.2f}, expected {limits.min_color} or"
            " more": self.color >= limits.min_color,
            f"share of known depth {self.valid_depth:.4f}, expected {limits.min_valid_depth} or"
            " more": self.valid_depth >= limits.min_valid_depth,
        }
        return [fault for fault, good in checks.items() if not good]

    def to_plain(self) -> dict[str, Any]:
        """Give builtins only; NaN becomes None, since JSON has no NaN."""
        return {k: None if v != v else v for k, v in asdict(self).items()}


def check_shards(folder: Path, *, max_graphs: int = 24, digests: bool = False) -> CheckReport:
    """Measure a folder of shards.

    Args:
        folder: Holds ``manifest.json`` and the tars.
        max_graphs: Graphs to measure, spread evenly over all.
        digests: Read every tar and compare its SHA-256 with the manifest's.

    Raises:
        DataError: A file is missing, cut off, of another size or digest than the manifest says,
            or a graph cannot be decoded.
    """
    manifest = read_manifest(folder)
    _check_files(folder, manifest, digests=digests)
    entries = [
        (folder / shard.name, entry)
        for shard in manifest.shards
        for entry in load_index(folder / shard.name).graphs
    ]
    if len(entries) != manifest.num_graphs:
        raise DataError(
            f"{folder}: {len(entries)} graphs in the tars, the manifest says"
            f" {manifest.num_graphs}; rebuild it with l3r-prep"
        )
    chosen = np.unique(np.linspace(0, len(entries) - 1, max_graphs).round().astype(int))
    measures: list[PairMeasure] = []
    valid: list[float] = []
    rotation_error = 0.0
    for number in chosen:
        shard, entry = entries[number]
        sample = decode_graph(read_members(shard, entry), entry.num_views)
        measures += measure_graph(sample)
        valid += [float((depth > 0).mean()) for depth in sample.depth]
        rotation_error = max(rotation_error, _rotation_error(sample))
    return _summarize(manifest, measures, valid, rotation_error, len(chosen))


def _check_files(folder: Path, manifest: Manifest, *, digests: bool) -> None:
    for shard in manifest.shards:
        path = folder / shard.name
        size = path.stat().st_size if path.is_file() else None
        if size != shard.bytes:
            found = "no such file" if size is None else f"{size} bytes"
            raise DataError(
                f"{path}: {found}, the manifest says {shard.bytes} bytes; remove it and run the"
                " same l3r-prep build again"
            )
        if digests:
            with path.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            if digest != shard.sha256:
                raise DataError(
                    f"{path}: SHA-256 {digest[:12]}..., the manifest says {shard.sha256[:12]}...;"
                    " remove it and run the same l3r-prep build again"
                )


def _rotation_error(sample: GraphSample) -> float:
    R = sample.cam_from_world[:, :3, :3]
    return float(np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max())


def _summarize(
    manifest: Manifest,
    measures: list[PairMeasure],
    valid: list[float],
    rotation_error: float,
    num_measured: int,
) -> CheckReport:
    connected = [m for m in measures if m.share >= CONNECTED]
    overlapping = [m for m in measures if m.stored_covisible >= OVERLAPPING]
    return CheckReport(
        dataset=manifest.dataset,
        num_graphs=manifest.num_graphs,
        num_measured=num_measured,
        num_pairs=len(measures),
        valid_depth=float(np.mean(valid)),
        rotation_error=rotation_error,
        connected=_share(sum(m.share >= CONNECTED for m in overlapping), len(overlapping)),
        connected_all=_share(len(connected), len(measures)),
        round_trip=median([m.pixels for m in connected]),
        depth_error=median([m.depth for m in connected]),
        color=median([m.color for m in connected]),
        covisible_gap=median([abs(m.share - m.stored_covisible) for m in measures]),
    )


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
