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
_MIDDLE = 0.3
"""Share of the room that cameras look at, and stand around."""
_NUM_RINGS = 256
"""Rings tried for a walk."""
_RING_FINE = 256
"""Points at which a ring's clearance is measured."""
_HARMONICS = torch.arange(2, 5).float()
"""Frequencies of what bends a ring."""


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


def build_room(seed: int, *, num_boxes: int = 4, num_spheres: int = 2) -> Room:
    """Draw a room; the same seed gives the same room.

    Args:
        seed: Seed of everything in it.
        num_boxes: Boxes standing in it.
        num_spheres: Spheres in it.
    """
    draw = torch.Generator().manual_seed(seed)
    half = torch.tensor([1.9, 1.6, 1.2]) + torch.rand(3, generator=draw) * torch.tensor(
        [0.4, 0.4, 0.2]
    )
    world_from_box = torch.eye(4).repeat(num_boxes + 1, 1, 1)
    half_size = torch.tensor([0.2, 0.2, 0.2]) + torch.rand(
        num_boxes + 1, 3, generator=draw
    ) * torch.tensor([0.25, 0.25, 0.45])
    half_size[0] = half
    angle = torch.rand(num_boxes, generator=draw) * math.pi
    world_from_box[1:, :3, :3] = _turn_down(angle)
    spread = torch.rand(num_boxes, 2, generator=draw) * 2 - 1
    world_from_box[1:, :2, 3] = spread * (half[:2] - 0.4)
    world_from_box[:, 2, 3] = -half_size[:, 2]
    radius = 0.25 + 0.15 * torch.rand(num_spheres, generator=draw)
    center = (torch.rand(num_spheres, 3, generator=draw) * 2 - 1) * (half - 0.7)
    center[:, 2] -= half[2]
    return Room(
        world_from_box=world_from_box,
        half_size=half_size,
        center=center,
        radius=radius,
        **draw_textures(6 * (num_boxes + 1) + num_spheres, draw),
    )


def draw_textures(num_surfaces: int, draw: torch.Generator) -> dict[str, Tensor]:
    """Draw colours far apart, and waves of 0.8 to 3 m: not aliased at 48 pixels and 90 degrees.

    Args:
        num_surfaces: How many surfaces.
        draw: Where randomness comes from.

    Returns:
        ``base``, ``frequency``, ``phase`` and ``amplitude`` of a :class:`Room`.
    """
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
    """Draw cameras one by one, as a capture of a room has them: from around its middle, inwards.

    Each stands anywhere outside the middle and clear of the objects, looks at a random point of
    the middle, and is a little rolled.

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
        unit = torch.rand(8 * num_views, 3, generator=draw)
        around = unit[(unit[:, :2] - 0.5).norm(dim=-1) > _MIDDLE]
        candidate = _inside(room, around)
        position = torch.cat([position, candidate[clearance(room, candidate) > _CLEARANCE]])
    position = position[:num_views]
    spread = _MIDDLE * (torch.rand(num_views, 3, generator=draw) - 0.5)
    target = _inside(room, 0.5 + spread)
    # A target right above or below would leave the heading to chance.
    target[:, 2] = position[:, 2] + 0.5 * (target[:, 2] - position[:, 2])
    roll = 0.15 * torch.randn(num_views, generator=draw)
    return look_along(position.double(), (target - position).double(), roll.double())


def draw_walk(room: Room, num_views: int, seed: int) -> Float[Tensor, "n 4 4"]:
    """Draw a smooth walk once around the room, looking across it and swaying from side to side.

    Args:
        room: The room, on the host.
        num_views: Views along it, evenly spaced in time.
        seed: Seed of the walk.

    Returns:
        ``world_from_cam``, OpenCV camera axes, float64.
    """
    draw = torch.Generator().manual_seed(seed)
    radius = 0.25 + 0.15 * torch.rand(_NUM_RINGS, generator=draw)
    bends = 0.03 * torch.randn(_NUM_RINGS, 2, 3, 3, generator=draw)
    fine = _ring(room, radius, bends, _RING_FINE)
    gap = clearance(room, fine.reshape(-1, 3)).reshape(_NUM_RINGS, -1).amin(1)
    clear = (gap > _CLEARANCE).int()
    chosen = int(clear.argmax() if clear.any() else gap.argmax())
    position = _ring(room, radius[chosen, None], bends[chosen, None], num_views)[0]
    angle = _loop(num_views)
    sway = 0.5 + 0.2 * _MIDDLE * torch.stack(
        [torch.sin(3 * angle), torch.cos(2 * angle), torch.sin(2 * angle)], dim=-1
    )
    forward = _inside(room, sway) - position
    forward[:, 2] *= 0.5
    roll = 0.05 * torch.sin(5 * angle)
    return look_along(position.double(), forward.double(), roll.double())


def _loop(num_views: int) -> Float[Tensor, " n"]:
    """Evenly spaced angles around the circle."""
    return torch.arange(num_views) * (2 * math.pi / max(num_views, 1))


def _ring(
    room: Room, radius: Float[Tensor, " c"], bends: Float[Tensor, "c 2 3 3"], num_views: int
) -> Float[Tensor, "c n 3"]:
    """Evaluate bent rings around the room's middle; ``radius`` is a share of the room."""
    angle = _loop(num_views)
    ring = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)
    wave = torch.stack([(angle[:, None] * _HARMONICS).cos(), (angle[:, None] * _HARMONICS).sin()])
    bent = torch.einsum("pth,cphx->ctx", wave, bends)
    return _inside(room, 0.5 + radius[:, None, None] * ring + bent)


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


def look_along(
    position: Float[Tensor, "n 3"], forward: Float[Tensor, "n 3"], roll: Float[Tensor, " n"]
) -> Float[Tensor, "n 4 4"]:
    """Place cameras, z along ``forward``, y down before the roll.

    Args:
        position: Camera centres.
        forward: Directions, of any length.
        roll: Turns about the optical axis [rad].

    Returns:
        ``world_from_cam``.
    """
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
