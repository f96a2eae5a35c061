"""Version 1: one TFRecord of Frame messages for each segment."""

from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from pathlib import Path

from data_prep.converters.waymo.calibration import CAMERAS, Camera
from data_prep.converters.waymo.depth import read_depth
from data_prep.converters.waymo.frame import (
    FRAME,
    FRAME_LASERS,
    first_returns,
    read_boxes,
    read_cameras,
    read_lasers,
    read_rigid,
    read_scans,
)
from data_prep.converters.waymo.images import check_jpeg, read_image
from data_prep.converters.waymo.lidar import Sweep, make_sweep
from data_prep.converters.waymo.moment import Moment, Shot
from data_prep.converters.waymo.tfrecord import (
    RecordPlace,
    find_records,
    read_bytes,
    read_payload,
)
from data_prep.converters.waymo.wire import Field, parse, to_bytes, to_int
from data_prep.problems import Problems
from data_prep.survey import SceneSurvey
from l3r.errors import DataError


def read_moments(path: Path, frame_step: int, problems: Problems) -> Iterator[Moment]:
    """Read a segment record by record; every record taken is checked against its CRC.

    Args:
        path: The TFRecord.
        frame_step: Take every so many records.
        problems: Told what is left out.
    """
    for place in find_records(path, problems):
        if place.number % frame_step:
            continue
        try:
            payload = read_payload(place)
        except DataError as error:
            problems.add("bad_crc", str(place), str(error))
            continue
        try:
            yield _read_moment(place, payload, problems)
        except DataError as error:
            problems.add("bad_frame", str(place), str(error))


def survey_segment(path: Path, name: str, excluded: str) -> SceneSurvey:
    """Count a segment's images, taking every record to hold what the first sound one holds.

    Args:
        path: The TFRecord.
        name: Name of the scene.
        excluded: Why it is left out by default.
    """
    places = list(find_records(path))
    moment = next(read_moments(path, 1, Problems()), None)
    shots = moment.shots if moment else []
    complete = len(shots) if moment and moment.has_lidar else 0
    return SceneSurvey(
        name=name,
        num_images=len(places) * complete,
        image_size=shots[0].camera.image_size if shots else None,
        num_missing=len(places) * (len(CAMERAS) - complete),
        excluded=excluded,
    )


def _read_moment(place: RecordPlace, payload: bytes, problems: Problems) -> Moment:
    """Read all of a frame but its pixels and ranges."""
    frame = parse(payload, FRAME)
    timestamp = to_int(frame, 2)
    if timestamp <= 0:
        raise DataError(f"{place}: no timestamp; download it again")
    cameras = read_cameras(frame, str(place), problems)
    images: dict[int, Field] = {}
    for field in frame.get(4, []):
        images.setdefault(to_int(parse(field.value, frozenset({1})), 1), field)
    shots = []
    for number, camera in sorted(cameras.items()):
        where = f"{place}, camera {camera.name}"
        if number not in images:
            problems.add("missing_image", where, "the frame has no image of it")
            continue
        shot = _read_shot(place, images[number], camera, problems)
        shots += [shot] if shot else []
    lasers, faults = read_lasers(frame)
    for fault in faults:
        problems.add("bad_calibration", str(place), fault)
    return Moment(
        timestamp=timestamp,
        world_from_vehicle=read_rigid(frame, 3, f"{place}: vehicle pose"),
        shots=shots,
        has_lidar=bool(lasers.keys() & first_returns(frame).keys()),
    )


def _read_shot(place: RecordPlace, field: Field, camera: Camera, problems: Problems) -> Shot | None:
    """Read all of an image but its pixels; None, and a problem, where it cannot be used."""
    where = f"{place}, camera {camera.name}"
    image = parse(field.value, frozenset({2, 3}))
    jpeg = to_bytes(image, 2)
    if not jpeg:
        problems.add("missing_image", where, "its pixels are stripped")
        return None
    try:
        check_jpeg(jpeg.tobytes(), camera.image_size, where)
    except DataError as error:
        problems.add("bad_image", where, str(error))
        return None
    try:
        # The vehicle's pose at the image's own time: the frame's is up to half a metre off.
        world_from_vehicle = read_rigid(image, 3, f"{where}: vehicle pose")
    except DataError as error:
        problems.add("bad_pose", where, str(error))
        return None
    world_from_cam = world_from_vehicle @ camera.vehicle_from_cam
    start = place.start + field.start + image[2][-1].start
    read_jpeg: Callable[[], bytes] = partial(read_bytes, place.path, start, len(jpeg))
    return Shot(
        camera=camera,
        world_from_cam=world_from_cam,
        read_image=partial(read_image, read_jpeg, camera, where),
        read_depth=partial(read_depth, partial(read_sweep, place), camera, world_from_cam),
    )


@lru_cache(maxsize=1)
def read_sweep(place: RecordPlace) -> Sweep:
    """Read the points of a frame's lasers; the last frame's are kept, for its other cameras.

    Raises:
        DataError: The record or a range image is damaged.
    """
    frame = parse(read_payload(place), FRAME_LASERS)
    try:
        return make_sweep(
            read_scans(frame), read_rigid(frame, 3, "vehicle pose"), read_boxes(frame)
        )
    except DataError as error:
        raise DataError(f"{place}: {error}; leave this frame out") from error
