import json
import math
import tracemalloc

import pytest

from data_prep.converters.co3d.annotations import (
    count_records,
    group_frames,
    read_list,
    read_sequences,
)
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.co3d.writer import gzipped, put, sequence_annotation, write_jgz


def plain(sequence, number, **change):
    """A record without depth and mask."""
    return {
        "sequence_name": sequence,
        "frame_number": number,
        "image": {"path": f"apple/{sequence}/images/{number}.jpg", "size": [40, 30]},
        "viewpoint": {
            "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
            "T": [0, 0, 1],
            "focal_length": [2, 2],
            "principal_point": [0, 0],
        },
        **change,
    }


def grouped(path, problems=None, is_wanted=lambda name: True):
    groups = group_frames(path, is_wanted, problems or Problems())
    return [(name, [frame.number for frame in frames]) for name, frames in groups]


def test_sequences_come_one_after_another_with_their_frames(tmp_path):
    path = tmp_path / "f.jgz"
    write_jgz(path, [plain("a", 1), plain("a", 0), plain("b", 5)])
    assert grouped(path) == [("a", [1, 0]), ("b", [5])]
    assert grouped(path, is_wanted=lambda name: name == "b") == [("b", [5])]


def test_records_of_mixed_sequences_are_brought_together(tmp_path):
    path = tmp_path / "f.jgz"
    write_jgz(path, [plain("a", 0), plain("b", 0), plain("c", 0), plain("a", 1), plain("b", 1)])
    assert grouped(path) == [("c", [0]), ("a", [0, 1]), ("b", [0, 1])]


def test_a_sequence_is_given_before_the_rest_of_the_file_is_parsed(tmp_path):
    good = json.dumps([plain("a", 0), plain("b", 0)])[:-1]
    filler = ", ".join([json.dumps(plain("c", 0, meta="x" * 1000))] * 1500)
    path = put(tmp_path, "f.jgz", gzipped(f"{good}, {filler}, nonsense, {filler}]".encode()))
    groups = group_frames(path, lambda name: True, Problems())
    assert next(groups)[0] == "a"
    assert next(groups)[0] == "b"
    with pytest.raises(DataError, match="expected a JSON list of objects"):
        next(groups)


def test_memory_does_not_grow_with_the_list(tmp_path):
    bulk = 6000 * "bulk"
    records = (json.dumps(plain(f"s{n // 10}", n % 10, meta=bulk)) for n in range(400))
    text = f"[{', '.join(records)}]"
    path = put(tmp_path, "f.jgz", gzipped(text.encode()))
    tracemalloc.start()
    number = sum(len(frames) for _, frames in group_frames(path, lambda name: True, Problems()))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert number == 400
    # Blocks of 1 MB as bytes and as text, a few at a time.
    assert peak < 7e6 < len(text)


@pytest.mark.parametrize("spaces", ["", "   ", "\n\t"])
def test_records_are_found_wherever_a_block_ends(tmp_path, spaces, monkeypatch):
    monkeypatch.setattr("data_prep.converters.co3d.annotations._CHUNK", 37)
    text = json.dumps([plain("a", n, note='}] "[{') for n in range(9)]).replace(
        ", {", f",{spaces}{{"
    )
    path = put(tmp_path, "f.jgz", gzipped((spaces + text + spaces).encode()))
    assert count_records(path) == {"a": 9}
    assert grouped(path) == [("a", list(range(9)))]


def test_an_empty_list_holds_nothing(tmp_path):
    write_jgz(tmp_path / "f.jgz", [])
    assert grouped(tmp_path / "f.jgz") == []


@pytest.mark.parametrize(
    "text", ["", "{}", "[", '[{"a": 1}', '[{"a": 1}, 3]', "[[]]", '[{"a"}]', "[" * 5000, "\udce4"]
)
def test_what_is_no_list_of_objects_is_refused(tmp_path, text):
    data = gzipped(text.encode("utf-8", "surrogateescape"))
    path = put(tmp_path, "f.jgz", data)
    with pytest.raises(DataError, match=r"f\.jgz: .*download it again"):
        list(read_list(path))


def test_a_record_without_end_is_refused_in_bounded_memory(tmp_path):
    path = put(tmp_path, "f.jgz", gzipped(b'[{"a": "' + b"x" * 20_000_000))
    tracemalloc.start()
    with pytest.raises(DataError, match="does not end"):
        list(read_list(path))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10e6


def test_a_record_nested_too_deeply_is_refused(tmp_path):
    path = put(tmp_path, "f.jgz", gzipped(b'[{"a": ' + b"[" * 2_000_000))
    with pytest.raises(DataError, match="does not end"):
        list(read_list(path))


def test_a_file_that_expands_beyond_belief_is_refused(tmp_path):
    path = put(tmp_path, "f.jgz", gzipped(b"[" + b" " * 70_000_000))
    with pytest.raises(DataError, match="expands to more than"):
        count_records(path)


def test_nothing_is_trusted_before_the_checksum_was_seen(tmp_path):
    whole = gzipped(json.dumps([plain("a", n) for n in range(50)]).encode())
    for damaged in (whole[:-1], whole[:-8], whole[:-5] + b"\0" + whole[-4:], b"", whole + b"junk"):
        path = put(tmp_path, "f.jgz", damaged)
        groups = group_frames(path, lambda name: True, Problems())
        if damaged:
            with pytest.raises(DataError, match="no whole gzip file"):
                next(groups)
        else:
            with pytest.raises(DataError, match="begins with ''"):
                next(groups)


BAD = {
    "frame_number": [None, "1", 1.5, True],
    "image": [
        None,
        3,
        {},
        {"path": "a/b.jpg"},
        {"path": "a/b.jpg", "size": [0, 30]},
        {"path": "a/b.jpg", "size": [math.nan, 30]},
        {"path": "a/b.jpg", "size": [40, 10**6]},
    ],
    "depth": [
        3,
        {},
        {"path": "a/b.png"},
        {"path": "a/b.png", "scale_adjustment": 0},
        {"path": "a/b.png", "scale_adjustment": math.nan},
        {"path": "a/b.png", "scale_adjustment": 10**400},
        {"path": "a/b.png", "scale_adjustment": 1, "mask_path": ["b.png"]},
    ],
    "mask": [{}, {"path": "a\nb.png"}, {"path": "a" * 2000}, {"path": ""}],
    "viewpoint": [
        {},
        {"R": [[1, 0, 0]] * 3, "T": [0, 0], "focal_length": [1, 1], "principal_point": [0, 0]},
        {"R": [[1, 0, 0]] * 2, "T": [0, 0, 0], "focal_length": [1, 1], "principal_point": [0, 0]},
        {**plain("a", 0)["viewpoint"], "T": [0, None, 0]},
        {**plain("a", 0)["viewpoint"], "T": [0, "1", 0]},
        {**plain("a", 0)["viewpoint"], "intrinsics_format": 3},
    ],
}


@pytest.mark.parametrize(
    ("key", "value"), [(key, v) for key, values in BAD.items() for v in values]
)
def test_a_malformed_record_is_counted_and_the_rest_kept(tmp_path, key, value):
    write_jgz(tmp_path / "f.jgz", [plain("a", 0), plain("a", 1, **{key: value}), plain("a", 2)])
    problems = Problems()
    assert grouped(tmp_path / "f.jgz", problems) == [("a", [0, 2])]
    assert problems.counts == {"bad_record": 1}
    assert "record 1" in problems.first["bad_record"].where


@pytest.mark.parametrize("name", ["../up", "a/b", "", None, 7, ".hidden", "x" * 200])
def test_a_name_that_is_no_plain_name_is_counted(tmp_path, name):
    write_jgz(tmp_path / "f.jgz", [plain(name, 0), plain("a", 2)])
    write_jgz(tmp_path / "s.jgz", [sequence_annotation(name), sequence_annotation("a")])
    problems = Problems()
    assert grouped(tmp_path / "f.jgz", problems) == [("a", [2])]
    assert list(read_sequences(tmp_path / "s.jgz", problems)) == ["a"]
    assert problems.counts == {"bad_record": 2}


def test_scores_may_be_null(tmp_path):
    records = [sequence_annotation("a", quality=None), sequence_annotation("b", cloud=None)]
    records += [sequence_annotation("c", quality=math.nan), sequence_annotation("d")]
    records[3]["point_cloud"] = None
    write_jgz(tmp_path / "s.jgz", records)
    found = read_sequences(tmp_path / "s.jgz", Problems())
    scores = {name: (r.viewpoint_quality, r.pointcloud_quality) for name, r in found.items()}
    assert scores == {"a": (None, 0.8), "b": (1.5, None), "c": (None, 0.8), "d": (1.5, None)}
