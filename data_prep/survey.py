"""What a raw data set holds, found without reading pixels."""

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
