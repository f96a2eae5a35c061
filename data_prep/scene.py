"""What a converter returns: scenes whose pixels are read frame by frame."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One image with its camera; the pixels stay on the disk until they are asked for."""

    name: str
    """Source name, unique within the scene."""
    image_size: tuple[int, int]
    """(height, width)."""
    K: Float64[np.ndarray, "3 3"]
    """Intrinsics in pixels; centre of the top-left pixel at (0.5, 0.5)."""
    world_from_cam: Float64[np.ndarray, "4 4"]
    """Rigid; OpenCV camera axes, any world."""
    read_image: Callable[[], UInt8[np.ndarray, "_h _w 3"]]
    """Give the RGB pixels; raises DataError."""
    read_depth: Callable[[], Float32[np.ndarray, "_h _w"]]
    """Give z in the camera, 0 where unknown; raises DataError."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Frames that share one world."""

    dataset: str
    """Name of the data set."""
    name: str
    """Name within the data set, parts joined by slashes."""
    is_metric: bool
    """Whether lengths are metres."""
    frames: list[Frame]
    """In the order of the source."""

    @property
    def slug(self) -> str:
        """Name fit for a key or a file: only letters, digits, ``-`` and ``_``."""
        return "".join(c if c.isalnum() or c in "-_" else "-" for c in self.name)

    @property
    def intrinsics(self) -> Float64[np.ndarray, "n 3 3"]:
        """K of all frames."""
        return np.stack([frame.K for frame in self.frames])

    @property
    def world_from_cam(self) -> Float64[np.ndarray, "n 4 4"]:
        """Cameras of all frames."""
        return np.stack([frame.world_from_cam for frame in self.frames])
