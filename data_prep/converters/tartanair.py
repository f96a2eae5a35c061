"""TartanAir V1: ``ENV/LEVEL/PNNN/{image_left, depth_left, pose_left.txt}``.

Poses, axes and intrinsics: :mod:`data_prep.converters.trajectories`. Depth is ``.npy``, float32 z.
"""

import math
import os
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float32

from data_prep.converters import trajectories
from data_prep.converters.trajectories import Layout, Split, keep_known
from data_prep.problems import Problems
from data_prep.scene import Scene
from data_prep.survey import SceneSurvey
from l3r.errors import DataError

HELD_OUT = frozenset(
    f"{environment}/{trajectory}"
    for environment, held_out in {
        "abandonedfactory": "Easy/P011 Hard/P011",
        "abandonedfactory_night": "Easy/P013 Hard/P014",
        "amusement": "Easy/P008 Hard/P007",
        "carwelding": "Easy/P007",
        "endofworld": "Easy/P009",
        "gascola": "Easy/P008 Hard/P009",
        "hospital": "Easy/P036 Hard/P049",
        "japanesealley": "Easy/P007 Hard/P005",
        "neighborhood": "Easy/P021 Hard/P017",
        "ocean": "Easy/P013 Hard/P009",
        "office": "Hard/P007",
        "office2": "Easy/P011 Hard/P010",
        "oldtown": "Easy/P007 Hard/P008",
        "seasidetown": "Easy/P009",
        "seasonsforest": "Easy/P011 Hard/P006",
        "seasonsforest_winter": "Easy/P009 Hard/P018",
        "soulcity": "Easy/P012 Hard/P009",
        "westerndesert": "Easy/P013 Hard/P007",
    }.items()
    for trajectory in held_out.split()
)
"""The 32 trajectories DROID-SLAM keeps for testing: the public convention."""


def read(
    root: Path,
    split: Split = "train",
    *,
    scenes: str = "*",
    frame_step: int = 1,
    problems: Problems,
    names: Collection[str] | None = None,
) -> Iterator[Scene]:
    """Find trajectories and read their cameras; pixels follow when asked for.

    Args:
        root: Any folder above the trajectories.
        split: ``train`` leaves :data:`HELD_OUT` out, ``test`` is that list, ``all`` is both.
        scenes: Pattern on ``ENV/LEVEL/PNNN``.
        frame_step: Take every so many frames.
        problems: Told about what is left out.
        names: Only scenes of these names; where given, that none of them can be read is no error.

    Yields:
        One scene per trajectory, sorted by name.

    Raises:
        DataError: There is no trajectory, none is asked for, or none of those can be read.
    """
    chosen = trajectories.choose_trajectories(root, LAYOUT, problems, split=split, scenes=scenes)
    yield from trajectories.read_scenes(
        chosen, LAYOUT, problems, dataset="tartanair", frame_step=frame_step, names=names
    )


def list_names(root: Path, split: Split, *, scenes: str, problems: Problems) -> list[str]:
    """List the names of what :func:`read` reads, in its order; arguments and errors are its own."""
    return list(
        trajectories.choose_trajectories(root, LAYOUT, problems, split=split, scenes=scenes)
    )


def survey(root: Path) -> Iterator[SceneSurvey]:
    """List the trajectories, in seconds.

    Raises:
        DataError: There is none.
    """
    return trajectories.survey(root, LAYOUT)


def read_npy_depth(path: Path, image_size: tuple[int, int]) -> Float32[np.ndarray, "h w"]:
    """Read z [m]; sky, what is not finite and what is not positive become 0.

    Raises:
        DataError: It is cut off, or not float32 of the image's size.
    """
    try:
        with path.open("rb") as stream:
            header = _read_header(stream)
            size = os.fstat(stream.fileno()).st_size - stream.tell()
            # Before anything is allocated: a damaged header may ask for any size.
            if header == _HEADER.format(*image_size) and size == 4 * math.prod(image_size):
                return keep_known(np.fromfile(stream, "<f4").reshape(image_size))
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; check the file and its permissions") from error
    raise DataError(
        f"{path}: {header[:80]!r} and {size} bytes, expected a whole float32 array of"
        f" {image_size}, row by row, as the image; unpack the archive again"
    )


def _read_header(stream: BinaryIO) -> str:
    """Give the text that describes the array; numpy's own reader raises anything on damage."""
    head = stream.read(10)
    if len(head) < 10 or head[:8] != b"\x93NUMPY\x01\x00":
        return "no array"
    return stream.read(int.from_bytes(head[8:], "little")).decode("latin-1").rstrip()


_HEADER = "{{'descr': '<f4', 'fortran_order': False, 'shape': ({}, {}), }}"

LAYOUT = Layout(
    title="TartanAir V1",
    poses="pose_left.txt",
    image_folder="image_left",
    image_ending="_left.png",
    depth_folder="depth_left",
    depth_ending="_left_depth.npy",
    read_depth=read_npy_depth,
    held_out=HELD_OUT,
)
"""Names of its files."""
