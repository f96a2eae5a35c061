"""Graphs of images by the greedy rule: overlap with the set, the widest angle from all of it.

A start pair is drawn with a probability proportional to its CroCo score. Then, again and again,
of the images that overlap and score enough with at least one member and are no near-duplicate of
any, the one whose smallest angle to the members is largest is added. The order is kept, and what
is added does not depend on how many are wanted: the first N images are the greedy graph for N.
"""

import math
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64

from l3r.errors import DataError

_BATCH = 256


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

    def __post_init__(self) -> None:
        """Check ranges."""
        if not (2 <= self.min_views <= self.max_views <= 99 and 0 < self.min_iou < self.max_iou):
            raise DataError(
                f"graph sampling: {asdict(self)}, expected 2 <= min_views <= max_views <= 99 and"
                " 0 < min_iou < max_iou; change the options"
            )


def sample_graphs(
    iou: Float32[np.ndarray, "n n"],
    score: Float32[np.ndarray, "n n"],
    angle: Float32[np.ndarray, "n n"],
    num_graphs: int,
    *,
    seed: int = 0,
    options: SamplingOptions | None = None,
) -> list[list[int]]:
    """Draw graphs of a scene.

    Every start pair is used once at most, since it fixes its graph. While a graph is shorter than
    ``min_views`` and nothing qualifies, the score is waived, then half the IoU is enough; a graph
    that is still too short is dropped.

    Args:
        iou: Covisibility of all pairs, symmetric.
        score: CroCo score of all pairs, symmetric.
        angle: Viewpoint angle of all pairs [rad], symmetric; taken as 90 degrees at most.
        num_graphs: How many are wanted.
        seed: Seed of the draw; asking for more graphs keeps the first ones.
        options: Thresholds; the defaults where None.

    Returns:
        View numbers of each graph in greedy order; fewer graphs where the scene has no more.
    """
    options = options or SamplingOptions()
    starts = _draw_starts(iou, score, seed, options)
    angle = np.minimum(angle, np.float32(math.pi / 2))
    graphs: list[list[int]] = []
    for first in range(0, len(starts), _BATCH):
        if len(graphs) >= num_graphs:
            break
        graphs += _grow(iou, score, angle, starts[first : first + _BATCH], options)
    return graphs[:num_graphs]


def _draw_starts(
    iou: Float32[np.ndarray, "n n"],
    score: Float32[np.ndarray, "n n"],
    seed: int,
    options: SamplingOptions,
) -> Int64[np.ndarray, "m 2"]:
    """Order all start pairs as successive draws without return, proportional to the score."""
    rng = np.random.default_rng(seed)
    good = (score >= options.min_score) & (iou <= options.max_iou)
    pairs = np.argwhere(np.triu(good, k=1))
    if not len(pairs):
        return pairs
    # The largest log s + Gumbel noise is a draw proportional to s; sorting gives all draws.
    weight = np.log(score[pairs[:, 0], pairs[:, 1]].astype(np.float64))
    order = np.argsort(-(weight + rng.gumbel(size=len(pairs))), kind="stable")
    flip = rng.random(len(pairs)) < 0.5
    pairs[flip] = pairs[flip][:, ::-1]
    return np.asarray(pairs[order])


class _Growth:
    """Graphs that grow side by side; row g says how each image relates to the members of g."""

    def __init__(
        self,
        iou: Float32[np.ndarray, "n n"],
        score: Float32[np.ndarray, "n n"],
        angle: Float32[np.ndarray, "n n"],
        first: Int64[np.ndarray, " g"],
    ) -> None:
        self.tables = (iou, score, angle)
        self.iou, self.score, self.angle = iou[first], score[first], angle[first]
        self.member = np.zeros(self.iou.shape, dtype=bool)
        self.member[np.arange(len(first)), first] = True

    def add(self, rows: Int64[np.ndarray, " r"], views: Int64[np.ndarray, " r"]) -> None:
        """Add one image to each of some graphs."""
        iou, score, angle = self.tables
        self.iou[rows] = np.maximum(self.iou[rows], iou[views])
        self.score[rows] = np.maximum(self.score[rows], score[views])
        self.angle[rows] = np.minimum(self.angle[rows], angle[views])
        self.member[rows, views] = True

    def pick(
        self, candidate: Bool[np.ndarray, "r n"], rows: Int64[np.ndarray, " r"]
    ) -> Int64[np.ndarray, " r"]:
        """Take the candidate of the largest least angle, then best score, then lowest number."""
        angle = np.where(candidate, self.angle[rows], np.float32(-1))
        tie = angle == angle.max(axis=1, keepdims=True)
        return np.asarray(np.where(tie, self.score[rows], np.float32(-1)).argmax(axis=1))


def _grow(
    iou: Float32[np.ndarray, "n n"],
    score: Float32[np.ndarray, "n n"],
    angle: Float32[np.ndarray, "n n"],
    starts: Int64[np.ndarray, "g 2"],
    options: SamplingOptions,
) -> list[list[int]]:
    growth = _Growth(iou, score, angle, starts[:, 0])
    growth.add(np.arange(len(starts)), starts[:, 1])
    graphs = [[int(i), int(j)] for i, j in starts]
    active = np.arange(len(starts))
    for size in range(2, options.max_views):
        candidate = _find_candidates(growth, active, options, relax=size < options.min_views)
        some = candidate.any(axis=1)
        active, candidate = active[some], candidate[some]
        if not len(active):
            break
        chosen = growth.pick(candidate, active)
        growth.add(active, chosen)
        for row, view in zip(active.tolist(), chosen.tolist(), strict=True):
            graphs[row].append(view)
    return [graph for graph in graphs if len(graph) >= options.min_views]


def _find_candidates(
    growth: _Growth, rows: Int64[np.ndarray, " r"], options: SamplingOptions, *, relax: bool
) -> Bool[np.ndarray, "r n"]:
    """Find the images each graph may add."""
    iou, score = growth.iou[rows], growth.score[rows]
    apart = ~growth.member[rows] & (iou <= options.max_iou)
    candidate = apart & (iou >= options.min_iou) & (score >= options.min_score)
    if relax:
        for waived in (options.min_iou, options.min_iou / 2):
            stuck = ~candidate.any(axis=1)
            candidate[stuck] = apart[stuck] & (iou[stuck] >= waived)
    return np.asarray(candidate)
