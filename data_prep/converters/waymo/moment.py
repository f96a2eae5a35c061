"""What both versions of the data set are read into: all cameras and lasers at one time."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from data_prep.converters.waymo.calibration import Camera


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One camera image."""

    camera: Camera
    """What took it."""
    world_from_cam: Float64[np.ndarray, "4 4"]
    """Camera at the image's own time: the vehicle pose stored with the image, not the frame's."""
    read_image: Callable[[], UInt8[np.ndarray, "h w 3"]]
    """Give the undistorted pixels; raises DataError."""
    read_depth: Callable[[], Float32[np.ndarray, "h w"]]
    """Give the sparse depth; raises DataError."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """One turn of the top laser and the images taken meanwhile."""

    timestamp: int
    """Start of the turn [us]."""
    world_from_vehicle: Float64[np.ndarray, "4 4"]
    """The frame's own pose: that of the laser labels."""
    shots: list[Shot]
    """Images with all they need, by camera number."""
    has_lidar: bool
    """Whether any laser's range image can be placed."""
