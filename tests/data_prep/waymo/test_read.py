import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest

from data_prep.converters.waymo import MIN_MOVE, MIN_TURN, read, survey, thin_stationary
from data_prep.converters.waymo.moment import Moment
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.naming import assert_scenes_are_named_before_they_are_read
from tests.data_prep.waymo import drive
from tests.data_prep.waymo.conftest import read_one
from tests.data_prep.waymo.parquet_writer import write_v2
from tests.data_prep.waymo.wire_writer import frame_message, tfrecord, write_v1

CAMERAS = ["FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT"]
AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
KINDS = ["v1", "v2"]


def write(root, kind, segment, split="training"):
    """Write a segment in either version."""
    if kind == "v1":
        write_v1(root / split, segment)
    else:
        write_v2(root / split, segment, compression=None)
    return root


def read_all(root, split="train", **options):
    """Scenes, and what was left out."""
    problems = Problems()
    return list(read(root, split, problems=problems, **options)), problems


def spoil(segment, change, index=1):
    """A segment, one frame of which is changed."""
    frames = [replace(f, images=dict(f.images), lasers=dict(f.lasers)) for f in segment.frames]
    change(frames[index])
    return replace(segment, frames=frames)


@pytest.mark.parametrize("kind", ["v1", "v2", "v2_old"])
def test_a_segment_is_one_scene_of_all_cameras_by_time(roots, segment, kind):
    scene = read_one(roots[kind])
    assert scene.dataset == "waymo"
    assert scene.name == f"training/{segment.context}"
    assert [frame.name for frame in scene.frames] == [
        f"{data.timestamp}_{camera}" for data in segment.frames for camera in CAMERAS
    ]
    assert [frame.image_size for frame in scene.frames[:5]] == list(drive.SIZES.values())
    for frame in scene.frames[:5]:
        assert frame.read_image().shape == (*frame.image_size, 3)
        assert frame.read_depth().shape == frame.image_size


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_stand_where_the_car_was_when_the_image_was_taken(roots, segment, kind):
    frames = iter(read_one(roots[kind]).frames)
    for data in segment.frames:
        for number, (_, pose) in data.images.items():
            mount = segment.cameras[number]["mount"]
            found = next(frames).world_from_cam
            np.testing.assert_allclose(found, pose @ mount @ np.linalg.inv(AXES), atol=1e-9)
            assert np.abs(found - data.pose @ mount @ np.linalg.inv(AXES)).max() > 0.05 or (
                abs(drive.CAMERA_DELAY[number] - 0.05) < 0.01
            )


def test_both_versions_give_the_same(roots):
    first, second = read_one(roots["v1"]), read_one(roots["v2"])
    for a, b in zip(first.frames, second.frames, strict=True):
        np.testing.assert_array_equal(a.K, b.K)
        np.testing.assert_array_equal(a.world_from_cam, b.world_from_cam)
        np.testing.assert_array_equal(a.read_image(), b.read_image())
        np.testing.assert_array_equal(a.read_depth(), b.read_depth())


def test_single_precision_poses_of_old_files_stay_rigid_and_within_a_millimetre(roots, scene):
    for a, b in zip(scene.frames, read_one(roots["v2_old"]).frames, strict=True):
        R = b.world_from_cam[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(a.world_from_cam, b.world_from_cam, atol=1.5e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_scenes_travel_between_processes_without_their_pixels(roots, segment, kind):
    scene = read_one(roots[kind])
    data = pickle.dumps(scene)
    assert len(data) < sum(len(jpeg) for f in segment.frames for jpeg, _ in f.images.values()) / 3
    copy = pickle.loads(data).frames[7]
    np.testing.assert_array_equal(copy.read_image(), scene.frames[7].read_image())
    np.testing.assert_array_equal(copy.read_depth(), scene.frames[7].read_depth())


def test_frames_may_be_read_in_any_order(roots):
    frames = read_one(roots["v2_old"]).frames
    forward = [(frame.read_image(), frame.read_depth()) for frame in frames]
    for index in [14, 0, 7, 6, 13, 1]:
        np.testing.assert_array_equal(frames[index].read_image(), forward[index][0])
        np.testing.assert_array_equal(frames[index].read_depth(), forward[index][1])


@pytest.mark.parametrize("kind", KINDS)
def test_every_other_frame_is_taken_on_request(roots, segment, kind):
    scene = read_one(roots[kind], frame_step=2)
    times = sorted({int(frame.name.split("_")[0]) for frame in scene.frames})
    assert times == [segment.frames[0].timestamp, segment.frames[2].timestamp]


@pytest.mark.parametrize("kind", KINDS)
def test_splits_are_the_published_folders_and_testing_is_never_read(tmp_path, light, kind):
    one = replace(light, frames=light.frames[:1])
    folders = ["training", "validation", "testing", "testing_3d_camera_only_detection", "other"]
    for index, folder in enumerate(folders):
        write(tmp_path, kind, replace(one, context=f"context{index}"), folder)
    names = {
        s: [scene.name for scene in read_all(tmp_path, s)[0]] for s in ("train", "test", "all")
    }
    assert names["train"] == ["training/context0"]
    assert names["test"] == ["validation/context1"]
    assert names["all"] == ["context4", "training/context0", "validation/context1"]
    excluded = {found.name: found.excluded for found in survey(tmp_path)}
    assert list(excluded) == [
        "context4",
        "testing/context2",
        "testing/context3",
        "training/context0",
        "validation/context1",
    ]
    assert [name for name, reason in excluded.items() if not reason] == ["training/context0"]
    with pytest.raises(DataError, match="testing is never read"):
        read_all(tmp_path / "testing", "all")


def test_a_root_may_be_the_folder_of_a_split_or_of_a_tar_part(tmp_path, light):
    one = replace(light, frames=light.frames[:1])
    write(tmp_path, "v1", one, "training_0003")
    assert read_one(tmp_path / "training_0003").name == f"training/{light.context}"
    (scene,) = read_all(tmp_path, scenes=f"*{light.context[:9]}*")[0]
    assert scene.name == f"training/{light.context}"
    with pytest.raises(DataError, match=r"none of 1 segments .* matches 'nothing'"):
        read_all(tmp_path, scenes="nothing")


def test_a_folder_without_segments_is_refused(tmp_path):
    for call in (lambda: read_all(tmp_path), lambda: list(survey(tmp_path))):
        with pytest.raises(DataError, match="no segment below it"):
            call()


def test_a_segment_of_both_versions_is_read_once(roots, segment, tmp_path):
    shutil.copytree(roots["v1"], tmp_path / "a")
    shutil.copytree(roots["v2"], tmp_path / "b")
    scenes, problems = read_all(tmp_path)
    assert [scene.name for scene in scenes] == [f"training/{segment.context}"]
    assert problems.summary() == "1 duplicate_segment"


@pytest.mark.parametrize("kind", KINDS)
def test_companions_a_mac_leaves_are_ignored(roots, tmp_path, kind):
    shutil.copytree(roots[kind], tmp_path / "root")
    for path in sorted((tmp_path / "root").rglob("*.*")):
        path.with_name(f"._{path.name}").write_bytes(b"\0\5\26\7")
    assert len(read_one(tmp_path / "root").frames) == 15


def test_a_segment_is_surveyed_without_its_pixels(roots):
    for kind in ("v1", "v2", "v2_old"):
        (found,) = survey(roots[kind])
        assert found.num_images == 15
        assert found.image_size == (128, 192)
        assert (found.num_missing, found.excluded) == (0, "")


def thinned(count, move=0.0, turn=0.0):
    """Numbers of the moments that are kept of ``count`` evenly spaced ones."""
    moments = [
        Moment(
            timestamp=step,
            world_from_vehicle=drive.mount([9000 + move * step, 0, 0], [turn * step, 0, 0]),
            shots=[],
            has_lidar=True,
        )
        for step in range(count)
    ]
    return [kept.timestamp for kept in thin_stationary(moments)]


def test_stationary_stretches_are_thinned():
    assert thinned(200) == [0]
    assert thinned(50, move=MIN_MOVE / 19.9) == [0, 20, 40]
    assert thinned(12, turn=MIN_TURN / 4.9) == [0, 5, 10]
    assert thinned(5, move=1.1 * MIN_MOVE) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("kind", KINDS)
def test_a_car_that_waits_gives_one_frame(tmp_path, light, kind):
    still = [replace(f, pose=light.frames[0].pose) for f in light.frames]
    write(tmp_path, kind, replace(light, frames=still))
    assert len(read_one(tmp_path).frames) == 5


def test_records_out_of_order_are_sorted_and_repeated_ones_counted(tmp_path, light):
    messages = [frame_message(light, light.frames[i]) for i in (2, 0, 1, 0)]
    (tmp_path / "training").mkdir()
    (tmp_path / "training" / "x.tfrecord").write_bytes(tfrecord(messages))
    (scene,), problems = read_all(tmp_path)
    times = [int(frame.name.split("_")[0]) for frame in scene.frames[::5]]
    assert times == [f.timestamp for f in light.frames]
    assert problems.summary() == "1 duplicate_frame"


def test_a_record_that_fails_its_checksum_is_counted_and_the_rest_kept(roots, tmp_path, segment):
    shutil.copytree(roots["v1"], tmp_path / "root")
    (path,) = (tmp_path / "root").rglob("*.tfrecord")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    (scene,), problems = read_all(tmp_path)
    assert problems.summary() == "1 bad_crc"
    assert len(scene.frames) == 10
    assert str(path) in problems.first["bad_crc"].where
    assert segment.frames[1].timestamp not in {int(f.name.split("_")[0]) for f in scene.frames}


@pytest.mark.parametrize("kind", ["v1", "v2"])
def test_segments_are_named_before_they_are_read(roots, kind):
    assert len(assert_scenes_are_named_before_they_are_read("waymo", roots[kind])) == 1
