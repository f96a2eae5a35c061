import shutil

import numpy as np
import pytest

from data_prep.check import EXACT, LIMITS, NOISY, CheckOptions, check_shards
from data_prep.cli import main
from data_prep.converters import CONVERTERS
from data_prep.converters.synthetic import pose_lines
from data_prep.converters.trajectories import read_poses
from l3r.data.schema import index_path, read_manifest
from tests.data_prep.planting import MISTAKES, half_a_pixel, noise, none, plant

CONNECT, DEPTH, BIAS = "overlapping pairs that connect", "depth disagreement", "depth bias"
QUANTITIES = {
    "half a pixel": BIAS,
    "long focal": BIAS,
    "swapped axes": CONNECT,
    "body axes": CONNECT,
    "inverted": CONNECT,
    "wrong cameras": CONNECT,
    "ranges": DEPTH,
    "forgotten scale": DEPTH,
    "distorted K": BIAS,
    "left distorted": DEPTH,
    "vehicle frame": DEPTH,
    "millimetres": "median depth",
    "inverse depth": CONNECT,
    "shuffled images": "brightness correlation",
}


def check(folder):
    return main(["check", str(folder), "--max-graphs", "3", "--no-report"])


def test_clean_shards_pass(room_shards, capsys):
    assert check(room_shards) == 0
    out, err = capsys.readouterr()
    assert "round trip" in out
    assert "l3r-prep" not in err


def test_a_copy_without_mistake_passes(room_shards, tmp_path):
    assert check(plant(room_shards, tmp_path, none)) == 0


@pytest.mark.parametrize("name", list(MISTAKES))
@pytest.mark.parametrize("shards", ["room_shards", "scattered_shards"])
def test_a_planted_mistake_is_found_and_the_quantity_named(
    request, tmp_path, complaint, shards, name
):
    folder = plant(request.getfixturevalue(shards), tmp_path, MISTAKES[name], num_shards=1)
    assert check(folder) == 2
    assert QUANTITIES[name] in complaint()


def test_clean_scattered_depth_passes_its_own_limits_and_not_those_of_rendered_depth(
    scattered_shards,
):
    assert check(scattered_shards) == 0
    report = check_shards(scattered_shards, CheckOptions(max_graphs=3))
    assert report.dataset == "waymo"
    assert report.valid_depth < 0.1
    assert report.connected > 1.5 * NOISY.min_connected
    assert report.depth_error < 0.5 * NOISY.max_depth_error
    assert report.depth_bias < 0.7 * NOISY.max_depth_bias
    assert report.find_faults(EXACT)


def test_half_a_pixel_is_found_under_noise_that_is_larger(room_shards, tmp_path):
    reports = []
    for name, mistake in (("clean", noise), ("planted", lambda s: half_a_pixel(noise(s)))):
        (tmp_path / name).mkdir()
        reports.append(
            check_shards(plant(room_shards, tmp_path / name, mistake), CheckOptions(max_graphs=3))
        )
    clean, planted = reports
    assert clean.find_faults(NOISY) == []
    assert clean.depth_error > 0.003
    (fault,) = planted.find_faults(NOISY)
    assert "depth bias" in fault


def test_the_verdict_keeps_a_distance_from_clean_data(room_shards):
    report = check_shards(room_shards)
    assert report.depth_error < 0.7 * EXACT.max_depth_error
    assert report.depth_bias < 0.1 * EXACT.max_depth_bias
    assert report.round_trip < 0.5 * EXACT.max_round_trip
    assert report.connected > 1.5 * EXACT.min_connected
    assert report.rotation_error < 1e-12
    assert report.valid_depth == 1
    assert report.is_metric
    assert 1 < report.median_depth < 4
    assert 0.3 < report.median_step < 4


def test_the_genuine_trajectory_passes_and_half_a_pixel_is_seen(shared, tmp_path, capsys):
    raw = shared / "data" / "raw" / "tartanair_v1_seq"
    clean, planted = tmp_path / "c", tmp_path / "p"
    planted.mkdir()
    words = f"build tartanair --raw {raw} --out {clean} --num-graphs 2 --max-views 6"
    assert main(words.split()) == 0
    assert main(["check", str(clean), "--no-report"]) == 0
    assert main(["check", str(plant(clean, planted, MISTAKES["half a pixel"]))]) == 2
    assert "depth disagreement" in capsys.readouterr().err


@pytest.fixture(scope="module")
def second_release(shared, tmp_path_factory):
    """Shards of the genuine clip of TartanAir V2."""
    out = tmp_path_factory.mktemp("v2")
    raw = shared / "data" / "raw" / "tartanair_v2"
    words = f"build tartanair_v2 --raw {raw} --out {out} --num-graphs 2 --max-views 3"
    assert main(words.split()) == 0
    return out


def test_the_genuine_clip_of_the_second_release_passes(second_release):
    assert check(second_release) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["long focal", "inverted", "ranges"])
def test_mistakes_in_the_second_release_do_not_pass(second_release, tmp_path, name):
    assert check(plant(second_release, tmp_path, MISTAKES[name])) == 2


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


def test_every_converter_has_its_limits():
    assert set(LIMITS) == {*CONVERTERS, "synthetic"}


@pytest.fixture(scope="module")
def headset(shared, tmp_path_factory):
    """Shards of genuine frames whose depth and cameras a headset measured."""
    root, out = shared / "data" / "scenes", tmp_path_factory.mktemp("headset")
    words = f"build folder --raw {root} --scenes hololens_000 --out {out} --num-graphs 3"
    assert main([*words.split(), "--max-views", "5", "--min-views", "4"]) == 0
    return out


def test_genuine_depth_of_a_device_passes_its_own_limits(headset):
    assert check(headset) == 0
    assert check_shards(headset, CheckOptions(max_graphs=3)).find_faults(NOISY)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["swapped axes", "inverted", "wrong cameras", "ranges"])
def test_mistakes_in_genuine_depth_of_a_device_do_not_pass(headset, tmp_path, name):
    assert check(plant(headset, tmp_path, MISTAKES[name])) == 2


def test_rendered_data_is_held_to_tighter_limits_than_sensors():
    for name in ("synthetic", "tartanair", "tartanair_v2"):
        assert LIMITS[name].max_depth_error < NOISY.max_depth_error
        assert LIMITS[name].max_round_trip < NOISY.max_round_trip


def test_a_missing_index_is_a_fault(room_shards, tmp_path):
    folder = plant(room_shards, tmp_path, none)
    for shard in read_manifest(folder).shards:
        index_path(folder / shard.name).unlink()
    assert check(folder) == 2


def test_a_folder_without_shards_is_refused(tmp_path, capsys):
    assert check(tmp_path) == 2
    assert "no such file" in capsys.readouterr().err
