"""What a raw data set holds, found without reading pixels."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class SceneSurvey:
    """One scene of a raw data set, as :mod:`data_prep.commands.inspect` lists it."""

    name: str
    """Name within the data set, as the converter gives it."""
    num_images: int
    """Images with all that a frame needs."""
    image_size: tuple[int, int] | None
    """(height, width) of its first image; None where there is none."""
    num_missing: int = 0
    """Images that lack something: depth, mask, camera, or the file itself."""
    excluded: str = ""
    """Why ``build`` leaves the scene out by default, such as ``held out for testing``, or empty."""


def quota(num_images: int, num_graphs: int, graphs_per_image: float) -> int:
    """Tell how many graphs a scene may have.

    Args:
        num_images: Images of the scene.
        num_graphs: The most graphs of any scene.
        graphs_per_image: Graphs for each image of the scene, rounded up.
    """
    # 0.1 * 30 is a little more than 3.
    return min(num_graphs, max(1, math.ceil(graphs_per_image * num_images - 1e-9)))
