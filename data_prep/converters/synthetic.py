"""A procedural room, rendered into TartanAir's raw layout so that its converter reads it.

``ENV/Easy/P000`` holds training cameras, ``P001`` held-out cameras of the same room drawn by a
seed of their own, ``P002`` a smooth walk through it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from data_prep.converters.trajectories import BODY_FROM_CAM
from data_prep.raycast import render
from data_prep.room import Room, build_room, draw_cameras, draw_walk
from l3r.errors import DataError
from l3r.files import write_atomic

_VIEWS_AT_ONCE = 4
"""Views rendered together on the host: more leaves the processor's cache."""

Report = Callable[[str, int, int], None]
"""Called with a trajectory's name, its views done so far and in all."""


def _silent(name: str, done: int, total: int) -> None:
    """Report nothing."""


@dataclass(frozen=True, kw_only=True)
class RoomRequest:
    """What to render; the same request gives the same files."""

    scene_seed: int = 0
    """Seed of the room; the cameras' seeds follow from it."""
    num_views: int = 3000
    """Training cameras (P000)."""
    num_held_out: int = 300
    """Held-out cameras (P001); 0: none."""
    num_walk: int = 200
    """Cameras of the walk (P002); 0: none."""
    image_size: tuple[int, int] = (48, 48)
    """(height, width)."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if self.num_views < 2 or min(self.image_size) < 8:
            raise DataError(
                f"synthetic room: {self.num_views} views of {self.image_size}, expected 2 or more"
                " of at least 8x8; change --views or --size"
            )

    @property
    def environment(self) -> str:
        """Name of the folder the room goes to."""
        return f"room{self.scene_seed:03d}"

    @property
    def lengths(self) -> dict[str, int]:
        """Cameras of each trajectory."""
        return {"P000": self.num_views, "P001": self.num_held_out, "P002": self.num_walk}


def intrinsics(image_size: tuple[int, int]) -> Float64[np.ndarray, "3 3"]:
    """K of the layout, which carries none: 90 degrees across, principal point at the centre."""
    height, width = image_size
    return np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]], np.float64)


def write_room(root: Path, request: RoomRequest, *, report: Report = _silent) -> Path:
    """Render a room's trajectories; those already complete are left alone.

    Args:
        root: Folder that gets ``ENV/Easy/P00x``.
        request: What to render.
        report: Told about the progress.

    Returns:
        The environment's folder.

    Raises:
        DataError: The folder holds a trajectory of another length.
    """
    room = build_room(request.scene_seed)
    folder = root / request.environment
    for number, (name, num_views) in enumerate(request.lengths.items()):
        draw = draw_walk if name == "P002" else draw_cameras
        target = folder / "Easy" / name
        if num_views and not _is_complete(target, request, num_views):
            world_from_cam = draw(room, num_views, 1000 * request.scene_seed + number)
            told = partial(report, f"{request.environment}/Easy/{name}")
            write_tartanair(target, room, world_from_cam, request.image_size, report=told)
    return folder


def is_complete(root: Path, request: RoomRequest) -> bool:
    """Tell whether a room is rendered.

    Raises:
        DataError: The folder holds a trajectory of another length.
    """
    return all(
        _is_complete(root / request.environment / "Easy" / name, request, num_views)
        for name, num_views in request.lengths.items()
        if num_views
    )


def _is_complete(target: Path, request: RoomRequest, num_views: int) -> bool:
    """``pose_left.txt`` is written last, so a trajectory that has it is whole."""
    poses = target / "pose_left.txt"
    if not poses.is_file():
        return False
    first = cv2.imread(str(target / "image_left" / "000000_left.png"))
    found = len(poses.read_text(encoding="utf-8").splitlines())
    if first is None or found != num_views or first.shape[:2] != request.image_size:
        raise DataError(
            f"{target}: holds {found} views of another request, expected {num_views} of"
            f" {request.image_size}; remove the folder or name another --raw"
        )
    return True


def write_tartanair(
    folder: Path,
    room: Room,
    world_from_cam: Float[Tensor, "n 4 4"],
    image_size: tuple[int, int],
    *,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Render a trajectory into ``image_left``, ``depth_left`` and ``pose_left.txt``.

    Args:
        folder: ``ROOT/ENV/LEVEL/PNNN``.
        room: The room, on the host.
        world_from_cam: Cameras with OpenCV axes, float64.
        image_size: (height, width).
        report: Called with the views done and the views in all.
    """
    (folder / "image_left").mkdir(parents=True, exist_ok=True)
    (folder / "depth_left").mkdir(parents=True, exist_ok=True)
    K = torch.from_numpy(intrinsics(image_size))
    for start in range(0, len(world_from_cam), _VIEWS_AT_ONCE):
        cameras = world_from_cam[start : start + _VIEWS_AT_ONCE]
        image, depth = render(room, K, cameras, image_size)
        pixels = (image * 255 + 0.5).to(torch.uint8).numpy()
        for view in range(len(cameras)):
            name = f"{start + view:06d}_left"
            bgr = cv2.cvtColor(pixels[view], cv2.COLOR_RGB2BGR)
            cv2.imwrite(str(folder / "image_left" / f"{name}.png"), bgr)
            np.save(folder / "depth_left" / f"{name}_depth.npy", depth[view].numpy())
        report(start + len(cameras), len(world_from_cam))
    write_atomic(folder / "pose_left.txt", pose_lines(world_from_cam.numpy()).encode())


def pose_lines(world_from_cam: Float64[np.ndarray, "n 4 4"]) -> str:
    """Write cameras as ``tx ty tz qx qy qz qw`` lines with north, east, down body axes.

    Args:
        world_from_cam: Rigid, OpenCV camera axes.
    """
    quaternions = Rotation.from_matrix(world_from_cam[:, :3, :3] @ BODY_FROM_CAM.T).as_quat()
    table = np.concatenate([world_from_cam[:, :3, 3], quaternions], axis=1)
    return "".join(" ".join(f"{x:.12g}" for x in row) + "\n" for row in table)
