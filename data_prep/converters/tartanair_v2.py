"""TartanAir V2: ``ENV/Data_LEVEL/PNNN/{image_lcam_front, depth_lcam_front, pose_lcam_front.txt}``.

Poses, axes and intrinsics: :mod:`data_prep.converters.trajectories`. A depth map is a PNG of four
8-bit channels whose bytes, in the order blue, green, red, alpha, are a little-endian float32 z.
Only the left front camera is read.
"""

from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from data_prep.converters import trajectories
from data_prep.converters.png import read_png_bgra
from data_prep.converters.trajectories import Layout, Split, keep_known
from data_prep.problems import Problems
from data_prep.scene import Scene
from data_prep.survey import SceneSurvey


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
        split: No list of test trajectories is published: ``train`` and ``all`` are everything.
        scenes: Pattern on ``ENV/Data_LEVEL/PNNN``.
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
        chosen, LAYOUT, problems, dataset="tartanair_v2", frame_step=frame_step, names=names
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


def read_png_depth(path: Path, image_size: tuple[int, int]) -> Float32[np.ndarray, "h w"]:
    """Read z [m]; sky, what is not finite and what is not positive become 0.

    Raises:
        DataError: It is cut off, damaged, of another size or not of four 8-bit channels.
    """
    return keep_known(read_png_bgra(path, image_size).view("<f4")[..., 0])


LAYOUT = Layout(
    title="TartanAir V2",
    poses="pose_lcam_front.txt",
    image_folder="image_lcam_front",
    image_ending="_lcam_front.png",
    depth_folder="depth_lcam_front",
    depth_ending="_lcam_front_depth.png",
    read_depth=read_png_depth,
    held_out=frozenset(),
)
"""Names of its files."""
