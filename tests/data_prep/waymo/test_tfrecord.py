import random

import pytest

from data_prep.converters.waymo.crc import crc32c, mask_crc
from data_prep.converters.waymo.tfrecord import (
    MAX_RECORD,
    find_records,
    read_bytes,
    read_payload,
)
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.waymo.wire_writer import masked_crc, tfrecord

PAYLOADS = [b"first" * 100, b"", b"third" * 1000, b"last"]


def write(path, data):
    path.write_bytes(data)
    return path


def read_sound(path, problems):
    """Payloads by number, those whose CRC is right."""
    found = {}
    for place in find_records(path, problems):
        try:
            found[place.number] = read_payload(place)
        except DataError as error:
            problems.add("bad_crc", str(place), str(error))
    return found


def test_checksums_are_the_published_ones():
    # RFC 3720, appendix B.4.
    assert crc32c(bytes(32)) == 0x8A9136AA
    assert crc32c(b"\xff" * 32) == 0x62A8AB43
    assert crc32c(bytes(range(32))) == 0x46DD794E
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(b"") == 0


@pytest.mark.parametrize("size", [511, 512, 513, 1025, 40_000, 2**20 - 1, 2**20, 2**20 + 517])
def test_checksums_of_any_length_are_those_computed_byte_by_byte(size):
    data = random.Random(size).randbytes(size)
    assert mask_crc(crc32c(data)) == masked_crc(data)


def test_a_flipped_bit_anywhere_changes_the_checksum():
    data = random.Random(0).randbytes(5000)
    for place in random.Random(1).sample(range(40_000), 50):
        flipped = bytearray(data)
        flipped[place // 8] ^= 1 << place % 8
        assert crc32c(bytes(flipped)) != crc32c(data)


def test_records_are_found_and_read_by_offset(tmp_path):
    path = write(tmp_path / "f", tfrecord(PAYLOADS))
    places = list(find_records(path))
    assert [place.number for place in places] == [0, 1, 2, 3]
    assert read_payload(places[2]) == PAYLOADS[2]
    assert read_payload(places[0]) == PAYLOADS[0]
    assert read_bytes(path, places[2].start + 5, 10) == PAYLOADS[2][5:15]


def test_a_damaged_payload_is_counted_and_the_rest_kept(tmp_path):
    data = bytearray(tfrecord(PAYLOADS))
    data[12 + 40] ^= 0x10
    problems = Problems()
    found = read_sound(write(tmp_path / "f", data), problems)
    assert found == {1: PAYLOADS[1], 2: PAYLOADS[2], 3: PAYLOADS[3]}
    assert problems.summary() == "1 bad_crc"
    assert "record 0" in problems.first["bad_crc"].where


@pytest.mark.parametrize("at", [0, 3, 7, 8, 11])
def test_a_damaged_length_ends_the_file(tmp_path, at):
    data = bytearray(tfrecord(PAYLOADS))
    data[516 + at] ^= 0x01
    problems = Problems()
    assert list(read_sound(write(tmp_path / "f", data), problems)) == [0]
    assert problems.summary() == "1 bad_length"


@pytest.mark.parametrize("cut", [1, 4, 5, 9, 19])
def test_a_cut_file_keeps_its_whole_records(tmp_path, cut):
    path = write(tmp_path / "f", tfrecord(PAYLOADS)[:-cut])
    problems = Problems()
    assert list(read_sound(path, problems)) == [0, 1, 2]
    assert problems.counts.total() == 1
    assert set(problems.counts) <= {"cut_off", "bad_length"}


def test_a_length_beyond_belief_is_refused_before_it_is_read(tmp_path):
    head = (MAX_RECORD + 1).to_bytes(8, "little")
    data = head + masked_crc(head).to_bytes(4, "little") + b"x" * 100
    problems = Problems()
    assert read_sound(write(tmp_path / "f", data), problems) == {}
    assert problems.summary() == "1 bad_length"


def test_a_file_that_became_shorter_is_an_error(tmp_path):
    path = write(tmp_path / "f", tfrecord(PAYLOADS))
    place = list(find_records(path))[2]
    write(path, path.read_bytes()[:1000])
    with pytest.raises(DataError, match="checksum differs"):
        read_payload(place)
    with pytest.raises(DataError, match="ends within a record"):
        read_bytes(path, place.start, place.size)
