"""Raw data sets and the modules that read them.

To add one: write ``data_prep/converters/NAME.py`` with ``read(root, split, *, scenes, frame_step)``
that yields scenes (see :mod:`data_prep.scene` and ``tartanair.py``), and name it below. ``build``
and ``cameras`` then offer it. Give it limits in ``data_prep/check.py`` once they were measured.
"""

import importlib
from collections.abc import Iterator
from pathlib import Path

from data_prep.scene import Scene

CONVERTERS = {"tartanair": "data_prep.converters.tartanair"}
"""Module of each raw data set; ``synthetic`` renders one in TartanAir's layout."""


def read_scenes(
    dataset: str, root: Path, split: str, *, scenes: str = "*", frame_step: int = 1
) -> Iterator[Scene]:
    """Read a raw data set by name.

    Args:
        dataset: A key of :data:`CONVERTERS`.
        root: Folder of the raw data.
        split: ``train``, ``test`` or ``all``.
        scenes: Pattern on scene names.
        frame_step: Take every so many frames.

    Raises:
        DataError: The data cannot be read.
    """
    module = importlib.import_module(CONVERTERS[dataset])
    found: Iterator[Scene] = module.read(root, split, scenes=scenes, frame_step=frame_step)
    return found
