"""What the graphs read so far are like: overlap, angles, scores, depth, sizes, repetition."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64

from data_prep.check.histograms import Histogram
from l3r.data.schema import GraphSample

_SHARE = np.linspace(0, 1, 41)
_ANGLE = np.linspace(0, 180, 73)
_LENGTH = 10.0 ** np.linspace(-4, 6, 161)


def _histograms() -> dict[str, Histogram]:
    pairs = {
        "iou": Histogram(title="Overlap (IoU)", unit="", of="pairs", edges=_SHARE),
        "score": Histogram(title="CroCo score", unit="", of="pairs", edges=_SHARE),
        "rotation": Histogram(title="Relative rotation", unit="deg", of="pairs", edges=_ANGLE),
        "axis": Histogram(title="Between optical axes", unit="deg", of="pairs", edges=_ANGLE),
        "parallax": Histogram(title="Median parallax", unit="deg", of="pairs", edges=_ANGLE),
    }
    images = {
        "valid_depth": Histogram(
            title="Known depth of an image", unit="%", of="images", edges=100 * _SHARE
        ),
        "depth": Histogram(
            title="Median depth of an image", unit="m", of="images", edges=_LENGTH, is_log=True
        ),
        "step": Histogram(
            title="Distance of two cameras", unit="m", of="pairs", edges=_LENGTH, is_log=True
        ),
    }
    return {**pairs, **images}


@dataclass(kw_only=True)
class Survey:
    """Counts over all graphs read."""

    histograms: dict[str, Histogram] = field(default_factory=_histograms)
    """By name; lengths are metres or the scenes' own units."""
    graph_sizes: Counter[int] = field(default_factory=Counter)
    """Graphs of so many images."""
    image_sizes: Counter[tuple[int, int]] = field(default_factory=Counter)
    """Images stored, by (height, width)."""
    uses: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Graphs that hold an image, by (scene, file)."""
    is_metric: bool = True
    """Whether all graphs are in metres."""

    def add(self, sample: GraphSample) -> None:
        """Count a graph."""
        upper = np.triu_indices(sample.num_views, k=1)
        pairs, add = sample.pairs, self._add
        add("iou", pairs.iou[upper])
        add("score", pairs.score[upper])
        for name in ("rotation", "axis", "parallax"):
            add(name, np.degrees(getattr(pairs, name)[upper]))
        add("step", camera_distances(sample))
        add("valid_depth", np.array([100.0 * (depth > 0).mean() for depth in sample.depth]))
        add("depth", median_depths(sample))
        self.graph_sizes[sample.num_views] += 1
        self.image_sizes.update(sample.image_size)
        self.uses.update((sample.scene, file) for file in sample.file)
        self.is_metric = self.is_metric and sample.is_metric

    def _add(self, name: str, values: Float64[np.ndarray, " m"]) -> None:
        self.histograms[name].add(values)

    @property
    def orientations(self) -> dict[str, int]:
        """Images that are landscape, portrait and square."""
        counts = {"landscape": 0, "portrait": 0, "square": 0}
        for (height, width), count in self.image_sizes.items():
            upright = "portrait" if height > width else "square"
            counts["landscape" if width > height else upright] += count
        return counts

    @property
    def num_uses(self) -> Counter[int]:
        """Images that are in so many of the graphs read."""
        return Counter(self.uses.values())

    def finish(self) -> None:
        """Name the unit of lengths, known when all graphs are read."""
        for name in ("depth", "step"):
            self.histograms[name].unit = "m" if self.is_metric else "units"

    def to_plain(self) -> dict[str, Any]:
        """Give builtins only."""
        return {
            "histograms": {name: h.to_plain() for name, h in self.histograms.items()},
            "graph_sizes": _by_number(self.graph_sizes),
            "image_sizes": {f"{h}x{w}": n for (h, w), n in self.image_sizes.most_common()},
            "orientations": self.orientations,
            "image_uses": _by_number(self.num_uses),
        }


def camera_distances(sample: GraphSample) -> Float64[np.ndarray, " m"]:
    """Distances between the cameras of a graph, one for each unordered pair."""
    R, t = sample.cam_from_world[:, :3, :3], sample.cam_from_world[:, :3, 3]
    centers = -np.einsum("nji,nj->ni", R, t)
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1)
    return np.asarray(apart[np.triu_indices(len(centers), k=1)])


def median_depths(sample: GraphSample) -> Float64[np.ndarray, " m"]:
    """Median known depth of each image of a graph that has any."""
    known = [depth[depth > 0] for depth in sample.depth]
    return np.array([np.median(z) for z in known if len(z)], dtype=np.float64)


def _by_number(counts: Counter[int]) -> dict[str, int]:
    """JSON's keys are strings; in ascending order."""
    return {str(number): counts[number] for number in sorted(counts)}
