"""Trajectories of the TartanAir simulator: numbered images, depth and one file of poses.

Both releases store ``tx ty tz qx qy qz qw`` lines, world from body with axes x forward, y right,
z down; line i, from 0, belongs to image i. Here the camera's axes become OpenCV's and the world
stays as it is. Neither carries intrinsics: the focal length is half the width and the principal
point the image centre, as published for 640x480 and 640x640.
"""

import os
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import Rotation

from data_prep.converters.png import read_png, read_png_size
from data_prep.problems import Problems
from data_prep.scene import Frame, Scene
from data_prep.survey import SceneSurvey
from l3r.errors import DataError

Split = Literal["train", "test", "all"]

MAX_DEPTH = 1000.0
"""Depth beyond this is sky [m]."""
MAX_POSITION = 1e5
"""No camera stands farther from its world's origin [m]; what does is a damaged line."""

BODY_FROM_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Columns are OpenCV's x right, y down, z forward in body axes x forward, y right, z down."""

_UNIT = 1e-3
_MOST_POSES = 2**26
"""Bytes of a pose file: a trajectory has some thousand lines of 200."""

ReadDepth = Callable[[Path, tuple[int, int]], Float32[np.ndarray, "h w"]]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How one release names its files."""

    title: str
    """The release, as messages call it."""
    poses: str
    """File of poses in a trajectory's folder."""
    image_folder: str
    """Folder of images."""
    image_ending: str
    """What follows the six digits of an image's number."""
    depth_folder: str
    """Folder of depth maps."""
    depth_ending: str
    """What follows the six digits of a depth map's number."""
    read_depth: ReadDepth
    """Read a depth map of a given size; a function of a module, since workers pickle it."""
    held_out: frozenset[str]
    """Trajectories never trained on."""

    def is_in(self, name: str, split: Split) -> bool:
        """Whether a trajectory belongs to a split."""
        return split == "all" or (name in self.held_out) == (split == "test")


def choose_trajectories(
    root: Path, layout: Layout, problems: Problems, *, split: Split, scenes: str
) -> dict[str, Path]:
    """Find the trajectories of a split whose name matches a pattern, sorted by name.

    Raises:
        DataError: There is none, or none is asked for.
    """
    found = find_trajectories(root, layout, problems)
    chosen = {
        name: path
        for name, path in found.items()
        if layout.is_in(name, split) and fnmatch(name, scenes)
    }
    if not chosen:
        raise DataError(
            f"{root}: none of {len(found)} trajectories ({min(found)}, ...) is in split '{split}'"
            f" and matches '{scenes}'; change --split or --scenes"
        )
    return chosen


def read_scenes(
    chosen: dict[str, Path],
    layout: Layout,
    problems: Problems,
    *,
    dataset: str,
    frame_step: int,
    names: Collection[str] | None,
) -> Iterator[Scene]:
    """Read trajectories one by one.

    Args:
        chosen: Folders by name.
        layout: The release.
        problems: Told about frames and trajectories that are left out.
        dataset: Name the scenes carry.
        frame_step: Take every so many frames.
        names: Only these of them, and no error if none has a frame.

    Raises:
        DataError: None of them has a frame.
    """
    some = names is not None
    for name, folder in chosen.items():
        if names is not None and name not in names:
            continue
        with problems.about(name):
            frames = list(read_trajectory(folder, layout, problems, frame_step))
            if not frames:
                problems.add("empty_scene", folder, "no frame is left")
        some = some or bool(frames)
        if frames:
            yield Scene(dataset=dataset, name=name, is_metric=True, frames=frames)
    if not some:
        raise DataError(
            f"{next(iter(chosen.values()))}: no frame has image, depth and camera"
            f" ({problems.summary()}); unpack the archives again"
        )


def survey(root: Path, layout: Layout) -> Iterator[SceneSurvey]:
    """List the trajectories below a folder.

    Raises:
        DataError: There is none.
    """
    # Each trajectory's counts go into its own row; ``read`` logs the files.
    problems = Problems(quiet=True)
    for name, folder in find_trajectories(root, layout, problems).items():
        yield _survey_trajectory(name, folder, layout)
    if problem := problems.first.get("missing_poses"):
        more = problems.counts["missing_poses"] - 1
        yield SceneSurvey(
            name=problem.where,
            num_images=0,
            image_size=None,
            excluded=problem.detail + (f" (and {more} other folders)" if more else ""),
        )


def find_trajectories(root: Path, layout: Layout, problems: Problems) -> dict[str, Path]:
    """Search for files of poses.

    Args:
        root: Any folder above the trajectories, or one of them.
        layout: The release.
        problems: Told about two trajectories of one name, and folders of images without poses.

    Returns:
        Folders by ``ENV/LEVEL/PNNN``, sorted: some extractions nest ENV/ENV/LEVEL/PNNN.

    Raises:
        DataError: There is none.
    """
    found: dict[str, Path] = {}
    for path in _walk(root, layout):
        name = "/".join(path.resolve().parts[-3:])
        if not (path / layout.poses).is_file():
            problems.add("missing_poses", path, f"images, but no {layout.poses}")
        elif found.setdefault(name, path) != path:
            problems.add("duplicate_scene", path, f"{found[name]} has the same name and is kept")
    if not found:
        raise DataError(
            f"{root}: no {layout.poses} below it, expected ENV/LEVEL/P000/{layout.poses} as the"
            f" {layout.title} archives unpack; check the folder"
        )
    return dict(sorted(found.items()))


def _walk(root: Path, layout: Layout) -> Iterator[Path]:
    """Give folders of poses or images; what lies below is not searched, so this takes seconds."""
    seen: set[tuple[int, int]] = set()
    for folder, folders, files in os.walk(root, followlinks=True):
        path = Path(folder)
        status = path.stat()
        if (status.st_dev, status.st_ino) in seen:  # links may loop
            folders.clear()
            continue
        seen.add((status.st_dev, status.st_ino))
        if layout.poses in files or layout.image_folder in folders:
            folders.clear()
            yield path
        # A Mac leaves a '._' companion beside every file and folder it packs.
        folders[:] = sorted(name for name in folders if not name.startswith("."))


@dataclass(frozen=True, kw_only=True)
class _Contents:
    """What a trajectory's folder holds, by number."""

    images: set[int]
    depths: set[int]
    cameras: Float64[np.ndarray, "n 4 4"]
    """NaN where a line is damaged; no camera where no line can be told to belong to an image."""


def read_trajectory(
    folder: Path, layout: Layout, problems: Problems, frame_step: int = 1
) -> Iterator[Frame]:
    """Read a trajectory's cameras; pixels follow when asked for.

    Args:
        folder: It.
        layout: The release.
        problems: Told about each frame that lacks something.
        frame_step: Take every so many frames.

    Yields:
        Frames that have image, depth and camera, in order.
    """
    contents = _list_contents(folder, layout, problems)
    for number in range(0, len(contents.cameras), frame_step):
        image = folder / layout.image_folder / f"{number:06d}{layout.image_ending}"
        depth = folder / layout.depth_folder / f"{number:06d}{layout.depth_ending}"
        if number not in contents.images:
            problems.add("missing_image", image, "no such file, but a line of poses")
        elif number not in contents.depths:
            problems.add("missing_depth", depth, "no such file, but an image")
        elif np.isnan(contents.cameras[number]).any():
            where = f"{folder / layout.poses}:{number + 1}"
            problems.add("bad_pose", where, "expected 'tx ty tz qx qy qz qw', quaternion of unit 1")
        else:
            try:
                size = read_png_size(image)
            except DataError as error:
                problems.add("bad_image", image, str(error))
            else:
                yield _make_frame(image, depth, size, contents.cameras[number], layout)


def _make_frame(
    image: Path,
    depth: Path,
    size: tuple[int, int],
    world_from_cam: Float64[np.ndarray, "4 4"],
    layout: Layout,
) -> Frame:
    height, width = size
    K = np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]], np.float64)
    return Frame(
        name=image.name,
        image_size=size,
        K=K,
        world_from_cam=world_from_cam,
        read_image=partial(read_png, image, size),
        read_depth=partial(layout.read_depth, depth, size),
    )


def _survey_trajectory(name: str, folder: Path, layout: Layout) -> SceneSurvey:
    """List what a trajectory holds, by file names and the first image's header."""
    problems = Problems(quiet=True)
    contents = _list_contents(folder, layout, problems)
    good = set(np.flatnonzero(np.isfinite(contents.cameras[:, 0, 0])).tolist())
    whole = contents.images & contents.depths & good
    size, excluded = None, "held out for testing" if name in layout.held_out else ""
    if whole:
        try:
            first = f"{min(whole):06d}{layout.image_ending}"
            size = read_png_size(folder / layout.image_folder / first)
        except DataError:
            excluded = excluded or "its first image is no PNG"
    elif not excluded:
        excluded = problems.summary() if problems.counts else "no image with depth and camera"
    return SceneSurvey(
        name=name,
        num_images=len(whole),
        image_size=size,
        num_missing=len(contents.images | contents.depths | good) - len(whole),
        excluded=excluded,
    )


def list_numbers(folder: Path, ending: str) -> set[int]:
    """Give the numbers of a folder's files NNNNNN + ending; none where it does not exist."""
    try:
        names = [entry.name for entry in os.scandir(folder)]
    except OSError:
        return set()
    stems = (name.removesuffix(ending) for name in names if name.endswith(ending))
    return {int(stem) for stem in stems if len(stem) == 6 and stem.isascii() and stem.isdecimal()}


def _list_contents(folder: Path, layout: Layout, problems: Problems) -> _Contents:
    """List a folder.

    A line of poses short of the images, or one too many and some damaged, means that bytes were
    lost or put in, and every later image would get its neighbour's camera: none is kept then.
    """
    path = folder / layout.poses
    images = list_numbers(folder / layout.image_folder, layout.image_ending)
    depths = list_numbers(folder / layout.depth_folder, layout.depth_ending)
    expected = max(images, default=-1) + 1
    cameras = np.empty((0, 4, 4))
    try:
        cameras = read_poses(path)
    except DataError as error:
        problems.add("unreadable_poses", path, str(error))
    damaged = int(np.isnan(cameras[:, 0, 0]).sum())
    if 0 < len(cameras) < expected or (len(cameras) > expected and damaged):
        problems.add(
            "pose_count",
            path,
            f"{len(cameras)} lines, {damaged} of them damaged, expected {expected}, one for each"
            " image; left out, since no line can be told to belong to an image",
        )
        cameras = cameras[:0]
    return _Contents(images=images, depths=depths, cameras=cameras)


def read_poses(path: Path) -> Float64[np.ndarray, "n 4 4"]:
    """Read ``tx ty tz qx qy qz qw`` lines as ``world_from_cam`` with OpenCV camera axes.

    Returns:
        One camera a line, NaN where the line has not seven finite numbers, its quaternion no unit
        length, or its camera stands more than 100 km off.

    Raises:
        DataError: The file cannot be read, is beyond all size, or holds nothing.
    """
    try:
        size = path.stat().st_size
        data = path.read_bytes() if size <= _MOST_POSES else b""
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; check the file and its permissions") from error
    # Bytes, since a string would also be split at characters that are no line ends in a text file.
    lines = data.rstrip().split(b"\n")
    if not data.strip():
        raise DataError(f"{path}: no poses ({size} bytes); unpack the archive again")
    table = np.array([_parse_line(line) for line in lines], dtype=np.float64)
    good = np.isfinite(table).all(1) & (np.abs(table[:, :3]) <= MAX_POSITION).all(1)
    good &= np.abs(np.linalg.norm(table[:, 3:], axis=1) - 1) < _UNIT
    cameras = np.full((len(table), 4, 4), np.nan)
    cameras[good] = np.eye(4)
    cameras[good, :3, :3] = Rotation.from_quat(table[good, 3:]).as_matrix() @ BODY_FROM_CAM
    cameras[good, :3, 3] = table[good, :3]
    return cameras


def _parse_line(line: bytes) -> list[float]:
    try:
        row = [float(word) for word in line.split()]
    except ValueError:
        row = []
    return row if len(row) == 7 else [np.nan] * 7


def keep_known(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Set sky, what is not finite and what is not positive to 0."""
    known = np.isfinite(depth) & (depth > 0) & (depth <= MAX_DEPTH)
    return np.where(known, depth, np.float32(0))
