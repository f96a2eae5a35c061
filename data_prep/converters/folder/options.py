"""``scene.json``: what a folder cannot say of itself. Every entry may be left out.

::

    {"metric": true, "depth_scale": 0.001, "cameras": "sparse/1", "image_folder": "photos",
     "depth_folder": "lidar"}

Other keys are notes of the user's own, unless they look like one of these misspelled.
"""

import difflib
import json
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from l3r.errors import DataError

FILE = "scene.json"

MAX_BYTES = 2**28
"""Larger JSON files are refused."""


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """What ``scene.json`` says."""

    metric: bool = False
    """Whether the cameras' unit is the metre."""
    depth_scale: float | None = None
    """What to multiply stored depth by to get the cameras' unit; by default 0.001 for PNG, which
    is millimetres where that unit is the metre, and 1 for npy and h5."""
    cameras: str = ""
    """COLMAP model, ``transforms.json`` or ``cameras.json`` to read, relative to the scene; by
    default the first that is found."""
    image_folder: str = "images"
    """Folder that names of photos are relative to."""
    depth_folder: str = "depth"
    """Folder of depth maps, named as the photos are."""

    def scale_of(self, depth: Path) -> float:
        """What to multiply the numbers of a depth map by."""
        if self.depth_scale is not None:
            return float(self.depth_scale)
        return 0.001 if depth.suffix == ".png" else 1.0


def read_options(folder: Path) -> SceneOptions:
    """Read a scene's ``scene.json``; without one everything is as by default.

    Raises:
        DataError: It is damaged, or an entry is of another type or looks misspelled.
    """
    path = folder / FILE
    if not path.is_file():
        return SceneOptions()
    table = read_json(path)
    if not isinstance(table, dict):
        raise DataError(f"{path}: no object; expected {{...}}")
    known = [field.name for field in fields(SceneOptions)]
    for key in set(table) - set(known):
        if near := difflib.get_close_matches(key, known, n=1, cutoff=0.8):
            raise DataError(f"{path}: '{key}' is unknown; did you mean '{near[0]}'?")
    given = {key: table[key] for key in known if key in table}
    for key, value in given.items():
        if fault := _find_fault(key, value):
            raise DataError(f"{path}: '{key}' is {value!r}, expected {fault}")
    return SceneOptions(**given)


def _find_fault(key: str, value: Any) -> str:
    """Say what an entry should be; empty where it is."""
    if key == "metric":
        return "" if isinstance(value, bool) else "true or false"
    if key == "depth_scale":
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return "" if is_number and 0.0 < value < math.inf else "a number above 0"
    return "" if isinstance(value, str) else "a path"


def read_json(path: Path) -> Any:
    """Read a JSON file of any content.

    Raises:
        DataError: It is missing, too large or damaged.
    """
    try:
        if (size := path.stat().st_size) > MAX_BYTES:
            raise DataError(f"{path}: {size:,} bytes, expected {MAX_BYTES:,} or less")
        return json.loads(path.read_bytes())
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; check the file and its permissions") from error
    except (ValueError, RecursionError) as error:
        reason = str(error).split("\n")[0][:120]
        raise DataError(f"{path}: not valid JSON ({reason}); write it again") from error
