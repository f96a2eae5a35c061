"""Cameras of a COLMAP model, binary or text.

Only ``cameras`` and ``images`` are read. The points are left alone: nothing here needs them, and
pycolmap does not come back from a truncated ``points3D.bin``.
"""

import math
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pycolmap
import roma
import torch
from jaxtyping import Float
from torch import Tensor

from l3r.errors import DataError
from l3r.geometry.rigid import rigid_from_parts
from l3r.types import Cameras

_UNDISTORTED = ("PINHOLE", "SIMPLE_PINHOLE")
_OBSERVATION_BYTES = 24
"""x, y and the point's number, eight bytes each."""


@dataclass(frozen=True, kw_only=True)
class _Image:
    name: str
    camera_id: int
    cam_from_world: Float[Tensor, "4 4"]


def read_colmap(folder: Path) -> Cameras:
    """Read the cameras of a model; the binary form is preferred where both are there.

    Lens distortion is ignored, with a warning: K then describes the undistorted centre of the
    image, which is enough to compare cameras. Every image of the model counts as registered.

    Raises:
        DataError: There is no model, it is damaged, or a camera has no K (such as a panorama).
    """
    if (folder / "images.bin").is_file() and (folder / "cameras.bin").is_file():
        cameras = dict(_binary_cameras(folder / "cameras.bin"))
        images = list(_binary_images(folder / "images.bin"))
    elif (folder / "images.txt").is_file() and (folder / "cameras.txt").is_file():
        cameras = dict(_text_cameras(folder / "cameras.txt"))
        images = list(_text_images(folder / "images.txt"))
    else:
        raise DataError(f"{folder}: no cameras and images (.bin or .txt); expected a COLMAP model")
    for image in images:
        if image.camera_id not in cameras:
            raise DataError(
                f"{folder}: image {image.name!r} has camera {image.camera_id}, which the model "
                "lacks; export the model again"
            )
    _warn_of_distortion(folder, cameras)
    return _to_cameras([(image, cameras[image.camera_id]) for image in images])


def _to_cameras(views: list[tuple[_Image, pycolmap.Camera]]) -> Cameras:
    K = torch.zeros(len(views), 3, 3, dtype=torch.float64)
    cam_from_world = torch.zeros(len(views), 4, 4, dtype=torch.float64)
    for index, (image, camera) in enumerate(views):
        K[index] = torch.from_numpy(camera.calibration_matrix())
        cam_from_world[index] = image.cam_from_world
    return Cameras(
        file=[image.name for image, _ in views],
        image_size=[(camera.height, camera.width) for _, camera in views],
        K=K,
        cam_from_world=cam_from_world,
        registered=torch.ones(len(views), dtype=torch.bool),
        component=torch.zeros(len(views), dtype=torch.int64),
    )


def _warn_of_distortion(folder: Path, cameras: dict[int, pycolmap.Camera]) -> None:
    models = sorted({camera.model_name for camera in cameras.values()} - {*_UNDISTORTED})
    if models:
        warnings.warn(
            f"{folder}: lens distortion of {', '.join(models)} is ignored, K alone is taken",
            stacklevel=3,
        )


def _build_camera(
    where: str, model: int | str, size: tuple[int, int], params: list[float]
) -> pycolmap.Camera:
    """Build a camera after checking what pycolmap would crash on or accept in silence.

    Args:
        where: File and camera, for messages.
        model: COLMAP's number or name.
        size: (width, height), as COLMAP has it.
        params: As many as the model needs.
    """
    known = pycolmap.CameraModelId.__members__
    names = [n for n, i in known.items() if model in (n, int(i)) and n != "INVALID"]
    if not names:
        raise DataError(f"{where}: unknown camera model {model!r}; expected one of COLMAP's")
    if min(size) <= 0:
        raise DataError(f"{where}: size {size[0]}x{size[1]}; expected positive width and height")
    camera = pycolmap.Camera(model=names[0], width=size[0], height=size[1], params=params)
    if not camera.is_perspective():
        raise DataError(f"{where}: model {names[0]} has no K; expected a perspective camera")
    if not (camera.verify_params() and all(map(math.isfinite, params))):
        raise DataError(f"{where}: {names[0]} has {params}; expected {camera.params_info}")
    return camera


def _build_image(
    where: str, name: str, camera_id: int, numbers: tuple[float, ...] | list[float]
) -> _Image:
    """Build an image from its quaternion (w, x, y, z) and translation."""
    quaternion = torch.tensor([*numbers[1:4], numbers[0]], dtype=torch.float64)
    t = torch.tensor(numbers[4:7], dtype=torch.float64)
    length = float(quaternion.norm())
    if not (math.isfinite(length) and length > 0 and t.isfinite().all()):
        raise DataError(f"{where}: rotation and shift are {list(numbers)}; expected finite numbers")
    cam_from_world = rigid_from_parts(roma.unitquat_to_rotmat(quaternion / length), t)
    return _Image(name=name, camera_id=camera_id, cam_from_world=cam_from_world)


class _Bytes:
    """Reads numbers off a file's bytes and says where they end too soon."""

    def __init__(self, path: Path) -> None:
        self._path, self._data, self._at = path, path.read_bytes(), 0

    def integers(self, layout: str) -> tuple[int, ...]:
        return self._take(layout)

    def floats(self, count: int) -> tuple[float, ...]:
        return self._take(f"{count}d")

    def text(self) -> str:
        end = self._data.find(b"\0", self._at)
        start = self._advance((end if end >= 0 else len(self._data)) + 1 - self._at)
        return self._data[start:end].decode(errors="replace")

    def skip(self, count: int) -> None:
        self._advance(count)

    def _take(self, layout: str) -> tuple[Any, ...]:
        layout = f"<{layout}"
        return struct.unpack_from(layout, self._data, self._advance(struct.calcsize(layout)))

    def _advance(self, count: int) -> int:
        start, self._at = self._at, self._at + count
        if self._at > len(self._data):
            raise DataError(
                f"{self._path}: ends at byte {len(self._data)}, expected {self._at} or more; "
                "the file is truncated, copy it again"
            )
        return start


def _binary_cameras(path: Path) -> Iterator[tuple[int, pycolmap.Camera]]:
    data = _Bytes(path)
    by_number = {int(i): i for n, i in pycolmap.CameraModelId.__members__.items() if n != "INVALID"}
    for _ in range(*data.integers("Q")):
        camera_id, model, width, height = data.integers("IiQQ")
        where = f"{path}: camera {camera_id}"
        if model not in by_number:
            raise DataError(f"{where}: unknown camera model {model!r}; expected one of COLMAP's")
        example = pycolmap.Camera.create_from_model_id(camera_id, by_number[model], 1.0, 1, 1)
        params = list(data.floats(len(example.params)))
        yield camera_id, _build_camera(where, model, (width, height), params)


def _binary_images(path: Path) -> Iterator[_Image]:
    data = _Bytes(path)
    for _ in range(*data.integers("Q")):
        (image_id,) = data.integers("I")
        numbers, (camera_id,), name = data.floats(7), data.integers("I"), data.text()
        data.skip(_OBSERVATION_BYTES * data.integers("Q")[0])
        yield _build_image(f"{path}: image {image_id} ({name!r})", name, camera_id, numbers)


def _text_cameras(path: Path) -> Iterator[tuple[int, pycolmap.Camera]]:
    for number, line in _content_lines(_lines(path)):
        where = f"{path}: line {number}"
        try:
            camera_id, model, width, height, *params = line.split()
            size = (int(width), int(height))
            values = [float(value) for value in params]
            yield int(camera_id), _build_camera(where, model, size, values)
        except ValueError as error:
            raise DataError(
                f"{where}: {line.strip()[:60]!r}; expected ID MODEL WIDTH HEIGHT PARAMS"
            ) from error


def _text_images(path: Path) -> Iterator[_Image]:
    lines = _lines(path)
    for number, line in _content_lines(lines):
        # The next line holds the observations, be it empty.
        next(lines, None)
        where = f"{path}: line {number}"
        try:
            words = line.strip().split(maxsplit=9)
            numbers = [float(word) for word in words[1:8]]
            yield _build_image(where, words[9], int(words[8]), numbers)
        except (ValueError, IndexError) as error:
            raise DataError(
                f"{where}: {line.strip()[:60]!r}; expected "
                "ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of observations"
            ) from error


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    # Not splitlines: a name may hold characters that it takes for line ends.
    yield from enumerate(path.read_text(errors="replace").split("\n"), start=1)


def _content_lines(lines: Iterator[tuple[int, str]]) -> Iterator[tuple[int, str]]:
    for number, line in lines:
        if line.strip() and not line.startswith("#"):
            yield number, line
