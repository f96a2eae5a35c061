"""Flipped bits and forged headers: an error of one line, or a graph; never anything else."""

import dataclasses
import io
import json
import random
import tarfile
import warnings

import numpy as np
import pytest

from l3r.data import schema
from l3r.data.schema.headers import depth_pixels, jpeg_size
from l3r.errors import DataError
from tests.data.graphs import make_graph, write_folder

DEPTH, PHOTO = "00.depth.npy", "00.jpg"


@pytest.fixture
def members():
    return schema.encode_graph(make_graph(0, 2, 8, 16), "toy-0")


def decode(members):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return schema.decode_graph(members, 2)


def flipped(data, bit):
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def header_bits(name, data):
    """A share of the bits of the headers; the meta is nothing else."""
    length = {"json": len(data), PHOTO: data.find(b"\xff\xda") + 12, DEPTH: 128}[name]
    return random.Random(0).sample(range(8 * length), 500)


@pytest.mark.parametrize("name", ["json", PHOTO, DEPTH])
def test_one_flipped_bit_gives_a_graph_or_a_line(members, name):
    messages = []
    for bit in header_bits(name, members[name]):
        try:
            decode({**members, name: flipped(members[name], bit)})
        except DataError as error:
            messages.append(str(error))
    # A flipped size in the meta is found where a picture has another.
    start = "toy-0." if name == "json" else f"toy-0.{name}: "
    assert all(message.startswith(start) for message in messages)
    assert all(len(message.splitlines()) == 1 for message in messages)
    assert len(messages) == 500 if name == DEPTH else len(messages) > 50


def test_one_flipped_bit_of_a_tar_gives_members_or_a_line(tmp_path):
    folder = write_folder(tmp_path, [make_graph(0, 2, 8, 16)])
    (entry,) = schema.index_shard(folder / "hand-000000.tar").graphs
    data = schema.read_range(folder / "hand-000000.tar", entry)
    refused = 0
    for bit in range(0, 8 * 512, 3):
        try:
            schema.members_from_bytes(flipped(data, bit), "here", entry.key)
        except DataError:
            refused += 1
    assert refused > 300


def forged(kind):
    stream = io.BytesIO()
    array = np.ones((8, 16), np.float16)
    if kind == "a zip":
        np.savez(stream, array)
    elif kind == "a giant":
        np.lib.format.write_array_header_1_0(
            stream, {"descr": "<f2", "fortran_order": False, "shape": (10**9, 10**9)}
        )
    elif kind == "in columns":
        np.save(stream, np.asfortranarray(array))
    elif kind == "of doubles":
        np.save(stream, array.astype(np.float64))
    elif kind == "too long":
        np.save(stream, array)
        stream.write(b"x")
    else:
        stream.write(b"PK\x03\x04 and no zip")
    return stream.getvalue()


@pytest.mark.parametrize(
    "kind", ["a zip", "PK alone", "a giant", "in columns", "of doubles", "too long"]
)
def test_depth_in_any_other_form_is_refused(members, kind):
    with pytest.raises(DataError, match=r"toy-0\.00\.depth\.npy: no whole array.*\(8, 16\)"):
        decode({**members, DEPTH: forged(kind)})


def test_depth_that_lies_in_columns_in_memory_is_stored_in_rows():
    graph = make_graph(0, 2, 8, 16)
    depth = [np.asfortranarray(np.arange(1, 129, dtype=np.float32).reshape(8, 16))] * 2
    turned = dataclasses.replace(graph, depth=depth)
    back = decode(schema.encode_graph(turned, "toy-0"))
    np.testing.assert_array_equal(back.depth[0], depth[0])


def test_a_jpeg_that_claims_to_be_huge_is_refused_before_it_is_decoded(members):
    data = members[PHOTO]
    at = data.index(b"\xff\xc0") + 5
    huge = data[:at] + (65000).to_bytes(2, "big") * 2 + data[at + 4 :]
    with pytest.raises(DataError, match=r"\(65000, 65000\), the meta says \(8, 16\)"):
        decode({**members, PHOTO: huge})


def spoil(**changes):
    return lambda meta: json.dumps({**meta, **changes}).encode()


BAD_META = {
    "infinite size": spoil(image_size=[[float("inf"), 16], [8, 16]]),
    "short list of sizes": spoil(image_size=[[8, 16]]),
    "size of a fraction": spoil(image_size=[[8.5, 16], [8, 16]]),
    "size of nothing": spoil(image_size=[[0, 16], [8, 16]]),
    "number of 400 digits": spoil(K=[[[10**400, 0, 8], [0, 30, 4], [0, 0, 1]]] * 2),
    "text for file names": spoil(file="ab"),
    "number for a name": spoil(scene=5),
    "text for a truth": spoil(is_metric="no"),
    "deep nesting": lambda _: b"[" * 100_000,
    "number of 5000 digits": lambda _: b"1" * 5000,
    "rotation beyond doubles": spoil(
        cam_from_world=[np.eye(4).tolist(), np.diag([1e200, 1e200, 1e200, 1]).tolist()]
    ),
    "turns beyond doubles": spoil(
        cam_from_world=[
            np.eye(4).tolist(),
            [[1e200, 1e200, 0, 0], [1e200, -1e200, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        ]
    ),
}


@pytest.mark.parametrize("name", list(BAD_META))
def test_meta_that_nobody_wrote_is_refused(members, name):
    with pytest.raises(DataError, match=r"toy-0\.json: ") as error:
        decode({**members, "json": BAD_META[name](json.loads(members["json"]))})
    assert len(str(error.value)) < 400


def test_a_member_that_is_no_file_is_refused():
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as tar:
        link = tarfile.TarInfo("toy-0.json")
        link.type, link.linkname = tarfile.SYMTYPE, "elsewhere"
        tar.addfile(link)
    with pytest.raises(DataError, match=r"here: found member 'toy-0\.json', expected files"):
        schema.members_from_bytes(stream.getvalue(), "here", "toy-0")


def test_headers_are_read_as_they_were_written(members):
    assert jpeg_size(members[PHOTO]) == (8, 16)
    assert jpeg_size(members[PHOTO][:20]) is None
    np.testing.assert_array_equal(depth_pixels(members[DEPTH], (8, 16)), np.ones((8, 16)))
    assert depth_pixels(members[DEPTH], (16, 8)) is None
