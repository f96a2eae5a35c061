"""The page that ``l3r-prep show`` writes: one graph, large."""

from dataclasses import dataclass

import numpy as np

from data_prep.check.tars import StoredGraph
from data_prep.pages.correspondences import (
    Correspondence,
    count_status,
    find_correspondences,
)
from data_prep.pages.pictures import Picture, image_picture
from data_prep.pages.render import render
from data_prep.pages.sheets import draw_sheet
from data_prep.roundtrip import PairMeasure, measure_pair
from l3r.data.schema import GraphSample

LARGE = 720
"""Long side of an image of the gallery [px]."""
_EDGE_WIDTH, _EDGE_HEIGHT = 588, 520
"""Each of the two images of an edge fits into such a frame."""
_GAP = 24


@dataclass(frozen=True, kw_only=True)
class Mark:
    """A correspondence in the pixels of the drawing."""

    point: Correspondence
    start: tuple[float, float]
    end: tuple[float, float] | None


@dataclass(frozen=True, kw_only=True)
class EdgeDrawing:
    """Two images beside each other, and the points they share."""

    parent: int
    child: int
    width: float
    height: float
    pictures: list[tuple[Picture, float, float, float]]
    """Each with its left end, width and height in the drawing."""
    marks: list[Mark]
    counts: str
    """How many points were seen, hidden and so on."""


@dataclass(frozen=True, kw_only=True)
class PairRow:
    """What is stored and measured of two images."""

    i: int
    j: int
    is_edge: bool
    iou: float
    score: float
    rotation: float
    """[deg]"""
    axis: float
    """[deg]"""
    parallax: float | None
    """[deg]; None where no point is common."""
    covisible: tuple[float, float]
    """Stored, from i to j and back."""
    measured: tuple[PairMeasure, PairMeasure]
    """From i to j and back."""


def render_show(stored: StoredGraph, sample: GraphSample) -> str:
    """Give the page of a graph as HTML.

    Args:
        stored: Where it lies.
        sample: The whole graph.
    """
    sheet = draw_sheet(stored, sample, LARGE)
    edges = [] if sheet.tree is None else [(e.parent, e.child) for e in sheet.tree.edges]
    return render(
        "show.html",
        stored=stored,
        sheet=sheet,
        sample=sample,
        focal=[float(K[0, 0]) for K in sample.K],
        rows=_pair_rows(sample, edges),
        edges=[draw_edge(sample, parent, child) for parent, child in edges],
    )


def draw_edge(sample: GraphSample, i: int, j: int) -> EdgeDrawing:
    """Draw points of image i, and where they lie in image j, with both images side by side.

    Args:
        sample: The graph.
        i: Image whose points are taken.
        j: Image they are carried into.
    """
    left, pictures, places = 0.0, [], []
    for view in (i, j):
        height, width = sample.image_size[view]
        scale = min(_EDGE_WIDTH / width, _EDGE_HEIGHT / height)
        picture = image_picture(sample.image[view], LARGE)
        pictures.append((picture, left, width * scale, height * scale))
        places.append((left, scale))
        left += width * scale + _GAP
    points = find_correspondences(sample, i, j)
    return EdgeDrawing(
        parent=i,
        child=j,
        width=left - _GAP,
        height=max(height for *_, height in pictures),
        pictures=pictures,
        marks=[
            Mark(
                point=point,
                start=_placed(point.start, *places[0]),
                end=None if point.end is None else _placed(point.end, *places[1]),
            )
            for point in points
        ],
        counts=count_status(points),
    )


def _placed(point: tuple[float, float], left: float, scale: float) -> tuple[float, float]:
    return round(left + scale * point[0], 1), round(scale * point[1], 1)


def _pair_rows(sample: GraphSample, edges: list[tuple[int, int]]) -> list[PairRow]:
    pairs, joined = sample.pairs, {frozenset(edge) for edge in edges}
    rows = []
    for i in range(sample.num_views):
        for j in range(i + 1, sample.num_views):
            parallax = float(np.degrees(pairs.parallax[i, j]))
            rows.append(
                PairRow(
                    i=i,
                    j=j,
                    is_edge=frozenset((i, j)) in joined,
                    iou=float(pairs.iou[i, j]),
                    score=float(pairs.score[i, j]) + 0.0,  # no -0
                    rotation=float(np.degrees(pairs.rotation[i, j])),
                    axis=float(np.degrees(pairs.axis[i, j])),
                    parallax=None if parallax != parallax else parallax,
                    covisible=(float(pairs.covisible[i, j]), float(pairs.covisible[j, i])),
                    measured=(measure_pair(sample, i, j), measure_pair(sample, j, i)),
                )
            )
    return rows
