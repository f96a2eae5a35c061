"""Tables of all pairs, square as the definitions have them."""

import numpy as np

from data_prep.covisibility import read_own_overlap, relate_depth, relate_pairs
from data_prep.depth_views import prepare_views
from data_prep.overlap_table import OverlapTable, all_pairs

DIAGONAL = {"iou": 1, "covisible": 1}


def relate_all(scene):
    """Relate all pairs of a scene."""
    pairs = all_pairs(len(scene.frames))
    return relate_pairs(scene, prepare_views(scene), pairs, read_own_overlap(scene))


def square(table, name):
    """A column as an n x n matrix, NaN for pairs that the table lacks."""
    matrix = np.full((table.num_views, table.num_views), np.nan)
    np.fill_diagonal(matrix, DIAGONAL.get(name, 0))
    column = getattr(table, name)
    i, j = table.views.T
    matrix[i, j], matrix[j, i] = column.T if column.ndim == 2 else (column, column)
    return matrix


def count_seen(views):
    """How many grid points of i each j sees, for all ordered pairs."""
    n = views.num_views
    pairs = np.array([(i, j) for i in range(n) for j in range(i, n)])
    seen, _ = relate_depth(views, pairs)
    matrix = np.zeros((n, n), dtype=np.int64)
    matrix[pairs[:, 0], pairs[:, 1]] = seen[:, 0]
    matrix[pairs[:, 1], pairs[:, 0]] = seen[:, 1]
    return matrix


def table_of(iou, score, angle, keep=None):
    """A table of the pairs of square matrices; of those only that ``keep`` marks."""
    pairs = all_pairs(len(iou))
    if keep is not None:
        pairs = pairs[keep[pairs[:, 0], pairs[:, 1]]]
    at = tuple(pairs.T)
    column = iou[at].astype(np.float32)
    return OverlapTable(
        num_views=len(iou),
        views=pairs,
        iou=column,
        covisible=np.stack([column, column], axis=1),
        rotation=angle[at].astype(np.float32),
        axis=angle[at].astype(np.float32),
        parallax=angle[at].astype(np.float32),
        angle=angle[at].astype(np.float32),
        score=score[at].astype(np.float32),
    )
