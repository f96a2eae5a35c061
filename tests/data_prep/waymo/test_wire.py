import struct

import numpy as np
import pytest

from data_prep.converters.waymo import wire
from data_prep.converters.waymo.wire import (
    parse,
    to_bytes,
    to_doubles,
    to_float,
    to_floats,
    to_int,
    to_ints,
)
from l3r.errors import DataError
from tests.data_prep.waymo.wire_writer import block, double, doubles, number, varint

ALL = frozenset(range(1, 100))


def test_fields_are_found_by_number_wherever_they_stand():
    data = block(7, b"seven") + number(3, 300) + double(2, -1.5) + number(90, 1)
    message = parse(data, ALL)
    assert bytes(to_bytes(message, 7)) == b"seven"
    assert to_int(message, 3) == 300
    assert to_float(message, 2) == -1.5
    assert to_int(message, 5) == 0
    assert np.isnan(to_float(message, 5))
    assert len(to_bytes(message, 5)) == 0
    assert list(parse(data, frozenset({3}))) == [3]


def test_a_field_knows_where_its_value_starts():
    data = number(1, 5) + block(2, b"xyz")
    (field,) = parse(data, ALL)[2]
    assert data[field.start : field.start + 3] == b"xyz"


def test_the_last_of_a_single_field_counts():
    assert to_int(parse(number(1, 5) + number(1, 6), ALL), 1) == 6


@pytest.mark.parametrize("value", [0, 1, 127, 128, 300, 2**31 - 1, -1, -(2**31), 2**62])
def test_numbers_of_any_size_and_sign(value):
    assert to_int(parse(number(1, value), ALL), 1) == value
    np.testing.assert_array_equal(to_ints(parse(block(1, varint(value)), ALL), 1), [value])


def test_lists_are_read_packed_or_not():
    values = [0.5, -2.0, 1e300]
    packed = block(1, struct.pack("<3d", *values))
    for data in (packed, doubles(1, values), doubles(1, values[:1]) + block(1, packed[10:])):
        np.testing.assert_array_equal(to_doubles(parse(data, ALL), 1), values)
    whole = [3, -7, 70_000]
    data = block(1, b"".join(map(varint, whole)))
    np.testing.assert_array_equal(to_ints(parse(data, ALL), 1), whole)
    np.testing.assert_array_equal(
        to_ints(parse(b"".join(number(1, v) for v in whole), ALL), 1), whole
    )
    np.testing.assert_array_equal(
        to_floats(parse(block(1, struct.pack("<2f", 1.5, -2)), ALL), 1), [1.5, -2]
    )


@pytest.mark.parametrize(
    "data",
    [
        b"\x0a",
        b"\x0a\x05abc",
        b"\x09\0\0",
        b"\x0d\0\0",
        b"\x08\xff",
        b"\x08" + b"\xff" * 10 + b"\x01",
        b"\x0b",
        b"\x0c",
        b"\x0f",
        b"\x00\x01",
        b"\x0a" + varint(2**63) + b"abc",
    ],
)
def test_what_is_no_message_is_refused(data):
    with pytest.raises(DataError, match="no protobuf message"):
        parse(data, ALL)


def test_values_of_another_type_are_refused():
    message = parse(block(1, b"abc") + number(2, 5), ALL)
    for read, tag in ((to_int, 1), (to_float, 1), (to_bytes, 2), (to_doubles, 1), (to_floats, 1)):
        with pytest.raises(DataError, match="protobuf field"):
            read(message, tag)


@pytest.mark.parametrize("packed", [b"\x80", b"\x01\xff", b"\xff" * 10 + b"\x01"])
def test_whole_numbers_that_do_not_end_are_refused(packed):
    with pytest.raises(DataError, match="protobuf field 1"):
        to_ints(parse(block(1, packed), ALL), 1)


def test_absurdly_many_fields_are_refused(monkeypatch):
    monkeypatch.setattr(wire, "_MAX_FIELDS", 1000)
    with pytest.raises(DataError, match="more than"):
        parse(b"\x08\x01" * 1001, ALL)
