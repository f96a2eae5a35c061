from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData

from l3r.export.ply import write_ply
from l3r.export.points import PointSelection

GOLDEN = Path(__file__).parents[1] / "golden" / "export_points.ply"


def test_header_and_three_vertices_are_as_agreed(tmp_path, scene, request):
    points = [torch.full_like(map, torch.nan) for map in scene.pts3d_world]
    colors = [map.clone() for map in scene.image]
    conf = [torch.full_like(map, 5.0) for map in scene.conf]
    points[0][0, :3] = torch.tensor([[0.0, 0.5, 0.25], [1.0, 0.0, 0.0], [-0.5, 2.0, 0.125]])
    colors[0][:, 0, :3] = torch.tensor([[0, 1, 0.5], [1, 0.25, 0], [0, 0, 1.0]])
    scene = replace(scene, pts3d_world=points, image=colors, conf=conf)
    assert write_ply(tmp_path / "points.ply", scene) == 3
    written = (tmp_path / "points.ply").read_bytes()
    if request.config.getoption("--update-golden", default=False):
        GOLDEN.write_bytes(written)
    assert written == GOLDEN.read_bytes()


def test_points_colours_and_confidence_are_read_back(tmp_path, scene):
    path = tmp_path / "points.ply"
    selection = PointSelection(max_points=600, min_conf=4.0)
    assert write_ply(path, scene, selection) == 600
    vertices = PlyData.read(path)["vertex"]
    xyz = np.stack([vertices[axis] for axis in "xyz"], 1)
    radius = np.linalg.norm(xyz, axis=1)
    # Every point lies on the ball or on the wall.
    assert np.minimum(abs(radius - 1), abs(radius - 6)).max() < 1e-4
    assert vertices["confidence"].min() > 4
    assert vertices["red"].dtype == np.uint8


def test_nothing_confident_gives_an_empty_cloud(tmp_path, scene):
    assert write_ply(tmp_path / "p.ply", scene, PointSelection(min_conf=1e9)) == 0
    assert len(PlyData.read(tmp_path / "p.ply")["vertex"]) == 0
