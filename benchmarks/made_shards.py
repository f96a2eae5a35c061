"""Shards that a benchmark makes for itself, as heavy to read as those of photos.

The images are views of a rendered room under a fractal texture and a little noise, since plain
renderings compress better than photos: their JPEGs take about as many bytes as genuine ones (0.23
to 0.52 bytes a pixel on five data sets, docs/data.md).
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from data_prep.converters.synthetic import intrinsics
from data_prep.raycast import render
from data_prep.room import build_room, draw_cameras
from data_prep.shards import relative_to_first
from l3r.data.schema import index_shard, write_index
from tests.data.graphs import make_graph, write_folder


def write_shards(
    folder: Path, num_graphs: int, num_views: int, image_size: tuple[int, int]
) -> Path:
    """Write graphs of the same rendered views in different orders, with their indices.

    Args:
        folder: Where to; made.
        num_graphs: How many.
        num_views: Images of each.
        image_size: (height, width) as stored [px].
    """
    room = build_room(0)
    world_from_cam = draw_cameras(room, num_views, 0)
    K = intrinsics(image_size)
    rng = np.random.default_rng(0)
    images, depths = [], []
    for camera in world_from_cam:
        image, depth = render(room, torch.from_numpy(K), camera[None], image_size)
        images.append(_textured(image[0].numpy(), rng))
        depths.append(depth[0].numpy())
    graphs = []
    for number in range(num_graphs):
        order = np.roll(np.arange(num_views), number)
        cameras = world_from_cam.double().numpy()[order]
        graphs.append(
            replace(
                make_graph(number, num_views, *image_size),
                image=[images[view] for view in order],
                depth=[depths[view] for view in order],
                K=np.tile(K, (num_views, 1, 1)),
                cam_from_world=relative_to_first(cameras),
            )
        )
    written = write_folder(folder, graphs)
    for tar in written.glob("*.tar"):
        write_index(tar, index_shard(tar))
    return written


def _textured(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Multiply a rendering by a texture whose amplitude falls with frequency as photos' do."""
    height, width = image.shape[:2]
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width))
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.normal(size=(height, width))) / frequency
    texture = np.fft.irfft2(spectrum, s=(height, width))
    shaded = image * (1 + 0.07 * texture / texture.std())[..., None]
    noisy = 255 * shaded + rng.normal(scale=0.5, size=image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)
