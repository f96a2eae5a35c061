"""Protocol-buffer wire format: fields of a message by number, every bound checked.

https://protobuf.dev/programming-guides/encoding/ is the whole grammar; groups are not used by the
messages read here.
"""

import struct
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64

from l3r.errors import DataError

_MAX_FIELDS = 100_000
"""Fields kept of one message; a frame has hundreds."""
_NUMBER, _BLOCK = 0, 2
_FIXED = {1: 8, 5: 4}
"""Bytes of the wire types that have a fixed size."""


class Field(NamedTuple):
    """One field of a message."""

    value: memoryview
    """Its bytes: content of a length-delimited field, the number of any other."""
    start: int
    """Offset of ``value`` within the message."""
    is_packed: bool
    """Whether it is length-delimited."""


Message = dict[int, list[Field]]
"""Fields by number, in the order they came."""


def parse(data: bytes | memoryview, wanted: frozenset[int]) -> Message:
    """Split a message into its fields.

    Args:
        data: The serialised message.
        wanted: Numbers to keep; others are stepped over.

    Raises:
        DataError: The bytes are no message, or hold absurdly many fields.
    """
    view = memoryview(data)
    found: Message = {}
    at = count = 0
    while at < len(view):
        key, at = (view[at], at + 1) if view[at] < 0x80 else _varint(view, at)
        number, kind = key >> 3, key & 7
        start, end = (at, at + _FIXED[kind]) if kind in _FIXED else _extent(view, at, kind)
        if number == 0 or end > len(view):
            raise DataError(f"no protobuf message: field {number} at byte {at} does not fit")
        if number in wanted:
            count += 1
            if count > _MAX_FIELDS:
                raise DataError(f"no protobuf message read here: more than {_MAX_FIELDS} fields")
            field = Field(view[start:end], start, kind == _BLOCK)
            found.setdefault(number, []).append(field)
        at = end
    return found


def _extent(view: memoryview, at: int, kind: int) -> tuple[int, int]:
    """Give where the value of a field of no fixed size starts and ends, which may be outside."""
    if kind == _NUMBER:
        return at, _varint(view, at)[1]
    if kind == _BLOCK:
        size, start = _varint(view, at)
        return start, start + size
    raise DataError(f"no protobuf message: wire type {kind} at byte {at}")


def _varint(view: memoryview, at: int) -> tuple[int, int]:
    """Read a number; give it and the offset behind it."""
    value = 0
    for index, byte in enumerate(view[at : at + 10]):
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return value, at + index + 1
    raise DataError(f"no protobuf message: no number at byte {at}")


def last(message: Message, number: int) -> Field | None:
    """Give a field that is not repeated: the last one counts."""
    fields = message.get(number)
    return fields[-1] if fields else None


def to_int(message: Message, number: int, default: int = 0) -> int:
    """Read an int32, int64 or enum."""
    field = last(message, number)
    if field is None:
        return default
    if field.is_packed:
        raise DataError(f"protobuf field {number} is no number")
    value = _varint(field.value, 0)[0] & (2**64 - 1)
    return value - 2**64 if value >> 63 else value


def to_float(message: Message, number: int, default: float = np.nan) -> float:
    """Read a double."""
    field = last(message, number)
    if field is None:
        return default
    if len(field.value) != 8:
        raise DataError(f"protobuf field {number} is no double")
    return float(struct.unpack("<d", field.value)[0])


def to_bytes(message: Message, number: int) -> memoryview:
    """Read bytes, a string or a sub-message; empty where absent."""
    field = last(message, number)
    if field is None:
        return memoryview(b"")
    if not field.is_packed:
        raise DataError(f"protobuf field {number} is of another type")
    return field.value


def to_doubles(message: Message, number: int) -> Float64[np.ndarray, " n"]:
    """Read repeated doubles, packed or not."""
    return _join(message, number, "<f8").astype(np.float64)


def to_floats(message: Message, number: int) -> Float32[np.ndarray, " n"]:
    """Read repeated floats, packed or not."""
    return _join(message, number, "<f4").astype(np.float32)


def _join(message: Message, number: int, dtype: str) -> np.ndarray:
    data = b"".join(field.value for field in message.get(number, []))
    if len(data) % np.dtype(dtype).itemsize:
        raise DataError(f"protobuf field {number} is no list of numbers ({len(data)} bytes)")
    return np.frombuffer(data, dtype)


def to_ints(message: Message, number: int) -> Int64[np.ndarray, " n"]:
    """Read repeated int32, packed or not."""
    data = np.frombuffer(b"".join(field.value for field in message.get(number, [])), np.uint8)
    ends = np.flatnonzero(data < 0x80)
    if len(data) and (not len(ends) or ends[-1] != len(data) - 1):
        raise DataError(f"protobuf field {number} ends within a number")
    starts = np.concatenate([[0], ends[:-1] + 1]) if len(ends) else ends
    sizes = ends - starts + 1
    longest = int(sizes.max(initial=0))
    if longest > 10:
        raise DataError(f"protobuf field {number} holds a number of {longest} bytes")
    values = np.zeros(len(ends), np.uint64)
    for place in range(longest):
        part = data[np.minimum(starts + place, ends)].astype(np.uint64) & np.uint64(0x7F)
        values |= np.where(place < sizes, part << np.uint64(7 * place), np.uint64(0))
    return values.view(np.int64)
