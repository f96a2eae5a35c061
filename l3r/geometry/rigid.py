"""Rigid transforms as 4x4 matrices ``b_from_a``: inner names cancel when they are chained."""

import torch
from jaxtyping import Float
from torch import Tensor


def rigid_from_parts(
    R: Float[Tensor, "*b 3 3"], t: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 4 4"]:
    """Join a rotation and a translation into homogeneous matrices."""
    top = torch.cat([R, t[..., None]], dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([top, bottom], dim=-2)


def invert_rigid(b_from_a: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Invert in closed form: the rotation transposes."""
    a_from_b_R = b_from_a[..., :3, :3].transpose(-1, -2)
    t = b_from_a[..., :3, 3:]
    return rigid_from_parts(a_from_b_R, (-a_from_b_R @ t)[..., 0])


def transform_points(
    b_from_a: Float[Tensor, "*#b 4 4"], pts3d: Float[Tensor, "*#b p 3"]
) -> Float[Tensor, "*b p 3"]:
    """Move points from frame a to frame b; leading dimensions broadcast."""
    R, t = b_from_a[..., :3, :3], b_from_a[..., :3, 3]
    return pts3d @ R.transpose(-1, -2) + t[..., None, :]


def rotation_angle(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Angle of rotations [rad], in [0, pi].

    From sine and cosine together: the arc cosine of the trace alone loses half the digits near 0
    and near pi. NaN matrices give NaN.
    """
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1)
    axis = torch.stack(
        [
            R[..., 2, 1] - R[..., 1, 2],
            R[..., 0, 2] - R[..., 2, 0],
            R[..., 1, 0] - R[..., 0, 1],
        ],
        dim=-1,
    )
    return torch.atan2(torch.linalg.vector_norm(axis, dim=-1), trace - 1)
