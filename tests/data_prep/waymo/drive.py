"""What the car's sensors record on the street, as plain numbers in Waymo's conventions.

Written from the data set's description alone; nothing here is shared with the converter.
"""

import io
from dataclasses import dataclass, field

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.data_prep.waymo import street

START = 1_550_000_000_000_000
PERIOD = 0.1
CAMERA_YAW_DEG = {1: 0.4, 2: 44.6, 3: -44.8, 4: 89.5, 5: -90.3}
SIZES = {1: (128, 192), 2: (128, 192), 3: (128, 192), 4: (88, 192), 5: (88, 192)}
LENS = [205.0, 205.0, 95.4, 63.6, 0.04, -0.33, 0.001, -0.0016, 0.0]
CAMERA_DELAY = {1: 0.072, 2: 0.061, 3: 0.083, 4: 0.048, 5: 0.094}
"""Time of each image after the frame's start [s]; the frame's own pose is at 0.05."""
LASER_MOUNT = {
    1: ([1.43, 0, 2.18], [2.58, 0.004, -0.006]),
    2: ([4.07, 0, 0.69], [0.01, 0.0, 0.01]),
    3: ([3.24, 1.02, 0.98], [1.58, 0.01, 0.0]),
    4: ([3.24, -1.02, 0.98], [-1.57, 0.0, 0.01]),
    5: ([-1.16, 0, 0.46], [3.13, 0.0, 0.0]),
}
LASER_SIZES = {1: (40, 700), 2: (24, 90), 3: (24, 90), 4: (24, 90), 5: (24, 90)}
"""Rows and columns of the range images."""


@dataclass
class FrameData:
    """One frame: what a Frame message or the rows of a timestamp hold."""

    timestamp: int
    pose: np.ndarray
    images: dict = field(default_factory=dict)
    """camera -> (JPEG, vehicle pose at its own time)."""
    lasers: dict = field(default_factory=dict)
    """laser -> (ranges HxWx4, projections HxWx6, pixel poses HxWx6 or None)."""
    labels: list = field(default_factory=list)
    """dicts: center, size (length, width, height), heading, speed (x, y), type."""


@dataclass
class SegmentData:
    """A segment."""

    context: str
    cameras: dict
    """camera -> dict(lens, mount, size)."""
    lasers: dict
    """laser -> dict(mount, inclinations, low, high, size)."""
    frames: list


def mount(position, euler_zyx):
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_euler("ZYX", euler_zyx).as_matrix()
    transform[:3, 3] = position
    return transform


def calibrate(laser_sizes):
    cameras = {}
    for number, yaw in CAMERA_YAW_DEG.items():
        lens = list(LENS)
        if number > 3:
            lens[3] = 24.5
        at = [1.5, 0.1 * np.sin(np.radians(yaw)), 2.11]
        turn = [np.radians(yaw), 0.015, -0.01]
        cameras[number] = {"lens": lens, "mount": mount(at, turn), "size": SIZES[number]}
    lasers = {}
    for number, (at, turn) in LASER_MOUNT.items():
        laser = {"mount": mount(at, turn), "inclinations": [], "low": -np.pi / 2, "high": 0.52}
        laser["size"] = laser_sizes[number]
        if number == 1:
            edges = np.linspace(-0.31, 0.045, laser_sizes[1][0] + 1)
            middle = (edges[:-1] + edges[1:]) / 2
            laser["inclinations"] = list(middle + 0.002 * np.sin(middle * 40))
            laser["low"], laser["high"] = edges[0], edges[-1]
        lasers[number] = laser
    return cameras, lasers


def lens_forward(x, y, lens):
    """Pixels of normalised points, x right, y down."""
    fu, fv, cu, cv, k1, k2, p1, p2, k3 = lens
    r2 = x**2 + y**2
    factor = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * factor + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return fu * u + cu, fv * v + cv, factor


def lens_backward(u, v, lens):
    """Normalised points of pixels, by fixed-point iteration."""
    x = x0 = (u - lens[2]) / lens[0]
    y = y0 = (v - lens[3]) / lens[1]
    for _ in range(15):
        px, py, _ = lens_forward(x, y, lens)
        x, y = x + x0 - (px - lens[2]) / lens[0], y + y0 - (py - lens[3]) / lens[1]
    return x, y


def take_image(camera, vehicle_pose, time):
    """A distorted picture, all of it at one moment."""
    height, width = camera["size"]
    v, u = np.mgrid[:height, :width] + 0.5
    x, y = lens_backward(u.ravel(), v.ravel(), camera["lens"])
    # Waymo's camera looks along x, y is left, z is up.
    sensor = np.stack([np.ones_like(x), -x, -y], axis=-1)
    cv_axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    world_from_cam = vehicle_pose @ camera["mount"]
    world_from_cam = world_from_cam.copy()
    world_from_cam[:3, :3] = world_from_cam[:3, :3] @ cv_axes.T
    color, _ = street.render(sensor @ cv_axes.T, world_from_cam, time, camera["size"])
    stream = io.BytesIO()
    Image.fromarray(color.round().clip(0, 255).astype(np.uint8)).save(stream, "JPEG", quality=97)
    return stream.getvalue()


def laser_rays(laser, size):
    """Unit directions in the laser's frame, row 0 highest, columns clockwise from the back."""
    rows, columns = size
    if len(laser["inclinations"]):
        pitch = np.array(laser["inclinations"])[::-1]
    else:
        step = (laser["high"] - laser["low"]) / rows
        pitch = laser["high"] - step * (np.arange(rows) + 0.5)
    turned = np.arctan2(laser["mount"][1, 0], laser["mount"][0, 0])
    yaw = np.pi - 2 * np.pi * (np.arange(columns) + 0.5) / columns - turned
    pitch, yaw = np.meshgrid(pitch, yaw, indexing="ij")
    return np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], -1)


def take_scan(number, laser, start, images, cameras):
    """Range image, camera projections and pixel poses of one laser."""
    size = laser["size"]
    rays = laser_rays(laser, size)
    columns = np.arange(size[1])
    # TOP turns during the frame; the others are resampled to the frame's own pose.
    times = start + PERIOD * columns / size[1] if number == 1 else np.full(size[1], start + 0.05)
    poses = np.stack([street.world_from_vehicle(t) for t in times])
    world_from_laser = poses @ laser["mount"]
    directions = np.einsum("cij,rcj->rci", world_from_laser[:, :3, :3], rays).reshape(-1, 3)
    origins = np.tile(world_from_laser[:, :3, 3], (size[0], 1))
    hit = street.cast(origins, directions, np.tile(times, size[0]))
    limit = 75.0 if number == 1 else 20.0
    distance = np.where(hit.distance < limit, hit.distance, -1.0)
    ranges = np.zeros((*size, 4), np.float32)
    ranges[..., 0] = distance.reshape(size)
    ranges[..., 3] = -1
    points = origins + directions * distance[:, None]
    projection = project_all(points, distance > 0, images, cameras).reshape(*size, 6)
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX")
    row = np.concatenate([angles[:, ::-1], poses[:, :3, 3]], axis=1).astype(np.float32)
    return ranges, projection, np.tile(row, (size[0], 1, 1)) if number == 1 else None


def project_all(points, known, images, cameras):
    """First two cameras that have a point in their image, and the whole pixels."""
    result = np.zeros((len(points), 6), np.int32)
    count = np.zeros(len(points), int)
    for number in sorted(cameras):
        camera = cameras[number]
        vehicle_pose = images[number][1]
        sensor = (points - (vehicle_pose @ camera["mount"])[:3, 3]) @ (
            vehicle_pose @ camera["mount"]
        )[:3, :3]
        front = known & (sensor[:, 0] > 0.1)
        x = np.where(front, -sensor[:, 1] / np.where(front, sensor[:, 0], 1), 9)
        y = np.where(front, -sensor[:, 2] / np.where(front, sensor[:, 0], 1), 9)
        u, v, factor = lens_forward(x, y, camera["lens"])
        inside = (u >= 0) & (u < camera["size"][1]) & (v >= 0) & (v < camera["size"][0])
        seen = np.flatnonzero(front & inside & (factor > 0.8) & (factor < 1.2) & (count < 2))
        for axis, values in enumerate((np.full_like(u, number), np.floor(u), np.floor(v))):
            result[seen, 3 * count[seen] + axis] = values[seen]
        count[seen] += 1
    return result


def label_mover(start, pose):
    """Label of the moving car at the time of the frame's own pose, in its vehicle frame."""
    time = start + 0.05
    center = street.WORLD_FROM_STREET @ np.append(street.mover_center(time), 1)
    axis = street.WORLD_FROM_STREET[:3, 0]
    vehicle = np.linalg.inv(pose)
    ahead = vehicle[:3, :3] @ axis
    return {
        "center": (vehicle @ center)[:3],
        "size": street.MOVER_SIZE,
        "heading": float(np.arctan2(ahead[1], ahead[0])),
        "speed": (-street.MOVER_SPEED, 0.0),
        "type": 1,
    }


def record(num_frames, laser_sizes=LASER_SIZES, context="1234567890123456789_100_000_120_000"):
    """Drive along the street."""
    cameras, lasers = calibrate(laser_sizes)
    frames = []
    for index in range(num_frames):
        start = index * PERIOD
        frame = FrameData(
            timestamp=START + round(1e6 * start), pose=street.world_from_vehicle(start + 0.05)
        )
        for number, camera in cameras.items():
            time = start + CAMERA_DELAY[number]
            pose = street.world_from_vehicle(time)
            frame.images[number] = (take_image(camera, pose, time), pose)
        for number, laser in lasers.items():
            frame.lasers[number] = take_scan(number, laser, start, frame.images, cameras)
        frame.labels = [label_mover(start, frame.pose)]
        frames.append(frame)
    return SegmentData(context, cameras, lasers, frames)


def image_time(frame_name):
    """When an image was taken [s], from the name the converter gives it."""
    timestamp, camera = frame_name.split("_", 1)
    names = ["FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT"]
    return (int(timestamp) - START) / 1e6 + CAMERA_DELAY[names.index(camera) + 1]
