"""Every fault is counted under its name and the rest of the segment kept."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from data_prep.converters.waymo import survey
from l3r.errors import DataError
from tests.data_prep.waymo.test_read import KINDS, read_all, spoil, write


def jpeg(size, mode="RGB"):
    stream = io.BytesIO()
    Image.new(mode, size).save(stream, "JPEG")
    return stream.getvalue()


def set_image(frame, number, data):
    frame.images[number] = (data, frame.images[number][1])


def set_pose(frame, number, change):
    data, pose = frame.images[number]
    pose = pose.copy()
    change(pose)
    frame.images[number] = (data, pose)


def make_nan(matrix):
    matrix[0, 3] = np.nan


def stretch(matrix):
    matrix[:3, :3] *= 1.01


def mirror(matrix):
    matrix[:3, 0] *= -1


BAD_JPEGS = {
    "empty": b"",
    "no image": b"not a JPEG at all",
    "another size": jpeg((192, 127)),
    "grey": jpeg((192, 128), "L"),
    "CMYK": jpeg((192, 128), "CMYK"),
    "huge": jpeg((4000, 4000)),
    "png": b"\x89PNG\r\n\x1a\n" + jpeg((192, 128)),
}


@pytest.mark.parametrize("name", list(BAD_JPEGS))
def test_an_image_that_is_none_is_counted_by_version_1(tmp_path, light, name):
    bad = spoil(light, lambda frame: set_image(frame, 2, BAD_JPEGS[name]))
    (scene,), problems = read_all(write(tmp_path, "v1", bad))
    assert len(scene.frames) == 14
    assert problems.counts.total() == 1
    assert set(problems.counts) <= {"bad_image", "missing_image"}


@pytest.mark.parametrize("name", list(BAD_JPEGS))
def test_an_image_that_is_none_is_found_by_version_2_when_it_is_read(tmp_path, light, name):
    bad = spoil(light, lambda frame: set_image(frame, 2, BAD_JPEGS[name]))
    (scene,), problems = read_all(write(tmp_path, "v2", bad))
    assert problems.summary() == "none"
    with pytest.raises(DataError, match="no whole colour JPEG"):
        scene.frames[6].read_image()
    assert scene.frames[7].read_image().shape == (128, 192, 3)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_cut_image_is_not_filled_with_grey(tmp_path, light, share):
    def cut(frame):
        data = frame.images[1][0]
        set_image(frame, 1, data[: int(share * len(data))])

    _, problems = read_all(write(tmp_path / "1", "v1", spoil(light, cut)))
    assert problems.summary() == "1 bad_image"
    (scene,), _ = read_all(write(tmp_path / "2", "v2", spoil(light, cut)))
    with pytest.raises(DataError, match="it has no end"):
        scene.frames[5].read_image()


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_image_is_counted(tmp_path, light, kind):
    def drop(frame):
        del frame.images[4]

    (scene,), problems = read_all(write(tmp_path, kind, spoil(light, drop)))
    assert problems.summary() == "1 missing_image"
    assert "SIDE_LEFT" in problems.first["missing_image"].where
    assert [frame.name.split("_", 1)[1] for frame in scene.frames[5:9]] == [
        "FRONT",
        "FRONT_LEFT",
        "FRONT_RIGHT",
        "SIDE_RIGHT",
    ]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("change", [make_nan, stretch, mirror])
def test_an_images_pose_that_is_none_is_counted(tmp_path, light, kind, change):
    bad = spoil(light, lambda frame: set_pose(frame, 3, change))
    (scene,), problems = read_all(write(tmp_path, kind, bad))
    assert problems.summary() == "1 bad_pose"
    assert len(scene.frames) == 14
    assert all(np.isfinite(frame.world_from_cam).all() for frame in scene.frames)


@pytest.mark.parametrize(("kind", "name"), [("v1", "bad_frame"), ("v2", "bad_pose")])
@pytest.mark.parametrize("change", [make_nan, stretch])
def test_a_frames_pose_that_is_none_costs_its_five_images(tmp_path, light, kind, name, change):
    def spoil_pose(frame):
        frame.pose = frame.pose.copy()
        change(frame.pose)

    (scene,), problems = read_all(write(tmp_path, kind, spoil(light, spoil_pose)))
    assert len(scene.frames) == 10
    assert problems.counts[name] >= 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "change",
    [
        {"lens": [np.nan] * 9},
        {"lens": [0.0] * 9},
        {"mount": np.zeros((4, 4))},
        {"size": (0, 0)},
        {"size": (10**6, 10**6)},
    ],
)
def test_a_cameras_calibration_that_is_none_costs_that_camera(tmp_path, light, kind, change):
    cameras = {**light.cameras, 5: {**light.cameras[5], **change}}
    (scene,), problems = read_all(write(tmp_path, kind, replace(light, cameras=cameras)))
    assert len(scene.frames) == 12
    assert set(problems.counts) == {"bad_calibration"}
    assert not any("SIDE_RIGHT" in frame.name for frame in scene.frames)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "change", [{"mount": np.zeros((4, 4))}, {"low": np.nan}, {"inclinations": [99.0] * 6}]
)
def test_a_lasers_calibration_that_is_none_costs_that_laser(tmp_path, light, kind, change):
    lasers = {**light.lasers, 2: {**light.lasers[2], **change}}
    (scene,), problems = read_all(write(tmp_path, kind, replace(light, lasers=lasers)))
    assert set(problems.counts) == {"bad_calibration"}
    assert len(scene.frames) == 15
    assert scene.frames[0].read_depth().any()


@pytest.mark.parametrize("kind", KINDS)
def test_frames_without_range_images_are_counted_or_kept_on_request(tmp_path, light, kind):
    bad = spoil(light, lambda frame: frame.lasers.clear())
    write(tmp_path, kind, bad)
    (scene,), problems = read_all(tmp_path)
    assert problems.summary() == "1 no_lidar"
    assert len(scene.frames) == 10
    (scene,), problems = read_all(tmp_path, require_depth=False)
    assert problems.summary() == "none"
    assert not scene.frames[5].read_depth().any()
    assert scene.frames[4].read_depth().any()


@pytest.mark.parametrize("kind", KINDS)
def test_a_segment_without_a_frame_is_counted_and_the_others_kept(tmp_path, light, kind):
    empty = replace(light, context="1_empty", frames=[])
    dark = replace(
        light,
        context="2_dark",
        frames=[replace(frame, lasers={}) for frame in light.frames[:1]],
    )
    for one in (empty, dark, light):
        write(tmp_path, kind, one)
    scenes, problems = read_all(tmp_path)
    assert [scene.name for scene in scenes] == [f"training/{light.context}"]
    assert problems.counts["empty_scene"] == 2
    with pytest.raises(DataError, match=r"no frame of 2 segments can be used: .*2 empty_scene"):
        read_all(tmp_path, scenes="*_*[ky]")


@pytest.mark.parametrize("component", ["camera_image", "camera_calibration", "vehicle_pose"])
@pytest.mark.parametrize("damage", ["missing", "empty", "cut"])
def test_a_segment_without_cameras_is_left_out(tmp_path, light, component, damage):
    write(tmp_path, "v2", light)
    write(tmp_path, "v2", replace(light, context="other"))
    path = tmp_path / "training" / component / "other.parquet"
    data = path.read_bytes()
    path.unlink()
    if damage != "missing":
        path.write_bytes(data[: len(data) // 2] if damage == "cut" else b"")
    scenes, problems = read_all(tmp_path)
    assert [scene.name for scene in scenes] == [f"training/{light.context}"]
    assert problems.summary() == "1 bad_segment, 1 empty_scene"
    assert str(path) in problems.first["bad_segment"].detail
    assert {found.name: found.num_images for found in survey(tmp_path)} == {
        "training/other": 0,
        f"training/{light.context}": 15,
    }


LIDAR = ["lidar", "lidar_calibration", "lidar_camera_projection", "lidar_pose", "lidar_box"]


@pytest.mark.parametrize("component", LIDAR)
def test_without_a_component_of_the_lidar_there_is_no_depth(tmp_path, light, component):
    write(tmp_path, "v2", light)
    (tmp_path / "training" / component / f"{light.context}.parquet").unlink()
    with pytest.raises(DataError, match="1 bad_lidar, 1 empty_scene, 3 no_lidar"):
        read_all(tmp_path)
    (scene,), problems = read_all(tmp_path, require_depth=False)
    assert problems.summary() == "1 bad_lidar"
    assert len(scene.frames) == 15


@pytest.mark.parametrize("kind", KINDS)
def test_a_range_image_of_a_wrong_shape_is_an_error_when_it_is_read(tmp_path, light, kind):
    def crop(frame):
        ranges, projection, poses = frame.lasers[2]
        frame.lasers[2] = (ranges, projection[1:], poses)

    (scene,), _ = read_all(write(tmp_path, kind, spoil(light, crop)))
    with pytest.raises(DataError, match="laser FRONT: ranges, camera projections and pixel poses"):
        scene.frames[5].read_depth()
    assert scene.frames[0].read_depth().any()


@pytest.mark.parametrize("kind", KINDS)
def test_a_laser_whose_range_image_cannot_be_placed_is_left_out(tmp_path, light, kind):
    def lose_poses(frame):
        ranges, projection, _ = frame.lasers[1]
        frame.lasers[1] = (ranges, projection, None)

    (scene,), problems = read_all(write(tmp_path, kind, spoil(light, lose_poses)))
    assert problems.summary() == "none"
    known = [int((frame.read_depth() > 0).sum()) for frame in scene.frames]
    assert 0 < known[5] < known[0] / 4
