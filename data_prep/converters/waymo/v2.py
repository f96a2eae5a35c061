"""Version 2: ``SPLIT/COMPONENT/CONTEXT.parquet``."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from data_prep.converters.waymo.calibration import CAMERAS, Camera, rigid_from_rows
from data_prep.converters.waymo.components import (
    ImageRow,
    ScanPlace,
    read_boxes,
    read_cameras,
    read_image_rows,
    read_scan,
    read_scan_places,
    read_vehicle_poses,
)
from data_prep.converters.waymo.depth import read_depth
from data_prep.converters.waymo.images import read_image
from data_prep.converters.waymo.lidar import Box, Sweep, make_sweep
from data_prep.converters.waymo.moment import Moment, Shot
from data_prep.converters.waymo.parquet import Cell, read_cell
from data_prep.problems import Problems
from data_prep.survey import SceneSurvey
from l3r.errors import DataError


@dataclass(frozen=True, eq=False, kw_only=True)
class SweepPlace:
    """All lasers of one frame, still in their tables; compared by identity."""

    where: str
    """Named in errors."""
    scans: Sequence[ScanPlace]
    """First returns."""
    world_from_vehicle: Float64[np.ndarray, "4 4"]
    """The frame's own pose."""
    boxes: Sequence[Box]
    """Laser labels."""


def read_moments(
    folder: Path, context: str, frame_step: int, problems: Problems
) -> Iterator[Moment]:
    """Read a segment's small tables and join them.

    Args:
        folder: Holds the components.
        context: Name of the segment.
        frame_step: Take every so many frames.
        problems: Told what is left out.

    Raises:
        DataError: Images, camera calibrations or vehicle poses are missing or damaged.
    """
    images: dict[int, dict[int, ImageRow]] = {}
    for image in read_image_rows(folder, context):
        kept = images.setdefault(image.timestamp, {}).setdefault(image.camera, image)
        if kept is not image:
            problems.add("duplicate_frame", str(image.jpeg), "another row has the same keys")
    cameras = read_cameras(folder, context, problems)
    poses = read_vehicle_poses(folder, context, problems)
    scans, boxes = _read_lidar(folder, context, problems)
    for timestamp in sorted(images)[::frame_step]:
        where = f"{folder}: {context} at {timestamp}"
        if timestamp not in poses:
            problems.add("bad_pose", where, "vehicle_pose has no sound row of it")
            continue
        sweep = SweepPlace(
            where=where,
            scans=scans.get(timestamp, []),
            world_from_vehicle=poses[timestamp],
            boxes=boxes.get(timestamp, []),
        )
        yield Moment(
            timestamp=timestamp,
            world_from_vehicle=poses[timestamp],
            shots=list(_read_shots(images[timestamp], cameras, sweep, problems)),
            has_lidar=bool(sweep.scans),
        )


def _read_lidar(
    folder: Path, context: str, problems: Problems
) -> tuple[dict[int, list[ScanPlace]], dict[int, list[Box]]]:
    """Find range images and labels by timestamp; without the one the other is of no use."""
    try:
        return read_scan_places(folder, context, problems), read_boxes(folder, context)
    except DataError as error:
        problems.add("bad_lidar", f"{folder}: {context}", str(error))
        return {}, {}


def _read_shots(
    images: dict[int, ImageRow],
    cameras: dict[int, Camera],
    sweep: SweepPlace,
    problems: Problems,
) -> Iterator[Shot]:
    for number, camera in sorted(cameras.items()):
        where = f"{sweep.where}, camera {camera.name}"
        if number not in images:
            problems.add("missing_image", where, "the frame has no image of it")
            continue
        image = images[number]
        try:
            # The vehicle's pose at the image's own time, not the one in vehicle_pose.
            world_from_vehicle = rigid_from_rows(image.vehicle_rows, f"{where}: vehicle pose")
        except DataError as error:
            problems.add("bad_pose", where, str(error))
            continue
        world_from_cam = world_from_vehicle @ camera.vehicle_from_cam
        yield Shot(
            camera=camera,
            world_from_cam=world_from_cam,
            read_image=partial(read_image, partial(_read_jpeg, image.jpeg), camera, where),
            read_depth=partial(read_depth, partial(read_sweep, sweep), camera, world_from_cam),
        )


def _read_jpeg(cell: Cell) -> bytes:
    data: bytes = read_cell(cell).as_py()
    return data


@lru_cache(maxsize=1)
def read_sweep(place: SweepPlace) -> Sweep:
    """Read the points of a frame's lasers; the last frame's are kept, for its other cameras.

    Raises:
        DataError: A range image is damaged.
    """
    try:
        # In the order of the file, which is read forwards.
        cells = sorted(place.scans, key=lambda scan: (scan.ranges.cell.group, scan.ranges.cell.row))
        scans = [read_scan(scan) for scan in cells]
        return make_sweep(scans, place.world_from_vehicle, place.boxes)
    except DataError as error:
        raise DataError(f"{place.where}: {error}; leave this frame out") from error


def survey_segment(folder: Path, context: str, name: str, excluded: str) -> SceneSurvey:
    """Count a segment's images from its keys.

    Args:
        folder: Holds the components.
        context: Name of the segment.
        name: Name of the scene.
        excluded: Why it is left out by default.
    """
    try:
        moments = list(read_moments(folder, context, 1, Problems()))
    except DataError:
        moments = []
    shots = [shot for moment in moments if moment.has_lidar for shot in moment.shots]
    return SceneSurvey(
        name=name,
        num_images=len(shots),
        image_size=shots[0].camera.image_size if shots else None,
        num_missing=len(CAMERAS) * len(moments) - len(shots),
        excluded=excluded,
    )
