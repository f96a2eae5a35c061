"""What broken downloads and disks make of TartanAir's files."""

import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest

from data_prep.converters import survey_scenes
from data_prep.converters.png import read_png, read_png_size
from data_prep.converters.tartanair import read_npy_depth
from data_prep.converters.tartanair_v2 import read_png_depth
from data_prep.converters.trajectories import read_poses
from l3r.errors import DataError
from tests.data_prep.mutations import NUM_ALL, NUM_QUICK, mutate, seeds
from tests.data_prep.raw_writer import chunk, depth_png_bytes, npy_bytes, png_bytes, write_v1
from tests.data_prep.test_tartanair import RELEASES, read_all

COUNTS = [NUM_QUICK, pytest.param(NUM_ALL, marks=pytest.mark.slow)]
SIZE = (120, 160)


@pytest.fixture
def raw(room_scene, tmp_path):
    """A trajectory of four frames that a test may spoil."""
    folder = tmp_path / "raw" / "room" / "Easy" / "P000"
    write_v1(folder, room_scene.frames[:4])
    return folder


def names_of(scenes):
    return [frame.name[:6] for scene in scenes for frame in scene.frames]


def attempt(read, path):
    """What was read, or None where it was refused with the file's name."""
    try:
        return read(path, SIZE)
    except DataError as error:
        message = str(error)
    assert message.startswith(f"{path}: ")
    return None


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("kind", ["image", "depth_v2"])
def test_a_damaged_png_is_refused_or_unharmed(room_scene, tmp_path, kind, count):
    frame, path = room_scene.frames[0], tmp_path / "x.png"
    read, pristine, data = {
        "image": (read_png, frame.read_image(), png_bytes(frame.read_image())),
        "depth_v2": (read_png_depth, frame.read_depth(), depth_png_bytes(frame.read_depth())),
    }[kind]
    refused = 0
    for seed in seeds(count):
        path.write_bytes(mutate(data, seed))
        found = attempt(read, path)
        refused += found is None
        assert found is None or np.array_equal(found, pristine)
        assert attempt(lambda path, _: read_png_size(path), path) in (SIZE, None)
    assert refused > 0.9 * count
    path.write_bytes(data)
    assert np.array_equal(attempt(read, path), pristine)


@pytest.mark.parametrize("count", COUNTS)
def test_a_damaged_npy_is_refused_or_gives_depth(room_scene, tmp_path, count):
    depth, path = room_scene.frames[0].read_depth(), tmp_path / "x.npy"
    data = npy_bytes(depth)
    read = 0
    for seed in seeds(count):
        # Half of the damage to the header, which is a hundredth of the file.
        spoilt = mutate(data[:128], seed) + data[128:] if seed % 2 else mutate(data, seed)
        path.write_bytes(spoilt)
        found = attempt(read_npy_depth, path)
        if found is not None:
            read += 1
            assert (found.shape, found.dtype) == (SIZE, np.float32)
            assert ((found >= 0) & (found <= 1000)).all()
            assert len(spoilt) == len(data)
            assert spoilt[128:] != data[128:] or np.array_equal(found, depth)
    assert 0 < read < 0.7 * count


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("dataset", list(RELEASES))
def test_damaged_poses_never_give_an_image_the_camera_of_another(
    room_scene, tmp_path, dataset, count
):
    # Twelve images of two by three pixels, since only cameras are looked at.
    tiny = replace(
        room_scene.frames[0],
        read_image=lambda: np.zeros((2, 3, 3), np.uint8),
        read_depth=lambda: np.ones((2, 3), np.float32),
    )
    folder = tmp_path / "env" / "level" / "P000"
    moved = [replace(tiny, world_from_cam=f.world_from_cam) for f in room_scene.frames[:12]]
    RELEASES[dataset](folder, moved)
    (path,) = folder.glob("pose_*.txt")
    data = path.read_bytes()
    lines, cameras = data.split(b"\n"), room_scene.world_from_cam
    kept = 0
    for seed in seeds(count):
        spoilt = mutate(data, seed)
        path.write_bytes(spoilt)
        try:
            scenes, left_out = read_all(tmp_path / "env", dataset)
        except DataError:
            continue
        (scene,) = scenes
        kept += 1
        assert len(scene.frames) + left_out.total() == 12
        for frame in scene.frames:
            number = int(frame.name[:6])
            R = frame.world_from_cam[:3, :3]
            np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
            assert np.isfinite(frame.world_from_cam).all()
            line = spoilt.split(b"\n")[number].strip()
            if line in lines:
                assert line == lines[number].strip()
                np.testing.assert_allclose(frame.world_from_cam, cameras[number], atol=1e-9)
    assert kept > 0.2 * count


@pytest.mark.parametrize(
    ("name", "kind"),
    [("image_left/000002_left.png", "missing_image"),
     ("depth_left/000002_left_depth.npy", "missing_depth")],
)  # fmt: skip
def test_a_missing_file_costs_its_frame(raw, name, kind):
    (raw / name).unlink()
    scenes, left_out = read_all(raw)
    assert names_of(scenes) == ["000000", "000001", "000003"]
    assert left_out == {kind: 1}


@pytest.mark.parametrize(
    "line",
    ["1 2 3 0 0 0 0.5", "1 2 3 nan 0 0 1", "nan 2 3 0 0 0 1", "1 2 3 0 0 0", "1 2 3 0 0 0 one",
     "1 2 1e9 0 0 0 1", ""],
)  # fmt: skip
def test_a_bad_pose_costs_its_frame_and_is_logged_with_its_line(raw, caplog, line):
    lines = (raw / "pose_left.txt").read_text().splitlines()
    lines[2] = line
    (raw / "pose_left.txt").write_text("\n".join(lines) + "\n")
    scenes, left_out = read_all(raw)
    assert names_of(scenes) == ["000000", "000001", "000003"]
    assert left_out == {"bad_pose": 1}
    assert "pose_left.txt:3: " in caplog.text


def test_a_line_of_poses_too_few_costs_the_trajectory(raw, tmp_path, room_scene):
    # Whichever line is missing, all later images would get their neighbour's camera.
    lines = (raw / "pose_left.txt").read_text().splitlines(keepends=True)
    (raw / "pose_left.txt").write_text("".join(lines[1:]))
    write_v1(tmp_path / "raw" / "room" / "Easy" / "P001", room_scene.frames[:2])
    scenes, left_out = read_all(tmp_path / "raw")
    assert [scene.name for scene in scenes] == ["room/Easy/P001"]
    assert left_out == {"pose_count": 1, "empty_scene": 1}
    (row, _) = survey_scenes("tartanair", tmp_path / "raw")
    assert row.excluded == "1 pose_count"


def test_poses_beyond_the_images_are_counted_as_missing_images(raw):
    with (raw / "pose_left.txt").open("a") as stream:
        stream.write("1 2 3 0 0 0 1\n")
    scenes, left_out = read_all(raw)
    assert len(names_of(scenes)) == 4
    assert left_out == {"missing_image": 1}


@pytest.mark.parametrize("data", [b"", b"\n \n"])
def test_a_root_of_which_nothing_can_be_read_is_refused(raw, data):
    (raw / "pose_left.txt").write_bytes(data)
    with pytest.raises(DataError, match=r"1 unreadable_poses"):
        read_all(raw)
    with pytest.raises(DataError, match="no poses"):
        read_poses(raw / "pose_left.txt")


def test_pose_files_beyond_all_size_are_not_read(tmp_path):
    path = tmp_path / "pose_left.txt"
    with path.open("wb") as stream:
        stream.truncate(2**40)
    with pytest.raises(DataError, match="no poses"):
        read_poses(path)


def test_an_image_without_a_header_costs_its_frame(raw):
    (raw / "image_left" / "000001_left.png").write_bytes(b"nothing of the kind, but long enough")
    scenes, left_out = read_all(raw)
    assert names_of(scenes) == ["000000", "000002", "000003"]
    assert left_out == {"bad_image": 1}


@pytest.mark.parametrize("share", [0.0, 0.5, 0.98])
def test_files_cut_off_are_named(raw, share):
    image = raw / "image_left" / "000001_left.png"
    depth = raw / "depth_left" / "000001_left_depth.npy"
    for path, read in ((image, read_png), (depth, read_npy_depth)):
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
        with pytest.raises(DataError, match=f"{path.name}: "):
            read(path, SIZE)


def test_a_png_that_claims_to_be_huge_is_refused_before_it_is_decoded(tmp_path):
    header = struct.pack(">IIBBBBB", 2**15, 2**15, 8, 2, 0, 0, 0)
    path = tmp_path / "bomb.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IEND", b""))
    with pytest.raises(DataError, match="32768x32768 pixels"):
        read_png_size(path)


def test_a_png_padded_beyond_all_need_is_refused_unread(tmp_path):
    path = tmp_path / "x.png"
    path.write_bytes(png_bytes(np.zeros((2, 3, 3), np.uint8)))
    with path.open("r+b") as stream:
        stream.truncate(2**40)
    with pytest.raises(DataError, match="1099511627776 bytes"):
        read_png(path, (2, 3))


def test_depth_of_another_type_or_size_is_refused(tmp_path):
    arrays = {
        "<f8": np.ones((2, 3), np.float64),
        r"\(3, 2\)": np.ones((3, 2), np.float32),
        "True": np.asfortranarray(np.ones((2, 3), np.float32)),
        r"\|O": np.array([[None] * 3] * 2),
    }
    for found, depth in arrays.items():
        np.save(tmp_path / "d.npy", depth, allow_pickle=True)
        with pytest.raises(DataError, match=f"{found}.*expected a whole float32"):
            read_npy_depth(tmp_path / "d.npy", (2, 3))
    (tmp_path / "d.png").write_bytes(png_bytes(np.zeros((2, 3, 3), np.uint8)))
    with pytest.raises(DataError, match="4 channels"):
        read_png_depth(tmp_path / "d.png", (2, 3))


def test_an_array_that_claims_to_be_huge_is_refused_before_it_is_read(tmp_path):
    data = npy_bytes(np.ones((2, 3), np.float32)).replace(b"(2, 3), }     ", b"(200000, 300000), }")
    (tmp_path / "d.npy").write_bytes(data)
    with pytest.raises(DataError, match=r"\(200000, 300000\)"):
        read_npy_depth(tmp_path / "d.npy", (200000, 300000))


def test_a_file_that_vanished_is_named(raw):
    scenes, _ = read_all(raw)
    shutil.rmtree(raw)
    for read in (scenes[0].frames[0].read_image, scenes[0].frames[0].read_depth):
        with pytest.raises(DataError, match="000000_left"):
            read()
