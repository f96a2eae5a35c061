"""One image of MegaDepth becomes one frame, if all it needs is there."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from data_prep.converters.depth_files import depth_size
from data_prep.converters.lens import Lens
from data_prep.converters.matrices import check_K, rigid_from_matrix
from data_prep.converters.megadepth.depth import is_ordinal, load_depth, read_depth
from data_prep.converters.megadepth.intrinsics import undistorted_K
from data_prep.converters.photos import photo_size, read_photo
from data_prep.converters.rejects import RejectedError, reject_as
from data_prep.problems import Problems
from data_prep.scene import Frame


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """An image with its files and camera, none of them looked at."""

    photo: Path
    depth: Path
    camera: Lens | Float64[np.ndarray, "3 3"]
    """The camera of the photo before it was undistorted, or K of the image itself."""
    cam_from_world: Float64[np.ndarray, "4 4"]
    name: str
    """Its name in the SfM model."""


def build_frames(
    candidates: Iterable[Candidate], problems: Problems
) -> Iterator[tuple[str, Frame]]:
    """Give the frames that can be used, with their names in the SfM model.

    Depth maps are read here, one at a time, because nothing but the numbers tells ordinal ones.

    Args:
        candidates: Images with their files.
        problems: Told about the others.
    """
    for candidate in candidates:
        try:
            yield candidate.name, _build_frame(candidate)
        except RejectedError as error:
            problems.add(*error.problem)


def _build_frame(candidate: Candidate) -> Frame:
    photo, depth = candidate.photo, candidate.depth
    with reject_as("bad_photo", photo):
        size = photo_size(photo)
    with reject_as("bad_depth", depth):
        found = depth_size(depth)
    if found != size:
        raise RejectedError(
            "size_mismatch", photo, f"image of (height, width) {size}, its depth has {found}"
        )
    with reject_as("bad_camera", photo):
        camera = candidate.camera
        K = undistorted_K(camera, size) if isinstance(camera, Lens) else camera
        check_K(K, size)
    with reject_as("bad_pose", photo):
        world_from_cam = np.linalg.inv(rigid_from_matrix(candidate.cam_from_world))
    with reject_as("bad_depth", depth):
        stored = load_depth(depth, size)
    if is_ordinal(stored):
        raise RejectedError("ordinal_depth", depth, "labels of two surfaces, no depth")
    if not stored.any():
        raise RejectedError("empty_depth", depth, "no pixel has depth")
    return Frame(
        name=photo.name,
        image_size=size,
        K=K,
        world_from_cam=world_from_cam,
        read_image=partial(read_photo, photo, size),
        read_depth=partial(read_depth, depth, size),
    )
