"""One stored graph: a few images of one scene with cameras, depth and pairwise overlap."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from l3r.errors import DataError

SCHEMA_VERSION = 1
"""Version of everything in a folder of shards; a reader refuses any other."""

_ORTHONORMAL = 1e-6
"""Largest entry of R R^T - I; float64 cameras that come through JSON keep 1e-15."""


@dataclass(frozen=True, kw_only=True)
class PairTable:
    """How the images of a graph relate, one entry for each ordered pair."""

    iou: Float64[np.ndarray, "n n"]
    """Covisibility: visible in both over visible in either; 1 on the diagonal, symmetric."""
    covisible: Float64[np.ndarray, "n n"]
    """``[i, j]``: share of the known depth of i that j sees too; 1 on the diagonal."""
    score: Float64[np.ndarray, "n n"]
    """CroCo score IoU 4 cos a (1 - cos a), at least 0; 0 on the diagonal."""
    rotation: Float64[np.ndarray, "n n"]
    """Angle of the relative rotation [rad]."""
    axis: Float64[np.ndarray, "n n"]
    """Angle between the optical axes [rad]."""
    parallax: Float64[np.ndarray, "n n"]
    """Median angle at the common points [rad]; NaN where there are none, 0 on the diagonal."""

    def __getitem__(self, rows: slice) -> "PairTable":
        """Take the pairs among some of the images."""
        return PairTable(**{f.name: getattr(self, f.name)[rows, rows] for f in fields(self)})


@dataclass(frozen=True, kw_only=True)
class GraphSample:
    """A graph of n images in greedy order; images may differ in size."""

    dataset: str
    """Name of the data set."""
    scene: str
    """Name of the scene within it."""
    is_metric: bool
    """Whether lengths are metres."""
    file: list[str]
    """Source name of each image."""
    image: list[UInt8[np.ndarray, "_h _w 3"]]
    """RGB."""
    depth: list[Float32[np.ndarray, "_h _w"]]
    """z in the camera, 0 where unknown; 0 or 6.2e-5 to 65504, kept to a relative 2^-11."""
    K: Float64[np.ndarray, "n 3 3"]
    """Intrinsics in pixels of ``image``; centre of the top-left pixel at (0.5, 0.5)."""
    cam_from_world: Float64[np.ndarray, "n 4 4"]
    """Rigid; the world is the camera of the graph's first image, so the first is the identity."""
    pairs: PairTable
    """Pairwise overlap and angles."""

    @property
    def num_views(self) -> int:
        """Images of the graph."""
        return len(self.image)

    @property
    def image_size(self) -> list[tuple[int, int]]:
        """(height, width) of each image."""
        return [(image.shape[0], image.shape[1]) for image in self.image]


def check_cameras(
    K: Float64[np.ndarray, "n 3 3"], cam_from_world: Float64[np.ndarray, "n 4 4"], where: str
) -> None:
    """Refuse cameras no reader could use.

    Args:
        K: Intrinsics.
        cam_from_world: Rigid transforms.
        where: What the message begins with: the shard's key.

    Raises:
        DataError: A number is not finite, a focal length not positive, a rotation not orthonormal
            or a reflection, or the first camera not the world.
    """
    for view, (intrinsics, camera) in enumerate(zip(K, cam_from_world, strict=True)):
        problem = _find_problem(intrinsics, camera)
        if problem:
            raise DataError(f"{where}: image {view:02d}: {problem}; rebuild it with l3r-prep")
    if not np.allclose(cam_from_world[0], np.eye(4), atol=_ORTHONORMAL):
        raise DataError(
            f"{where}: cam_from_world of image 00 is not the identity, expected the graph's first"
            " camera as its world; rebuild it with l3r-prep"
        )


def _find_problem(K: Float64[np.ndarray, "3 3"], cam_from_world: Float64[np.ndarray, "4 4"]) -> str:
    if not np.isfinite(K).all() or not np.isfinite(cam_from_world).all():
        return "K or cam_from_world holds a NaN or an infinity, expected finite numbers"
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.array_equal(K[2], [0, 0, 1])):
        return f"K is {K.tolist()}, expected positive focal lengths and a last row 0 0 1"
    rotation = cam_from_world[:3, :3]
    # A turn has no entry above 1; the square of a huge one would overflow.
    bounded = np.clip(rotation, -2, 2)
    error = float(np.abs(bounded @ bounded.T - np.eye(3)).max())
    if error > _ORTHONORMAL or np.linalg.det(bounded) < 0:
        return (
            f"cam_from_world is off a rotation by {error:.1e}, expected {_ORTHONORMAL:.0e} or less"
        )
    if not np.array_equal(cam_from_world[3], [0, 0, 0, 1]):
        return f"cam_from_world ends in {cam_from_world[3].tolist()}, expected 0 0 0 1"
    return ""
