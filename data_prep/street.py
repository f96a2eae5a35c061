"""A procedural street, and a walk along it: a scene far longer than any image sees."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from data_prep.raycast import render_depth
from data_prep.room import Room, draw_textures, look_along

REACH = 40.0
"""Depth beyond this is unknown, as that of the sky is [m]."""

_WIDTH, _HEIGHT = 16.0, 60.0
_EYE = 1.6
"""Height of the walker's eyes [m]."""
_FRONT = 5.0
"""Mean length of a house front [m]."""
_SWING = 48
"""Mean number of images between two turns of the head to the same side."""
_VIEWS_AT_ONCE = 4
"""Views rendered together: more leaves the processor's cache."""


def build_street(seed: int, *, length: float = 1000.0) -> Room:
    """Draw a street canyon along x: house fronts of all depths on both sides, things between them.

    Its roof is farther than :data:`REACH`, so that nothing is known of what is above.

    Args:
        seed: Seed of everything in it.
        length: Its length [m].
    """
    draw = torch.Generator().manual_seed(seed)
    num_fronts = 2 * round(length / _FRONT)
    num_things = round(length / 4)
    unit = torch.rand(num_fronts + num_things, 6, generator=draw)
    half = torch.empty(len(unit), 3)
    middle = torch.empty(len(unit), 3)
    side = torch.where(torch.arange(len(unit)) % 2 == 0, 1.0, -1.0)
    front, thing = slice(0, num_fronts), slice(num_fronts, None)
    # A front stands out from the wall by up to 2.5 m and ends at any height.
    half[front] = torch.tensor([1.0, 0.1, 1.5]) + unit[front, :3] * torch.tensor([2.5, 1.2, 6.0])
    middle[front, 0] = torch.arange(num_fronts) // 2 * _FRONT + unit[front, 3] * 2 - length / 2
    middle[front, 1] = side[front] * (_WIDTH / 2 - half[front, 1])
    half[thing] = 0.15 + unit[thing, :3] * torch.tensor([1.2, 0.6, 0.9])
    middle[thing, 0] = (unit[thing, 3] - 0.5) * length
    middle[thing, 1] = side[thing] * (4.2 + unit[thing, 4])
    middle[:, 2] = -half[:, 2]
    world_from_box = torch.eye(4).repeat(len(unit) + 1, 1, 1)
    world_from_box[1:, :3, 3] = middle
    world_from_box[0, 2, 3] = -_HEIGHT / 2
    canyon = torch.tensor([[length / 2 + 10, _WIDTH / 2, _HEIGHT / 2]])
    return Room(
        world_from_box=world_from_box,
        half_size=torch.cat([canyon, half]),
        center=torch.empty(0, 3),
        radius=torch.empty(0),
        **draw_textures(6 * (len(unit) + 1), draw),
    )


def draw_stroll(street: Room, num_views: int, seed: int) -> Float[Tensor, "n 4 4"]:
    """Draw a walk up one side of a street and down the other, the head turning to and fro.

    Args:
        street: The street.
        num_views: Views along it, evenly spaced.
        seed: Seed of the walk.

    Returns:
        ``world_from_cam``, OpenCV camera axes, float64.
    """
    draw = torch.Generator().manual_seed(seed)
    time = torch.arange(num_views, dtype=torch.float64) / num_views
    way = 1 - (2 * time - 1).abs() * 2
    jitter = torch.randn(4, num_views, generator=draw, dtype=torch.float64)
    back = time >= 0.5
    length = street.size[0].double() - 30
    position = torch.stack(
        [
            way * length / 2,
            torch.where(back, -2.5, 2.5) + 0.5 * torch.sin(60 * time) + 0.05 * jitter[0],
            -_EYE + 0.03 * jitter[1],
        ],
        dim=-1,
    )
    turns = num_views / _SWING
    swing = torch.sin(2 * math.pi * turns * time + torch.sin(9 * time))
    heading = torch.where(back, math.pi, 0.0) + math.radians(60) * swing + 0.05 * jitter[2]
    forward = torch.stack([heading.cos(), heading.sin(), 0.1 * swing - 0.05], dim=-1)
    return look_along(position, forward, 0.02 * jitter[3])


def street_depth(
    street: Room,
    K: Float[Tensor, "3 3"],
    world_from_cam: Float[Tensor, "n 4 4"],
    image_size: tuple[int, int],
) -> Float[Tensor, "n h w"]:
    """Give z [m] for views of a street, 0 beyond :data:`REACH`.

    Args:
        street: The street.
        K: Intrinsics shared by all views.
        world_from_cam: Cameras with OpenCV axes.
        image_size: (height, width).
    """
    # The corner of an image sees as far as its middle, measured along the axis.
    corner = torch.linalg.inv(K.double()) @ torch.tensor([0, 0, 1.0]).double()
    depth = torch.empty(len(world_from_cam), *image_size)
    for at in range(0, len(world_from_cam), _VIEWS_AT_ONCE):
        cameras = world_from_cam[at : at + _VIEWS_AT_ONCE]
        around = _nearby(street, cameras[:, :3, 3], REACH * float(corner.norm()))
        depth[at : at + len(cameras)] = render_depth(around, K, cameras, image_size)
    return depth.masked_fill_(depth > REACH, 0)


def _nearby(street: Room, position: Float[Tensor, "n 3"], distance: float) -> Room:
    """Keep the boxes that come closer than a distance to some position: the others cost time."""
    gap = (street.world_from_box[:, :3, 3] - position.float()[:, None]).norm(dim=-1).amin(0)
    keep = gap - street.half_size.norm(dim=-1) < distance
    keep[0] = True
    textures = {
        name: getattr(street, name)[keep.repeat_interleave(6)]
        for name in ("base", "frequency", "phase", "amplitude")
    }
    return replace(
        street,
        world_from_box=street.world_from_box[keep],
        half_size=street.half_size[keep],
        **textures,
    )
