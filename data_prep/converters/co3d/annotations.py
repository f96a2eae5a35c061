"""Annotations of a CO3D category: gzipped JSON lists, read record by record.

A list of some hundred thousand records is never in memory as a whole. The gzip checksum stands at
the end of the file, so a first pass verifies it, and counts the records of each sequence, before
the second pass trusts anything.

Field names: ``FrameAnnotation`` and ``SequenceAnnotation`` of facebookresearch/co3d.
"""

import gzip
import json
import math
import re
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_prep.problems import Problems
from l3r.errors import DataError

_CHUNK = 2**20
_MAX_RECORD = 2**20
"""Characters within which a record must end; genuine ones take 1,200."""
_FREE_BYTES = 2**26
_MAX_RATIO = 300
"""Bytes for each compressed byte that are still believed, above :data:`_FREE_BYTES`."""
_GAP = re.compile(r"[ \t\r\n,]*")
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}")
_NAME_OF_RECORD = re.compile(rb'"sequence_name"\s*:\s*"([A-Za-z0-9_.-]{1,128})"')
_OVERLAP = 512
"""Bytes kept between blocks, so that a name on their border is found."""
_MAX_SIDE = 2**15
_MAX_PATH = 1024

_UNREADABLE = (OSError, EOFError, zlib.error)


@dataclass(frozen=True, kw_only=True, slots=True)
class Viewpoint:
    """A PyTorch3D camera as it stands in the file: ``X_cam = X_world @ R + T``."""

    R: tuple[tuple[float, ...], ...]
    """3x3, for row vectors."""
    T: tuple[float, ...]
    """Translation, in the sequence's own unit."""
    focal_length: tuple[float, ...]
    """(x, y), in units of ``intrinsics_format``."""
    principal_point: tuple[float, ...]
    """(x, y) from the image centre, x to the left and y up."""
    intrinsics_format: str
    """``ndc_isotropic`` or ``ndc_norm_image_bounds``."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameRecord:
    """One frame; its paths are relative to the data set's root, as they stand in the file."""

    sequence: str
    """Name of its sequence."""
    number: int
    """``frame_number``: the key of the set lists, not the suffix of a file name."""
    image_path: str
    """JPEG."""
    image_size: tuple[int, int]
    """(height, width)."""
    depth_path: str | None
    """16-bit PNG."""
    scale_adjustment: float
    """What the numbers in the PNG are multiplied with."""
    depth_mask_path: str | None
    """PNG, above 0 where depth is valid."""
    mask_path: str | None
    """8-bit PNG of foreground probability."""
    viewpoint: Viewpoint | None
    """Camera; None where structure from motion gave none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SequenceRecord:
    """One sequence."""

    name: str
    """Name, unique within the category."""
    viewpoint_quality: float | None
    """The bigger the better; None where it was not judged."""
    pointcloud_quality: float | None
    """The bigger the better; None where it was not judged or there is no point cloud."""


def read_sequences(path: Path, problems: Problems) -> dict[str, SequenceRecord]:
    """Read ``sequence_annotations.jgz``: a small table.

    Args:
        path: The file.
        problems: Told about records that cannot be used.

    Raises:
        DataError: The file is missing, damaged or no list.
    """
    count_records(path)
    found: dict[str, SequenceRecord] = {}
    for number, raw in enumerate(read_list(path)):
        try:
            record = _sequence_record(raw)
        except DataError as error:
            problems.add("bad_record", f"{path}: record {number}", str(error))
            continue
        found.setdefault(record.name, record)
    return found


def group_frames(
    path: Path, is_wanted: Callable[[str], bool], problems: Problems
) -> Iterator[tuple[str, list[FrameRecord]]]:
    """Read ``frame_annotations.jgz`` and give the frames of one sequence after another.

    A sequence is given as soon as its last record was read, so that only sequences whose records
    are mixed with each other are in memory together.

    Args:
        path: The file.
        is_wanted: Tells which sequences to give, by name.
        problems: Told about records that cannot be used.

    Yields:
        ``(sequence, frames)``, frames in the order of the file.

    Raises:
        DataError: The file is missing, damaged or no list.
    """
    left = count_records(path)
    unfinished: dict[str, list[FrameRecord]] = {}
    for number, raw in enumerate(read_list(path)):
        where = f"{path}: record {number}"
        name = raw.get("sequence_name")
        if not (isinstance(name, str) and _NAME.fullmatch(name)):
            problems.add(
                "bad_record", where, f"sequence_name {_short(name)}, expected a plain name"
            )
            continue
        if is_wanted(name):
            try:
                unfinished.setdefault(name, []).append(_frame_record(raw, name))
            except DataError as error:
                problems.add("bad_record", where, str(error))
        left[name] -= 1
        if left[name] == 0 and unfinished.get(name):
            yield name, unfinished.pop(name)
    yield from ((name, frames) for name, frames in unfinished.items() if frames)


def count_records(path: Path) -> Counter[str]:
    """Verify a gzipped list's checksum and count how often each sequence is named in it.

    Args:
        path: The file.

    Raises:
        DataError: The file is missing, cut off, damaged or expands beyond belief.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file; unpack the category's archive again")
    counts: Counter[str] = Counter()
    most = max(_FREE_BYTES, _MAX_RATIO * path.stat().st_size)
    total, rest = 0, b""
    try:
        with gzip.open(path, "rb") as stream:
            while block := stream.read(_CHUNK):
                total += len(block)
                if total > most:
                    raise DataError(
                        f"{path}: expands to more than {most:,} bytes, expected {_MAX_RATIO} times"
                        " its size or less; download it again"
                    )
                text, end = rest + block, 0
                for match in _NAME_OF_RECORD.finditer(text):
                    counts[match[1].decode()] += 1
                    end = match.end()
                rest = text[max(end, len(text) - _OVERLAP) :]
    except _UNREADABLE as error:
        raise DataError(f"{path}: no whole gzip file ({error}); download it again") from error
    return counts


def read_list(path: Path) -> Iterator[dict[str, Any]]:
    """Give the objects of a gzipped JSON list one by one.

    Args:
        path: The file.

    Raises:
        DataError: The file is damaged, or not a list of objects.
    """
    decode = json.JSONDecoder().raw_decode
    with gzip.open(path, "rt", encoding="utf-8") as stream:
        text = _read_more(stream, path).lstrip()
        if not text.startswith("["):
            raise _no_list(path, f"begins with {text[:20]!r}")
        at = 1
        while True:
            gap = _GAP.match(text, at)
            at = gap.end() if gap else at
            if text.startswith("{", at):
                try:
                    record, at = decode(text, at)
                except (ValueError, RecursionError) as error:
                    if len(text) - at > _MAX_RECORD:
                        raise _no_list(path, f"a record does not end ({error})") from error
                else:
                    yield record
                    continue
            elif text.startswith("]", at):
                return
            elif at < len(text):
                raise _no_list(path, f"holds {text[at : at + 20]!r}")
            more = _read_more(stream, path)
            if not more:
                raise _no_list(path, "ends within the list")
            text, at = text[at:] + more, 0


def _read_more(stream: Any, path: Path) -> str:
    try:
        return str(stream.read(_CHUNK))
    except (*_UNREADABLE, UnicodeDecodeError) as error:
        raise DataError(f"{path}: no whole gzip file ({error}); download it again") from error


def _no_list(path: Path, found: str) -> DataError:
    return DataError(f"{path}: {found}, expected a JSON list of objects; download it again")


def _sequence_record(raw: dict[str, Any]) -> SequenceRecord:
    name = raw.get("sequence_name")
    if not (isinstance(name, str) and _NAME.fullmatch(name)):
        raise DataError(f"sequence_name {_short(name)}, expected a plain name")
    cloud = raw.get("point_cloud")
    return SequenceRecord(
        name=name,
        viewpoint_quality=_score(raw.get("viewpoint_quality_score")),
        pointcloud_quality=_score(cloud.get("quality_score") if isinstance(cloud, dict) else None),
    )


def _score(value: Any) -> float | None:
    """Scores may be null; one that is no number was not judged either."""
    try:
        score = _number(value, "score")
    except DataError:
        return None
    return score if math.isfinite(score) else None


def _frame_record(raw: dict[str, Any], name: str) -> FrameRecord:
    number = raw.get("frame_number")
    if not isinstance(number, int) or isinstance(number, bool):
        raise DataError(f"frame_number {_short(number)}, expected a whole number")
    image = _part(raw, "image")
    depth, mask = raw.get("depth"), raw.get("mask")
    if image is None:
        raise DataError("no image, expected its path and size")
    scale, depth_path, depth_mask_path = 1.0, None, None
    if depth is not None:
        depth = _part(raw, "depth") or {}
        depth_path = _path(depth.get("path"))
        scale = _number(depth.get("scale_adjustment"), "scale_adjustment")
        if not 0 < scale < math.inf:
            raise DataError(f"scale_adjustment {scale}, expected a finite number above 0")
        if depth.get("mask_path") is not None:
            depth_mask_path = _path(depth["mask_path"])
    return FrameRecord(
        sequence=name,
        number=number,
        image_path=_path(image.get("path")),
        image_size=_image_size(image.get("size")),
        depth_path=depth_path,
        scale_adjustment=scale,
        depth_mask_path=depth_mask_path,
        mask_path=None if mask is None else _path((_part(raw, "mask") or {}).get("path")),
        viewpoint=_viewpoint(_part(raw, "viewpoint")),
    )


def _part(raw: dict[str, Any], key: str) -> dict[str, Any] | None:
    value = raw.get(key)
    if value is not None and not isinstance(value, dict):
        raise DataError(f"{key} {_short(value)}, expected an object")
    return value


def _viewpoint(raw: dict[str, Any] | None) -> Viewpoint | None:
    if raw is None:
        return None
    rows = raw.get("R")
    if not (isinstance(rows, list) and len(rows) == 3):
        raise DataError(f"R {_short(rows)}, expected three rows")
    # Files of the first release lack the key and mean this one.
    unit = raw.get("intrinsics_format", "ndc_norm_image_bounds")
    if not isinstance(unit, str):
        raise DataError(f"intrinsics_format {_short(unit)}, expected a name")
    return Viewpoint(
        R=tuple(_numbers(row, 3, "R") for row in rows),
        T=_numbers(raw.get("T"), 3, "T"),
        focal_length=_numbers(raw.get("focal_length"), 2, "focal_length"),
        principal_point=_numbers(raw.get("principal_point"), 2, "principal_point"),
        intrinsics_format=unit.lower(),
    )


def _image_size(value: Any) -> tuple[int, int]:
    height, width = _numbers(value, 2, "image size")
    if not (height % 1 == width % 1 == 0 and min(height, width) >= 2):
        raise DataError(f"image size {_short(value)}, expected [height, width]")
    if max(height, width) > _MAX_SIDE:
        raise DataError(f"image size {_short(value)}, expected {_MAX_SIDE} or less")
    return int(height), int(width)


def _numbers(value: Any, count: int, what: str) -> tuple[float, ...]:
    if not (isinstance(value, list) and len(value) == count):
        raise DataError(f"{what} {_short(value)}, expected {count} numbers")
    return tuple(_number(item, what) for item in value)


def _number(value: Any, what: str) -> float:
    """Give a number; JSON of Python may hold NaN and infinities."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise DataError(f"{what} {_short(value)}, expected a number")
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _path(value: Any) -> str:
    """Give a path as it stands in the file; whoever opens it keeps it inside the root."""
    if not (isinstance(value, str) and 0 < len(value) <= _MAX_PATH and value.isprintable()):
        raise DataError(f"path {_short(value)}, expected one relative to the data set's root")
    return value


def _short(value: Any) -> str:
    return repr(value)[:80]
