"""Cameras with lens distortion, as COLMAP models them, and the images of pinholes made from them.

Pixel coordinates are COLMAP's, which are the project's: the centre of the top-left pixel is
(0.5, 0.5). OpenCV's remapping counts from pixel centres, so half a pixel is taken off there, and
nowhere else.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, UInt8

from data_prep.converters.depth_files import read_depth_file
from data_prep.converters.photos import read_photo
from l3r.errors import DataError

MAX_SIDE = 30_000
"""Images with a longer side are refused; OpenCV remaps none above 32,767 [px]."""

_PINHOLE = ("PINHOLE", "SIMPLE_PINHOLE")
_POLYNOMIAL = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Models that are a pinhole where all their coefficients are 0."""
_MIN_FOCAL, _MAX_FOCAL = 0.05, 100.0
"""Focal lengths outside are damage, in units of the longer side."""
_MAX_COEFFICIENT = 1000.0
"""Rational models of real lenses stay below."""
_SAME_SURFACE = 0.02
"""Depths that differ by less than this share are interpolated between."""
_BLOCK = 2**20
"""Pixels mapped at once."""


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A camera as plain values, which travel between processes; build it by :func:`build_lens`."""

    model: str
    """COLMAP's name of the model."""
    image_size: tuple[int, int]
    """(height, width)."""
    params: tuple[float, ...]
    """COLMAP's parameters of the model [px and none]."""

    def to_colmap(self) -> pycolmap.Camera:
        """Give pycolmap's form."""
        height, width = self.image_size
        return pycolmap.Camera(model=self.model, width=width, height=height, params=self.params)

    @property
    def K(self) -> Float64[np.ndarray, "3 3"]:
        """Intrinsics [px], distortion left aside."""
        return np.asarray(self.to_colmap().calibration_matrix(), dtype=np.float64)

    @property
    def is_distorted(self) -> bool:
        """Whether straight lines come out bent. A fisheye is, whatever its coefficients."""
        if self.model not in _POLYNOMIAL:
            return self.model not in _PINHOLE
        return any(self.params[len(self.to_colmap().focal_length_idxs()) + 2 :])


def build_lens(model: int | str, image_size: tuple[int, int], params: tuple[float, ...]) -> Lens:
    """Check a camera before pycolmap computes with it.

    Args:
        model: COLMAP's number or name.
        image_size: (height, width).
        params: As many as the model has.

    Raises:
        DataError: The model is unknown or no perspective one, or the values are no lens's.
    """
    members = pycolmap.CameraModelId.__members__
    names = [name for name, number in members.items() if model in (name, int(number))]
    if not names or names[0] == "INVALID":
        raise DataError(f"camera model {model!r}, expected one of COLMAP's; export the model again")
    if not all(1 <= side <= MAX_SIDE for side in image_size):
        raise DataError(
            f"camera of {image_size[1]}x{image_size[0]} pixels, expected sides from 1 to {MAX_SIDE}"
        )
    lens = Lens(model=names[0], image_size=image_size, params=tuple(params))
    camera = lens.to_colmap()
    if not (all(map(math.isfinite, params)) and camera.verify_params()):
        raise DataError(f"{lens.model} has {list(params)}, expected finite {camera.params_info}")
    if not camera.is_perspective():
        raise DataError(f"{lens.model} has no focal length, expected a perspective or fisheye lens")
    if camera.has_bogus_params(_MIN_FOCAL, _MAX_FOCAL, _MAX_COEFFICIENT):
        raise DataError(
            f"{lens.model} has {camera.params_info} = {list(params)} for {image_size[1]}x"
            f"{image_size[0]} pixels, which no lens has; export the model again"
        )
    return lens


def undistort_lens(lens: Lens) -> Lens:
    """Give the pinhole camera that COLMAP's ``image_undistorter`` makes of a camera.

    Its axes and centre are the distorted camera's own; all its pixels are seen by that camera.
    """
    target = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens.to_colmap())
    return build_lens("PINHOLE", (target.height, target.width), tuple(map(float, target.params)))


def read_undistorted_photo(path: Path, lens: Lens, target: Lens) -> UInt8[np.ndarray, "_h _w 3"]:
    """Read a photo as a pinhole camera would have taken it, as RGB.

    Args:
        path: The distorted photo.
        lens: Its camera.
        target: The pinhole camera.

    Raises:
        DataError: The photo is damaged or of another size than the camera.
    """
    image = read_photo(path, lens.image_size)
    map_x, map_y = _sampling_map(lens, target)
    return np.asarray(cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR))


def read_undistorted_depth(
    path: Path, scale: float, lens: Lens, target: Lens
) -> Float32[np.ndarray, "_h _w"]:
    """Read the depth map of a distorted photo as the pinhole camera sees it.

    z stays what it is. Inverse depth is interpolated, which is exact on a plane; at edges the
    nearest pixel is taken.

    Args:
        path: The distorted depth map.
        scale: What to multiply the stored numbers by.
        lens: Camera of the photo.
        target: The pinhole camera.

    Raises:
        DataError: The file is damaged or of another size than the camera.
    """
    depth = read_depth_file(path, scale, lens.image_size)
    map_x, map_y = _sampling_map(lens, target)
    nearest = cv2.remap(depth, map_x, map_y, cv2.INTER_NEAREST)
    known = (depth > 0).astype(np.float32)
    inverse = np.divide(known, depth, out=np.zeros_like(depth), where=depth > 0)
    weight = cv2.remap(known, map_x, map_y, cv2.INTER_LINEAR)
    inverse = cv2.remap(inverse, map_x, map_y, cv2.INTER_LINEAR)
    between = np.divide(weight, inverse, out=np.zeros_like(inverse), where=inverse > 0)
    same = np.abs(between - nearest) <= _SAME_SURFACE * nearest
    return np.asarray(np.where(same, between, nearest), dtype=np.float32)


@lru_cache(maxsize=1)
def _sampling_map(
    lens: Lens, target: Lens
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Where OpenCV finds each target pixel; photos of a folder mostly share one lens."""
    height, width = target.image_size
    rays_from_pixels = np.linalg.inv(target.K).T
    camera = lens.to_colmap()
    places = np.empty((height, width, 2), dtype=np.float32)
    rows = max(1, _BLOCK // width)
    for top in range(0, height, rows):
        y, x = np.mgrid[top : min(top + rows, height), :width].astype(np.float64) + 0.5
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ rays_from_pixels
        found = np.nan_to_num(camera.img_from_cam(rays), nan=-1e4, posinf=-1e4, neginf=-1e4)
        places[top : top + rows] = (found - 0.5).reshape(*x.shape, 2)
    return np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1])
