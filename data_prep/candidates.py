"""Which pairs of a large scene are worth relating: a bounded number for each image, in the mean.

Three sieves, each finer than the one before and no wider than what it lets through:

1. An inverted index of coarse voxels: the shares of an image's grid points that lie in voxels which
   another image has points in too. A scene that has its own overlap gives that instead.
2. The best of these, and neighbours in the order of the source, are related exactly, but on few
   points.
3. Of these the best are kept, each image's first choice first, until the bound is reached.

Best is what clears the sampler's two thresholds, of IoU and of score, by the most, up to a factor
of two. Of more pairs that are so clear than the bound allows, a lot decides that is the pair's own:
to keep the highest scores would leave graphs of one kind of pair. The same scene and options give
the same pairs.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64, UInt64
from scipy.sparse import csr_array, hstack

from data_prep.covisibility import MIN_ROTATION, croco_score, relate_pairs
from data_prep.depth_views import DepthViews
from data_prep.graph_sampling import SamplingOptions
from data_prep.overlap_table import OverlapTable, all_pairs
from data_prep.scene import Scene

_POOL = 4
"""Pairs of an image that are looked at on few points, for each one that may be kept."""
_NEIGHBOURS = 2
"""Images next to one another in the source are always related: these many to either side."""
_FEW = 64
"""Points of an image in the look at few."""
_MORE = 1024
"""Points of an image that are sorted into voxels."""
_DENSITY = 8
"""Points of an image in a voxel, about: with fewer, images of one surface would meet in few."""
_CLEAR = 2.0
"""A pair that clears both thresholds by this factor is as good as any."""
_BLOCK = 2**22
"""Pairs of images compared by voxels at once."""
_MAX_PRODUCTS = 2**31
"""Products of voxels at most: beyond, only every so many-th voxel is looked at."""

_Overlaps = tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " m"], Float32[np.ndarray, " m"]]
"""View numbers i, view numbers j, both (i, j) and (j, i), and their IoU."""


def choose_pairs(
    scene: Scene, views: DepthViews, own: csr_array | None, options: SamplingOptions
) -> Int64[np.ndarray, "m 2"]:
    """Choose the pairs of a scene to be related.

    Args:
        scene: Its cameras.
        views: Its depth.
        own: The scene's own overlap where it has one.
        options: Thresholds, and the bound: ``candidates_per_image``.

    Returns:
        View numbers (i, j), i < j, ascending: all pairs where they are no more than the bound
        lets through, else at most half of ``candidates_per_image`` x images.
    """
    n, bound = views.num_views, options.candidates_per_image
    if n - 1 <= bound:
        return all_pairs(n)
    world_from_cam = scene.world_from_cam
    distance = _median_distance(views)
    pool = [_neighbours(n)]
    blocks = _shared_voxels(views, distance) if own is None else _own_blocks(own)
    for i, j, iou in blocks:
        angle = _rough_angle(world_from_cam, distance, i, j)
        margin = _margin(iou, angle, options)
        best = _rank(i, margin, _lots(i, j)) < _POOL * bound
        pool.append(np.sort(np.stack([i[best], j[best]], axis=1), axis=1))
    pairs = np.unique(np.concatenate(pool), axis=0)
    rough = relate_pairs(scene, _take_points(views, _FEW), pairs, own)
    return _within_bound(rough, options)


def _margin(
    iou: Float32[np.ndarray, " m"], angle: Float32[np.ndarray, " m"], options: SamplingOptions
) -> Float32[np.ndarray, " m"]:
    """Tell by what factor pairs clear both thresholds of a link, no more than is clear enough."""
    score = croco_score(torch.from_numpy(iou), torch.from_numpy(angle)).numpy()
    floor = max(options.min_score, 1e-6)
    margin = np.minimum(iou / np.float32(options.min_iou), score / np.float32(floor))
    return np.minimum(margin, np.float32(_CLEAR))


def _lots(i: Int64[np.ndarray, " m"], j: Int64[np.ndarray, " m"]) -> UInt64[np.ndarray, " m"]:
    """Give each pair a number that follows from it and looks drawn by chance (SplitMix64)."""
    x = (np.minimum(i, j) << 32 | np.maximum(i, j)).astype(np.uint64)
    x = x * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = (x ^ (x >> np.uint64(shift))) * np.uint64(factor)
    return np.asarray(x ^ (x >> np.uint64(31)))


def _rank(
    image: Int64[np.ndarray, " m"],
    margin: Float32[np.ndarray, " m"],
    lot: UInt64[np.ndarray, " m"],
) -> Int64[np.ndarray, " m"]:
    """Rank the pairs of each image: by margin, then by lot; the best is 0."""
    order = np.lexsort((lot, -margin, image))
    ordered = image[order]
    rank = np.empty(len(image), dtype=np.int64)
    rank[order] = np.arange(len(image)) - np.searchsorted(ordered, ordered)
    return rank


def _within_bound(rough: OverlapTable, options: SamplingOptions) -> Int64[np.ndarray, "k 2"]:
    """Keep neighbours and, in turns, what each image ranks first, second, and so on."""
    i, j = rough.views.T
    margin = _margin(rough.iou, rough.angle, options)
    lot = _lots(i, j)
    rank = _rank(np.concatenate([i, j]), np.tile(margin, 2), np.tile(lot, 2))
    turn = rank.reshape(2, -1).min(axis=0)
    turn[j - i <= _NEIGHBOURS] = -1
    order = np.lexsort((lot, -margin, turn))
    order = order[(turn[order] < 0) | (rough.iou[order] > 0)]
    kept = order[: rough.num_views * options.candidates_per_image // 2]
    return np.asarray(rough.views[np.sort(kept)])


def _neighbours(num_views: int) -> Int64[np.ndarray, "m 2"]:
    first = np.repeat(np.arange(num_views), _NEIGHBOURS)
    second = first + np.tile(np.arange(1, _NEIGHBOURS + 1), num_views)
    pairs = np.stack([first, second], axis=1)[second < num_views]
    return pairs.astype(np.int64)


def _take_points(views: DepthViews, num_points: int) -> DepthViews:
    """Keep some known points of each view, spread over it."""
    # Steps of the golden ratio fall evenly onto rows as well as columns.
    spread = np.sort(np.arange(num_points) * (math.sqrt(5) - 1) / 2 % 1)
    number = np.zeros((views.num_views, num_points), dtype=np.int64)
    for row, valid in enumerate(views.valid.cpu().numpy()):
        known = np.flatnonzero(valid)
        if len(known):
            number[row] = known[(spread * len(known)).astype(np.int64)]
    index = torch.from_numpy(number).to(views.center.device)
    points = views.pts3d_world.gather(2, index[:, None].expand(-1, 3, -1))
    return replace(views, pts3d_world=points, valid=views.valid.gather(1, index))


def _median_distance(views: DepthViews) -> Float32[np.ndarray, " n"]:
    """Median distance of each view's points from it; 0 where it has none."""
    away = (views.pts3d_world - views.center[..., None]).norm(dim=1)
    away[~views.valid] = torch.nan
    return np.asarray(away.nanmedian(dim=1).values.nan_to_num(0.0).cpu().numpy())


def _rough_angle(
    world_from_cam: Float64[np.ndarray, "n 4 4"],
    distance: Float32[np.ndarray, " n"],
    i: Int64[np.ndarray, " m"],
    j: Int64[np.ndarray, " m"],
) -> Float32[np.ndarray, " m"]:
    """Viewpoint angles, the parallax as that of two centres from the median distance."""
    R = world_from_cam[:, :3, :3].reshape(-1, 9).astype(np.float32)
    center = (world_from_cam[:, :3, 3] - world_from_cam[:, :3, 3].mean(0)).astype(np.float32)
    cos = (np.einsum("mk,mk->m", R[i], R[j]) - 1) / 2
    rotation = np.arccos(np.clip(cos, -1, 1))
    baseline = np.linalg.norm(center[i] - center[j], axis=1)
    parallax = np.arctan2(baseline, (distance[i] + distance[j]) / 2)
    return np.asarray(np.where(rotation < MIN_ROTATION, parallax, rotation))


def _shared_voxels(views: DepthViews, distance: Float32[np.ndarray, " n"]) -> Iterator[_Overlaps]:
    """Estimate the overlap of images where it is not 0."""
    known = views.valid.sum(-1).clamp_max(_MORE).cpu().numpy()
    if not known.any():
        return
    views = _take_points(views, _MORE)
    valid = views.valid.cpu().numpy()
    count = valid.sum(axis=1)
    # A view of 90 degrees shows a square of twice its distance.
    size = 2 * np.median(distance[known > 0]) / math.sqrt(np.median(known[known > 0]) / _DENSITY)
    cell = np.floor(views.pts3d_world.transpose(1, 2).cpu().numpy()[valid] / size)
    # 21 bits for each axis; what is farther off shares the outermost voxels.
    x, y, z = np.clip(cell, -(2**20), 2**20 - 1).astype(np.int64).T + 2**20
    _, voxel = np.unique(x << 42 | y << 21 | z, return_inverse=True)
    image = np.repeat(np.arange(len(valid)), count)
    weight = (1 / np.maximum(count, 1)[image]).astype(np.float32)
    share = csr_array((weight, (image, voxel)), shape=(len(valid), voxel.max(initial=0) + 1))
    share.sum_duplicates()
    presence = csr_array((np.ones_like(share.data), share.indices, share.indptr), share.shape)
    products = float((presence.sum(axis=0, dtype=np.float64) ** 2).sum())
    step = max(1, math.ceil(products / _MAX_PRODUCTS))
    share, presence = share[:, ::step], presence[:, ::step]
    left = csr_array(hstack([share, presence], format="csr"))
    right = csr_array(hstack([presence, share], format="csr").T.tocsr())
    for first, last in _row_blocks(len(valid)):
        i, j, both = _entries(csr_array(left[first:last] @ right), first)
        common = np.minimum(both * (step / 2), 1).astype(np.float32)
        yield i, j, common / (2 - common)


def _own_blocks(own: csr_array) -> Iterator[_Overlaps]:
    """Give the overlap that a scene has of its own, where it is not 0."""
    for first, last in _row_blocks(own.shape[0]):
        i, j, iou = _entries(own[first:last], first)
        yield i, j, iou.astype(np.float32)


def _row_blocks(num_views: int) -> Iterator[tuple[int, int]]:
    rows = max(1, _BLOCK // num_views)
    for first in range(0, num_views, rows):
        yield first, min(first + rows, num_views)


def _entries(
    block: csr_array, first: int
) -> tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Give row, column and value of entries off the diagonal; the block begins at row ``first``."""
    entries = block.tocoo()
    i, j = entries.row.astype(np.int64) + first, entries.col.astype(np.int64)
    other = i != j
    return i[other], j[other], entries.data[other]
