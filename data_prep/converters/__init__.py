"""Raw data sets and the modules that read them.

To add one: write a module or package ``data_prep/converters/NAME`` with these three functions, and
name it below; ``build``, ``cameras`` and ``inspect`` then offer it::

    list_names(root, split, *, scenes, problems) -> list[str]
    read(root, split, *, scenes, frame_step, problems, names) -> Iterator[Scene]
    survey(root) -> Iterator[SceneSurvey]

``list_names`` gives the names of what ``read`` would give, in one fixed order and without opening
what is large, so that a build can be shared out. ``read`` streams: a scene holds cameras and names,
its pixels follow frame by frame when asked for. What cannot be used is counted in ``problems``, a
scene's own inside ``with problems.about(name)``, and left out; DataError is for a root of which
nothing can be read. Every convention of the source is translated there, once: K in pixels with the
centre of the top-left pixel at (0.5, 0.5), OpenCV camera axes, ``world_from_cam`` rigid, depth z,
0 where unknown. ``survey`` lists what is there in seconds, without pixels. Give the data set limits
in ``data_prep/check/limits.py`` once they were measured.
"""

import importlib
from collections.abc import Collection, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from data_prep.problems import Problems
from data_prep.scene import Scene
from data_prep.survey import SceneSurvey
from l3r.errors import DataError

CONVERTERS = {
    "tartanair": "data_prep.converters.tartanair",
    "tartanair_v2": "data_prep.converters.tartanair_v2",
    "waymo": "data_prep.converters.waymo",
    "co3d": "data_prep.converters.co3d",
    "megadepth": "data_prep.converters.megadepth",
    "folder": "data_prep.converters.folder",
}
"""Module of each raw data set; ``synthetic`` renders one in TartanAir's layout."""
WITH_EXCLUDED = {"megadepth"}
"""Those that leave scenes out by default because other benchmarks are made of them."""


def read_scenes(
    dataset: str,
    root: Path,
    split: str,
    *,
    scenes: str = "*",
    frame_step: int = 1,
    problems: Problems,
    names: Collection[str] | None = None,
    include_excluded: bool = False,
) -> Iterator[Scene]:
    """Read a raw data set by name.

    Args:
        dataset: A key of :data:`CONVERTERS`.
        root: Folder of the raw data.
        split: ``train``, ``test`` or ``all``.
        scenes: Pattern on scene names.
        frame_step: Take every so many frames.
        problems: Told about what is left out.
        names: Only scenes of these names; where given, that none of them can be read is no error.
        include_excluded: Also take scenes that hold evaluation sets (MegaDepth alone).

    Raises:
        DataError: Nothing can be read, or nothing is excluded from this data set.
    """
    found: Iterator[Scene] = _load(dataset).read(
        root,
        split,
        scenes=scenes,
        frame_step=frame_step,
        problems=problems,
        names=names,
        **_options(dataset, include_excluded=include_excluded),
    )
    return found


def list_scenes(
    dataset: str,
    root: Path,
    split: str,
    *,
    scenes: str = "*",
    problems: Problems,
    include_excluded: bool = False,
) -> list[str]:
    """List the names of what :func:`read_scenes` reads, always in one order.

    Some of them may turn out to have no usable frame.

    Args:
        dataset: A key of :data:`CONVERTERS`.
        root: Folder of the raw data.
        split: ``train``, ``test`` or ``all``.
        scenes: Pattern on scene names.
        problems: Told about what is left out before any scene is opened.
        include_excluded: Also scenes that hold evaluation sets (MegaDepth alone).

    Raises:
        DataError: Nothing can be read, or nothing is excluded from this data set.
    """
    found: list[str] = _load(dataset).list_names(
        root,
        split,
        scenes=scenes,
        problems=problems,
        **_options(dataset, include_excluded=include_excluded),
    )
    return found


def _options(dataset: str, *, include_excluded: bool) -> dict[str, Any]:
    if include_excluded and dataset not in WITH_EXCLUDED:
        raise DataError(f"--include-excluded has no effect on {dataset}; leave it out")
    return {"include_excluded": True} if include_excluded else {}


def survey_scenes(dataset: str, root: Path) -> Iterator[SceneSurvey]:
    """List the scenes of a raw data set by name, in seconds.

    Args:
        dataset: A key of :data:`CONVERTERS`.
        root: Folder of the raw data.

    Raises:
        DataError: Nothing can be read.
    """
    found: Iterator[SceneSurvey] = _load(dataset).survey(root)
    return found


def _load(dataset: str) -> ModuleType:
    """Import a converter; it alone imports what its formats need."""
    return importlib.import_module(CONVERTERS[dataset])
