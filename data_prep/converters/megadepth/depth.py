"""MegaDepth's depth maps: z of multi-view stereo, or ordinal labels, which are no depth."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from data_prep.converters.depth_files import read_h5_depth
from l3r.errors import DataError

FAR_PERCENTILE, NEAR_PERCENTILE = 98, 1
FAR, NEAR = 2.0, 0.5
"""Depth beyond ``FAR`` times the 98th percentile of an image's depth, or nearer than ``NEAR`` times
the first, is dropped as stereo gone astray.

MegaDepth's own loader cuts at the percentiles themselves. On the genuine pair at hand all depth
beyond the 98th percentile agrees between the two images, so that a plain cut would lose good
surfaces, the farthest of every scene, and nothing else.
"""


def load_depth(path: Path, image_size: tuple[int, int]) -> Float32[np.ndarray, "_h _w"]:
    """Read a depth map as it is stored; below 0 somewhere if it is ordinal.

    Args:
        path: The h5 file.
        image_size: (height, width) of its image.

    Raises:
        DataError: It is missing, damaged or of another size.
    """
    depth = read_h5_depth(path, image_size).astype(np.float32, copy=False)
    return np.where(np.isfinite(depth), depth, np.float32(0))


def is_ordinal(depth: Float32[np.ndarray, "h w"]) -> bool:
    """Tell whether the map says which of two surfaces is nearer, and not how far they are."""
    return bool(depth.min() < 0)


def read_depth(path: Path, image_size: tuple[int, int]) -> Float32[np.ndarray, "_h _w"]:
    """Read z in the model's unit, 0 where unknown or astray.

    Args:
        path: The h5 file.
        image_size: (height, width) of its image.

    Raises:
        DataError: It is missing, damaged, of another size, or ordinal.
    """
    depth = load_depth(path, image_size)
    if is_ordinal(depth):
        raise DataError(f"{path}: ordinal labels in place of depth; leave the image out")
    return drop_outliers(depth)


def drop_outliers(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Make unknown what lies far outside an image's depth."""
    known = depth[depth > 0]
    if not known.size:
        return depth
    near, far = np.percentile(known, (NEAR_PERCENTILE, FAR_PERCENTILE))
    return np.where((depth >= NEAR * near) & (depth <= FAR * far), depth, np.float32(0))
