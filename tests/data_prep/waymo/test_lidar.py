import zlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_prep.converters.waymo import frame as frame_module
from data_prep.converters.waymo.calibration import Laser
from data_prep.converters.waymo.frame import FRAME_LASERS, read_boxes, read_scans
from data_prep.converters.waymo.lidar import (
    Box,
    beam_inclinations,
    find_moving,
    make_scan,
    make_sweep,
)
from data_prep.converters.waymo.wire import parse
from l3r.errors import DataError
from tests.data_prep.waymo import drive, street
from tests.data_prep.waymo.wire_writer import (
    block,
    float_matrix,
    frame_message,
    int_matrix,
    number,
)

WORLD_FROM_VEHICLE = drive.mount([100.0, -50, 3], [0.7, 0.02, -0.01])


def laser(number, inclinations=(), low=-0.4, high=0.4, mount=None):
    return Laser(
        number=number,
        vehicle_from_laser=np.eye(4) if mount is None else mount,
        inclinations=np.array(inclinations, np.float64),
        inclination_range=(low, high),
    )


def scan(of, ranges, poses=None):
    ranges = np.repeat(np.array(ranges, np.float32)[..., None], 4, axis=-1)
    projection = np.zeros((*ranges.shape[:2], 6), np.int32)
    projection[..., 0] = 1
    return make_scan(of, ranges, projection, poses)


def test_evenly_spaced_beams_start_at_the_highest():
    np.testing.assert_allclose(beam_inclinations(laser(2), 4), [0.3, 0.1, -0.1, -0.3])


def test_listed_beams_are_turned_round():
    np.testing.assert_array_equal(
        beam_inclinations(laser(1, [-0.3, -0.1, 0.05]), 3), [0.05, -0.1, -0.3]
    )


def test_another_number_of_beams_than_rows_is_refused():
    with pytest.raises(DataError, match="TOP: 4 rows, its calibration lists 3 beams"):
        beam_inclinations(laser(1, [-0.3, -0.1, 0.05]), 4)


def test_columns_run_clockwise_from_the_back():
    # Four columns of one horizontal beam: middles at 135, 45, -45 and -135 degrees from ahead.
    sweep = make_sweep([scan(laser(2, [0.0]), [[1.0, 1, 1, 1]])], np.eye(4), [])
    a = np.sqrt(0.5)
    np.testing.assert_allclose(
        sweep.pts3d_world, [[-a, a, 0], [a, a, 0], [a, -a, 0], [-a, -a, 0]], atol=1e-12
    )


def test_columns_count_angles_of_the_vehicle_when_the_laser_is_mounted_turned():
    turned = drive.mount([0, 0, 0], [2.6, 0, 0])
    sweep = make_sweep([scan(laser(2, [0.0], mount=turned), [[1.0, 1, 1, 1]])], np.eye(4), [])
    np.testing.assert_allclose(sweep.pts3d_world[1], np.array([1, 1, 0]) / np.sqrt(2), atol=1e-12)


def test_side_lasers_take_the_frames_pose_and_top_that_of_each_pixel():
    aside = make_sweep([scan(laser(3, [0.0]), [[2.0, 0]])], WORLD_FROM_VEHICLE, [])
    # The first of two columns points to the left.
    expected = WORLD_FROM_VEHICLE @ [0, 2, 0, 1]
    np.testing.assert_allclose(aside.pts3d_world, [expected[:3]], atol=1e-12)
    poses = np.zeros((1, 2, 6), np.float32)
    poses[0, 0] = [0.1, -0.2, 0.3, 5, 6, 7]
    top = make_sweep([scan(laser(1, [0.0]), [[2.0, 0]], poses)], WORLD_FROM_VEHICLE, [])
    turn = Rotation.from_euler("ZYX", [0.3, -0.2, 0.1]).as_matrix()
    np.testing.assert_allclose(top.pts3d_world, [turn @ [0, 2, 0] + [5, 6, 7]], atol=1e-6)


def test_top_without_poses_of_its_pixels_is_refused():
    with pytest.raises(DataError, match=r"TOP: ranges, camera projections and pixel poses are"):
        scan(laser(1, [0.0]), [[2.0, 2]])


def test_missing_and_damaged_returns_and_points_no_camera_sees_are_left_out():
    one = scan(laser(2, [0.0]), [[-1.0, 0, np.nan, np.inf, 1e30, 3, 3, 3]])
    one.projection[0, 6] = 0
    one.projection[0, 7] = [0, 0, 0, 2, 5, 5]
    sweep = make_sweep([one], np.eye(4), [])
    assert len(sweep.pts3d_world) == 2
    np.testing.assert_array_equal(sweep.projection[:, [0, 3]], [[1, 0], [0, 2]])


def test_range_images_survive_their_encoding(segment):
    frame = parse(frame_message(segment, segment.frames[0]), FRAME_LASERS)
    scans = read_scans(frame)
    assert [s.laser.number for s in scans] == [1, 2, 3, 4, 5]
    for one in scans:
        ranges, projection, poses = segment.frames[0].lasers[one.laser.number]
        np.testing.assert_array_equal(one.range_image, ranges[..., 0])
        np.testing.assert_array_equal(one.projection, projection)
        if poses is not None:
            np.testing.assert_array_equal(one.pixel_poses, poses)


def test_points_of_all_lasers_lie_on_the_street(segment):
    frame = parse(frame_message(segment, segment.frames[0]), FRAME_LASERS)
    for one in read_scans(frame):
        sweep = make_sweep([one], segment.frames[0].pose, [])
        p = (sweep.pts3d_world - street.WORLD_FROM_STREET[:3, 3]) @ street.WORLD_FROM_STREET[:3, :3]
        low, high = street.BOXES[:, 0], street.BOXES[:, 1]
        outside = np.maximum(low - p[:, None], p[:, None] - high).max(-1)
        off = np.minimum(np.abs(outside).min(1), np.abs(p[:, 2]))
        # Single precision of the pixel poses at 9 km is 1 mm. The moving car is 1% of the points.
        assert len(p) > 20
        assert np.quantile(off, 0.97) < 0.003


def test_labels_are_read_with_width_before_length(segment):
    label = segment.frames[0].labels[0]
    (box,) = read_boxes(parse(frame_message(segment, segment.frames[0]), FRAME_LASERS))
    np.testing.assert_allclose(box.center, label["center"])
    np.testing.assert_array_equal(box.size, [4.0, 1.8, 1.6])
    assert box.speed == 9.0


def box(speed, heading=0.0):
    return Box(center=(10.0, 0.0, 0.0), size=(4.0, 2.0, 2.0), heading=heading, speed=speed)


def test_points_in_enlarged_boxes_of_moving_objects_are_found():
    points = np.array([[10.0, 0, 0], [13.2, 0, 0], [13.4, 0, 0], [10, 0, 1.2], [10, 0, 1.4]])
    # 2 m half the length, 0.3 m margin, 0.1 s at 10 m/s.
    assert find_moving(points, [box(10.0)]).tolist() == [True, True, False, True, False]
    assert not find_moving(points, [box(0.1)]).any()


def test_a_box_is_turned_by_its_heading():
    across = np.array([[10.0, 2.2, 0], [12.2, 0, 0]])
    assert find_moving(across, [box(0.3, heading=np.pi / 2)]).tolist() == [True, False]


def test_an_object_of_unknown_speed_counts_as_moving_unless_it_is_a_sign(segment):
    frame = segment.frames[0]
    for kind, moves in ((1, True), (2, True), (3, False)):
        frame_copy = drive.FrameData(frame.timestamp, frame.pose)
        frame_copy.labels = [{**frame.labels[0], "speed": None, "type": kind}]
        boxes = read_boxes(parse(frame_message(segment, frame_copy), FRAME_LASERS))
        assert find_moving(np.array([boxes[0].center]), boxes).tolist() == [moves]


def lasers_of(segment, ranges, projection):
    """A frame with the segment's calibrations and one range image of laser 2."""
    frame = drive.FrameData(segment.frames[0].timestamp, segment.frames[0].pose)
    image = block(2, ranges) + block(3, projection)
    laser = block(5, number(1, 2) + block(2, image))
    return parse(frame_message(segment, frame) + laser, FRAME_LASERS)


GOOD = float_matrix(np.ones((3, 4, 4)))
SEEN = int_matrix(np.ones((3, 4, 6), int))


@pytest.mark.parametrize(
    ("ranges", "projection"),
    [
        (GOOD[:-3], SEEN),
        (b"no zlib", SEEN),
        (zlib.compress(b"\x0a\xff"), SEEN),
        (float_matrix(np.ones((3, 4, 3))), SEEN),
        (float_matrix(np.ones((12, 4))), SEEN),
        (zlib.compress(zlib.decompress(GOOD) + block(2, number(1, 2**40))), SEEN),
        (zlib.compress(zlib.decompress(GOOD) + block(2, number(1, -3))), SEEN),
        (GOOD, SEEN[:-3]),
        (GOOD, int_matrix(np.ones((3, 4, 4), int))),
        (GOOD, int_matrix(np.ones((4, 4, 6), int))),
    ],
    ids=range(10),
)
def test_damaged_range_images_are_refused(segment, ranges, projection):
    with pytest.raises(DataError):
        make_sweep(read_scans(lasers_of(segment, ranges, projection)), np.eye(4), [])


def test_a_zlib_bomb_is_not_unpacked(segment, monkeypatch):
    monkeypatch.setattr(frame_module, "_MAX_MATRIX", 10_000)
    bomb = float_matrix(np.zeros((100, 100, 4)))
    assert len(bomb) < 1000
    with pytest.raises(DataError, match="cut off or has more than 10000 bytes"):
        read_scans(lasers_of(segment, bomb, SEEN))
