"""Cameras written as matrices, checked."""

import math

import numpy as np
from jaxtyping import Float64

from l3r.errors import DataError

MAX_DISTANCE = 1e9
"""Cameras farther from the origin are damage, in the source's unit."""

_ORTHONORMAL = 1e-3
"""Largest deviation of R R^T from the identity; sources round."""


def rigid_from_matrix(matrix: Float64[np.ndarray, "_r _c"]) -> Float64[np.ndarray, "4 4"]:
    """Check that a matrix turns and shifts and does nothing else, and take rounding out of it.

    Args:
        matrix: 3x4 or 4x4.

    Raises:
        DataError: It holds NaN, scale or a mirror, or is of another shape.
    """
    rigid = np.eye(4)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise DataError(f"matrix of shape {matrix.shape}, expected 3x4 or 4x4 finite numbers")
    rigid[: len(matrix)] = matrix
    R = rigid[:3, :3]
    error = float(np.abs(R @ R.T - np.eye(3)).max()) if np.abs(R).max() < 2 else math.inf
    bottom_fits = (rigid[3] == (0, 0, 0, 1)).all()
    if not (error <= _ORTHONORMAL and np.linalg.det(R) > 0 and bottom_fits):
        raise DataError(
            f"matrix that is not rigid (R R^T is off by {error:.2g}), expected a rotation without"
            " scale or mirror, and a shift"
        )
    if np.abs(rigid[:3, 3]).max() > MAX_DISTANCE:
        raise DataError(f"shift {rigid[:3, 3].tolist()}, expected less than {MAX_DISTANCE:.0e}")
    left, _, right = np.linalg.svd(R)
    rigid[:3, :3] = left @ right
    return rigid


def check_K(K: Float64[np.ndarray, "_r _c"], image_size: tuple[int, int]) -> None:
    """Check intrinsics against the size of their image.

    Args:
        K: In pixels.
        image_size: (height, width).

    Raises:
        DataError: Focal lengths are not positive, or the principal point lies outside the image.
    """
    height, width = image_size
    good = K.shape == (3, 3) and np.isfinite(K).all() and (K[2] == (0, 0, 1)).all()
    if not (good and min(K[0, 0], K[1, 1]) > 0 and K[1, 0] == 0 and abs(K[0, 1]) < K[0, 0]):
        raise DataError(f"K is {K.tolist()}, expected fx, fy > 0 and a last row 0 0 1")
    if not (0 < K[0, 2] < width and 0 < K[1, 2] < height):
        raise DataError(
            f"principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f}) outside an image of {width}x{height}"
            " pixels; K belongs to an image of another size"
        )
