"""PyTorch3D cameras become OpenCV cameras; the world stays as it is.

In the files points are row vectors, ``X_cam = X_world @ R + T``, with camera axes x left, y up,
z forward. Focal length and principal point are in normalised device coordinates whose unit is half
the shorter side (``ndc_isotropic``) or half of each side (``ndc_norm_image_bounds``), measured from
the image centre to the left and up. The image's corner is the origin of pixels there too, so the
centre of the top-left pixel is (0.5, 0.5) without further ado.

Source: https://pytorch3d.org/docs/cameras and ``ViewpointAnnotation`` of facebookresearch/co3d.
"""

import math

import numpy as np
from jaxtyping import Float64

from data_prep.converters.co3d.annotations import Viewpoint
from data_prep.converters.matrices import check_K, rigid_from_matrix
from l3r.errors import DataError

MAX_TRANSLATION = 1e5
"""|x| + |y| + |z| of T beyond which a whole sequence counts as corrupt, as PoseDiffusion has it."""

_FLIP = np.array([-1.0, -1.0, 1.0])
"""From x left, y up to x right, y down."""


def K_from_viewpoint(
    viewpoint: Viewpoint, image_size: tuple[int, int]
) -> Float64[np.ndarray, "3 3"]:
    """Give the intrinsics in pixels; centre of the top-left pixel at (0.5, 0.5).

    Args:
        viewpoint: The annotation.
        image_size: (height, width) of the annotated image.

    Raises:
        DataError: The format is unknown, a number not finite, a focal length not positive, or the
            principal point outside the image.
    """
    height, width = image_size
    half = np.array([width, height], np.float64) / 2
    match viewpoint.intrinsics_format:
        case "ndc_isotropic":
            unit = np.full(2, half.min())
        case "ndc_norm_image_bounds":
            unit = half
        case other:
            raise DataError(
                f"intrinsics_format '{other[:40]}', expected ndc_isotropic or ndc_norm_image_bounds"
            )
    K = np.eye(3)
    K[0, 0], K[1, 1] = np.array(viewpoint.focal_length) * unit
    K[:2, 2] = half - np.array(viewpoint.principal_point) * unit
    check_K(K, image_size)
    return K


def world_from_viewpoint(viewpoint: Viewpoint) -> Float64[np.ndarray, "4 4"]:
    """Give ``world_from_cam`` with OpenCV camera axes, its rotation orthonormal to float64.

    Args:
        viewpoint: The annotation, written with the digits of float32.

    Raises:
        DataError: R is no rotation, or a number not finite.
    """
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = _FLIP[:, None] * np.array(viewpoint.R, np.float64).T
    cam_from_world[:3, 3] = _FLIP * np.array(viewpoint.T, np.float64)
    cam_from_world = rigid_from_matrix(cam_from_world)
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = cam_from_world[:3, :3].T
    world_from_cam[:3, 3] = -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
    return world_from_cam


def is_corrupt(viewpoint: Viewpoint) -> bool:
    """Tell whether T is so large that its sequence's reconstruction went astray.

    Args:
        viewpoint: The annotation.
    """
    size = sum(map(abs, viewpoint.T))
    return math.isfinite(size) and size > MAX_TRANSLATION
