"""What a converter returns: scenes whose pixels are read frame by frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.sparse import csr_array

from l3r.errors import DataError


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
    has_sparse_depth: bool = False
    """Whether depth is known at scattered pixels only, as lidar gives it."""
    read_overlap: Callable[[], csr_array] | None = None
    """Give the overlap (IoU of shared 3-D points) of all pairs that have any, as an n x n matrix,
    where the source knows it better than depth reprojection does; 1 on the diagonal."""

    @property
    def slug(self) -> str:
        """Name fit for a key or a file."""
        return slug_of(self.name)

    @property
    def intrinsics(self) -> Float64[np.ndarray, "n 3 3"]:
        """K of all frames."""
        return np.stack([frame.K for frame in self.frames])

    @property
    def world_from_cam(self) -> Float64[np.ndarray, "n 4 4"]:
        """Cameras of all frames."""
        return np.stack([frame.world_from_cam for frame in self.frames])

    def take(self, views: Sequence[int]) -> "Scene":
        """Keep some of the frames, and what is known of their overlap.

        Args:
            views: Numbers of the frames, in the order wanted.
        """
        frames = [self.frames[view] for view in views]
        if self.read_overlap is None:
            return replace(self, frames=frames)
        cut = partial(_cut_overlap, self.read_overlap, self.name, len(self.frames), list(views))
        return replace(self, frames=frames, read_overlap=cut)


def _cut_overlap(
    read: Callable[[], csr_array], name: str, num_frames: int, views: list[int]
) -> csr_array:
    whole = read()
    if whole.shape != (num_frames, num_frames):
        raise DataError(
            f"{name}: overlap of {whole.shape} images, expected one row and column for each of"
            f" {num_frames} frames; the source's points do not belong to its images"
        )
    return whole[views][:, views]


def slug_of(name: str) -> str:
    """Make a scene's name fit for a key or a file: only letters, digits, ``-`` and ``_``."""
    return "".join(c if c.isalnum() or c in "-_" else "-" for c in name)
