"""What is broken is named and counted; the rest is still read."""

import json
from pathlib import Path

import numpy as np
import pytest

from data_prep.check import EXACT, CheckOptions, check_shards
from data_prep.check.faults import KINDS, LISTED_EACH, Fault, Faults
from data_prep.cli import main
from l3r.data.schema import index_path, read_manifest
from tests.data_prep import damage

GOLDEN = Path(__file__).parents[1] / "golden" / "check_json_keys.txt"
EVERYTHING = CheckOptions(max_graphs=2, decode_all=True, digests=True)


@pytest.fixture
def folder(room_shards, tmp_path):
    return damage.copy(room_shards, tmp_path / "shards")


def check(folder, *words):
    return main(["check", str(folder), "--all", "--max-graphs", "2", "--no-report", *words])


def nan_camera(meta):
    meta["cam_from_world"][1][0][3] = float("nan")


def negative_focal(meta):
    meta["K"][0][0][0] = -1.0


def overlap_of_two(meta):
    meta["pairs"]["iou"][0][1] = 2.0


def lost_score(meta):
    meta["pairs"]["score"][0][1] = None


def other_size(meta):
    meta["image_size"][0][0] += 1


def drop(name):
    return lambda members: members.pop(name)


def put(name, data):
    return lambda members: members.update({name: data})


def in_meta(change):
    return lambda tar: damage.edit_meta(tar, change)


def in_members(change):
    return lambda tar: damage.edit_first(tar, change)


GRAPH_DAMAGE = {
    "a lost image": (in_members(drop("02.jpg")), "missing_member", "02.jpg"),
    "a lost depth map": (in_members(drop("00.depth.npy")), "missing_member", "00.depth.npy"),
    "a lost JSON": (in_members(drop("json")), "missing_member", "json"),
    "text for JSON": (in_members(put("json", b"{")), "bad_meta", "no JSON"),
    "bytes for a JPEG": (in_members(put("01.jpg", b"\xff\xd8 no")), "bad_image", "01.jpg"),
    "bytes for depth": (in_members(put("01.depth.npy", b"no")), "bad_depth", "01.depth.npy"),
    "NaN camera": (in_meta(nan_camera), "bad_camera", "NaN"),
    "negative focal length": (in_meta(negative_focal), "bad_camera", "focal"),
    "another size": (in_meta(other_size), "bad_image", "the meta says"),
    "overlap above one": (in_meta(overlap_of_two), "bad_pairs", "iou"),
    "a score that is not there": (in_meta(lost_score), "bad_pairs", "score"),
}


@pytest.mark.parametrize("name", list(GRAPH_DAMAGE))
def test_a_damaged_graph_is_named_and_counted_and_the_others_are_read(folder, name):
    spoil, kind, words = GRAPH_DAMAGE[name]
    tar = damage.first_tar(folder)
    key = spoil(tar)
    report = check_shards(folder, EVERYTHING)
    assert report.faults.counts == {kind: 1}
    (fault,) = report.faults.listed
    assert (fault.kind, fault.shard, fault.key) == (kind, tar.name, key)
    assert words in fault.detail
    assert (report.num_read, report.num_bad, report.num_lost) == (5, 1, 0)
    assert report.bad_share == pytest.approx(0.2)
    assert report.survey.graph_sizes.total() == 4


def nan_depth(members):
    header = members["00.depth.npy"][:128]
    depth = np.frombuffer(members["00.depth.npy"][128:], np.float16).copy()
    depth[0] = np.nan
    members["00.depth.npy"] = header + depth.tobytes()


def test_a_nan_in_depth_is_found(folder):
    key = damage.edit_first(damage.first_tar(folder), nan_depth)
    report = check_shards(folder, EVERYTHING)
    assert [(fault.kind, fault.key) for fault in report.faults.listed] == [("bad_depth", key)]


def test_corrupted_bytes_inside_a_jpeg_are_found_without_its_checksum(folder, capfd):
    tar = damage.first_tar(folder)
    key, name = damage.spoil_bytes(tar, ".jpg")
    report = check_shards(folder, CheckOptions(max_graphs=2, decode_all=True))
    assert [(fault.kind, fault.key) for fault in report.faults.listed] == [("bad_image", key)]
    assert report.faults.listed[0].detail.startswith(f"{name}: damaged JPEG data")
    assert "Corrupt JPEG" not in capfd.readouterr().err


def delete(tar):
    tar.unlink()


def cut_off(tar):
    damage.truncate(tar, 0.5)


def flip(tar):
    damage.spoil_bytes(tar, ".npy")


def no_tar(tar):
    damage.spoil_header(tar, 0)
    index_path(tar).unlink()
    damage.refresh_manifest(tar.parent)  # so that neither size nor checksum gives it away


def ends_early(tar):
    damage.spoil_header(tar, 1)
    index_path(tar).unlink()
    damage.refresh_manifest(tar.parent)


TAR_DAMAGE = {
    "deleted": (delete, "missing_tar", "no such file"),
    "cut off": (cut_off, "wrong_size", "the manifest says"),
    "another checksum": (flip, "wrong_checksum", "SHA-256"),
    "first header overwritten": (no_tar, "unreadable_tar", "no whole tar"),
    "second header overwritten": (ends_early, "wrong_graph_count", "the manifest says"),
}


@pytest.mark.parametrize("name", list(TAR_DAMAGE))
def test_a_damaged_tar_loses_its_graphs_and_the_others_are_read(folder, complaint, name):
    spoil, kind, words = TAR_DAMAGE[name]
    tar, lost = damage.first_tar(folder), read_manifest(folder).shards[0].num_graphs
    spoil(tar)
    report = check_shards(folder, EVERYTHING)
    (fault,) = report.faults.listed
    assert (fault.kind, fault.shard, fault.key) == (kind, tar.name, "")
    assert words in fault.detail
    assert (report.num_damaged_tars, report.num_lost) == (1, lost)
    assert report.num_read == 5 - lost
    assert report.bad_share == pytest.approx(lost / 5)
    assert check(folder, "--digests", "--max-bad-share", "1") == 2
    message = complaint()
    assert "damaged tars 1, expected 0 or less" in message
    assert f"{kind}: {tar.name}: " in message


def test_a_header_overwritten_under_a_good_index_costs_the_tar(folder):
    tar = damage.first_tar(folder)
    damage.spoil_header(tar, 1)
    report = check_shards(folder, CheckOptions(decode_all=True))
    assert [(fault.kind, fault.shard) for fault in report.faults.listed] == [
        ("wrong_graph_count", tar.name)
    ]


def other_index(path):
    plain = json.loads(path.read_text())
    plain["graphs"][0]["num_views"] += 1
    path.write_text(json.dumps(plain))


INDEX_DAMAGE = {
    "deleted": (lambda path: path.unlink(), "no index"),
    "of other views": (other_index, "says other than the tar's headers"),
    "no JSON": (lambda path: path.write_text("{"), "no index"),
}


@pytest.mark.parametrize("name", list(INDEX_DAMAGE))
def test_a_wrong_index_fails_the_check_and_its_graphs_are_read(folder, complaint, name):
    spoil, words = INDEX_DAMAGE[name]
    tar = damage.first_tar(folder)
    spoil(index_path(tar))
    report = check_shards(folder, EVERYTHING)
    (fault,) = report.faults.listed
    assert (fault.kind, fault.shard, fault.key) == ("wrong_index", tar.name, "")
    assert words in fault.detail
    assert (report.num_damaged_tars, report.num_read, report.num_bad) == (1, 5, 0)
    assert check(folder, "--max-bad-share", "1") == 2
    assert f"wrong_index: {tar.name}: " in complaint()


def test_a_wrong_checksum_shows_only_where_checksums_are_compared(folder, capsys):
    flip(damage.first_tar(folder))
    # A byte within a depth map changes numbers, not their form.
    assert not check_shards(folder, CheckOptions(max_graphs=2)).digests_compared
    assert check(folder, "--digests") == 2
    assert "wrong_checksum" in capsys.readouterr().err


def test_several_faults_are_all_counted(folder, capsys):
    tars = [folder / shard.name for shard in read_manifest(folder).shards]
    damage.edit_meta(tars[0], nan_camera)
    damage.edit_first(tars[1], drop("00.jpg"))
    tars[-1].unlink()
    report = check_shards(folder, EVERYTHING)
    assert report.faults.counts == {"bad_camera": 1, "missing_member": 1, "missing_tar": 1}
    assert check(folder) == 2
    out, err = capsys.readouterr()
    for kind in report.faults.counts:
        assert f"{kind}: " in err
        assert f"    {kind}: " in out


def test_a_share_of_bad_graphs_is_borne_up_to_its_limit(folder, capsys):
    damage.edit_meta(damage.first_tar(folder), nan_camera)
    assert check(folder) == 2
    assert "share of bad graphs 20.00%, expected 1% or less" in capsys.readouterr().err
    assert check(folder, "--max-bad-share", "0.19") == 2
    assert check(folder, "--max-bad-share", "0.2") == 0
    # It is told all the same.
    assert "bad_camera" in capsys.readouterr().out


def test_of_a_sample_the_share_stands_for_the_rest(folder):
    damage.edit_meta(damage.first_tar(folder), nan_camera)
    report = check_shards(folder, CheckOptions(max_graphs=2))
    assert (report.num_read, report.num_bad) == (2, 1)
    assert report.bad_share == pytest.approx(0.5)


def test_nothing_that_can_be_read_is_one_line_without_geometry(folder, complaint):
    for shard in read_manifest(folder).shards:
        (folder / shard.name).unlink()
    assert check(folder) == 2
    message = complaint()
    assert "share of bad graphs 100.00%" in message
    assert "depth" not in message


@pytest.mark.parametrize("words", [["--max-bad-share", "2"], ["--max-graphs", "0"]])
def test_options_out_of_range_are_refused(room_shards, capsys, words):
    assert main(["check", str(room_shards), *words]) == 2
    assert "expected" in capsys.readouterr().err


def test_faults_beyond_the_first_of_a_kind_are_counted_not_listed():
    faults = Faults()
    for number in range(LISTED_EACH + 5):
        faults.add(Fault(kind="bad_image", shard="x.tar", key=str(number), detail="no"))
    faults.add(Fault(kind="missing_tar", shard="y.tar", key="", detail="no"))
    assert faults.counts == {"bad_image": LISTED_EACH + 5, "missing_tar": 1}
    assert len(faults.listed) == LISTED_EACH + 1
    assert faults.first("missing_tar").shard == "y.tar"
    assert set(faults.counts) <= set(KINDS)


COUNTED = ("graph_sizes", "image_sizes", "image_uses", "faults.counts", "problems")
"""Where keys are what was counted."""


def paths(value, name=""):
    """Every key of a JSON value with the type of what it holds."""
    if name in COUNTED:
        yield f"{name}.* {'int' if all(type(n) is int for n in value.values()) else '?'}"
    elif isinstance(value, dict):
        for key, inner in sorted(value.items()):
            yield from paths(inner, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        yield f"{name}[] {type(value[0]).__name__ if value else 'empty'}"
        if value and isinstance(value[0], dict):
            yield from paths(value[0], f"{name}[]")
    else:
        yield f"{name} {type(value).__name__}"


def test_json_has_the_keys_it_had(folder, capsys):
    damage.edit_meta(damage.first_tar(folder), nan_camera)
    assert check(folder, "--json", "--digests") == 2
    (line,) = capsys.readouterr().out.splitlines()
    plain = json.loads(line)
    found = "\n".join(paths(plain)) + "\n"
    assert found == GOLDEN.read_text()
    assert plain["digests_compared"]
    assert not plain["passed"]
    assert plain["faults"]["counts"] == {"bad_camera": 1}
    assert sum(plain["graph_sizes"].values()) == 4
    assert sum(plain["histograms"]["iou"]["counts"]) == sum(
        int(n) * (int(n) - 1) // 2 * count for n, count in plain["graph_sizes"].items()
    )


def test_json_has_no_nan_where_nothing_could_be_measured(folder, capsys):
    for shard in read_manifest(folder).shards:
        (folder / shard.name).unlink()
    assert check(folder, "--json") == 2
    plain = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert plain["round_trip"] is None


def test_folders_of_train_and_val_are_both_checked(room_shards, tmp_path, capsys):
    damage.copy(room_shards, tmp_path / "train")
    damage.copy(room_shards, tmp_path / "val")
    assert check(tmp_path, "--json") == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [Path(line["folder"]).name for line in lines] == ["train", "val"]
    (tmp_path / "val" / "manifest.json").unlink()
    assert check(tmp_path) == 2
    assert "val/manifest.json: no such file" in capsys.readouterr().err


def test_what_the_build_left_out_is_in_the_report(folder):
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["request"]["problems"] = {"bad_crc": 3}
    path.write_text(json.dumps(manifest))
    report = check_shards(folder, CheckOptions(max_graphs=1))
    assert report.problems == {"bad_crc": 3}
    assert report.find_faults(EXACT) == []
