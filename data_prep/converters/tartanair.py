"""TartanAir V1: ``ENV/LEVEL/PNNN/{image_left, depth_left, pose_left.txt}``.

Cameras in the files are world-from-camera with body axes north, east, down; here the camera's
axes become OpenCV's and the world stays as it is. The layout carries no intrinsics: the focal
length is half the width and the principal point the image centre, as published for 640x480.
"""

import struct
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.spatial.transform import Rotation

from data_prep.scene import Frame, Scene
from l3r.errors import DataError

Split = Literal["train", "test", "all"]

MAX_DEPTH = 1000.0
"""Depth beyond this is sky [m]."""

BODY_FROM_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Columns are OpenCV's x right, y down, z forward in body axes x forward, y right, z down."""

HELD_OUT = frozenset(
    f"{environment}/{level}/{name}"
    for environment, trajectories in {
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
    for level, name in (trajectory.split("/") for trajectory in trajectories.split())
)
"""The 32 trajectories DROID-SLAM keeps for testing: the public convention."""

_PNG_END = b"IEND\xaeB`\x82"
_UNIT = 1e-3


def read(
    root: Path,
    split: Split = "train",
    *,
    scenes: str = "*",
    frame_step: int = 1,
    dataset: str = "tartanair",
) -> Iterator[Scene]:
    """Find trajectories and read their cameras; pixels follow when asked for.

    Args:
        root: Any folder above the trajectories.
        split: ``train`` leaves :data:`HELD_OUT` out, ``test`` is that list, ``all`` is both.
        scenes: Pattern on ``ENV/LEVEL/PNNN``.
        frame_step: Take every so many frames.
        dataset: Name the scenes carry; other sources write this layout too.

    Yields:
        One scene per trajectory, sorted by name.

    Raises:
        DataError: There is no trajectory, or one is incomplete or malformed.
    """
    found = {_scene_name(path): path for path in _find_trajectories(root)}
    if not found:
        raise DataError(
            f"{root}: no pose_left.txt below it, expected ENV/Easy/P000/pose_left.txt as the"
            " TartanAir archives unpack; check the folder"
        )
    chosen = [name for name in sorted(found) if _is_in(name, split) and fnmatch(name, scenes)]
    if not chosen:
        raise DataError(
            f"{root}: none of {len(found)} trajectories ({min(found)}, ...) is in split '{split}'"
            f" and matches '{scenes}'; change --split or --scenes"
        )
    for name in chosen:
        frames = _read_trajectory(found[name], frame_step)
        yield Scene(dataset=dataset, name=name, is_metric=True, frames=frames)


def _find_trajectories(root: Path) -> list[Path]:
    # A Mac leaves a '._' companion beside every file and folder it packs.
    return [
        path.parent
        for path in sorted(root.rglob("pose_left.txt"))
        if not any(part.startswith("._") for part in path.relative_to(root).parts)
    ]


def _scene_name(trajectory: Path) -> str:
    """Name by the last three folders: some extractions nest ENV/ENV/LEVEL/PNNN."""
    return "/".join(trajectory.resolve().parts[-3:])


def _is_in(name: str, split: Split) -> bool:
    return split == "all" or (name in HELD_OUT) == (split == "test")


def _read_trajectory(folder: Path, frame_step: int) -> list[Frame]:
    cameras = read_poses(folder / "pose_left.txt")
    images = sorted(
        path for path in (folder / "image_left").glob("*.png") if not path.name.startswith("._")
    )
    if len(images) != len(cameras):
        raise DataError(
            f"{folder}: {len(images)} images in image_left, {len(cameras)} lines in pose_left.txt,"
            " expected one line per image; unpack the archive again"
        )
    frames = []
    for index in range(0, len(images), frame_step):
        image = folder / "image_left" / f"{index:06d}_left.png"
        depth = folder / "depth_left" / f"{index:06d}_left_depth.npy"
        for path in (image, depth):
            if not path.is_file():
                raise DataError(f"{path}: no such file; unpack the archive again")
        frames.append(_frame(image, depth, cameras[index]))
    return frames


def _frame(image: Path, depth: Path, world_from_cam: Float64[np.ndarray, "4 4"]) -> Frame:
    size = _png_size(image)
    height, width = size
    K = np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]], np.float64)
    return Frame(
        name=image.name,
        image_size=size,
        K=K,
        world_from_cam=world_from_cam,
        read_image=partial(read_png, image),
        read_depth=partial(read_npy_depth, depth, size),
    )


def read_poses(path: Path) -> Float64[np.ndarray, "n 4 4"]:
    """Read ``tx ty tz qx qy qz qw`` lines as ``world_from_cam`` with OpenCV camera axes.

    Raises:
        DataError: A line has not seven finite numbers or its quaternion no unit length.
    """
    rows = []
    lines = path.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            row = [float(word) for word in line.split()]
        except ValueError:
            row = []
        norm = float(np.linalg.norm(row[3:])) if len(row) == 7 else np.nan
        if not (np.isfinite(row).all() and abs(norm - 1) < _UNIT):
            raise DataError(
                f"{path}:{number}: '{line[:80]}', expected 'tx ty tz qx qy qz qw' with a quaternion"
                " of length 1; unpack the file again"
            )
        rows.append(row)
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    cameras = np.tile(np.eye(4), (len(table), 1, 1))
    if len(table):
        cameras[:, :3, :3] = Rotation.from_quat(table[:, 3:]).as_matrix() @ BODY_FROM_CAM
        cameras[:, :3, 3] = table[:, :3]
    return cameras


def _png_size(path: Path) -> tuple[int, int]:
    with path.open("rb") as stream:
        head = stream.read(24)
    if len(head) < 24 or head[12:16] != b"IHDR":
        raise DataError(f"{path}: no PNG; unpack the archive again")
    width, height = struct.unpack(">II", head[16:24])
    return height, width


def read_png(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read a PNG as RGB.

    Raises:
        DataError: It is cut off or no image.
    """
    data = path.read_bytes()
    # The decoder may fill what is missing and only warn, so look for the end of the file.
    image = None
    if data.endswith(_PNG_END):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise DataError(f"{path}: no whole PNG ({len(data)} bytes); unpack the archive again")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def read_npy_depth(path: Path, image_size: tuple[int, int]) -> Float32[np.ndarray, "h w"]:
    """Read z [m]; sky, what is not finite and what is not positive become 0.

    Raises:
        DataError: It is cut off, or not float32 of the image's size.
    """
    try:
        depth = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise DataError(f"{path}: no whole array ({error}); unpack the archive again") from error
    if depth.dtype != np.float32 or depth.shape != image_size:
        raise DataError(
            f"{path}: {depth.dtype} of shape {depth.shape}, expected float32 of {image_size} as the"
            " image; unpack the archive again"
        )
    known = np.isfinite(depth) & (depth > 0) & (depth <= MAX_DEPTH)
    return np.where(known, depth, np.float32(0))
