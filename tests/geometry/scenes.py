"""Random transforms, points and cameras for the laws of geometry."""

import roma
import torch

from l3r.geometry.rigid import rigid_from_parts


def generator(seed):
    return torch.Generator().manual_seed(seed)


def random_rotation(*batch, draw, dtype=torch.float64):
    quaternion = torch.randn((*batch, 4), generator=draw, dtype=dtype)
    return roma.unitquat_to_rotmat(torch.nn.functional.normalize(quaternion, dim=-1))


def random_rigid(*batch, draw, dtype=torch.float64):
    t = 3 * torch.randn((*batch, 3), generator=draw, dtype=dtype)
    return rigid_from_parts(random_rotation(*batch, draw=draw, dtype=dtype), t)


def random_K(*batch, draw, width=64, height=48):
    K = torch.zeros(*batch, 3, 3, dtype=torch.float64)
    K[..., 0, 0] = width * (0.5 + torch.rand(batch, generator=draw, dtype=torch.float64))
    K[..., 1, 1] = K[..., 0, 0] * 1.1
    K[..., 0, 2] = width * (0.4 + 0.2 * torch.rand(batch, generator=draw, dtype=torch.float64))
    K[..., 1, 2] = height * (0.4 + 0.2 * torch.rand(batch, generator=draw, dtype=torch.float64))
    K[..., 2, 2] = 1
    return K
