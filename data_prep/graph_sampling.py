"""Graphs of images by the greedy rule: overlap with the set, the widest angle from all of it.

A start pair is drawn with a probability proportional to its CroCo score. Then, again and again,
of the images that overlap and score enough with at least one member and are no near-duplicate of
any, the one whose smallest angle to the members is largest is added. The order is kept, and what
is added does not depend on how many are wanted: the first N images are the greedy graph for N.

Overlap and score come from a table of pairs; images that are no pair of it are taken to share
nothing, so that none is added for the sake of such a pair. Two things hold all the same: the angle
between them is that of their relative rotation (also where it is below 2 degrees: the parallax
that would stand in is that of common points, which they have none of, as far as the table knows),
and a near-duplicate is never added, since the overlap with the members is asked for first.

Graphs grow side by side, 256 at once, each with some 50 bytes for every image of the scene: 134 MB
for 10,000 images. Nothing grows with n x n.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import islice

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from data_prep.overlap_table import OverlapTable
from l3r.errors import DataError

_BATCH = 256

OverlapOf = Callable[[Int64[np.ndarray, "m 2"]], Float32[np.ndarray, " m"]]
"""Gives the IoU of pairs that a table lacks."""


@dataclass(frozen=True, kw_only=True)
class SamplingOptions:
    """Thresholds of the sampler."""

    min_score: float = 0.02
    """Least score of a start pair, and of an added image with some member."""
    min_iou: float = 0.1
    """Least IoU of an added image with some member."""
    max_iou: float = 0.75
    """Two images of a graph never overlap more than this."""
    min_views: int = 8
    """Graphs that end with fewer images are dropped."""
    max_views: int = 10
    """Graphs end with this many images."""
    max_uses: int | None = None
    """An image stands in at most this many graphs of its scene; None: in any number."""
    candidates_per_image: int = 64
    """Pairs are related up to this many partners of an image, in the mean over a scene; scenes of
    fewer images have all their pairs related."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if not (2 <= self.min_views <= self.max_views <= 99 and 0 < self.min_iou < self.max_iou):
            raise DataError(
                f"graph sampling: {asdict(self)}, expected 2 <= min_views <= max_views <= 99 and"
                " 0 < min_iou < max_iou; change the options"
            )
        if self.candidates_per_image < 1 or (self.max_uses is not None and self.max_uses < 1):
            raise DataError(
                f"graph sampling: {asdict(self)}, expected candidates_per_image and max_uses of 1"
                " or more; change the options"
            )


def sample_graphs(
    table: OverlapTable,
    world_from_cam_R: Float64[np.ndarray, "n 3 3"],
    num_graphs: int,
    *,
    seed: int = 0,
    options: SamplingOptions | None = None,
    overlap_of: OverlapOf | None = None,
) -> list[list[int]]:
    """Draw graphs of a scene.

    Every start pair is used once at most, since it fixes its graph. While a graph is shorter than
    ``min_views`` and nothing qualifies, the score is waived, then half the IoU is enough; a graph
    that is still too short is dropped. With ``max_uses``, a graph is grown without the images that
    the graphs before it have used up.

    Args:
        table: Pairs of the scene.
        world_from_cam_R: Rotations of its cameras, for the angles between images that are no pair
            of the table; angles are taken as 90 degrees at most.
        num_graphs: How many are wanted.
        seed: Seed of the draw; asking for more graphs keeps the first ones.
        options: Thresholds; the defaults where None.
        overlap_of: Gives the IoU of pairs that the table lacks; it is 0 where None.

    Returns:
        View numbers of each graph in greedy order; fewer graphs where the scene has no more.
    """
    options = options or SamplingOptions()
    starts = _draw_starts(table, seed, options)
    relations = Relations(table, world_from_cam_R, overlap_of)
    return list(islice(_grow_in_turn(relations, starts, options), num_graphs))


def _draw_starts(
    table: OverlapTable, seed: int, options: SamplingOptions
) -> Int64[np.ndarray, "m 2"]:
    """Order all start pairs as successive draws without return, proportional to the score."""
    rng = np.random.default_rng(seed)
    good = (table.score >= options.min_score) & (table.iou <= options.max_iou)
    pairs = table.views[good]
    # The largest log s + Gumbel noise is a draw proportional to s; sorting gives all draws.
    weight = np.log(table.score[good].astype(np.float64))
    order = np.argsort(-(weight + rng.gumbel(size=len(pairs))), kind="stable")
    flip = rng.random(len(pairs)) < 0.5
    pairs[flip] = pairs[flip][:, ::-1]
    return np.asarray(pairs[order])


def _grow_in_turn(
    relations: "Relations", starts: Int64[np.ndarray, "m 2"], options: SamplingOptions
) -> Iterator[list[int]]:
    """Grow graphs from start pairs, in this order, and count the uses of each image."""
    limit = np.iinfo(np.int64).max if options.max_uses is None else options.max_uses
    uses = np.zeros(relations.table.num_views, dtype=np.int64)
    for first in range(0, len(starts), _BATCH):
        batch = starts[first : first + _BATCH]
        grown = grow_graphs(relations, batch, uses >= limit, options)
        for turn in range(len(batch)):
            if (uses[grown[turn]] >= limit).any():
                # A graph without images used up since is what it would be if they were barred.
                stale = [g for g in range(turn, len(batch)) if (uses[grown[g]] >= limit).any()]
                again = grow_graphs(relations, batch[stale], uses >= limit, options)
                for g, graph in zip(stale, again, strict=True):
                    grown[g] = graph
            if len(grown[turn]) >= options.min_views:
                uses[grown[turn]] += 1
                yield grown[turn]


class Relations:
    """How each image relates to all others, one row at a time."""

    def __init__(
        self,
        table: OverlapTable,
        world_from_cam_R: Float64[np.ndarray, "n 3 3"],
        overlap_of: OverlapOf | None,
    ) -> None:
        n = table.num_views
        i, j = table.views.T
        columns = [table.iou, table.score, np.minimum(table.angle, np.float32(math.pi / 2))]
        both = np.concatenate([i, j])
        order = np.lexsort((np.concatenate([j, i]), both))
        self.start = np.searchsorted(both[order], np.arange(n + 1))
        self.partner = np.concatenate([j, i])[order]
        self.columns = [np.tile(column, 2)[order] for column in columns]
        self.table, self.overlap_of = table, overlap_of
        self.R = world_from_cam_R.reshape(n, 9)

    def rows(self, views: Int64[np.ndarray, " r"]) -> list[Float32[np.ndarray, "r n"]]:
        """Give IoU, score and angle (at most 90 degrees) of some images with all images."""
        shape = len(views), len(self.R)
        count = self.start[views + 1] - self.start[views]
        row = np.repeat(np.arange(len(views)), count)
        entry = np.arange(len(row)) + np.repeat(self.start[views] - np.cumsum(count) + count, count)
        tables = [np.zeros(shape, dtype=np.float32) for _ in range(2)] + [self._rotation(views)]
        for table, column in zip(tables, self.columns, strict=True):
            table[row, self.partner[entry]] = column[entry]
        tables[0][np.arange(len(views)), views] = 1
        tables[2][np.arange(len(views)), views] = 0
        return tables

    def _rotation(self, views: Int64[np.ndarray, " r"]) -> Float32[np.ndarray, "r n"]:
        """Angles of relative rotations, at most 90 degrees."""
        if len(self.table) == len(self.R) * (len(self.R) - 1) // 2:
            return np.zeros((len(views), len(self.R)), dtype=np.float32)
        cos = (self.R[views] @ self.R.T - 1) / 2
        # Rounded, so that rotations that are equal but for the last bits tie.
        return np.asarray(np.arccos(np.clip(cos.round(12), 0, 1)), dtype=np.float32)

    def least_known(self, pairs: Int64[np.ndarray, "m 2"]) -> Float32[np.ndarray, " m"]:
        """Give the IoU of pairs that the table lacks, 0 for those that it has."""
        iou = np.zeros(len(pairs), dtype=np.float32)
        unknown = self.table.find(pairs) < 0
        if self.overlap_of is not None and unknown.any():
            iou[unknown] = self.overlap_of(pairs[unknown])
        return iou


class _Growth:
    """Graphs that grow side by side; row g says how each image relates to the members of g."""

    def __init__(
        self,
        relations: Relations,
        starts: Int64[np.ndarray, "g 2"],
        barred: Bool[np.ndarray, " n"],
    ) -> None:
        self.relations = relations
        self.iou, self.score, self.angle = relations.rows(starts[:, 0])
        self.excluded = np.tile(barred, (len(starts), 1))
        self.excluded[np.arange(len(starts)), starts[:, 0]] = True
        self.members = [[int(first)] for first in starts[:, 0]]
        self.add(np.arange(len(starts)), starts[:, 1])

    def add(self, rows: Int64[np.ndarray, " r"], views: Int64[np.ndarray, " r"]) -> None:
        """Add one image to each of some graphs."""
        iou, score, angle = self.relations.rows(views)
        self.iou[rows] = np.maximum(self.iou[rows], iou)
        self.score[rows] = np.maximum(self.score[rows], score)
        self.angle[rows] = np.minimum(self.angle[rows], angle)
        self.excluded[rows, views] = True
        for row, view in zip(rows.tolist(), views.tolist(), strict=True):
            self.members[row].append(view)

    def bar_duplicates(
        self, rows: Int64[np.ndarray, " r"], views: Int64[np.ndarray, " r"], max_iou: float
    ) -> Bool[np.ndarray, " r"]:
        """Exclude images that turn out to overlap a member too much; tell which."""
        members = np.array([self.members[row] for row in rows.tolist()])
        pairs = np.stack([members, np.broadcast_to(views[:, None], members.shape)], axis=-1)
        iou = self.relations.least_known(pairs.reshape(-1, 2)).reshape(members.shape)
        bad = np.asarray((iou > max_iou).any(axis=1))
        self.excluded[rows[bad], views[bad]] = True
        return bad

    def pick(
        self, candidate: Bool[np.ndarray, "r n"], rows: Int64[np.ndarray, " r"]
    ) -> Int64[np.ndarray, " r"]:
        """Take the candidate of the largest least angle, then best score, then lowest number."""
        angle = np.where(candidate, self.angle[rows], np.float32(-1))
        tie = angle == angle.max(axis=1, keepdims=True)
        return np.asarray(np.where(tie, self.score[rows], np.float32(-1)).argmax(axis=1))


def grow_graphs(
    relations: Relations,
    starts: Int64[np.ndarray, "g 2"],
    barred: Bool[np.ndarray, " n"],
    options: SamplingOptions,
) -> list[list[int]]:
    """Grow a graph from each start pair; none (an empty one) where an image of it is barred."""
    free = np.flatnonzero(~barred[starts].any(axis=1))
    growth = _Growth(relations, starts[free], barred)
    active = np.arange(len(free))
    for size in range(2, options.max_views):
        active = _add_one(growth, active, options, relax=size < options.min_views)
        if not len(active):
            break
    graphs: list[list[int]] = [[] for _ in starts]
    for g, members in zip(free.tolist(), growth.members, strict=True):
        graphs[g] = members
    return graphs


def _add_one(
    growth: _Growth, rows: Int64[np.ndarray, " r"], options: SamplingOptions, *, relax: bool
) -> Int64[np.ndarray, " _r"]:
    """Add an image to each graph that may have one; tell which."""
    grown = []
    while len(rows):
        candidate = _find_candidates(growth, rows, options, relax=relax)
        some = candidate.any(axis=1)
        rows, candidate = rows[some], candidate[some]
        if not len(rows):
            break
        chosen = growth.pick(candidate, rows)
        bad = growth.bar_duplicates(rows, chosen, options.max_iou)
        growth.add(rows[~bad], chosen[~bad])
        grown.append(rows[~bad])
        rows = rows[bad]
    return np.sort(np.concatenate(grown)) if grown else rows


def _find_candidates(
    growth: _Growth, rows: Int64[np.ndarray, " r"], options: SamplingOptions, *, relax: bool
) -> Bool[np.ndarray, "r n"]:
    """Find the images each graph may add."""
    iou, score = growth.iou[rows], growth.score[rows]
    apart = ~growth.excluded[rows] & (iou <= options.max_iou)
    candidate = apart & (iou >= options.min_iou) & (score >= options.min_score)
    if relax:
        for waived in (options.min_iou, options.min_iou / 2):
            stuck = ~candidate.any(axis=1)
            candidate[stuck] = apart[stuck] & (iou[stuck] >= waived)
    return np.asarray(candidate)
