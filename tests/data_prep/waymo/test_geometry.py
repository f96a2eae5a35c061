"""Is what the converter gives true? Mistakes planted in files and in frames must show."""

from dataclasses import replace

import numpy as np
import pytest

from data_prep.converters.waymo import depth as depth_module
from data_prep.converters.waymo.images import decode_jpeg
from tests.data_prep.waymo import drive, street
from tests.data_prep.waymo.conftest import read_one
from tests.data_prep.waymo.judge import judge
from tests.data_prep.waymo.wire_writer import write_v1


@pytest.mark.parametrize("kind", ["v1", "v2", "v2_old"])
def test_images_and_depth_of_both_versions_are_those_of_the_street(roots, kind):
    scene = read_one(roots[kind])
    verdict = judge(scene)
    assert verdict.faults() == set()
    assert scene.is_metric
    assert scene.has_sparse_depth


def not_undistorted(frame):
    jpeg, camera, where = frame.read_image.args
    return replace(frame, read_image=lambda: decode_jpeg(jpeg(), camera.image_size, where))


def stored_K(frame):
    K = frame.K.copy()
    K[0, 0], K[1, 1] = frame.read_image.args[1].lens[:2]
    return replace(frame, K=K)


def half_a_pixel(frame):
    return replace(frame, K=frame.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))


def sensor_axes(frame):
    """x forward, y left, z up taken for x right, y down, z forward."""
    turn = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    return replace(frame, world_from_cam=frame.world_from_cam @ np.linalg.inv(turn))


def inverted(frame):
    return replace(frame, world_from_cam=np.linalg.inv(frame.world_from_cam))


def ranges_for_depth(frame):
    """Distance along the ray in place of z."""
    y, x = np.mgrid[: frame.image_size[0], : frame.image_size[1]] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(frame.K).T
    depth = frame.read_depth() * np.linalg.norm(rays, axis=-1)
    return replace(frame, read_depth=lambda: depth.astype(np.float32))


IN_FRAMES = {
    not_undistorted: "shift",
    stored_K: "shift",
    half_a_pixel: "shift",
    sensor_axes: "correlation",
    inverted: "color",
    ranges_for_depth: "depth",
}


@pytest.mark.parametrize("mistake", list(IN_FRAMES), ids=lambda m: m.__name__)
def test_a_mistake_planted_in_the_frames_is_seen(scene, mistake):
    count = 10 if IN_FRAMES[mistake] == "color" else 5
    spoilt = replace(scene, frames=[mistake(frame) for frame in scene.frames[:count]])
    assert IN_FRAMES[mistake] in judge(spoilt).faults()


def frame_pose(frame):
    """What using the frame's own pose for the images comes to."""
    frame.images = {name: (jpeg, frame.pose) for name, (jpeg, _) in frame.images.items()}


def map_top(frame, change):
    ranges, projection, poses = (part.copy() for part in frame.lasers[1])
    frame.lasers = {**frame.lasers, 1: change(ranges, projection, poses)}


def one_pose_for_the_turn(frame):
    """Points of TOP placed as if the car stood still during the turn."""
    map_top(frame, lambda r, p, poses: (r, p, np.broadcast_to(poses[:, 350:351], poses.shape)))


def vehicle_frame(frame):
    """Points of TOP left in the frame of the vehicle."""
    map_top(frame, lambda r, p, poses: (r, p, 0 * poses))


def upside_down(frame):
    """Beams counted from the lowest."""
    map_top(frame, lambda r, p, poses: (r[::-1], p[::-1], poses))


def mirrored(frame):
    """Columns counted the other way round."""
    map_top(frame, lambda r, p, poses: (r[:, ::-1], p[:, ::-1], poses))


def half_a_column(frame):
    """The azimuth of a column's edge in place of its middle, times two: less makes no odds."""
    map_top(frame, lambda r, p, poses: (np.roll(r, 3, 1), np.roll(p, 3, 1), poses))


IN_FILES = {
    frame_pose: {"shift", "correlation"},
    one_pose_for_the_turn: {"depth", "off"},
    vehicle_frame: {"known", "off"},
    upside_down: {"depth", "known", "off"},
    mirrored: {"depth", "known", "off"},
    half_a_column: {"depth", "off"},
}


@pytest.mark.parametrize("mistake", list(IN_FILES), ids=lambda m: m.__name__)
def test_a_mistake_planted_in_the_file_is_seen(segment, tmp_path, mistake):
    frame = replace(segment.frames[0])
    mistake(frame)
    write_v1(tmp_path / "training", replace(segment, frames=[frame]))
    assert IN_FILES[mistake] & judge(read_one(tmp_path)).faults()


def count_on_mover(scene):
    """Known pixels whose depth is that of the moving car, over all frames."""
    count = 0
    for frame in scene.frames:
        depth = frame.read_depth()
        rows, columns = np.nonzero(depth)
        rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], -1)
        directions = rays @ np.linalg.inv(frame.K).T @ frame.world_from_cam[:3, :3].T
        origin, time = frame.world_from_cam[:3, 3], drive.image_time(frame.name)
        hit = street.cast(origin, directions, time)
        near = np.abs(depth[rows, columns] / hit.distance - 1) < 0.08
        count += int((hit.moving & near).sum())
    return count


def test_points_of_moving_objects_are_left_out(segment, scene, tmp_path):
    assert count_on_mover(scene) == 0
    unlabelled = [replace(frame, labels=[]) for frame in segment.frames]
    write_v1(tmp_path / "training", replace(segment, frames=unlabelled))
    assert count_on_mover(read_one(tmp_path)) > 20


def test_what_lasers_see_behind_things_is_left_out(scene, monkeypatch):
    strict = judge(scene).off
    monkeypatch.setattr(depth_module, "OCCLUDED", np.inf)
    assert judge(scene).off > 1.5 * strict


def test_all_five_lasers_contribute(segment, scene, tmp_path):
    known = sum(int((frame.read_depth() > 0).sum()) for frame in scene.frames[:5])
    for number in segment.lasers:
        first = segment.frames[0]
        left = {n: scan for n, scan in first.lasers.items() if n != number}
        folder = tmp_path / str(number)
        write_v1(folder / "training", replace(segment, frames=[replace(first, lasers=left)]))
        without = read_one(folder).frames
        assert sum(int((frame.read_depth() > 0).sum()) for frame in without) < known - 20, number
