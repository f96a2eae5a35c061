"""Files of a COLMAP model, record by record; every count is held against the bytes there are.

``rigs`` and ``frames`` need not be read: ``images`` holds the composed transform of every
registered image.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
import pycolmap
from jaxtyping import Int64

from l3r.errors import DataError

Report = Callable[[str], None]
"""Told what is damaged and left out."""
Position = tuple[float, float, float]
_Read = TypeVar("_Read")

_MAX_NAME = 1024
_MAX_LINE = 2**26
"""Bytes of one line of text: an image of a million keypoints takes 40 MB."""
_MAX_ID = 2**63
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("id", "<i8")])
_NO_POINT = -1


@dataclass(frozen=True, kw_only=True)
class CameraRecord:
    """A camera as the file has it."""

    camera_id: int
    model: int | str
    """COLMAP's number or name."""
    image_size: tuple[int, int]
    """(height, width)."""
    params: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class ImageRecord:
    """An image as the file has it."""

    name: str
    camera_id: int
    numbers: tuple[float, ...]
    """Quaternion w x y z and shift of ``cam_from_world``."""
    point_ids: Int64[np.ndarray, " _k"]
    """Points seen, ascending, each once."""


def read_cameras(path: Path, report: Report) -> Iterator[CameraRecord]:
    """Read ``cameras.bin`` or ``cameras.txt``."""
    return _reported(_binary_cameras if path.suffix == ".bin" else _text_cameras, path, report)


def read_images(path: Path, report: Report) -> Iterator[ImageRecord]:
    """Read ``images.bin`` or ``images.txt``."""
    return _reported(_binary_images if path.suffix == ".bin" else _text_images, path, report)


def read_positions(path: Path, report: Report) -> Iterator[tuple[int, Position]]:
    """Read number and position of each point of ``points3D.bin`` or ``points3D.txt``."""
    return _reported(_binary_points if path.suffix == ".bin" else _text_points, path, report)


def _reported(
    read: Callable[[Path, Report], Iterator[_Read]], path: Path, report: Report
) -> Iterator[_Read]:
    """Give what comes before damage that hides all that follows."""
    try:
        yield from read(path, report)
    except DataError as error:
        report(str(error))
    except OSError as error:
        report(str(error.strerror))


class _Bytes:
    """Reads numbers off a file and never more than it holds."""

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self._stream = stream
        self._left = path.stat().st_size

    def numbers(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack(f"<{layout}", self.take(struct.calcsize(f"<{layout}")))

    def take(self, count: int) -> bytes:
        if count > self._left:
            raise DataError(f"cut off: {count:,} bytes asked, {self._left:,} left")
        self._left -= count
        return self._stream.read(count)

    def name(self) -> str:
        text = bytearray()
        while (letter := self.take(1)) != b"\0":
            text += letter
            if len(text) > _MAX_NAME:
                raise DataError(f"a name of more than {_MAX_NAME} letters")
        return text.decode(errors="replace")

    def finish(self) -> None:
        if self._left:
            raise DataError(f"{self._left:,} bytes after its end")


def _binary_cameras(path: Path, report: Report) -> Iterator[CameraRecord]:
    members = pycolmap.CameraModelId.__members__.items()
    by_number = {int(number): number for name, number in members if name != "INVALID"}
    with path.open("rb") as stream:
        data = _Bytes(path, stream)
        for _ in range(*data.numbers("Q")):
            camera_id, model, width, height = data.numbers("IiQQ")
            if model not in by_number:
                raise DataError(f"camera {camera_id} has unknown model {model}")
            example = pycolmap.Camera.create_from_model_id(0, by_number[model], 1.0, 1, 1)
            yield CameraRecord(
                camera_id=camera_id,
                model=model,
                image_size=(height, width),
                params=data.numbers(f"{len(example.params)}d"),
            )
        data.finish()


def _binary_images(path: Path, report: Report) -> Iterator[ImageRecord]:
    with path.open("rb") as stream:
        data = _Bytes(path, stream)
        for _ in range(*data.numbers("Q")):
            _, *numbers, camera_id = data.numbers("I7dI")
            name = data.name()
            (count,) = data.numbers("Q")
            seen = np.frombuffer(data.take(_OBSERVATION.itemsize * count), _OBSERVATION)
            yield ImageRecord(
                name=name,
                camera_id=camera_id,
                numbers=tuple(numbers),
                point_ids=_known(seen["id"]),
            )
        data.finish()


def _binary_points(path: Path, report: Report) -> Iterator[tuple[int, Position]]:
    with path.open("rb") as stream:
        data = _Bytes(path, stream)
        for _ in range(*data.numbers("Q")):
            number, x, y, z, *_, length = data.numbers("q3d3BdQ")
            data.take(8 * length)
            yield number, (x, y, z)
        data.finish()


def _known(ids: Int64[np.ndarray, " _k"]) -> Int64[np.ndarray, " _m"]:
    return np.unique(ids[ids != _NO_POINT]).astype(np.int64)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Give numbered lines without their ends; what is no UTF-8 becomes question marks."""
    with path.open("rb") as stream:
        number = 0
        while line := stream.readline(_MAX_LINE):
            number += 1
            if len(line) == _MAX_LINE:
                raise DataError(f"line {number}: more than {_MAX_LINE:,} bytes")
            yield number, line.decode(errors="replace").rstrip("\r\n")


def _content(path: Path) -> Iterator[tuple[int, str]]:
    return ((n, line) for n, line in _lines(path) if line.strip() and not line.startswith("#"))


def _text_cameras(path: Path, report: Report) -> Iterator[CameraRecord]:
    for number, line in _content(path):
        try:
            camera_id, model, width, height, *params = line.split()
            yield CameraRecord(
                camera_id=int(camera_id),
                model=model,
                image_size=(int(height), int(width)),
                params=tuple(map(float, params)),
            )
        except ValueError:
            report(f"line {number}: {line[:60]!r}, expected ID MODEL WIDTH HEIGHT PARAMS")


def _text_images(path: Path, report: Report) -> Iterator[ImageRecord]:
    head: ImageRecord | None = None
    for number, line in _lines(path):
        if head is None:
            if line.strip() and not line.startswith("#"):
                head = _parse_image(number, line, report)
            continue
        try:
            yield _with_points(head, line)
            head = None
        except (ValueError, OverflowError):
            report(f"line {number}: {line[:60]!r}, expected triples X Y POINT3D_ID")
            # Where the observations are missing, this is the next image.
            head = _parse_image(number, line, lambda detail: None)
    if head is not None:
        report(f"no observations of {head.name!r}, the last image")


def _parse_image(number: int, line: str, report: Report) -> ImageRecord | None:
    # A name may hold blanks.
    words = line.strip().split(maxsplit=9)
    try:
        return ImageRecord(
            name=words[9],
            camera_id=int(words[8]),
            numbers=tuple(map(float, words[1:8])),
            point_ids=np.zeros(0, dtype=np.int64),
        )
    except (ValueError, IndexError):
        report(
            f"line {number}: {line[:60]!r}, expected ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then"
            " a line of observations"
        )
        return None


def _with_points(image: ImageRecord, line: str) -> ImageRecord:
    words = line.split()
    if len(words) % 3:
        raise ValueError
    ids = np.array(list(map(int, words[2::3])), dtype=np.int64)
    return ImageRecord(
        name=image.name,
        camera_id=image.camera_id,
        numbers=image.numbers,
        point_ids=_known(ids),
    )


def _text_points(path: Path, report: Report) -> Iterator[tuple[int, Position]]:
    for number, line in _content(path):
        words = line.split(maxsplit=4)
        try:
            point_id, x, y, z = int(words[0]), *map(float, words[1:4])
            if not -_MAX_ID <= point_id < _MAX_ID:
                raise ValueError
        except ValueError:
            report(f"line {number}: {line[:60]!r}, expected ID X Y Z ...")
        else:
            yield point_id, (x, y, z)
