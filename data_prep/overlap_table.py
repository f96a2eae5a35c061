"""How pairs of images of a scene relate: one row for each pair that was looked at."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64

from l3r.data.schema import PairTable


@dataclass(frozen=True, kw_only=True)
class OverlapTable:
    """Overlap and angles of pairs, in ascending order of (i, j), i < j, each pair once."""

    num_views: int
    """Images of the scene."""
    views: Int64[np.ndarray, "m 2"]
    """View numbers (i, j)."""
    iou: Float32[np.ndarray, " m"]
    """Visible in both over visible in either."""
    covisible: Float32[np.ndarray, "m 2"]
    """Share of the known depth of i that j sees too, and of j that i sees."""
    rotation: Float32[np.ndarray, " m"]
    """Angle of the relative rotation [rad]."""
    axis: Float32[np.ndarray, " m"]
    """Angle between the optical axes [rad]."""
    parallax: Float32[np.ndarray, " m"]
    """Median angle at the common points [rad]; NaN where there are none."""
    angle: Float32[np.ndarray, " m"]
    """Viewpoint angle: the rotation, or the median parallax where it is below 2 degrees [rad]."""
    score: Float32[np.ndarray, " m"]
    """CroCo score of IoU and viewpoint angle."""

    def __len__(self) -> int:
        """Pairs in the table."""
        return len(self.views)

    def find(self, pairs: Int64[np.ndarray, "k 2"]) -> Int64[np.ndarray, " k"]:
        """Give the rows of pairs, in either order of their images; -1 where there is none."""
        if not len(self):
            return np.full(len(pairs), -1)
        key = self.views[:, 0] * self.num_views + self.views[:, 1]
        wanted = pairs.min(axis=1) * self.num_views + pairs.max(axis=1)
        row = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        return np.where(key[row] == wanted, row, -1)

    def take(self, rows: Any) -> "OverlapTable":
        """Keep some rows.

        Args:
            rows: Their numbers, ascending, or a mask.
        """
        return OverlapTable(
            num_views=self.num_views,
            **{name: getattr(self, name)[rows] for name in _COLUMNS},
        )

    def join(self, other: "OverlapTable") -> "OverlapTable":
        """Put two tables of a scene that share no pair together."""
        both = OverlapTable(
            num_views=self.num_views,
            **{
                name: np.concatenate([getattr(self, name), getattr(other, name)])
                for name in _COLUMNS
            },
        )
        return both.take(np.lexsort((both.views[:, 1], both.views[:, 0])))

    def among(self, graph: list[int]) -> PairTable:
        """Give the table of a graph, all of whose pairs must be here."""
        n = len(graph)
        upper = np.triu_indices(n, k=1)
        pairs = np.array(graph, dtype=np.int64)[np.stack(upper, axis=1)]
        row = self.find(pairs)
        assert (row >= 0).all(), graph
        tables: dict[str, Float64[np.ndarray, "n n"]] = {}
        for field in fields(PairTable):
            ways = getattr(self, field.name)[row].astype(np.float64)
            if ways.ndim == 1:
                ways = np.stack([ways, ways], axis=1)
            elif len(pairs):
                ways = np.where((pairs[:, 0] < pairs[:, 1])[:, None], ways, ways[:, ::-1])
            table = np.eye(n) if field.name in ("iou", "covisible") else np.zeros((n, n))
            table[upper], table[upper[::-1]] = ways.T
            tables[field.name] = table
        return PairTable(**tables)


_COLUMNS = [field.name for field in fields(OverlapTable) if field.name != "num_views"]


def all_pairs(num_views: int) -> Int64[np.ndarray, "m 2"]:
    """List the pairs (i, j), i < j, of all images."""
    return np.stack(np.triu_indices(num_views, k=1), axis=1).astype(np.int64)
