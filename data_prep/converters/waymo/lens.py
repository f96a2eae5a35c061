"""The lens: radial and tangential distortion as OpenCV has it, taken out of the images.

All pixels count from the outer corner of the top-left pixel, in Waymo's calibrations and here, so
intrinsics need no shift; OpenCV's own functions count from that pixel's centre and get -0.5.
"""

from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from l3r.errors import DataError

_RADIAL = (0.8, 1.2)
"""Waymo's own camera model holds for a radial factor within this range only."""
_ZOOM = (0.5, 2.0)
_BORDER = 8


def distort(
    rays: Float64[np.ndarray, "*n 2"], lens: tuple[float, ...]
) -> tuple[Float64[np.ndarray, "*n 2"], Bool[np.ndarray, "*n"]]:
    """Find where rays meet the stored image.

    Args:
        rays: x / z and y / z, OpenCV axes.
        lens: ``f_u f_v c_u c_v k1 k2 p1 p2 k3``.

    Returns:
        ``(pts2d, valid)``: pixels of the distorted image, and whether the model holds there.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    u, v = rays[..., 0], rays[..., 1]
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    y = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    pts2d = np.stack([fx * x + cx, fy * y + cy], axis=-1)
    return pts2d, (radial >= _RADIAL[0]) & (radial <= _RADIAL[1])


@lru_cache(maxsize=64)
def undistorted_K(
    lens: tuple[float, ...], image_size: tuple[int, int]
) -> Float64[np.ndarray, "3 3"]:
    """Choose the pinhole of the undistorted image: the least zoom that leaves no pixel empty.

    Size, principal point and the ratio of the focal lengths stay; only both focal lengths are
    multiplied by one number, the smallest for which every pixel centre of the undistorted image
    has its source within the stored one.

    Args:
        lens: ``f_u f_v c_u c_v k1 k2 p1 p2 k3``.
        image_size: (height, width).

    Raises:
        DataError: There is no such number between 0.5 and 2.
    """
    height, width = image_size
    fx, fy, cx, cy = lens[:4]
    border = _border_pixels(height, width)

    def fits(zoom: float) -> bool:
        rays = (border - [cx, cy]) / [zoom * fx, zoom * fy]
        source, valid = distort(rays, lens)
        inside = (source >= 0.5) & (source <= [width - 0.5, height - 0.5])
        return bool(valid.all() and inside.all())

    inside = 0.5 < cx < width - 0.5 and 0.5 < cy < height - 0.5
    low, high = _ZOOM
    if not (fx > 1 and fy > 1 and inside and max(map(abs, lens)) < 1e6 and fits(high)):
        raise DataError(
            f"lens {', '.join(f'{x:.4g}' for x in lens)} of a {height}x{width} image: no zoom of"
            f" {low} to {high} undistorts it"
        )
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return np.array([[high * fx, 0, cx], [0, high * fy, cy], [0, 0, 1]])


def _border_pixels(height: int, width: int) -> Float64[np.ndarray, "n 2"]:
    """Centres of the outermost pixels, every eighth and the corners."""
    x = np.unique(np.append(np.arange(0, width, _BORDER), width - 1)) + 0.5
    y = np.unique(np.append(np.arange(0, height, _BORDER), height - 1)) + 0.5
    sides = [np.stack([x, np.full_like(x, edge)], -1) for edge in (0.5, height - 0.5)]
    sides += [np.stack([np.full_like(y, edge), y], -1) for edge in (0.5, width - 0.5)]
    return np.concatenate(sides)


def undistort_image(
    image: UInt8[np.ndarray, "h w 3"], lens: tuple[float, ...], K: Float64[np.ndarray, "3 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Resample an image bilinearly to the pinhole camera ``K``.

    Args:
        image: As stored.
        lens: ``f_u f_v c_u c_v k1 k2 p1 p2 k3`` of it.
        K: Intrinsics of the result, of the same size.
    """
    fx, fy, cx, cy, *distortion = lens
    source = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    target = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    height, width = image.shape[:2]
    maps = cv2.initUndistortRectifyMap(
        source, np.array(distortion), None, target, (width, height), cv2.CV_16SC2
    )
    return np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR))
