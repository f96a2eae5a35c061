"""From a stored graph to a sample of the training batch.

A stage is a generator function: samples in, samples out, options by keyword. It makes new objects
and never edits its input, so that stages compose in any loader.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8

from l3r.data.color import ColorChange, change_colors
from l3r.data.schema import GraphSample
from l3r.errors import DataError
from l3r.geometry.camera import transpose_K
from l3r.types import Views


@dataclass(frozen=True, kw_only=True)
class KeyedGraph:
    """A graph and where it came from."""

    key: str
    """Shard and key, for messages and the log of skipped steps."""
    graph: GraphSample


def resize_crop(
    samples: Iterable[KeyedGraph], *, image_size: tuple[int, int]
) -> Iterator[KeyedGraph]:
    """Bring every image to one shape: crop around the principal point, then scale.

    Every image takes the shape in its own orientation: portrait images with height and width
    swapped. The crop is the largest of that aspect that is centred on the principal point, so that
    the principal point ends up in the middle. Colour is averaged over areas; depth takes the
    nearest sample, since the mean of two surfaces lies on neither.

    Args:
        samples: Graphs.
        image_size: Target (height, width), landscape or square.

    Yields:
        Graphs whose images, depths and ``K`` match, upright.

    Raises:
        DataError: A principal point lies outside its image.
    """
    assert image_size[0] <= image_size[1], image_size
    for sample in samples:
        graph = sample.graph
        fitted = [
            _fit_view(image, depth, K, _oriented(image_size, image), f"{sample.key}: {file}")
            for image, depth, K, file in zip(
                graph.image, graph.depth, graph.K, graph.file, strict=True
            )
        ]
        images, depths, Ks = zip(*fitted, strict=True)
        resized = replace(graph, image=list(images), depth=list(depths), K=np.stack(Ks))
        yield replace(sample, graph=resized)


def jitter_colors(
    samples: Iterable[KeyedGraph], *, changes: Sequence[ColorChange]
) -> Iterator[KeyedGraph]:
    """Change the colours of every image.

    Args:
        samples: Graphs.
        changes: One for each image of a graph; none leaves graphs as they are.
    """
    for sample in samples:
        if not changes:
            yield sample
            continue
        pairs = zip(sample.graph.image, changes, strict=True)
        images = [change_colors(image, change) for image, change in pairs]
        yield replace(sample, graph=replace(sample.graph, image=images))


@dataclass(frozen=True, kw_only=True)
class PackedViews:
    """A batch as it travels between processes: :class:`Views` in two fifths of the memory."""

    image: UInt8[torch.Tensor, "b n h w 3"]
    """RGB as bytes."""
    others: dict[str, Any]
    """The other fields of ``Views`` but ``valid``, which follows from ``depth``."""

    def unpack(self) -> Views:
        """Make the batch that the model takes."""
        return Views(image=_to_planes(self.image), valid=self.others["depth"] > 0, **self.others)


def lay_out(samples: Sequence[KeyedGraph]) -> PackedViews:
    """Make a batch of graphs, all images laid out landscape.

    Portrait images are transposed with their depth, and the first two rows of their ``K`` are
    swapped, so that all images of a shape stack; ``true_shape`` keeps the upright shapes. Cameras,
    and so points, are those of the upright images.

    Args:
        samples: One or more graphs of as many images, which have one shape but for orientation,
            see :func:`resize_crop`.
    """
    graphs = [sample.graph for sample in samples]
    true_shape = torch.tensor([graph.image_size for graph in graphs])
    is_portrait = (true_shape[..., 0] > true_shape[..., 1])[..., None, None]
    K = torch.from_numpy(np.stack([graph.K for graph in graphs]))
    world_from_cam = np.linalg.inv(np.stack([graph.cam_from_world for graph in graphs]))
    others = {
        "true_shape": true_shape,
        "K": torch.where(is_portrait, transpose_K(K), K).float(),
        "world_from_cam": torch.from_numpy(world_from_cam).float(),
        "depth": _stack([graph.depth for graph in graphs]),
        "is_metric": torch.tensor([graph.is_metric for graph in graphs]),
        "dataset": [graph.dataset for graph in graphs],
        "scores": torch.from_numpy(np.stack([graph.pairs.iou for graph in graphs])).float(),
        "key": [sample.key for sample in samples],
    }
    return PackedViews(image=_stack([graph.image for graph in graphs]), others=others)


def _oriented(image_size: tuple[int, int], image: np.ndarray) -> tuple[int, int]:
    """The target (height, width) in the orientation of an image."""
    height, width = image_size
    return (width, height) if image.shape[0] > image.shape[1] else (height, width)


def _landscape(pixels: np.ndarray) -> np.ndarray:
    """Swap the two pixel axes of what is portrait."""
    return pixels.swapaxes(0, 1) if pixels.shape[0] > pixels.shape[1] else pixels


def _stack(graphs: Sequence[Sequence[np.ndarray]]) -> torch.Tensor:
    stacked = [[_landscape(pixels) for pixels in images] for images in graphs]
    return torch.from_numpy(np.array(stacked))


def _to_planes(image: UInt8[torch.Tensor, "b n h w 3"]) -> Float32[torch.Tensor, "b n 3 h w"]:
    """Bytes to numbers in [0, 1]; plane by plane is three times as fast as all in one go."""
    b, n, height, width, _ = image.shape
    planes = torch.empty(b, n, 3, height, width)
    for pixels, target in zip(image.flatten(0, 1).numpy(), planes.flatten(0, 1), strict=True):
        for channel, plane in enumerate(cv2.split(pixels)):
            torch.div(torch.from_numpy(plane), 255, out=target[channel])
    return planes


def _fit_view(
    image: UInt8[np.ndarray, "_h _w 3"],
    depth: Float32[np.ndarray, "_h _w"],
    K: Float[np.ndarray, "3 3"],
    image_size: tuple[int, int],
    where: str,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    left, top, width, height = _centered_crop(K, image.shape[:2], image_size, where)
    window = (slice(top, top + height), slice(left, left + width))
    target = (image_size[1], image_size[0])  # OpenCV's order
    shrinks = width > target[0] or height > target[1]
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    scale = np.array([[target[0] / width], [target[1] / height], [1.0]])
    shift = np.array([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]])
    return (
        cv2.resize(image[window], target, interpolation=interpolation),
        # Exact: takes the sample under each new pixel's centre, as K does.
        cv2.resize(depth[window], target, interpolation=cv2.INTER_NEAREST_EXACT),
        (K - shift) * scale,
    )


def _centered_crop(
    K: Float[np.ndarray, "3 3"], size: tuple[int, int], target: tuple[int, int], where: str
) -> tuple[int, int, int, int]:
    """Largest whole-pixel window (left, top, width, height) of the target's aspect."""
    height, width = size
    half_width = min(K[0, 2], width - K[0, 2])
    half_height = min(K[1, 2], height - K[1, 2])
    if half_width <= 0.5 or half_height <= 0.5:
        raise DataError(
            f"{where}: principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f}) outside the image of "
            f"{width} x {height}; rebuild the shards from right intrinsics"
        )
    scale = min(half_width / target[1], half_height / target[0])
    crop_width = max(1, min(width, round(2 * scale * target[1])))
    crop_height = max(1, min(height, round(2 * scale * target[0])))
    left = min(max(0, round(K[0, 2] - crop_width / 2)), width - crop_width)
    top = min(max(0, round(K[1, 2] - crop_height / 2)), height - crop_height)
    return left, top, crop_width, crop_height
