"""Raw scenes as large as genuine ones, for :mod:`benchmarks.data_prep`.

TartanAir's are rendered here; the others come from the writers of the tests, which know their
formats. Waymo's are photographed small and enlarged, since rendering takes longer than reading.
"""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np

from data_prep.converters.synthetic import RoomRequest, write_room
from data_prep.converters.trajectories import MAX_DEPTH

NUM_IMAGES = 4

_SMALLER = 10
"""How much smaller the tests' cameras are than the genuine ones."""


def write_tartanair(root: Path, image_size: tuple[int, int] = (480, 640)) -> None:
    """Write a trajectory of V1."""
    request = RoomRequest(num_views=NUM_IMAGES, num_held_out=0, num_walk=0, image_size=image_size)
    write_room(root, request)


def write_tartanair_v2(root: Path) -> None:
    """Write a trajectory of V2, out of one of V1."""
    write_tartanair(root / "v1", (640, 640))
    (source,) = (root / "v1").glob("*/Easy/P000")
    target = root / "room" / "Data_easy" / "P000"
    for folder in ("image_lcam_front", "depth_lcam_front"):
        (target / folder).mkdir(parents=True)
    for number in range(NUM_IMAGES):
        name = f"{number:06d}_lcam_front"
        shutil.copy(
            source / "image_left" / f"{number:06d}_left.png",
            target / "image_lcam_front" / f"{name}.png",
        )
        depth = np.load(source / "depth_left" / f"{number:06d}_left_depth.npy", allow_pickle=False)
        assert depth.max() < MAX_DEPTH
        # OpenCV writes four channels in the order blue, green, red, alpha, as the format has them.
        half = depth.astype(np.float16).astype("<f4")
        path = target / "depth_lcam_front" / f"{name}_depth.png"
        cv2.imwrite(str(path), half.view(np.uint8).reshape(*depth.shape, 4))
    shutil.copy(source / "pose_left.txt", target / "pose_lcam_front.txt")


def write_waymo(root: Path) -> None:
    """Write a frame of version 1: five images, five lasers at their genuine resolution."""
    from tests.data_prep.waymo import drive, wire_writer

    genuine = {laser: (64, 2650) if laser == 1 else (200, 600) for laser in drive.LASER_SIZES}
    segment = drive.record(1, genuine)
    for camera in segment.cameras.values():
        camera["size"] = tuple(_SMALLER * side for side in camera["size"])
        camera["lens"] = [_SMALLER * x for x in camera["lens"][:4]] + list(camera["lens"][4:])
    for frame in segment.frames:
        for number, (jpeg, pose) in frame.images.items():
            frame.images[number] = (_enlarge(jpeg), pose)
        for _, projection, _ in frame.lasers.values():
            for first in (1, 4):
                projection[..., first : first + 2] *= _SMALLER
    wire_writer.write_v1(root / "training", segment)


def _enlarge(jpeg: bytes) -> bytes:
    small = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    large = cv2.resize(small, None, fx=_SMALLER, fy=_SMALLER, interpolation=cv2.INTER_CUBIC)
    # Grain, without which a JPEG is far too easy to decode.
    grain = np.random.default_rng(0).normal(0, 4, large.shape)
    noisy = np.clip(large + grain, 0, 255).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 85])[1])


def write_co3d(root: Path) -> None:
    """Write a sequence of upright images."""
    from tests.data_prep.co3d import writer

    records = writer.write_sequence(root, writer.Recipe(count=NUM_IMAGES, image_size=(1896, 1066)))
    writer.write_category(root, records)


def write_megadepth(root: Path) -> None:
    """Write a reconstruction of photos of 1600 pixels."""
    from tests.data_prep.megadepth import writers

    lens = tuple(_SMALLER * x for x in writers.LENS[:3]) + tuple(writers.LENS[3:])
    size = tuple(_SMALLER * side for side in writers.RAW)
    with patch.multiple(writers, RAW=size, LENS=lens, LONGEST=_SMALLER * writers.LONGEST):
        writers.write_merged(root, "0001", count=2)


def write_folder(root: Path) -> None:
    """Write a scene of distorted photos with depth maps in millimetres."""
    from tests.data_prep.folder import writers

    small = writers.PARAMS["OPENCV"]
    lens = tuple(_SMALLER * x for x in small[:4]) + tuple(small[4:])
    size = tuple(_SMALLER * side for side in writers.SIZE)
    with patch.dict(writers.PARAMS, {"OPENCV": lens}):
        cameras = writers.cameras_of("OPENCV", 2, size)
    writers.write_transforms(root / "scene", cameras, depth=".png")


WRITERS: dict[str, Callable[[Path], Any]] = {
    "tartanair": write_tartanair,
    "tartanair_v2": write_tartanair_v2,
    "waymo": write_waymo,
    "co3d": write_co3d,
    "megadepth": write_megadepth,
    "folder": write_folder,
}
"""What writes a scene below a folder, by the name of its converter."""
