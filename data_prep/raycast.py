"""Images and exact depth of a procedural room, for many cameras at once, on any device."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from data_prep.room import NUM_WAVES, Room
from l3r.geometry.camera import pixel_centers

_NEAR = 1e-3
"""Surfaces nearer than this are behind the lens [m]."""


def render(
    room: Room,
    K: Float[Tensor, "3 3"],
    world_from_cam: Float[Tensor, "n 4 4"],
    image_size: tuple[int, int],
) -> tuple[Float[Tensor, "n h w 3"], Float[Tensor, "n h w"]]:
    """Cast one ray per pixel centre for depth and four around it for colour.

    All views and all objects go through the same few tensor operations, so memory grows with
    views x pixels x objects: about 1 kB for each pixel.

    Args:
        room: The room, on the device to render on.
        K: Intrinsics shared by all views, centre of the top-left pixel at (0.5, 0.5).
        world_from_cam: Cameras with OpenCV axes.
        image_size: (height, width).

    Returns:
        ``(image, depth)``: RGB in [0, 1], and z [m], known everywhere since the room is closed.
    """
    height, width = image_size
    device = room.base.device
    world_from_cam = world_from_cam.to(device, torch.float32)
    centers = pixel_centers(height, width, like=room.base)
    rays_from_pixels = torch.linalg.inv(K.to(device, torch.float64)).float()
    depth, _, _ = _cast(room, _rays(centers, rays_from_pixels), world_from_cam)
    offset = pixel_centers(2, 2, like=room.base) / 2 - 0.5
    samples = (centers[:, None] + offset).reshape(-1, 2)
    rays = _rays(samples, rays_from_pixels)
    sample_depth, surface, direction = _cast(room, rays, world_from_cam)
    pts3d_world = world_from_cam[:, None, :3, 3] + direction * sample_depth[..., None]
    color = _shade(room, surface, pts3d_world).reshape(-1, height * width, 4, 3).mean(2)
    return color.reshape(-1, height, width, 3), depth.reshape(-1, height, width)


def _rays(
    pts2d: Float[Tensor, "p 2"], rays_from_pixels: Float[Tensor, "3 3"]
) -> Float[Tensor, "p 3"]:
    """Rays of z = 1, so that the length along one is the depth."""
    return torch.cat([pts2d, torch.ones_like(pts2d[:, :1])], dim=-1) @ rays_from_pixels.T


def _cast(
    room: Room, rays: Float[Tensor, "p 3"], world_from_cam: Float[Tensor, "n 4 4"]
) -> tuple[Float[Tensor, "n p"], Int[Tensor, "n p"], Float[Tensor, "n p 3"]]:
    """Find the depth, the surface and the world direction of each ray's first hit."""
    num_boxes = len(room.half_size)
    box_depth, axis, side = _hit_boxes(room, rays, world_from_cam)
    direction = rays @ world_from_cam[:, :3, :3].transpose(-1, -2)
    ball_depth = _hit_spheres(room, direction, world_from_cam[:, :3, 3])
    depth, hit = torch.cat([box_depth, ball_depth], dim=1).min(dim=1)
    box = hit.clamp_max(num_boxes - 1)[:, None]
    face = axis.gather(1, box)[:, 0] + 3 * side.gather(1, box)[:, 0]
    surface = torch.where(hit < num_boxes, 6 * hit + face, 5 * num_boxes + hit)
    return depth, surface, direction


def _hit_boxes(
    room: Room, rays: Float[Tensor, "p 3"], world_from_cam: Float[Tensor, "n 4 4"]
) -> tuple[Float[Tensor, "n k p"], Int[Tensor, "n k p"], Int[Tensor, "n k p"]]:
    """Give depth, face axis and face side of the first hit; the room's own box is hit from inside."""
    R, t = room.world_from_box[:, :3, :3], room.world_from_box[:, :3, 3]
    box_from_cam_R = torch.einsum("kji,njl->nkil", R, world_from_cam[:, :3, :3])
    origin = torch.einsum("kji,nkj->nki", R, world_from_cam[:, None, :3, 3] - t)
    direction = box_from_cam_R @ rays.T
    inverse = 1 / torch.where(direction.abs() < 1e-9, 1e-9, direction)
    middle = -origin[..., None] * inverse
    reach = room.half_size[..., None] * inverse.abs()
    near, near_axis = (middle - reach).max(dim=2)
    far, far_axis = (middle + reach).min(dim=2)
    depth = torch.where((near < far) & (near > _NEAR), near, torch.inf)
    depth[:, 0], near_axis[:, 0] = far[:, 0], far_axis[:, 0]
    entering = (direction.gather(2, near_axis[:, :, None])[:, :, 0] < 0).long()
    entering[:, 0] = 1 - entering[:, 0]
    return depth, near_axis, entering


def _hit_spheres(
    room: Room, direction: Float[Tensor, "n p 3"], position: Float[Tensor, "n 3"]
) -> Float[Tensor, "n s p"]:
    """Give the depth of the first hit of each sphere, infinite where there is none."""
    to_camera = position[:, None] - room.center
    a = (direction * direction).sum(-1)[:, None]
    b = to_camera @ direction.transpose(-1, -2)
    c = (to_camera * to_camera).sum(-1) - room.radius**2
    root = b * b - a * c[..., None]
    depth = (-b - root.clamp_min(0).sqrt()) / a
    return torch.where((root > 0) & (depth > _NEAR), depth, torch.inf)


def _shade(
    room: Room, surface: Int[Tensor, "n p"], pts3d_world: Float[Tensor, "n p 3"]
) -> Float[Tensor, "n p 3"]:
    """Evaluate each surface's own waves at world points."""
    frequency = room.frequency.flatten(1)[surface].unflatten(-1, (NUM_WAVES, 3))
    angle = (frequency * pts3d_world[..., None, :]).sum(-1) + room.phase[surface]
    amplitude = room.amplitude.flatten(1)[surface].unflatten(-1, (NUM_WAVES, 3))
    color = room.base[surface] + (angle.sin()[..., None] * amplitude).sum(-2)
    return color.clamp(0, 1)
