"""TFRecord: ``u64 length | u32 CRC of the length | payload | u32 CRC of the payload``, repeated.

Integers are little-endian, the CRCs masked CRC-32C. One payload at a time is in memory.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from data_prep.converters.waymo.crc import crc32c, mask_crc
from data_prep.problems import Problems
from l3r.errors import DataError

MAX_RECORD = 2**28
"""Longest payload believed [bytes]; a frame with all its images and range images has 5 MB."""

_HEAD = struct.Struct("<QI")
_TAIL = struct.Struct("<I")


@dataclass(frozen=True, kw_only=True)
class RecordPlace:
    """Where a record lies."""

    path: Path
    """The file."""
    number: int
    """Its place among the records, from 0."""
    start: int
    """Offset of the payload in the file."""
    size: int
    """Bytes of the payload."""

    def __str__(self) -> str:
        return f"{self.path}: record {self.number}"


def find_records(path: Path, problems: Problems | None = None) -> Iterator[RecordPlace]:
    """Hop from length to length without reading payloads.

    Args:
        path: The file.
        problems: Told where the chain breaks: ``bad_length`` where a length fails its checksum,
            ``cut_off`` where the file ends within a record. What follows is lost either way.
    """
    problems = problems or Problems()
    file_size = path.stat().st_size
    offset = number = 0
    with path.open("rb") as stream:
        while offset < file_size:
            stream.seek(offset)
            size = _read_length(stream)
            where = f"{path}: record {number}"
            if size is None:
                problems.add("bad_length", where, "its length fails the checksum; the rest is lost")
                return
            end = offset + _HEAD.size + size + _TAIL.size
            if end > file_size:
                found = file_size - offset
                problems.add("cut_off", where, f"{found} bytes, expected {end - offset}")
                return
            yield RecordPlace(path=path, number=number, start=offset + _HEAD.size, size=size)
            offset, number = end, number + 1


def _read_length(stream: BinaryIO) -> int | None:
    """Read a record's length; None where its checksum or the length itself is not sound."""
    head = stream.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    size, crc = _HEAD.unpack(head)
    sound = crc == mask_crc(crc32c(head[:8])) and size <= MAX_RECORD
    return int(size) if sound else None


def read_payload(place: RecordPlace) -> bytes:
    """Read a record and check its CRC.

    Raises:
        DataError: The file ends early or the checksum differs.
    """
    with place.path.open("rb") as stream:
        stream.seek(place.start)
        data = stream.read(place.size + _TAIL.size)
    payload = memoryview(data)[: place.size]
    found = mask_crc(crc32c(payload))
    if len(data) < place.size + _TAIL.size or _TAIL.unpack(data[place.size :])[0] != found:
        raise DataError(f"{place}: its checksum differs from the stored one; download it again")
    return payload.tobytes()


def read_bytes(path: Path, start: int, size: int) -> bytes:
    """Read part of a file that was checked before.

    Raises:
        DataError: The file has become shorter.
    """
    with path.open("rb") as stream:
        stream.seek(start)
        data = stream.read(size)
    if len(data) < size:
        raise DataError(f"{path}: ends within a record; download it again")
    return data
