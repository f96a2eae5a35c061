"""A box with a ball in it, seen through any lens: exact images, depth and points.

Shares no code with the product: rays, distortion and intersections are written out here. The
texture is smooth, so that a shift of a hundredth of a pixel can be measured.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

BOX, BALL = 3.0, 0.7
"""Half the side of the box and radius of the ball at its middle."""


@dataclass(frozen=True)
class Camera:
    """A lens by COLMAP's name and parameters, and where it stands."""

    model: str
    size: tuple[int, int]
    params: tuple[float, ...]
    world_from_cam: np.ndarray


def ring(count, radius=1.9, seed=0):
    """Cameras that look at the ball from around it, slightly rolled, as world_from_cam."""
    draw = np.random.default_rng(seed)
    cameras = []
    for number in range(count):
        angle = 0.18 * number
        center = np.array(
            [radius * np.sin(angle), draw.uniform(-0.3, 0.3), -radius * np.cos(angle)]
        )
        z = -center / np.linalg.norm(center)
        x = np.cross([0, 1, 0], z)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z], axis=1)
        world_from_cam = np.eye(4)
        world_from_cam[:3, :3] = R @ Rotation.from_euler("z", draw.uniform(-0.1, 0.1)).as_matrix()
        world_from_cam[:3, 3] = center
        cameras.append(world_from_cam)
    return cameras


def distort(model, params, xy):
    """Pixels of normalised image coordinates (x / z, y / z)."""
    x, y = np.asarray(xy, float).T
    r2 = x * x + y * y
    match model:
        case "PINHOLE":
            fx, fy, cx, cy = params
        case "SIMPLE_RADIAL":
            f, cx, cy, k = params
            fx = fy = f
            x, y = x * (1 + k * r2), y * (1 + k * r2)
        case "OPENCV":
            fx, fy, cx, cy, k1, k2, p1, p2 = params
            radial = 1 + k1 * r2 + k2 * r2 * r2
            x, y = (
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            )
        case "OPENCV_FISHEYE":
            fx, fy, cx, cy, k1, k2, k3, k4 = params
            r = np.sqrt(r2)
            t = np.arctan(r)
            bent = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8)
            factor = np.where(r > 1e-9, bent / np.maximum(r, 1e-9), 1)
            x, y = x * factor, y * factor
    return np.stack([fx * x + cx, fy * y + cy], axis=-1)


def undistort(model, params, pixels):
    """Normalised coordinates of pixels, by Newton's method with numerical derivatives."""
    fx, fy = (params[0], params[0]) if model == "SIMPLE_RADIAL" else params[:2]
    cx, cy = params[1:3] if model == "SIMPLE_RADIAL" else params[2:4]
    xy = (pixels - (cx, cy)) / (fx, fy)
    step, right, down = 1e-6, np.array([1e-6, 0]), np.array([0, 1e-6])
    for _ in range(8):
        error = distort(model, params, xy) - pixels
        dx = (distort(model, params, xy + right) - distort(model, params, xy - right)) / 2
        dy = (distort(model, params, xy + down) - distort(model, params, xy - down)) / 2
        J = np.stack([dx, dy], axis=-1) / step
        xy = xy - np.linalg.solve(J, error[..., None])[..., 0]
    assert np.abs(distort(model, params, xy) - pixels).max() < 1e-6
    return xy


def hit(origin, direction):
    """Length along rays to the first surface; rays start inside the box, outside the ball."""
    with np.errstate(divide="ignore"):
        walls = ((np.sign(direction) * BOX - origin) / direction).min(-1)
    b = (direction * origin).sum(-1)
    a = (direction**2).sum(-1)
    inside = b * b - a * ((origin**2).sum(-1) - BALL**2)
    ball = (-b - np.sqrt(np.maximum(inside, 0))) / a
    return np.where((inside > 0) & (ball > 0), np.minimum(ball, walls), walls)


def shade(points):
    """Colour of world points in [0, 1]."""
    x, y, z = (points * 6.0).T
    waves = [
        np.sin(x + 0.7 * y) + np.sin(1.3 * y - 0.5 * z) + np.sin(1.1 * z + 0.4 * x),
        np.sin(0.9 * x - 1.2 * z) + np.sin(1.4 * y) + np.sin(0.8 * z + 0.6 * y),
        np.sin(1.2 * x) + np.sin(y + z) + np.sin(0.7 * z - 0.9 * y),
    ]
    return 0.5 + np.stack(waves, axis=-1) / 6.5


def rays(camera):
    """Rays of z = 1 through all pixel centres, which lie at .5, row by row."""
    height, width = camera.size
    y, x = np.mgrid[:height, :width] + 0.5
    xy = undistort(camera.model, camera.params, np.stack([x, y], axis=-1).reshape(-1, 2))
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=-1)


def photograph(camera):
    """Give (image, depth): RGB uint8 and z."""
    R, center = camera.world_from_cam[:3, :3], camera.world_from_cam[:3, 3]
    direction = rays(camera) @ R.T
    z = hit(center, direction)
    color = shade(center + direction * z[:, None])
    image = np.clip(np.rint(255 * color), 0, 255).astype(np.uint8)
    return image.reshape(*camera.size, 3), z.reshape(camera.size)


def photograph_pinhole(K, world_from_cam, size):
    """The same through a pinhole."""
    params = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    return photograph(Camera("PINHOLE", size, params, world_from_cam))


def surface_points(cameras, count, seed=0):
    """Draw points that cameras see, with the pixel each camera sees them at.

    Returns:
        ``(points, tracks)``: positions, and a list of (camera, pixel) for each.
    """
    draw = np.random.default_rng(seed)
    points, tracks = [], []
    for number in range(count):
        source = cameras[number % len(cameras)]
        pixel = draw.uniform((1, 1), (source.size[1] - 1, source.size[0] - 1))
        ray = np.append(undistort(source.model, source.params, pixel[None])[0], 1)
        R, center = source.world_from_cam[:3, :3], source.world_from_cam[:3, 3]
        point = center + R @ ray * hit(center, R @ ray)
        track = [(i, p) for i, c in enumerate(cameras) if (p := see(c, point)) is not None]
        if len(track) > 1:
            points.append(point)
            tracks.append(track)
    return np.array(points), tracks


def see(camera, point):
    """Pixel at which a camera sees a point; None where it does not."""
    R, center = camera.world_from_cam[:3, :3], camera.world_from_cam[:3, 3]
    cam = R.T @ (point - center)
    if cam[2] <= 0.1 or hit(center, point - center) < 1 - 1e-6:
        return None
    pixel = distort(camera.model, camera.params, (cam[:2] / cam[2])[None])[0]
    inside = (pixel > 0).all() and pixel[0] < camera.size[1] and pixel[1] < camera.size[0]
    # A polynomial may fold what lies far outside back into the image.
    return pixel if inside and np.abs(cam[:2] / cam[2]).max() < 1.2 else None


def shift_between(image, expected):
    """Largest shift [px] of the four quarters of an image against what is expected there."""
    a, b = (x.astype(float).mean(-1)[3:-3, 3:-3] for x in (image, expected))
    gy, gx = np.gradient(b)
    rows, columns = (
        np.array_split(np.arange(a.shape[0]), 2),
        np.array_split(np.arange(a.shape[1]), 2),
    )
    shifts = []
    for r in rows:
        for c in columns:
            part = np.ix_(r, c)
            flat = np.abs(gx[part]) + np.abs(gy[part]) < 25  # away from the ball's edge
            A = np.stack([gx[part][flat], gy[part][flat]], axis=-1)
            d, *_ = np.linalg.lstsq(A, (a - b)[part][flat], rcond=None)
            shifts.append(np.linalg.norm(d))
    return max(shifts)
