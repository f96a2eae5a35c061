"""A procedural room, and cameras inside it."""

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

NUM_WAVES = 3
"""Sinusoids of each surface's texture."""

_CLEARANCE = 0.35
"""Least distance of a camera from any surface [m]."""
_NUM_CURVES = 1024
"""Curves tried for a walk."""
_BEND = 0.98
"""Least cosine between headings 1/256 of a walk apart: no cusps."""
_HARMONICS = torch.arange(1, 4).float()
"""Frequencies a walk is made of."""


@dataclass(frozen=True, kw_only=True)
class Room:
    """A closed box seen from inside, with boxes and spheres in it; world z points DOWN, floor 0.

    Box 0 is the room itself. Surfaces are numbered: six per box (axis + 3 * (positive side)),
    then one per sphere. Lengths in metres.
    """

    world_from_box: Float[Tensor, "k 4 4"]
    """Centres and headings of the boxes."""
    half_size: Float[Tensor, "k 3"]
    """Half the sides of the boxes."""
    center: Float[Tensor, "s 3"]
    """Centres of the spheres in the world."""
    radius: Float[Tensor, " s"]
    """Radii of the spheres."""
    base: Float[Tensor, "f 3"]
    """Mean colour of each surface."""
    frequency: Float[Tensor, "f w 3"]
    """Wave vectors of each surface's texture, in the world [rad/m]."""
    phase: Float[Tensor, "f w"]
    """Phases of the waves."""
    amplitude: Float[Tensor, "f w 3"]
    """Strength of each wave in each colour."""

    def to(self, device: torch.device | str) -> "Room":
        """Copy the room to a device."""
        moved = {f.name: getattr(self, f.name).to(device) for f in fields(self)}
        return Room(**moved)

    @property
    def size(self) -> Float[Tensor, "3"]:
        """Length, width and height."""
        return 2 * self.half_size[0]


def build_room(seed: int, *, num_boxes: int = 7, num_spheres: int = 4) -> Room:
    """Draw a room; the same seed gives the same room.

    Args:
        seed: Seed of everything in it.
        num_boxes: Boxes standing in it.
        num_spheres: Spheres in it.
    """
    draw = torch.Generator().manual_seed(seed)
    half = torch.tensor([3.0, 2.5, 1.4]) + torch.rand(3, generator=draw) * torch.tensor(
        [1.0, 1.0, 0.3]
    )
    world_from_box = torch.eye(4).repeat(num_boxes + 1, 1, 1)
    half_size = torch.tensor([0.2, 0.2, 0.2]) + torch.rand(
        num_boxes + 1, 3, generator=draw
    ) * torch.tensor([0.45, 0.45, 0.65])
    half_size[0] = half
    angle = torch.rand(num_boxes, generator=draw) * math.pi
    world_from_box[1:, :3, :3] = _turn_down(angle)
    spread = torch.rand(num_boxes, 2, generator=draw) * 2 - 1
    world_from_box[1:, :2, 3] = spread * (half[:2] - 0.4)
    world_from_box[:, 2, 3] = -half_size[:, 2]
    radius = 0.25 + 0.35 * torch.rand(num_spheres, generator=draw)
    center = (torch.rand(num_spheres, 3, generator=draw) * 2 - 1) * (half - 0.7)
    center[:, 2] -= half[2]
    return Room(
        world_from_box=world_from_box,
        half_size=half_size,
        center=center,
        radius=radius,
        **_draw_textures(6 * (num_boxes + 1) + num_spheres, draw),
    )


def _draw_textures(num_surfaces: int, draw: torch.Generator) -> dict[str, Tensor]:
    """Colours far apart, waves of 0.8 to 3 m: not aliased at 48 pixels and 90 degrees."""
    shape = (num_surfaces, NUM_WAVES)
    direction = torch.randn(*shape, 3, generator=draw)
    wavelength = 0.8 * (3.0 / 0.8) ** torch.rand(*shape, 1, generator=draw)
    amplitude = torch.randn(*shape, 3, generator=draw)
    amplitude *= 0.3 / amplitude.norm(dim=-1).sum(-1)[:, None, None]
    return {
        "base": 0.15 + 0.7 * torch.rand(num_surfaces, 3, generator=draw),
        "frequency": direction / direction.norm(dim=-1, keepdim=True) * 2 * math.pi / wavelength,
        "phase": torch.rand(*shape, generator=draw) * 2 * math.pi,
        "amplitude": amplitude,
    }


def draw_cameras(room: Room, num_views: int, seed: int) -> Float[Tensor, "n 4 4"]:
    """Draw cameras one by one: anywhere clear of the objects, towards anywhere, a little rolled.

    Args:
        room: The room, on the host.
        num_views: How many cameras.
        seed: Seed of the trajectory; another seed gives other cameras in the same room.

    Returns:
        ``world_from_cam``, OpenCV camera axes, float64.
    """
    draw = torch.Generator().manual_seed(seed)
    position = torch.empty(0, 3)
    while len(position) < num_views:
        candidate = _inside(room, torch.rand(4 * num_views, 3, generator=draw))
        position = torch.cat([position, candidate[clearance(room, candidate) > _CLEARANCE]])
    position = position[:num_views]
    target = _inside(room, torch.rand(num_views, 3, generator=draw))
    # A target right above or below would leave the heading to chance.
    target[:, 2] = position[:, 2] + 0.5 * (target[:, 2] - position[:, 2])
    roll = 0.15 * torch.randn(num_views, generator=draw)
    return _look(position.double(), (target - position).double(), roll.double())


def draw_walk(room: Room, num_views: int, seed: int) -> Float[Tensor, "n 4 4"]:
    """Draw a smooth walk around the room, looking ahead and swaying from side to side.

    Args:
        room: The room, on the host.
        num_views: Views along it, evenly spaced in time.
        seed: Seed of the walk.

    Returns:
        ``world_from_cam``, OpenCV camera axes, float64.
    """
    draw = torch.Generator().manual_seed(seed)
    weight = torch.randn(_NUM_CURVES, 2, 3, 3, generator=draw) / _HARMONICS[:, None] ** 2
    fine = _curve(room, weight, 256)
    gap = clearance(room, fine.reshape(-1, 3)).reshape(_NUM_CURVES, -1).amin(1)
    ahead = torch.nn.functional.normalize((fine.roll(-1, 1) - fine)[..., :2], dim=-1)
    bend = (ahead * ahead.roll(-1, 1)).sum(-1).amin(1)
    good = ((gap > _CLEARANCE) & (bend > _BEND)).int()
    chosen = int(good.argmax() if good.any() else (gap + bend).argmax())
    position = _curve(room, weight[chosen : chosen + 1], num_views)[0]
    time = _loop(num_views)
    along = _curve(room, weight[chosen : chosen + 1], 16 * num_views)[0]
    step = (along.roll(-1, 0) - along.roll(1, 0))[::16]
    heading = torch.atan2(step[:, 1], step[:, 0]) + 0.6 * torch.sin(3 * time)
    forward = torch.stack([heading.cos(), heading.sin(), 0.15 + 0.1 * torch.sin(2 * time)], dim=-1)
    roll = 0.05 * torch.sin(5 * time)
    return _look(position.double(), forward.double(), roll.double())


def _loop(num_views: int) -> Float[Tensor, " n"]:
    """Evenly spaced angles around the circle."""
    return torch.arange(num_views) * (2 * math.pi / max(num_views, 1))


def _curve(room: Room, weight: Float[Tensor, "c 2 3 3"], num_views: int) -> Float[Tensor, "c n 3"]:
    """Evaluate closed curves of three harmonics within the room."""
    angle = _loop(num_views)[:, None] * _HARMONICS
    wave = torch.stack([angle.cos(), angle.sin()])
    return _inside(room, 0.5 + 0.2 * torch.einsum("pth,cphx->ctx", wave, weight))


def clearance(room: Room, pts3d_world: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
    """Distance of points from the nearest surface [m]; negative within objects and walls."""
    R, t = room.world_from_box[:, :3, :3], room.world_from_box[:, :3, 3]
    local = torch.einsum("kji,pkj->pki", R, pts3d_world[:, None] - t)
    beyond = local.abs() - room.half_size
    outside = beyond.clamp_min(0).norm(dim=-1) + beyond.amax(-1).clamp_max(0)
    outside[:, 0] *= -1
    ball = (pts3d_world[:, None] - room.center).norm(dim=-1) - room.radius
    return torch.cat([outside, ball], dim=-1).amin(-1)


def _inside(room: Room, unit: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
    """Map the unit cube onto the room, held clear of its walls, between knee and ceiling."""
    half = room.half_size[0]
    low = torch.tensor([-half[0], -half[1], -2 * half[2]]) + _CLEARANCE
    high = torch.tensor([half[0], half[1], -0.15]) - _CLEARANCE
    return low + unit.clamp(0.01, 0.99) * (high - low)


def _turn_down(angle: Float[Tensor, " k"]) -> Float[Tensor, "k 3 3"]:
    """Rotations about the vertical."""
    R = torch.eye(3).repeat(len(angle), 1, 1)
    R[:, 0, 0], R[:, 0, 1] = angle.cos(), -angle.sin()
    R[:, 1, 0], R[:, 1, 1] = angle.sin(), angle.cos()
    return R


def _look(
    position: Float[Tensor, "n 3"], forward: Float[Tensor, "n 3"], roll: Float[Tensor, " n"]
) -> Float[Tensor, "n 4 4"]:
    """Cameras at positions, z along ``forward``, y down before the roll [rad]."""
    z = torch.nn.functional.normalize(forward, dim=-1)
    down = torch.tensor([0.0, 0.0, 1.0], dtype=z.dtype).expand_as(z)
    x = torch.nn.functional.normalize(torch.linalg.cross(down, z), dim=-1)
    y = torch.linalg.cross(z, x)
    cos, sin = roll.cos()[:, None], roll.sin()[:, None]
    world_from_cam = torch.eye(4, dtype=z.dtype).repeat(len(z), 1, 1)
    world_from_cam[:, :3, 0] = cos * x + sin * y
    world_from_cam[:, :3, 1] = cos * y - sin * x
    world_from_cam[:, :3, 2] = z
    world_from_cam[:, :3, 3] = position
    return world_from_cam
