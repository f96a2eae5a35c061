"""Images and exact depth of a procedural room, for many cameras at once, on any device."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from data_prep.room import Room
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
    depth = render_depth(room, K, world_from_cam, image_size)
    world_from_cam = world_from_cam.to(device, torch.float32)
    centers = pixel_centers(height, width, like=room.base)
    rays_from_pixels = torch.linalg.inv(K.to(device, torch.float64)).float()
    offset = pixel_centers(2, 2, like=room.base) / 2 - 0.5
    samples = (centers[:, None] + offset).reshape(-1, 2)
    rays = _rays(samples, rays_from_pixels)
    sample_depth, hit, direction = _cast(room, rays, world_from_cam)
    pts3d_world = world_from_cam[:, None, :3, 3] + direction * sample_depth[..., None]
    color = (
        _shade(room, _find_surface(room, hit, pts3d_world), pts3d_world)
        .reshape(-1, height * width, 4, 3)
        .mean(2)
    )
    return color.reshape(-1, height, width, 3), depth


def render_depth(
    room: Room,
    K: Float[Tensor, "3 3"],
    world_from_cam: Float[Tensor, "n 4 4"],
    image_size: tuple[int, int],
) -> Float[Tensor, "n h w"]:
    """Cast one ray per pixel centre: the depth that :func:`render` gives, at a fifth of the cost.

    Args:
        room: The room, on the device to render on.
        K: Intrinsics shared by all views, centre of the top-left pixel at (0.5, 0.5).
        world_from_cam: Cameras with OpenCV axes.
        image_size: (height, width).

    Returns:
        z [m].
    """
    centers = pixel_centers(*image_size, like=room.base)
    rays = _rays(centers, torch.linalg.inv(K.to(room.base.device, torch.float64)).float())
    depth, _, _ = _cast(room, rays, world_from_cam.to(room.base.device, torch.float32))
    return depth.reshape(-1, *image_size)


def _rays(
    pts2d: Float[Tensor, "p 2"], rays_from_pixels: Float[Tensor, "3 3"]
) -> Float[Tensor, "p 3"]:
    """Rays of z = 1, so that the length along one is the depth."""
    return torch.cat([pts2d, torch.ones_like(pts2d[:, :1])], dim=-1) @ rays_from_pixels.T


def _cast(
    room: Room, rays: Float[Tensor, "p 3"], world_from_cam: Float[Tensor, "n 4 4"]
) -> tuple[Float[Tensor, "n p"], Int[Tensor, "n p"], Float[Tensor, "n p 3"]]:
    """Find the depth and the object (boxes first) of each first hit, and the world direction."""
    direction = rays @ world_from_cam[:, :3, :3].transpose(-1, -2)
    depths = torch.cat(
        [
            _hit_boxes(room, rays, world_from_cam),
            _hit_spheres(room, direction, world_from_cam[:, :3, 3]),
        ]
    )
    depth = depths.amin(0)
    # A minimum with its index is ten times slower on a CPU than two plain reductions.
    number = torch.arange(len(depths), dtype=depth.dtype, device=depth.device)
    hit = ((depths == depth) * number[:, None, None]).amax(0)
    return depth, hit.long(), direction


def _hit_boxes(
    room: Room, rays: Float[Tensor, "p 3"], world_from_cam: Float[Tensor, "n 4 4"]
) -> Float[Tensor, "k n p"]:
    """Give the depth of the first hit of each box; the room's own box is hit from inside."""
    R, t = room.world_from_box[:, :3, :3], room.world_from_box[:, :3, 3]
    box_from_cam_R = torch.einsum("kji,njl->iknl", R, world_from_cam[:, :3, :3])
    origin = torch.einsum("kji,nkj->ikn", R, world_from_cam[:, None, :3, 3] - t)
    # In place, since these arrays are the largest; the tiny shift keeps 0 / 0 out.
    inverse = (box_from_cam_R @ rays.T).add_(1e-12).reciprocal_()
    reach = inverse.abs().mul_(room.half_size.T[..., None, None])
    middle = inverse.mul_(-origin[..., None])
    near = (middle - reach).amax(0)
    far = middle.add_(reach).amin(0)
    depth = torch.where((near < far) & (near > _NEAR), near, torch.inf)
    depth[0] = far[0]
    return depth


def _hit_spheres(
    room: Room, direction: Float[Tensor, "n p 3"], position: Float[Tensor, "n 3"]
) -> Float[Tensor, "s n p"]:
    """Give the depth of the first hit of each sphere, infinite where there is none."""
    to_camera = position - room.center[:, None]
    a = (direction * direction).sum(-1)
    b = torch.einsum("sni,npi->snp", to_camera, direction)
    c = (to_camera * to_camera).sum(-1) - room.radius[:, None] ** 2
    root = b * b - a * c[..., None]
    depth = (-b - root.clamp_min(0).sqrt()) / a
    return torch.where((root > 0) & (depth > _NEAR), depth, torch.inf)


def _find_surface(
    room: Room, hit: Int[Tensor, "n p"], pts3d_world: Float[Tensor, "n p 3"]
) -> Int[Tensor, "n p"]:
    """Number the surface of the object ``hit`` on which the points lie."""
    num_boxes = len(room.half_size)
    box = hit.clamp_max(num_boxes - 1)
    R, t = room.world_from_box[:, :3, :3], room.world_from_box[:, :3, 3]
    unit_from_world = (R / room.half_size[:, None]).transpose(-1, -2)
    offset = -(unit_from_world @ t[..., None])[..., 0]
    rows = unit_from_world[box]
    x, y, z = ((rows * pts3d_world[..., None, :]).sum(-1) + offset[box]).unbind(-1)
    ax, ay, az = x.abs(), y.abs(), z.abs()
    is_x, is_y = (ax >= ay) & (ax >= az), ay >= az
    axis = torch.where(is_x, 0, torch.where(is_y, 1, 2))
    positive = torch.where(is_x, x, torch.where(is_y, y, z)) > 0
    return torch.where(hit < num_boxes, 6 * hit + axis + 3 * positive, 5 * num_boxes + hit)


def _shade(
    room: Room, surface: Int[Tensor, "n p"], pts3d_world: Float[Tensor, "n p 3"]
) -> Float[Tensor, "n p 3"]:
    """Evaluate each surface's own waves at world points."""
    waves = torch.cat([room.frequency, room.phase[..., None], room.amplitude], dim=-1)[surface]
    angle = (waves[..., :3] @ pts3d_world[..., None])[..., 0] + waves[..., 3]
    color = room.base[surface] + (angle.sin()[..., None, :] @ waves[..., 4:])[..., 0, :]
    return color.clamp(0, 1)
