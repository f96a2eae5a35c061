"""An image and its camera, whichever tool wrote them, in one form."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from data_prep.converters.folder.options import SceneOptions
from data_prep.converters.lens import Lens
from data_prep.converters.paths import join_inside
from data_prep.converters.photos import SUFFIXES
from data_prep.problems import Problems
from l3r.errors import DataError

_WORKSPACES = ("colmap", "dense")
"""Folders that hold a model and may hold its photos."""


@dataclass(frozen=True, kw_only=True)
class View:
    """A photo with its camera, neither opened."""

    name: str
    """As the source names it."""
    photo: Path
    """The file."""
    image_size: tuple[int, int]
    """(height, width) that the camera is for."""
    K: Float64[np.ndarray, "3 3"]
    """Intrinsics in pixels of the photo; centre of the top-left pixel at (0.5, 0.5)."""
    lens: Lens | None
    """The camera where the photo is distorted; ``K`` is its undistorted part then."""
    world_from_cam: Float64[np.ndarray, "4 4"]
    """Rigid; OpenCV axes."""
    depth_name: str = ""
    """Its depth map, where the source names one."""


class PhotoFinder:
    """Finds photos by the names that sources give them.

    Args:
        folder: The scene's folder.
        source: What names them.
        options: Says which folder the photos are in.
    """

    def __init__(self, folder: Path, source: Path, options: SceneOptions) -> None:
        self.folder = folder
        parts = source.relative_to(folder).parts
        bases = (folder, folder.joinpath(*(part for part in parts[:1] if part in _WORKSPACES)))
        self._folders = [
            *(join_inside(base, options.image_folder) for base in bases),
            *bases,
        ]

    def find(self, name: str, problems: Problems) -> Path | None:
        """Give the file of a photo, or report and give None.

        Args:
            name: As the source has it; its ending may be missing.
            problems: Told about a name that leads out of the scene, and about a missing file.
        """
        try:
            places = [join_inside(folder, name) for folder in self._folders]
        except DataError as error:
            problems.add("unsafe_path", self.folder, str(error))
            return None
        for place in places:
            for path in (place, *(place.with_name(place.name + suffix) for suffix in SUFFIXES)):
                if path.is_file():
                    return path
        problems.add("missing_photo", places[0], "no such file")
        return None
