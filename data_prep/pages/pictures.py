"""Small pictures of stored images and depth, as ``data:`` URIs."""

import base64
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, UInt8

from data_prep.surfaces import is_scattered

_QUALITY = 82
_STRIPE = 6
"""Width of the stripes that mark unknown depth [px]."""
_STRIPES = (236, 205)
_DOT = 1
"""Half the side of a dot of scattered depth [px]."""
_PIXELATED = 128


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture ready for a page."""

    uri: str
    width: int
    height: int

    @property
    def is_tiny(self) -> bool:
        """Whether it should be enlarged without smoothing."""
        return max(self.width, self.height) < _PIXELATED


@dataclass(frozen=True, kw_only=True)
class DepthScale:
    """What the colours of depth span, the same for all images of a graph; logarithmic."""

    low: float
    """Depth of the reddest colour."""
    high: float
    """Depth of the bluest colour."""
    unit: str
    """``m``, or empty where the scene has no metres."""

    @classmethod
    def of(cls, depths: list[Float32[np.ndarray, "_h _w"]], *, is_metric: bool) -> "DepthScale":
        """Span the 2nd to the 98th percentile of all known depth."""
        known = np.concatenate([depth[depth > 0] for depth in depths])
        low, high = np.percentile(known[:: max(1, len(known) // 100_000)], [2, 98])
        return cls(low=float(low), high=float(high), unit=" m" if is_metric else "")

    def color(self, depth: Float32[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape 3"]:
        """Give RGB, red where near and blue where far; of unknown depth it means nothing."""
        span = np.log(max(self.high / self.low, 1 + 1e-6))
        level = np.log(np.maximum(depth, self.low) / self.low) / span
        index = (255 * (1 - level.clip(0, 1))).astype(np.uint8)
        bgr = cv2.applyColorMap(index.reshape(-1, 1), cv2.COLORMAP_TURBO)
        return np.asarray(bgr[:, 0, ::-1]).reshape(*depth.shape, 3)

    @property
    def gradient(self) -> str:
        """The colours from near to far, as CSS writes them."""
        steps = np.geomspace(self.low, max(self.high, self.low * 1.001), 13).astype(np.float32)
        return ", ".join(f"rgb({r}, {g}, {b})" for r, g, b in self.color(steps).tolist())

    @property
    def labels(self) -> list[str]:
        """Depth at the ends of the gradient and at its middle."""
        middle = float(np.sqrt(self.low * self.high))
        return [f"{z:.3g}{self.unit}" for z in (self.low, middle, self.high)]


def image_picture(image: UInt8[np.ndarray, "h w 3"], long_side: int) -> Picture:
    """Shrink an image; a smaller one stays as it is."""
    return _encode(_shrink(image, long_side))


def depth_picture(
    depth: Float32[np.ndarray, "h w"],
    image: UInt8[np.ndarray, "h w 3"],
    scale: DepthScale,
    long_side: int,
) -> Picture:
    """Colour a depth map: stripes where it is unknown, dots over the image where it is scattered.

    Args:
        depth: z, 0 where unknown.
        image: What it belongs to.
        scale: What the colours span.
        long_side: Pixels of the longer side, or the map's own where that is less.
    """
    if is_scattered(torch.from_numpy(depth)):
        return _encode(_draw_dots(depth, _shrink(image, long_side), scale), has_dots=True)
    height, width = _shrink(image, long_side).shape[:2]
    small = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)
    row, column = np.mgrid[:height, :width]
    stripes = np.array(_STRIPES, np.uint8)[(row + column) // _STRIPE % 2]
    return _encode(np.where((small > 0)[..., None], scale.color(small), stripes[..., None]))


def _draw_dots(
    depth: Float32[np.ndarray, "h w"], image: UInt8[np.ndarray, "sh sw 3"], scale: DepthScale
) -> UInt8[np.ndarray, "sh sw 3"]:
    gray = image.mean(-1, keepdims=True) * 0.55 + 90
    canvas = np.broadcast_to(gray, image.shape).astype(np.uint8).copy()
    row, column = np.nonzero(depth)
    far_first = np.argsort(-depth[row, column], kind="stable")
    row, column = row[far_first], column[far_first]
    colors = scale.color(depth[row, column])
    y = ((row + 0.5) * image.shape[0] / depth.shape[0]).astype(int)
    x = ((column + 0.5) * image.shape[1] / depth.shape[1]).astype(int)
    for dy in range(-_DOT, _DOT):
        for dx in range(-_DOT, _DOT):
            at = (y + dy).clip(0, image.shape[0] - 1), (x + dx).clip(0, image.shape[1] - 1)
            canvas[at] = colors
    return canvas


def _shrink(image: UInt8[np.ndarray, "h w 3"], long_side: int) -> UInt8[np.ndarray, "sh sw 3"]:
    height, width = image.shape[:2]
    scale = long_side / max(height, width)
    if scale >= 1:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _encode(image: UInt8[np.ndarray, "h w 3"], *, has_dots: bool = False) -> Picture:
    # Half the resolution of colour would take the colour out of dots.
    sampling = (
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444 if has_dots else cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420
    )
    options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), options)
    text = base64.b64encode(data.tobytes()).decode()
    height, width = image.shape[:2]
    return Picture(uri=f"data:image/jpeg;base64,{text}", width=width, height=height)
