"""A ring of cameras around an analytic surface: exact cameras, depth and point maps."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from l3r.geometry.camera import window_centers
from l3r.geometry.rigid import invert_rigid, rigid_from_parts
from l3r.types import Cameras, Reconstruction, SceneTree, Window


def look_at(center, target):
    """``cam_from_world`` of a camera at ``center``; the world's up is -y."""
    forward = torch.nn.functional.normalize(target - center, dim=0)
    down = torch.tensor([0.0, 1.0, 0.0]).double()
    right = torch.nn.functional.normalize(torch.linalg.cross(down, forward), dim=0)
    R = torch.stack([right, torch.linalg.cross(forward, right), forward])
    return rigid_from_parts(R, -R @ center)


def room_depth(origin, rays):
    """Distance along rays from inside a sphere of radius 6 that holds a ball of radius 1."""

    def hit(radius, *, far):
        a, b = (rays**2).sum(-1), (rays @ origin)
        root = b**2 - a * ((origin**2).sum() - radius**2)
        distance = (-b + (1 if far else -1) * root.clamp_min(0).sqrt()) / a
        return torch.where(root >= 0, distance, torch.inf)

    ball, wall = hit(1.0, far=False), hit(6.0, far=True)
    return torch.where(ball.isfinite() & (ball > 0), ball, wall), ball.isfinite()


def ring_scene(num_views=6, original=(120, 160), size=(48, 64), window=None):
    """Build an exact reconstruction with distinct sizes of photo and network image.

    The network saw the whole photos, or a window of each.
    """
    window = window or Window.whole(*original)
    views = [_view(index / num_views, original, size, window) for index in range(num_views)]
    image, pts3d, conf, cam_from_world, K = map(list, zip(*views, strict=True))
    n = num_views
    parent = torch.tensor([[0 if child in (1, n - 1) else child - 1 for child in range(1, n)]])
    level = [1]
    for child in range(2, n):
        level.append(1 if parent[0, child - 1] == 0 else level[-1] + 1)
    scores = torch.full((n, n), 0.4).fill_diagonal_(1.0)
    for child in range(1, n):
        scores[child, parent[0, child - 1]] = scores[parent[0, child - 1], child] = 0.95 - 0.1 * (
            child / n
        )
    edge_scores = scores[parent[0], torch.arange(1, n)]
    tree = SceneTree(
        root=torch.tensor([0]),
        parent=parent,
        child=torch.arange(1, n)[None],
        level=torch.tensor([level]),
        parent_edge=parent - 1,
        cost=(1 - edge_scores.double())[None],
    )
    cameras = Cameras(
        file=[f"ring_{index:03d}.jpg" for index in range(n)],
        image_size=[original] * n,
        K=torch.stack(K),
        cam_from_world=torch.stack(cam_from_world),
        registered=torch.ones(n, dtype=torch.bool),
        component=torch.zeros(n, dtype=torch.int64),
    )
    return Reconstruction(
        cameras=cameras,
        image=image,
        window=[window] * n,
        pts3d_world=pts3d,
        conf=conf,
        tree=tree,
        scores=scores,
        residual=torch.linspace(0, 0.02, n - 1),
        point_rule=["threshold"] * n,
        seconds={"load": 0.4, "encode": 2.1, "decode": 3.2, "cameras": 0.6},
        peak_mib={"load": 210.0, "encode": 900.0, "decode": 1400.0, "cameras": 700.0},
    )


def _view(turn, original, size, window):
    angle = 2 * np.pi * turn
    height = 0.3 * np.sin(3 * angle)
    center = torch.tensor([3 * np.cos(angle), height, 3 * np.sin(angle)]).double()
    cam_from_world = look_at(center, torch.zeros(3).double())
    focal = 0.9 * original[1]
    K = torch.tensor([[focal, 0, original[1] / 2], [0, focal, original[0] / 2], [0, 0, 1]]).double()
    pixels = window_centers(*size, window, like=K)
    rays_cam = torch.cat([pixels, torch.ones_like(pixels[:, :1])], 1) @ torch.linalg.inv(K).T
    world_from_cam = invert_rigid(cam_from_world)
    rays = rays_cam @ world_from_cam[:3, :3].T
    depth, on_ball = room_depth(center, rays)
    points = center + rays * depth[:, None]
    stripes = 0.5 + 0.5 * torch.sin(points * torch.tensor([5.0, 7.0, 3.0]).double())
    color = torch.where(on_ball[:, None], stripes * torch.tensor([1, 0.6, 0.3]).double(), stripes)
    conf = 1 + 9 * torch.exp(-depth / 3) * (0.6 + 0.4 * stripes[:, 0])
    return (
        color.T.reshape(3, *size).float(),
        points.reshape(*size, 3).float(),
        conf.reshape(size).float(),
        cam_from_world,
        K,
    )


def unregister(scene, *views):
    """The same scene after PnP failed for some images."""
    cameras = scene.cameras
    registered, cam_from_world = cameras.registered.clone(), cameras.cam_from_world.clone()
    K = cameras.K.clone()
    rules = list(scene.point_rule)
    for view in views:
        registered[view] = False
        cam_from_world[view] = torch.nan
        K[view, 0, 0] = K[view, 1, 1] = torch.nan
        rules[view] = "none"
    cameras = replace(cameras, registered=registered, cam_from_world=cam_from_world, K=K)
    return replace(scene, cameras=cameras, point_rule=rules)


@pytest.fixture(scope="session")
def scene():
    return ring_scene()


@pytest.fixture(scope="session")
def scene_with_a_loss():
    """Image 2 is not registered."""
    return unregister(ring_scene(), 2)
