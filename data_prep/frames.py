"""Frames as shards store them: reduced, never enlarged, and kept while graphs share them."""

from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from data_prep.scene import Frame, Scene
from data_prep.stored_size import reduced_size
from l3r.errors import DataError
from l3r.geometry.camera import resize_K

STORABLE = (float(np.finfo(np.float16).smallest_normal), float(np.finfo(np.float16).max))
"""Least and largest depth that shards hold, as half floats with all their digits."""

_BUDGET = 256 * 2**20


@dataclass(frozen=True, kw_only=True)
class StoredFrame:
    """Pixels of a frame at the size they are stored in."""

    image: UInt8[np.ndarray, "h w 3"]
    """RGB."""
    depth: Float32[np.ndarray, "h w"]
    """z in the camera, 0 where unknown."""
    K: Float64[np.ndarray, "3 3"]
    """Intrinsics in pixels of ``image``."""


def reduce_frame(frame: Frame, *, sparse: bool = False) -> StoredFrame:
    """Read a frame and shrink it: colour by area, depth by nearest pixel, K along with them.

    Depth that is known at scattered pixels only goes to the pixel it falls into, the nearest
    surface first: the nearest pixel's depth would lose most of it.

    Args:
        frame: It.
        sparse: Whether depth is known at scattered pixels only.

    Raises:
        DataError: The pixels cannot be read or are of another size than the frame says.
    """
    image, depth = read_image(frame), read_depth(frame)
    height, width = reduced_size(frame.image_size)
    if (height, width) != frame.image_size:
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        if sparse:
            depth = _pool_depth(depth, (height, width))
        else:
            # Plain INTER_NEAREST takes the corner of each cell, half a pixel off its centre.
            depth = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    scale_y, scale_x = height / frame.image_size[0], width / frame.image_size[1]
    K = resize_K(torch.from_numpy(frame.K), scale_x, scale_y).numpy()
    return StoredFrame(image=np.asarray(image), depth=np.asarray(depth), K=K)


def read_image(frame: Frame) -> UInt8[np.ndarray, "h w 3"]:
    """Read a frame's image.

    Raises:
        DataError: It cannot be read or is of another size than the frame says.
    """
    image = frame.read_image()
    _check_size(frame, "image", image.shape[:2])
    return image


def read_depth(frame: Frame) -> Float32[np.ndarray, "h w"]:
    """Read a frame's depth; what shards cannot hold becomes 0, unknown.

    Raises:
        DataError: It cannot be read or is of another size than the frame says.
    """
    depth = frame.read_depth()
    _check_size(frame, "depth", depth.shape)
    return np.where((depth >= STORABLE[0]) & (depth <= STORABLE[1]), depth, np.float32(0))


def _check_size(frame: Frame, name: str, shape: tuple[int, ...]) -> None:
    if shape != frame.image_size:
        raise DataError(
            f"{frame.name}: {name} is {shape}, expected (height, width) {frame.image_size};"
            " unpack the source again"
        )


def _pool_depth(
    depth: Float32[np.ndarray, "_h _w"], image_size: tuple[int, int]
) -> Float32[np.ndarray, "h w"]:
    """Give each pixel the least known depth whose centre falls into it; 0 where none does."""
    height, width = image_size
    rows, columns = np.nonzero(depth > 0)
    # Centres in halves of a source pixel, so that nothing is rounded.
    row = (2 * rows + 1) * height // (2 * depth.shape[0])
    column = (2 * columns + 1) * width // (2 * depth.shape[1])
    least = np.full(image_size, np.inf, dtype=np.float32)
    np.minimum.at(least, (row, column), depth[rows, columns])
    return np.where(np.isfinite(least), least, np.float32(0))


class FrameCache:
    """Frames of a scene, the latest ones kept: graphs of a shard share many.

    Args:
        scene: Where the frames come from.
        budget: Bytes of pixels to keep.
    """

    def __init__(self, scene: Scene, budget: int = _BUDGET) -> None:
        self.scene = scene
        self.budget = budget
        self._kept: OrderedDict[int, StoredFrame] = OrderedDict()
        self._size = 0

    def read(self, index: int) -> StoredFrame:
        """Give a frame, from memory where it was read lately.

        Raises:
            DataError: The pixels cannot be read.
        """
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        frame = reduce_frame(self.scene.frames[index], sparse=self.scene.has_sparse_depth)
        self._kept[index] = frame
        self._size += frame.image.nbytes + frame.depth.nbytes
        while self._size > self.budget and len(self._kept) > 1:
            _, oldest = self._kept.popitem(last=False)
            self._size -= oldest.image.nbytes + oldest.depth.nbytes
        return frame
