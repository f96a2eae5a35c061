"""Parts of version 1's Frame message: calibrations, range images, labels.

Field numbers are those of ``dataset.proto`` and ``label.proto`` of the Waymo Open Dataset
(Perception). Entries of repeated fields come in no order: all are looked up by their name field.
Range images are zlib streams of MatrixFloat or MatrixInt32 messages; the delta encoding of the
Motion data set's lidar is another format and does not occur in Frames.
"""

import math
import zlib

import numpy as np
from jaxtyping import Float32, Float64, Int32

from data_prep.converters.waymo.calibration import (
    TOP,
    Camera,
    Laser,
    make_camera,
    make_laser,
    rigid_from_rows,
)
from data_prep.converters.waymo.lidar import SIGN, Box, Scan, make_scan
from data_prep.converters.waymo.wire import (
    Message,
    parse,
    to_bytes,
    to_doubles,
    to_float,
    to_floats,
    to_int,
    to_ints,
)
from data_prep.problems import Problems
from l3r.errors import DataError

_MAX_MATRIX = 2**26
"""Longest range image believed, unpacked [bytes]; the pixel poses of TOP have 4 MB."""

FRAME = frozenset({1, 2, 3, 4, 5})
"""Fields of a Frame that cameras and images need: context, time, pose, images, lasers."""
FRAME_LASERS = frozenset({1, 3, 5, 6})
"""Fields of a Frame that points need: context, pose, lasers, laser labels."""


def read_rigid(message: Message, number: int, what: str) -> Float64[np.ndarray, "4 4"]:
    """Read a Transform.

    Raises:
        DataError: It is missing or not rigid.
    """
    transform = parse(to_bytes(message, number), frozenset({1}))
    return rigid_from_rows(to_doubles(transform, 1), what)


def read_cameras(frame: Message, where: str, problems: Problems) -> dict[int, Camera]:
    """Read the camera calibrations, those that are sound.

    Args:
        frame: With its context.
        where: Named in problems.
        problems: Told of calibrations that cannot be used.
    """
    cameras = {}
    context = parse(to_bytes(frame, 1), frozenset({2}))
    for field in context.get(2, []):
        try:
            message = parse(field.value, frozenset({1, 2, 3, 4, 5}))
            sensor = parse(to_bytes(message, 3), frozenset({1}))
            camera = make_camera(
                to_int(message, 1),
                to_doubles(message, 2),
                to_doubles(sensor, 1),
                (to_int(message, 5), to_int(message, 4)),
            )
        except DataError as error:
            problems.add("bad_calibration", where, str(error))
            continue
        cameras[camera.number] = camera
    return cameras


def read_lasers(frame: Message) -> tuple[dict[int, Laser], list[str]]:
    """Read the laser calibrations.

    Args:
        frame: With its context.

    Returns:
        ``(lasers, faults)``: those that are sound, by number, and what is wrong with the others.
    """
    lasers, faults = {}, []
    context = parse(to_bytes(frame, 1), frozenset({3}))
    for field in context.get(3, []):
        try:
            message = parse(field.value, frozenset({1, 2, 3, 4, 5}))
            mount = parse(to_bytes(message, 5), frozenset({1}))
            laser = make_laser(
                to_int(message, 1),
                to_doubles(message, 2),
                (to_float(message, 3), to_float(message, 4)),
                to_doubles(mount, 1),
            )
        except DataError as error:
            faults.append(str(error))
            continue
        lasers[laser.number] = laser
    return lasers, faults


def first_returns(frame: Message) -> dict[int, Message]:
    """Find the lasers whose first return can be placed, by number.

    A range image needs its camera projections, and that of TOP the poses of its pixels.
    """
    found = {}
    for field in frame.get(5, []):
        laser = parse(field.value, frozenset({1, 2}))
        number = to_int(laser, 1)
        image = parse(to_bytes(laser, 2), frozenset({2, 3, 4}))
        needed = (2, 3, 4) if number == TOP else (2, 3)
        if all(len(to_bytes(image, part)) for part in needed):
            found[number] = image
    return found


def read_scans(frame: Message) -> list[Scan]:
    """Unpack the first returns of all lasers whose calibration is sound, by number.

    Raises:
        DataError: A range image is damaged.
    """
    lasers, _ = read_lasers(frame)
    return [
        make_scan(
            lasers[number],
            _unpack_floats(to_bytes(image, 2)),
            _unpack_ints(to_bytes(image, 3)),
            _unpack_floats(to_bytes(image, 4)) if number == TOP else None,
        )
        for number, image in sorted(first_returns(frame).items())
        if number in lasers
    ]


def _unpack_floats(data: memoryview) -> Float32[np.ndarray, "h w c"]:
    message = _inflate(data)
    values = to_floats(message, 1)
    return values.reshape(_shape(message, len(values)))


def _unpack_ints(data: memoryview) -> Int32[np.ndarray, "h w c"]:
    message = _inflate(data)
    values = to_ints(message, 1)
    return values.astype(np.int32).reshape(_shape(message, len(values)))


def _inflate(data: memoryview) -> Message:
    """Unpack a zlib stream, never beyond what a range image can hold."""
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(data, _MAX_MATRIX)
    except zlib.error as error:
        raise DataError(f"a range image is no whole zlib stream ({error})") from error
    if not stream.eof:
        raise DataError(f"a range image is cut off or has more than {_MAX_MATRIX} bytes")
    return parse(content, frozenset({1, 2}))


def _shape(message: Message, found: int) -> tuple[int, ...]:
    shape = tuple(to_ints(parse(to_bytes(message, 2), frozenset({1})), 1).tolist())
    if len(shape) != 3 or min(shape) < 1 or math.prod(shape) != found:
        raise DataError(f"a range image of shape {shape[:4]} holds {found} numbers")
    return shape


def read_boxes(frame: Message) -> list[Box]:
    """Read the laser labels."""
    boxes = []
    for field in frame.get(6, []):
        label = parse(field.value, frozenset({1, 2, 3}))
        box = parse(to_bytes(label, 1), frozenset(range(1, 8)))
        motion = parse(to_bytes(label, 2), frozenset({1, 2}))
        speed = math.hypot(to_float(motion, 1), to_float(motion, 2))
        # A box's fields are x, y, z, then width before length, height, heading.
        x, y, z, width, length, height, heading = (to_float(box, n) for n in range(1, 8))
        boxes.append(
            Box(
                center=(x, y, z),
                size=(length, width, height),
                heading=heading,
                speed=0.0 if to_int(label, 3) == SIGN and math.isnan(speed) else speed,
            )
        )
    return boxes
