"""Colour jitter on bytes: what torchvision's ColorJitter does, at a millisecond an image."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import cv2
import numpy as np
from jaxtyping import UInt8

_LUMA = np.array([0.299, 0.587, 0.114])
"""Share of red, green and blue in grey, ITU-R 601."""
_STEPS_ROUND = 256
"""Steps of a byte around the circle of hues."""


Kind = Literal["brightness", "contrast", "saturation", "hue"]
"""The four changes, in the order of ``data.color_jitter``."""


class ColorStep(NamedTuple):
    """One of the four changes."""

    kind: Kind
    """Which."""
    amount: float
    """The factor, 1 for no change; of ``hue`` the turn as a share of the circle, 0 for none."""


@dataclass(frozen=True, kw_only=True)
class ColorChange:
    """What happens to one image's colours."""

    steps: tuple[ColorStep, ...]
    """In this order."""


def draw_color_changes(
    rng: np.random.Generator, strengths: Sequence[float], num_views: int
) -> tuple[ColorChange, ...]:
    """Draw the changes of a graph's images.

    Args:
        rng: Where from; each image takes as many draws, so that the first images' changes do not
            depend on how many follow, nor a change on the other strengths.
        strengths: Of brightness, contrast, saturation and hue: a factor is uniform between
            max(0, 1 - strength) and 1 + strength, the hue between -strength and strength.
            What has strength 0 is left out.
        num_views: Images.

    Returns:
        A change for each image, its steps in random order.
    """
    kinds = [kind for kind, strength in zip(get_args(Kind), strengths, strict=True) if strength]
    by_kind = dict(zip(get_args(Kind), strengths, strict=True))
    changes = []
    for draws in rng.random((num_views, 2, 4)).tolist():
        shares, turns = (dict(zip(get_args(Kind), row, strict=True)) for row in draws)
        order = sorted(kinds, key=turns.__getitem__)
        steps = tuple(ColorStep(k, _spread(k, by_kind[k], shares[k])) for k in order)
        changes.append(ColorChange(steps=steps))
    return tuple(changes)


def _spread(kind: Kind, strength: float, share: float) -> float:
    """The amount at a share of the way between the least and the greatest."""
    least = -strength if kind == "hue" else max(0.0, 1 - strength)
    greatest = strength if kind == "hue" else 1 + strength
    return least + (greatest - least) * share


def change_colors(
    image: UInt8[np.ndarray, "h w 3"], change: ColorChange
) -> UInt8[np.ndarray, "h w 3"]:
    """Change the colours of an RGB image; every step rounds and clips to bytes.

    Brightness blends with black, contrast with the mean grey of the image, saturation with the
    grey of each pixel; hue turns the H of HSV, which is kept to a byte.
    """
    for step in change.steps:
        image = _turn_hue(image, step.amount) if step.kind == "hue" else _blend(image, step)
    return image


def _blend(image: UInt8[np.ndarray, "h w 3"], step: ColorStep) -> UInt8[np.ndarray, "h w 3"]:
    """Go from another image (factor 0) through this one (1) and beyond: an affine map of RGB."""
    matrix = np.zeros((3, 4))
    matrix[:, :3] = step.amount * np.eye(3)
    if step.kind == "contrast":
        matrix[:, 3] = (1 - step.amount) * (_LUMA @ cv2.mean(image)[:3])
    elif step.kind == "saturation":
        matrix[:, :3] += (1 - step.amount) * _LUMA
    return np.asarray(cv2.transform(image, matrix))


def _turn_hue(image: UInt8[np.ndarray, "h w 3"], turn: float) -> UInt8[np.ndarray, "h w 3"]:
    shift = round(turn * _STEPS_ROUND) % _STEPS_ROUND
    if shift == 0:
        return image
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV_FULL)
    # Whole rows at once: bytes wrap around as hues do.
    row = np.tile(np.array([shift, 0, 0], np.uint8), image.shape[1])
    turned = (hsv.reshape(len(hsv), -1) + row).reshape(hsv.shape)
    return np.asarray(cv2.cvtColor(turned, cv2.COLOR_HSV2RGB_FULL))
