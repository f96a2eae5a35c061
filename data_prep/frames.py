"""Frames as shards store them: reduced, never enlarged, and kept while graphs share them."""

from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from data_prep.scene import Frame, Scene
from l3r.errors import DataError
from l3r.geometry.camera import resize_K

SHORT_SIDE = 480
"""A reduced image keeps at least this on its short side [px]."""
LONG_SIDE = 640
"""A reduced image keeps at least this on its long side [px]."""

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


def reduced_size(image_size: tuple[int, int]) -> tuple[int, int]:
    """Give (height, width) of the smallest copy that keeps both sides long enough.

    Args:
        image_size: (height, width) of the source.
    """
    scale = min(1.0, max(SHORT_SIDE / min(image_size), LONG_SIDE / max(image_size)))
    height, width = image_size
    return round(scale * height), round(scale * width)


def reduce_frame(frame: Frame) -> StoredFrame:
    """Read a frame and shrink it: colour by area, depth by nearest pixel, K along with them.

    Raises:
        DataError: The pixels cannot be read or are of another size than the frame says.
    """
    image, depth = frame.read_image(), frame.read_depth()
    for name, shape in (("image", image.shape[:2]), ("depth", depth.shape)):
        if shape != frame.image_size:
            raise DataError(
                f"{frame.name}: {name} is {shape}, expected (height, width) {frame.image_size};"
                " unpack the source again"
            )
    height, width = reduced_size(frame.image_size)
    if (height, width) != frame.image_size:
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        # Plain INTER_NEAREST takes the corner of each cell, half a pixel off its centre.
        depth = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    scale_y, scale_x = height / frame.image_size[0], width / frame.image_size[1]
    K = resize_K(torch.from_numpy(frame.K), scale_x, scale_y).numpy()
    return StoredFrame(image=np.asarray(image), depth=np.asarray(depth), K=K)


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
        frame = reduce_frame(self.scene.frames[index])
        self._kept[index] = frame
        self._size += frame.image.nbytes + frame.depth.nbytes
        while self._size > self.budget and len(self._kept) > 1:
            _, oldest = self._kept.popitem(last=False)
            self._size -= oldest.image.nbytes + oldest.depth.nbytes
        return frame
