"""Holds what the converter gives against the street it was recorded on, by geometry alone."""

from dataclasses import dataclass

import numpy as np

from tests.data_prep.waymo import drive, street


@dataclass
class Verdict:
    """Worst of all frames."""

    correlation: float
    """Of brightness, with the picture a pinhole takes from the frame's camera with its K."""
    shift: float
    """Displacement from that picture at the corners, by a linear fit [px]."""
    depth: float
    """Median relative error of depth."""
    off: float
    """Share of depth that is off by more than a tenth."""
    known: float
    """Least share of pixels whose depth is known."""
    color: float
    """Correlation of brightness of points moved from image to image by their depth."""

    def faults(self):
        """Name what is out of range; clean drives stay clearly inside (see test_geometry)."""
        good = {
            "correlation": self.correlation > 0.95,
            "shift": self.shift < 0.13,
            "depth": self.depth < 0.008,
            "off": self.off < 0.02,
            "known": self.known > 0.1,
            "color": self.color > 0.85,
        }
        return {name for name, fine in good.items() if not fine}


def judge(scene):
    """Look at the first five images, and at pairs where there are two times."""
    looks, depths = [], []
    for frame in scene.frames[:5]:
        time = drive.image_time(frame.name)
        color, z = street.picture(frame.K, frame.world_from_cam, frame.image_size, time)
        looks.append(_look(frame, color, z))
        depths.append(_depth(frame, z))
    colors = [move_colors(a, b) for a, b in pairs(scene)] if len(scene.frames) > 5 else [1.0]
    return Verdict(
        correlation=min(look[0] for look in looks),
        shift=max(look[1] for look in looks),
        depth=max(depth[0] for depth in depths),
        off=max(depth[1] for depth in depths),
        known=min(depth[2] for depth in depths),
        color=float(np.median(colors)),
    )


def _look(frame, color, z):
    """Correlation and displacement of the image against the rendered one."""
    expected, found = color.mean(-1), frame.read_image().mean(-1)
    dy, dx = np.gradient(expected)
    # Away from outlines and beyond 40 m, where waves are thinner than pixels, all is smooth.
    steep = np.hypot(dx, dy) > 25
    use = ~steep & np.isfinite(z) & (z < 40)
    if use.sum() < 100:
        return 0.0, np.inf
    correlation = float(np.corrcoef(expected[use], found[use])[0, 1])
    height, width = frame.image_size
    y, x = np.mgrid[:height, :width] + 0.5
    x, y = (x - width / 2)[use], (y - height / 2)[use]
    gx, gy = dx[use], dy[use]
    # found(p) = expected(p + d(p)) with d = shift, zoom and turn about the middle.
    terms = np.stack([gx, gy, gx * x + gy * y, gy * x - gx * y], -1)
    left = np.clip(found[use] - expected[use], -30, 30)
    tx, ty, zoom, turn = np.linalg.lstsq(terms, left, rcond=None)[0]
    return correlation, float(np.hypot(tx, ty) + np.hypot(zoom, turn) * np.hypot(width, height) / 2)


def _depth(frame, z):
    """Median error, share far off, and share known."""
    depth = frame.read_depth()
    known = depth > 0
    if not known.any():
        return np.inf, 1.0, 0.0
    error = np.abs(depth[known] / z[known] - 1)
    return float(np.median(error)), float((error > 0.1).mean()), float(known.mean())


def pairs(scene):
    """Images of neighbouring times, of one camera and of neighbouring cameras."""
    named = enumerate(scene.frames)
    by_name = {frame.name.split("_", 1)[1] + str(i // 5): frame for i, frame in named}
    names = ["FRONT0 FRONT1", "FRONT_LEFT0 FRONT_LEFT1", "FRONT_RIGHT1 FRONT_RIGHT0"]
    names += ["FRONT0 FRONT_LEFT1", "FRONT_RIGHT0 SIDE_RIGHT1", "FRONT_LEFT0 SIDE_LEFT1"]
    return [tuple(by_name[name] for name in pair.split()) for pair in names]


def move_colors(source, target):
    """Correlate the brightness of known points of one image with that where they fall."""
    depth = source.read_depth()
    rows, columns = np.nonzero((depth > 0) & (depth < 30))
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], -1)
    cam = pixels @ np.linalg.inv(source.K).T * depth[rows, columns, None]
    world = cam @ source.world_from_cam[:3, :3].T + source.world_from_cam[:3, 3]
    there = (world - target.world_from_cam[:3, 3]) @ target.world_from_cam[:3, :3] @ target.K.T
    x, y = (there[:, :2] / there[:, 2:]).T
    height, width = target.image_size
    inside = (there[:, 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    if inside.sum() < 30:
        return 0.0
    here = source.read_image().mean(-1)[rows, columns][inside]
    seen = target.read_image().mean(-1)[y[inside].astype(int), x[inside].astype(int)]
    return float(np.corrcoef(here, seen)[0, 1])
