"""Small pictures of photos, depth and confidence, as ``data:`` URIs."""

import base64
import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

LONG_SIDE = 320
"""Pixels; smaller pictures stay as they are."""
_TINY = 128
"""Long side below which a picture is kept without loss and shown with its pixels visible."""
_UNKNOWN_GREY = 128
_QUALITY = 85


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture ready for a page."""

    uri: str
    tiny: bool
    """Whether it should be enlarged without smoothing."""
    note: str = ""
    """What its colours span."""


def photo_picture(image: Float[Tensor, "3 h w"]) -> Picture:
    """Shrink a photo.

    Args:
        image: RGB in [0, 1].
    """
    rgb = (image.cpu() * 255).round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0)
    return _picture(_shrunk(rgb.numpy(), cv2.INTER_AREA)[..., ::-1])


def depth_picture(depth: Float[Tensor, "h w"]) -> Picture:
    """Colour a depth map, near in red and far in blue; grey where there is no positive depth.

    The colours span its own 2nd to 98th percentile, on a logarithmic scale.
    """
    return _picture(*depth_colors(_shrunk(depth.float().cpu().numpy(), cv2.INTER_NEAREST)))


def depth_colors(values: Float32[np.ndarray, "h w"]) -> tuple[UInt8[np.ndarray, "h w 3"], str]:
    """Colour a depth map as :func:`depth_picture` does; BGR, and what the colours span."""
    known = np.isfinite(values) & (values > 0)
    if not known.any():
        return np.full((*values.shape, 3), _UNKNOWN_GREY, np.uint8), "no depth"
    low, high = np.percentile(values[known], [2, 98])
    level = 1 - _log_level(np.where(known, values, low), low, high)
    colored = cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    colored[~known] = _UNKNOWN_GREY
    return colored, f"{low:.3g} to {high:.3g}"


def confidence_picture(conf: Float[Tensor, "h w"], highest: float) -> Picture:
    """Colour a confidence map, logarithmic from 1 (dark) to ``highest`` (bright)."""
    values = _shrunk(conf.float().cpu().numpy(), cv2.INTER_NEAREST)
    return _picture(confidence_colors(values, highest), f"median {float(np.median(values)):.3g}")


def confidence_colors(
    values: Float32[np.ndarray, "h w"], highest: float
) -> UInt8[np.ndarray, "h w 3"]:
    """Colour a confidence map as :func:`confidence_picture` does; BGR."""
    level = _log_level(values, 1.0, highest)
    return np.asarray(cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS))


def _log_level(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Map [low, high] to [0, 1] by logarithm."""
    span = math.log(high / low) if high > low else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        level = np.log(values / low) / span
    return np.asarray(np.nan_to_num(np.clip(level, 0, 1)))


def _shrunk(pixels: np.ndarray, interpolation: int) -> np.ndarray:
    """Bring the long side down to :data:`LONG_SIDE`; numbers are picked, colours averaged."""
    height, width = pixels.shape[:2]
    scale = LONG_SIDE / max(height, width)
    if scale >= 1:
        return pixels
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(np.ascontiguousarray(pixels), size, interpolation=interpolation))


def _picture(bgr: UInt8[np.ndarray, "h w 3"], note: str = "") -> Picture:
    tiny = max(bgr.shape[:2]) < _TINY
    suffix, kind, options = (
        (".png", "png", []) if tiny else (".jpg", "jpeg", [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    )
    _, data = cv2.imencode(suffix, np.ascontiguousarray(bgr), options)
    text = base64.b64encode(data.tobytes()).decode()
    return Picture(uri=f"data:image/{kind};base64,{text}", tiny=tiny, note=note)
