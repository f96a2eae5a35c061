import json
import shutil

import numpy as np
import pytest

from data_prep.check import EXACT, LIMITS, MEASURED, check_shards
from data_prep.cli import main
from data_prep.converters.synthetic import pose_lines
from data_prep.converters.tartanair import read_poses
from l3r.data.schema import index_path, read_manifest
from tests.data_prep.planting import MISTAKES, none, plant

QUANTITIES = {
    "half a pixel": "depth disagreement",
    "long focal": "depth disagreement",
    "swapped axes": "overlapping pairs that connect",
    "body axes": "overlapping pairs that connect",
    "inverted": "overlapping pairs that connect",
    "ranges": "depth disagreement",
    "inverse depth": "overlapping pairs that connect",
    "shuffled images": "brightness correlation",
}


def check(folder):
    return main(["check", str(folder), "--max-graphs", "3"])


def test_clean_shards_pass(room_shards, capsys):
    assert check(room_shards) == 0
    out, err = capsys.readouterr()
    assert "round trip" in out
    assert err == ""


def test_a_copy_without_mistake_passes(room_shards, tmp_path):
    assert check(plant(room_shards, tmp_path, none)) == 0


@pytest.mark.parametrize("name", list(MISTAKES))
def test_a_planted_mistake_is_found_and_the_quantity_named(room_shards, tmp_path, capsys, name):
    assert check(plant(room_shards, tmp_path, MISTAKES[name])) == 2
    message = capsys.readouterr().err
    assert message.startswith("l3r-prep check: ")
    assert message.count("\n") == 1
    assert QUANTITIES[name] in message


def test_the_verdict_keeps_a_distance_from_clean_data(room_shards):
    report = check_shards(room_shards)
    assert report.depth_error < 0.7 * EXACT.max_depth_error
    assert report.round_trip < 0.5 * EXACT.max_round_trip
    assert report.connected > 1.5 * EXACT.min_connected
    assert report.rotation_error < 1e-12
    assert report.valid_depth == 1


def test_the_genuine_trajectory_passes_and_half_a_pixel_is_seen(shared, tmp_path, capsys):
    raw, clean, planted = (
        shared / "data" / "raw" / "tartanair_v1_seq",
        tmp_path / "c",
        tmp_path / "p",
    )
    planted.mkdir()
    words = f"build tartanair --raw {raw} --out {clean} --num-graphs 2 --max-views 6"
    assert main(words.split()) == 0
    assert main(["check", str(clean)]) == 0
    assert main(["check", str(plant(clean, planted, MISTAKES["half a pixel"]))]) == 2
    assert "depth disagreement" in capsys.readouterr().err


def spoil_cameras(trajectory):
    path = trajectory / "pose_left.txt"
    path.write_text(pose_lines(np.linalg.inv(read_poses(path))))


def spoil_axes(trajectory):
    # Written as if the camera's own axes were the body's.
    path = trajectory / "pose_left.txt"
    cameras = read_poses(path)
    cameras[:, :3, :3] = cameras[:, :3, :3] @ np.eye(3)[[1, 2, 0]]
    path.write_text(pose_lines(cameras))


def spoil_depth(trajectory):
    y, x = (np.mgrid[:120, :160] + 0.5 - np.array([60, 80])[:, None, None]) / 80
    for path in (trajectory / "depth_left").iterdir():
        depth = np.load(path, allow_pickle=False)
        np.save(path, (depth * np.sqrt(1 + x * x + y * y)).astype(np.float32))


@pytest.mark.parametrize("spoil", [spoil_cameras, spoil_axes, spoil_depth])
def test_a_mistake_in_the_source_does_not_pass_build_and_check(raw_room, tmp_path, spoil):
    # Overlap is measured with the mistake in: the sampler picks pairs that agree by accident.
    trajectory = tmp_path / "raw" / "room000" / "Easy" / "P000"
    shutil.copytree(raw_room / "room000" / "Easy" / "P000", trajectory)
    spoil(trajectory)
    words = f"build tartanair --raw {tmp_path}/raw --out {tmp_path}/out --num-graphs 3"
    codes = [main([*words.split(), "--max-views", "5", "--min-views", "3"])]
    if codes == [0]:
        codes.append(check(tmp_path / "out"))
    assert codes[-1] == 2


def test_json_holds_every_quantity(room_shards, capsys):
    assert main(["check", str(room_shards), "--json", "--digests", "--max-graphs", "1"]) == 0
    plain = json.loads(capsys.readouterr().out)
    assert plain["num_graphs"] == 5
    assert plain["num_measured"] == 1


def test_rendered_data_is_held_to_tighter_limits_than_sensors():
    assert LIMITS["synthetic"].max_depth_error < MEASURED.max_depth_error


@pytest.mark.parametrize("share", [None, 0.5])
def test_a_shard_missing_or_cut_off_is_named(room_shards, tmp_path, capsys, share):
    folder = plant(room_shards, tmp_path, none)
    shard = folder / read_manifest(folder).shards[1].name
    data = shard.read_bytes()
    shard.unlink()
    if share is not None:
        shard.write_bytes(data[: int(share * len(data))])
    assert check(folder) == 2
    assert f"{shard.name}: " in capsys.readouterr().err


def test_a_flipped_bit_is_found_by_its_digest(room_shards, tmp_path, capsys):
    folder = plant(room_shards, tmp_path, none)
    shard = folder / read_manifest(folder).shards[0].name
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(bytes(data))
    assert main(["check", str(folder), "--digests"]) == 2
    assert "SHA-256" in capsys.readouterr().err


def test_an_index_is_not_needed(room_shards, tmp_path):
    folder = plant(room_shards, tmp_path, none)
    for shard in read_manifest(folder).shards:
        index_path(folder / shard.name).unlink()
    assert check(folder) == 0


def test_a_folder_without_shards_is_refused(tmp_path, capsys):
    assert check(tmp_path) == 2
    assert "no such file" in capsys.readouterr().err
