"""How well two images agree about their cameras: by matched features, and by depth."""

from dataclasses import dataclass

import cv2
import numpy as np

HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""Half a pixel in the principal point."""


@dataclass(frozen=True)
class View:
    """An image with its camera; depth where it has one."""

    image: np.ndarray
    K: np.ndarray
    world_from_cam: np.ndarray
    depth: np.ndarray | None = None


def view_of(frame):
    return View(frame.read_image(), frame.K, frame.world_from_cam, frame.read_depth())


def match(first, second, *, count=3000):
    """Match SIFT features; pixel centres at .5. Without precise upscaling they are 0.25 px off."""
    sift = cv2.SIFT_create(count, enable_precise_upscale=True)
    found = [
        sift.detectAndCompute(cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY), None)
        for view in (first, second)
    ]
    pairs = cv2.BFMatcher().knnMatch(found[0][1], found[1][1], k=2)
    good = [a for a, b in pairs if a.distance < 0.75 * b.distance]
    return (
        np.array([found[0][0][m.queryIdx].pt for m in good]) + 0.5,
        np.array([found[1][0][m.trainIdx].pt for m in good]) + 0.5,
    )


def sampson(first, second, pts_first, pts_second):
    """Share of matches within 3 px of the epipolar geometry, and their median distance [px]."""
    second_from_first = np.linalg.inv(second.world_from_cam) @ first.world_from_cam
    x, y, z = second_from_first[:3, 3]
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ second_from_first[:3, :3]
    F = np.linalg.inv(second.K).T @ E @ np.linalg.inv(first.K)
    a, b = (np.c_[p, np.ones(len(p))] for p in (pts_first, pts_second))
    lines, back = a @ F.T, b @ F
    length = np.sqrt((lines[:, :2] ** 2).sum(-1) + (back[:, :2] ** 2).sum(-1))
    distance = np.abs((b * lines).sum(-1)) / length
    near = distance < 3
    return near.mean(), np.median(distance[near]) if near.any() else np.inf


def interpolate(depth, pixels):
    """Inverse depth between four neighbours that agree within 5%; 0 elsewhere."""
    height, width = depth.shape
    x, y = np.nan_to_num(pixels - 0.5, nan=-1, posinf=-1, neginf=-1).T
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    column = np.clip(x, 0, width - 1.001).astype(int).clip(max=width - 2)
    row = np.clip(y, 0, height - 1.001).astype(int).clip(max=height - 2)
    four = np.stack([depth[row + a, column + b] for a in (0, 1) for b in (0, 1)]).astype(float)
    known = inside & (four.min(0) > 0) & (four.max(0) <= 1.05 * four.min(0))
    x, y = x - column, y - row
    weights = np.stack([(1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x])
    inverse = (weights / np.where(known, four, 1)).sum(0)
    return np.where(known, 1 / inverse, 0)


def transfer(first, second, pixels, z):
    """Where pixels of known depth lie in the other image, and how deep."""
    second_from_first = np.linalg.inv(second.world_from_cam) @ first.world_from_cam
    cam = np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(first.K).T * z[:, None]
    moved = (cam @ second_from_first[:3, :3].T + second_from_first[:3, 3]) @ second.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return moved[:, :2] / moved[:, 2:], moved[:, 2]


@dataclass(frozen=True)
class Agreement:
    """Depth of one image seen from another."""

    share: float
    """Of the first's known depth, what agrees within 5% with the second's."""
    of_known: float
    """The same share of what falls on known depth of the second."""
    depth: float
    """Median relative difference where it does."""
    pixels: float
    """Median distance after going there and back [px]."""


def agree(first, second, step=3):
    """Move the first image's depth to the second and back."""
    rows, columns = np.nonzero(first.depth[::step, ::step])
    z = first.depth[::step, ::step][rows, columns].astype(float)
    start = np.stack([columns, rows], axis=-1) * step + 0.5
    there, moved = transfer(first, second, start, z)
    found = interpolate(second.depth, there)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.abs(found - moved) / moved
    known = (moved > 0) & (found > 0)
    good = known & (off < 0.05)
    if not good.any():
        return Agreement(0.0, 0.0, np.inf, np.inf)
    back, _ = transfer(second, first, there[good], found[good])
    distance = np.linalg.norm(back - start[good], axis=-1)
    return Agreement(
        share=good.mean(),
        of_known=good.sum() / known.sum(),
        depth=np.median(off[good]),
        pixels=np.median(distance),
    )
