"""``points.ply``: the confident points with colour and confidence."""

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from l3r.export.points import PointSelection, sample_points
from l3r.files import atomic_path
from l3r.types import Reconstruction

_VERTEX = [
    ("x", "<f4"),
    ("y", "<f4"),
    ("z", "<f4"),
    ("red", "u1"),
    ("green", "u1"),
    ("blue", "u1"),
    ("confidence", "<f4"),
]


def write_ply(path: Path, scene: Reconstruction, selection: PointSelection | None = None) -> int:
    """Write a binary point cloud in the world's frame.

    Args:
        path: The file to write.
        scene: Only registered images give points.
        selection: Which points; by default up to two million above the rule of each image.

    Returns:
        Number of points written.
    """
    sample = sample_points(scene, selection or PointSelection(max_points=2_000_000))
    vertices = np.empty(len(sample.conf), dtype=_VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name] = sample.pts3d_world[:, axis].cpu().numpy()
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = sample.color[:, channel].cpu().numpy()
    vertices["confidence"] = sample.conf.cpu().numpy()
    element = PlyElement.describe(vertices, "vertex")
    with atomic_path(path) as temporary:
        PlyData([element], text=False, byte_order="<").write(temporary)
    return len(vertices)
