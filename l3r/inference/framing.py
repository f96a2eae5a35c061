"""How much of a photo the network sees, and at what size."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from l3r.config import ModelConfig
from l3r.config.inference import Crop
from l3r.errors import DataError
from l3r.types import Window


@dataclass(frozen=True, kw_only=True)
class Framing:
    """What becomes of a photo: it is scaled first, then cut."""

    scaled: tuple[int, int]
    """(height, width) of the whole photo after scaling."""
    left: int
    """Scaled columns cut off on the left."""
    top: int
    """Scaled rows cut off at the top."""
    size: tuple[int, int]
    """(height, width) of what is left: multiples of the patch."""

    def window(self, height: int, width: int) -> Window:
        """What is left, in pixels of the photo of this size."""
        # Whole numbers are divided last: a side that is not cut comes out exactly.
        return Window(
            left=self.left * width / self.scaled[1],
            top=self.top * height / self.scaled[0],
            width=self.size[1] * width / self.scaled[1],
            height=self.size[0] * height / self.scaled[0],
        )


def choose_framing(height: int, width: int, config: ModelConfig, crop: Crop) -> Framing:
    """Choose how a photo is brought to the network's size.

    Args:
        height: Rows of the photo, upright.
        width: Columns of it.
        config: ``image_size`` and the patch.
        crop: ``whole`` or ``official``, see :class:`~l3r.config.InferenceConfig`.

    Raises:
        DataError: ``official``, and the photo is narrower than a patch where its long side is that
            of ``image_size``.
    """
    match crop:
        case "whole":
            return _whole(height, width, config)
        case "official":
            return _official(height, width, config)


def frame_photo(
    image: UInt8[np.ndarray, "_h _w 3"], config: ModelConfig, crop: Crop
) -> tuple[Float[Tensor, "3 h w"], Window]:
    """Scale and cut a photo.

    Args:
        image: RGB, upright.
        config: ``image_size`` and the patch.
        crop: ``whole`` or ``official``.

    Returns:
        ``(image, window)``: RGB in [0, 1], and the part of the photo that it shows.

    Raises:
        DataError: ``official``, and the photo is narrower than a patch where its long side is that
            of ``image_size``.
    """
    before = image.shape[0], image.shape[1]
    framing = choose_framing(*before, config, crop)
    resized = _resize(image, framing.scaled, crop)
    rows, columns = framing.size
    cut = resized[framing.top : framing.top + rows, framing.left : framing.left + columns]
    pixels = torch.from_numpy(cut).permute(2, 0, 1).float() / 255
    return pixels, framing.window(*before)


def _whole(height: int, width: int, config: ModelConfig) -> Framing:
    """The long side becomes the network's, each side then the nearest multiple of the patch."""
    patch = config.encoder.patch_size
    scale = max(config.image_size) / max(height, width)
    # Halves go up: Python's round would send 10.5 down and 11.5 up.
    rows, columns = (math.floor(side * scale / patch + 0.5) for side in (height, width))
    size = max(1, rows) * patch, max(1, columns) * patch
    return Framing(scaled=size, left=0, top=0, size=size)


def _official(height: int, width: int, config: ModelConfig) -> Framing:
    """The framing of DUSt3R's and MASt3R's released loader, at any size of the network.

    A square ``image_size`` is their 224: the short side is fitted and a square cut out. Any other
    is their 512: the long side is fitted, sides are cut to multiples of the patch, and what is
    square by then to 4:3.
    """
    patch, target = config.encoder.patch_size, max(config.image_size)
    long_side, short_side = max(height, width), min(height, width)
    # Nothing is left of such a photo; a square network would have to blow it up without bounds.
    if round(short_side * target / long_side) < patch:
        raise DataError(
            f"{width} x {height} px is too narrow for inference.crop=official: less than a patch "
            f"of {patch} px where the long side is {target}; use inference.crop=whole"
        )
    if min(config.image_size) == target:
        scaled = round(height * target / short_side), round(width * target / short_side)
        size = target, target
    else:
        scaled = round(height * target / long_side), round(width * target / long_side)
        size = scaled[0] // patch * patch, scaled[1] // patch * patch
        if scaled[0] == scaled[1]:
            size = size[1] * 3 // 4 // patch * patch, size[1]
    top, left = (whole // 2 - kept // 2 for whole, kept in zip(scaled, size, strict=True))
    return Framing(scaled=scaled, left=left, top=top, size=size)


def _resize(
    image: UInt8[np.ndarray, "_h _w 3"], size: tuple[int, int], crop: Crop
) -> UInt8[np.ndarray, "h w 3"]:
    height, width = size
    if crop == "official":
        # The pixels that the released weights are used to, bit for bit.
        shrinks = max(size) < max(image.shape[:2])
        filter_ = Image.Resampling.LANCZOS if shrinks else Image.Resampling.BICUBIC
        return np.array(Image.fromarray(image).resize((width, height), filter_))
    shrinks = height < image.shape[0] or width < image.shape[1]
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, (width, height), interpolation=interpolation))
