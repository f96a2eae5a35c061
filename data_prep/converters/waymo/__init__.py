"""Waymo Open Dataset (Perception), version 1 (TFRecord) and 2 (Parquet).

One scene for each segment of 20 s, with all five cameras: images of different cameras at different
times see the same street from far apart, which no single camera of a driving car does. Images are
undistorted; depth comes from all five lasers and is sparse; cameras stand where the car was when
the image was taken. See docs/datasets/waymo.md.
"""

import math
from collections.abc import Collection, Iterable, Iterator
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from data_prep.converters.waymo import v1
from data_prep.converters.waymo.moment import Moment
from data_prep.converters.waymo.segments import Segment, Split, find_segments
from data_prep.problems import Problems
from data_prep.scene import Frame, Scene
from data_prep.survey import SceneSurvey
from l3r.errors import DataError

MIN_MOVE = 0.2
"""A frame is taken when the car has driven this far since the last one taken [m]..."""
MIN_TURN = math.radians(1.0)
"""...or has turned by this angle [rad]; the rest, such as waiting at lights, is left out."""


def read(
    root: Path,
    split: Split = "train",
    *,
    scenes: str = "*",
    frame_step: int = 1,
    problems: Problems,
    names: Collection[str] | None = None,
    require_depth: bool = True,
) -> Iterator[Scene]:
    """Read segments of whichever version lies below a folder; pixels follow when asked for.

    Args:
        root: Any folder above the segments.
        split: ``train`` is the published training split, ``test`` the validation split, ``all``
            both and what lies below no folder named after a split. Testing is never read.
        scenes: Pattern on ``SPLIT/CONTEXT``.
        frame_step: Take every so many frames of a segment, before stationary ones are left out.
        problems: Told what is left out.
        names: Only scenes of these names; where given, that none of them can be read is no error.
        require_depth: Leave out frames without range images; else their depth is unknown
            everywhere.

    Yields:
        One scene per segment, sorted by name; frames by time, then camera.

    Raises:
        DataError: There is no segment, or not one frame can be read.
    """
    chosen = _choose(root, split, scenes, problems)
    num_scenes = 0
    for segment in chosen:
        if names is not None and segment.name not in names:
            continue
        with problems.about(segment.name):
            frames = _read_frames(segment, frame_step, problems, require_depth=require_depth)
            if not frames:
                problems.add("empty_scene", segment.path, f"{segment.name}: no frame can be used")
        if not frames:
            continue
        num_scenes += 1
        yield Scene(
            dataset="waymo",
            name=segment.name,
            is_metric=True,
            frames=frames,
            has_sparse_depth=True,
        )
    if not num_scenes and names is None:
        raise DataError(
            f"{root}: no frame of {len(chosen)} segments can be used: {problems.summary()};"
            " download them again, with all components"
        )


def list_names(root: Path, split: Split, *, scenes: str, problems: Problems) -> list[str]:
    """List the names of what :func:`read` reads, in its order; arguments and errors are its own."""
    return [segment.name for segment in _choose(root, split, scenes, problems)]


def survey(root: Path) -> Iterator[SceneSurvey]:
    """List the segments below a folder; of a TFRecord only the lengths and one record are read.

    Args:
        root: Any folder above the segments.

    Raises:
        DataError: There is no segment, or Parquet cannot be read here.
    """
    for segment in _find(root, Problems()):
        if segment.is_parquet:
            from data_prep.converters.waymo import v2

            yield v2.survey_segment(
                segment.path, segment.context, segment.name, excluded=segment.excluded
            )
        else:
            yield v1.survey_segment(segment.path, segment.name, segment.excluded)


def _find(root: Path, problems: Problems) -> list[Segment]:
    segments = find_segments(root, problems)
    if not segments:
        raise DataError(
            f"{root}: no segment below it, expected training/segment-*.tfrecord (version 1) or"
            " training/camera_image/*.parquet (version 2); check the folder"
        )
    return segments


def _choose(root: Path, split: Split, scenes: str, problems: Problems) -> list[Segment]:
    segments = _find(root, problems)
    chosen = [s for s in segments if s.is_in(split) and fnmatch(s.name, scenes)]
    if not chosen:
        raise DataError(
            f"{root}: none of {len(segments)} segments ({segments[0].name}, ...) is in split"
            f" '{split}' and matches '{scenes}'; change --split or --scenes (training is 'train',"
            " validation is 'test', testing is never read)"
        )
    return chosen


def _read_frames(
    segment: Segment, frame_step: int, problems: Problems, *, require_depth: bool
) -> list[Frame]:
    found: dict[int, Moment] = {}
    for moment in _read_moments(segment, frame_step, problems):
        where = f"{segment.path}: frame at {moment.timestamp}"
        if require_depth and not moment.has_lidar:
            problems.add("no_lidar", where, "no range image that can be placed")
        elif moment.timestamp in found:
            problems.add("duplicate_frame", where, "another one has the same timestamp")
        else:
            found[moment.timestamp] = moment
    return [
        Frame(
            name=f"{moment.timestamp}_{shot.camera.name}",
            image_size=shot.camera.image_size,
            K=shot.camera.K,
            world_from_cam=shot.world_from_cam,
            read_image=shot.read_image,
            read_depth=shot.read_depth,
        )
        for moment in thin_stationary([found[time] for time in sorted(found)])
        for shot in moment.shots
    ]


def _read_moments(segment: Segment, frame_step: int, problems: Problems) -> Iterator[Moment]:
    """Read whichever version it is; what breaks a whole segment is a problem, not the end."""
    try:
        if segment.is_parquet:
            from data_prep.converters.waymo import v2

            yield from v2.read_moments(segment.path, segment.context, frame_step, problems)
        else:
            yield from v1.read_moments(segment.path, frame_step, problems)
    except DataError as error:
        problems.add("bad_segment", segment.path, str(error))


def thin_stationary(moments: Iterable[Moment]) -> Iterator[Moment]:
    """Leave out moments at which the car stands where the last one taken stood.

    Args:
        moments: In order of time.
    """
    taken: Float64[np.ndarray, "4 4"] | None = None
    for moment in moments:
        if taken is None or _has_moved(taken, moment.world_from_vehicle):
            taken = moment.world_from_vehicle
            yield moment


def _has_moved(taken: Float64[np.ndarray, "4 4"], now: Float64[np.ndarray, "4 4"]) -> bool:
    move = float(np.linalg.norm(now[:3, 3] - taken[:3, 3]))
    # |R - I| is 2 sqrt(2) sin(angle / 2), which keeps small angles.
    chord = float(np.linalg.norm(taken[:3, :3].T @ now[:3, :3] - np.eye(3)))
    return move >= MIN_MOVE or chord >= math.sqrt(8) * math.sin(MIN_TURN / 2)
