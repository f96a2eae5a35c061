"""Intrinsics of MegaDepth's images, which COLMAP undistorted and reduced without writing them."""

import numpy as np
from jaxtyping import Float64

from data_prep.converters.lens import Lens, undistort_lens
from l3r.errors import DataError

_ROUNDING = 2
"""Sides are cut to whole pixels once when undistorting and once when reducing."""


def undistorted_K(lens: Lens, image_size: tuple[int, int]) -> Float64[np.ndarray, "3 3"]:
    """Find K of the undistorted image from the photo's own camera.

    Args:
        lens: Camera of the photo as it was uploaded.
        image_size: (height, width) of the undistorted image.

    Returns:
        Intrinsics in pixels of that image. COLMAP's pixel convention is the project's, so nothing
        is shifted.

    Raises:
        DataError: The image cannot come from that camera: its proportions differ.
    """
    target = undistort_lens(lens)
    height, width = image_size
    whole_height, whole_width = target.image_size
    scale = max(image_size) / max(target.image_size)
    off = max(abs(height - scale * whole_height), abs(width - scale * whole_width))
    if off > _ROUNDING:
        raise DataError(
            f"image of {width}x{height} pixels, the camera undistorts to {whole_width}x"
            f"{whole_height}; image and SfM model do not belong together"
        )
    scales = np.array([[width / whole_width], [height / whole_height], [1.0]])
    return np.asarray(target.K * scales, dtype=np.float64)
