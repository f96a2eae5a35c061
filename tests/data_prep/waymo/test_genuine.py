"""What genuine files can show: they hold no lidar, and pixels of one moment at rest only."""

import io
import struct

import cv2
import numpy as np
import pytest
from PIL import Image

from data_prep.converters.waymo import read, survey, thin_stationary
from data_prep.converters.waymo.components import read_vehicle_poses
from data_prep.converters.waymo.frame import FRAME_LASERS, read_boxes
from data_prep.converters.waymo.images import decode_jpeg
from data_prep.converters.waymo.lidar import MOVING_SPEED
from data_prep.converters.waymo.moment import Moment
from data_prep.converters.waymo.wire import parse
from data_prep.problems import Problems
from tests.data_prep.waymo import drive
from tests.data_prep.waymo.drive import laser_rays, project_all
from tests.data_prep.waymo.wire_writer import (
    block,
    float_matrix,
    get,
    int_matrix,
    matrix,
    number,
    payloads,
    split,
    tfrecord,
)

NAMES = ["FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT"]
AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def raw(shared):
    return shared / "data" / "raw" / "waymo"


@pytest.fixture(scope="module")
def standing(raw):
    """The genuine frame with images, by camera."""
    problems = Problems()
    options = {"scenes": "pvps*", "problems": problems, "require_depth": False}
    (scene,) = read(raw, "all", **options)
    assert problems.summary() == "none"
    return {frame.name.split("_", 1)[1]: frame for frame in scene.frames}


def grey_jpeg(size):
    stream = io.BytesIO()
    Image.new("RGB", size, (90, 90, 90)).save(stream, "JPEG")
    return stream.getvalue()


def mounts(payload):
    """Genuine mounts of the cameras by number."""
    calibrations = [v for tag, _, v in split(get(payload, 1)) if tag == 2]
    return {get(c, 1): matrix(get(c, 3)) for c in calibrations}


def test_the_cameras_of_a_moving_car_stand_at_the_images_own_pose(raw, tmp_path):
    genuine = list(payloads((raw / "two_frames_no_pixels.tfrecord").read_bytes()))
    # The pixels were stripped from this file; everything else in it stays as it was.
    filled = []
    for payload in genuine:
        out = b""
        for tag, kind, value in split(payload):
            if tag == 4:
                side = get(value, 1) in (4, 5)
                value += block(2, grey_jpeg((1920, 886 if side else 1280)))
            out += number(tag, value) if kind == 0 else block(tag, value)
        filled.append(out)
    (tmp_path / "training").mkdir()
    (tmp_path / "training" / "x.tfrecord").write_bytes(tfrecord(filled))
    (scene,) = read(tmp_path, problems=Problems(), require_depth=False)
    off = []
    frames = iter(scene.frames)
    for payload in genuine:
        images = {get(v, 1): v for tag, _, v in split(payload) if tag == 4}
        for camera, mount in sorted(mounts(payload).items()):
            found = next(frames).world_from_cam
            to_cam = mount @ np.linalg.inv(AXES)
            np.testing.assert_allclose(found, matrix(get(images[camera], 3)) @ to_cam, atol=1e-8)
            off.append(np.linalg.norm((found - matrix(get(payload, 3)) @ to_cam)[:3, 3]))
    # Taken from the frame's pose, all but FRONT would be off: by 10 to 30 ms of driving.
    np.testing.assert_allclose(off, [0, 0.177, 0.177, 0.532, 0.355] * 2, atol=0.002)
    drive_length = scene.frames[5].world_from_cam[:3, 3] - scene.frames[0].world_from_cam[:3, 3]
    assert 1.7 < np.linalg.norm(drive_length) < 1.9


def test_checksums_of_genuine_files_are_right(raw):
    problems = Problems()
    list(read(raw, "all", problems=problems, require_depth=False))
    # The files lack pixels, and version 2 its images; nothing is damaged.
    assert problems.summary() == "1 bad_segment, 3 empty_scene, 15 missing_image"
    found = {scene.name: scene for scene in survey(raw)}
    assert found["pvps_data_one_frame"].image_size == (1280, 1920)
    assert found["pvps_data_one_frame"].num_missing == 5
    assert found["10023947602400723454_1120_000_1140_000"].num_images == 0


def test_genuine_images_are_read_with_the_least_zoom(standing):
    assert list(standing) == NAMES
    for frame in standing.values():
        image = frame.read_image()
        assert image.shape == (*frame.image_size, 3)
        # No corner was left empty.
        assert min(image[y, x].max() for y in (0, -1) for x in (0, -1)) > 5
        lens = frame.read_image.args[1].lens
        assert 1 < frame.K[0, 0] / lens[0] < 1.005
    sizes = [frame.image_size for frame in standing.values()]
    assert sizes == [(1280, 1920)] * 3 + [(886, 1920)] * 2


def match(first, second, from_left, width=260):
    """Pixels of the same features in the strips of two images that see the same."""
    sift = cv2.SIFT_create(2500, contrastThreshold=0.01)
    found = []
    for image, at_left in ((first, from_left), (second, not from_left)):
        start = 0 if at_left else image.shape[1] - width
        strip = cv2.cvtColor(image[:, start : start + width], cv2.COLOR_RGB2GRAY)
        points, descriptors = sift.detectAndCompute(strip, None)
        centers = np.array([point.pt for point in points])
        found.append((np.add(centers, [start + 0.5, 0.5]), descriptors))
    pairs = cv2.BFMatcher().knnMatch(found[0][1], found[1][1], k=2)
    good = [a for a, b in pairs if a.distance < 0.75 * b.distance]
    return found[0][0][[m.queryIdx for m in good]], found[1][0][[m.trainIdx for m in good]]


def share_in_front(a, b, pts_a, pts_b, K_a, K_b):
    """Of features that are near where one at infinity would be: how many lie in front."""
    b_from_a = np.linalg.inv(b.world_from_cam) @ a.world_from_cam
    rays_a = np.c_[pts_a, np.ones(len(pts_a))] @ np.linalg.inv(K_a).T @ b_from_a[:3, :3].T
    far = rays_a @ K_b.T
    near = (rays_a[:, 2] > 0) & (np.linalg.norm(far[:, :2] / far[:, 2:] - pts_b, axis=1) < 40)
    rays_b = np.c_[pts_b, np.ones(len(pts_b))] @ np.linalg.inv(K_b).T
    depths = [
        np.linalg.lstsq(np.c_[u, -v], -b_from_a[:3, 3], rcond=None)[0][0]
        for u, v in zip(rays_a[near], rays_b[near], strict=True)
    ]
    return int(near.sum()), float((np.array(depths) > 0).mean())


def test_neighbouring_genuine_images_agree_once_undistorted(standing):
    a, b = standing["FRONT"], standing["FRONT_RIGHT"]
    count, front = share_in_front(
        a, b, *match(a.read_image(), b.read_image(), from_left=False), a.K, b.K
    )
    assert count > 100
    assert front > 0.95
    # Read as if they were not distorted, most features would lie behind the cameras.
    stored, K = [], []
    for frame in (a, b):
        jpeg, camera, where = frame.read_image.args
        stored.append(decode_jpeg(jpeg(), camera.image_size, where))
        fx, fy, cx, cy = camera.lens[:4]
        K.append(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    _, front = share_in_front(a, b, *match(*stored, from_left=False), *K)
    assert front < 0.7


def test_genuine_labels_tell_parked_from_moving(raw):
    (payload,) = payloads((raw / "pvps_data_one_frame.tfrecord").read_bytes())
    speeds = np.sort([box.speed for box in read_boxes(parse(payload, FRAME_LASERS))])
    assert len(speeds) == 75
    fast, slow = speeds[speeds > MOVING_SPEED], speeds[speeds <= MOVING_SPEED]
    assert (len(fast), slow.max() < 0.17, fast.min() > 1.3) == (12, True, True)


def genuine_laser(calibration):
    """Laser calibration as the test's own code takes it."""
    doubles = [v for tag, kind, v in split(calibration) if tag == 2 and kind == 1]
    return {
        "mount": matrix(get(calibration, 5)),
        "inclinations": [struct.unpack("<d", v)[0] for v in doubles],
        "low": struct.unpack("<d", get(calibration, 3))[0],
        "high": struct.unpack("<d", get(calibration, 4))[0],
    }


def test_flat_ground_seen_through_genuine_calibrations_is_flat(raw, tmp_path):
    """The frame has no range images: some of a plane are made from its calibrations."""
    (payload,) = payloads((raw / "pvps_data_one_frame.tfrecord").read_bytes())
    world_from_vehicle = matrix(get(payload, 3))
    cameras, images = genuine_cameras(payload)
    for calibration in (v for tag, _, v in split(get(payload, 1)) if tag == 3):
        name, laser = get(calibration, 1), genuine_laser(calibration)
        size = (64, 660) if name == 1 else (50, 150)
        assert len(laser["inclinations"]) == (64 if name == 1 else 0)
        rays = laser_rays(laser, size).reshape(-1, 3) @ laser["mount"][:3, :3].T
        with np.errstate(divide="ignore"):
            distance = -laser["mount"][2, 3] / rays[:, 2]
        distance = np.where((distance > 0) & (distance < 75), distance, -1)
        points = (laser["mount"][:3, 3] + rays * distance[:, None]) @ world_from_vehicle[:3, :3].T
        points = points + world_from_vehicle[:3, 3]
        projection = project_all(points, distance > 0, images, cameras)
        ranges = np.repeat(distance.reshape(*size, 1), 4, axis=2)
        image = block(2, float_matrix(ranges))
        image += block(3, int_matrix(projection.reshape(*size, 6)))
        if name == 1:
            turn = np.arctan2(world_from_vehicle[1, 0], world_from_vehicle[0, 0])
            pitch = -np.arcsin(world_from_vehicle[2, 0])
            roll = np.arctan2(world_from_vehicle[2, 1], world_from_vehicle[2, 2])
            pose = np.array([roll, pitch, turn, *world_from_vehicle[:3, 3]])
            image += block(4, float_matrix(np.broadcast_to(pose, (*size, 6))))
        payload += block(5, number(1, name) + block(2, image))
    (tmp_path / "training").mkdir()
    (tmp_path / "training" / "x.tfrecord").write_bytes(tfrecord([payload]))
    (scene,) = read(tmp_path, problems=Problems())
    for frame in scene.frames:
        depth = frame.read_depth()
        rows, columns = np.nonzero(depth)
        rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], -1)
        points = rays @ np.linalg.inv(frame.K).T * depth[rows, columns, None]
        vehicle = np.linalg.inv(world_from_vehicle) @ frame.world_from_cam
        height = (points @ vehicle[:3, :3].T + vehicle[:3, 3])[:, 2]
        assert len(rows) > 500
        # Half a pixel is 1.2 cm at 50 m; the car stands still, the poses differ by 0.1 mm.
        assert np.abs(height).max() < 0.05


def genuine_cameras(payload):
    """Genuine cameras and poses as the test's own code takes them."""
    calibrations = [v for tag, _, v in split(get(payload, 1)) if tag == 2]
    cameras = {}
    for calibration in calibrations:
        lens = [struct.unpack("<d", v)[0] for tag, _, v in split(calibration) if tag == 2]
        size = (get(calibration, 5), get(calibration, 4))
        mount = matrix(get(calibration, 3))
        cameras[get(calibration, 1)] = {"lens": lens, "size": size, "mount": mount}
    found = [v for tag, _, v in split(payload) if tag == 4]
    return cameras, {get(image, 1): (None, matrix(get(image, 3))) for image in found}


def test_a_genuine_table_of_vehicle_poses_is_read_and_thinned(raw):
    context = "10023947602400723454_1120_000_1140_000"
    problems = Problems()
    poses = read_vehicle_poses(raw / "v2", context, problems)
    assert (len(poses), problems.summary()) == (199, "none")
    path = np.stack([poses[time][:3, 3] for time in sorted(poses)])
    assert abs(np.linalg.norm(np.diff(path, axis=0), axis=1).sum() - 7.55) < 0.01
    moments = [
        Moment(timestamp=time, world_from_vehicle=poses[time], shots=[], has_lidar=True)
        for time in sorted(poses)
    ]
    assert len(list(thin_stationary(moments))) == 24


def test_the_synthetic_drive_is_of_the_genuine_kind(raw):
    """Lens and mounts of the drive, scaled to the genuine size, are near the genuine ones."""
    (payload,) = payloads((raw / "pvps_data_one_frame.tfrecord").read_bytes())
    cameras, _ = genuine_cameras(payload)
    mine, _ = drive.calibrate(drive.LASER_SIZES)
    for name, camera in cameras.items():
        scale = camera["size"][1] / mine[name]["size"][1]
        np.testing.assert_allclose(
            np.array(mine[name]["lens"][:4]) * scale, camera["lens"][:4], rtol=0.1
        )
        np.testing.assert_allclose(mine[name]["lens"][4:], camera["lens"][4:], atol=0.04)
        np.testing.assert_allclose(mine[name]["mount"], camera["mount"], atol=0.1)
