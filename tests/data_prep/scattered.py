"""Depth known at scattered pixels, as lidar leaves it in an image."""

from dataclasses import replace
from functools import partial

import numpy as np
import torch

from data_prep.surfaces import interpolate_depth

SHARE = 0.08


def scatter(scene, dataset, share=SHARE):
    """The scene with few depths kept, each measured up to half a pixel off its pixel's centre."""
    frames = [
        replace(frame, read_depth=partial(scattered_depth, frame.read_depth, number, share))
        for number, frame in enumerate(scene.frames)
    ]
    return replace(scene, dataset=dataset, frames=frames, has_sparse_depth=True)


def scattered_depth(read, seed, share):
    whole = torch.from_numpy(read()).double()
    height, width = whole.shape
    draw = np.random.default_rng(seed)
    number = int(share * height * width)
    pixels = np.stack([draw.integers(1, width - 1, number), draw.integers(1, height - 1, number)])
    hits = pixels.T + draw.random((number, 2))
    z, known = interpolate_depth(whole, torch.from_numpy(hits))
    depth = np.full((height, width), np.inf, np.float32)
    column, row = pixels[:, known.numpy()]
    np.minimum.at(depth, (row, column), z[known].numpy().astype(np.float32))
    return np.where(np.isfinite(depth), depth, np.float32(0))
