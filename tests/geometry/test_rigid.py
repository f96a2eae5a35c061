import math

import pytest
import roma
import torch
from hypothesis import given
from hypothesis import strategies as st

from l3r.geometry.rigid import invert_rigid, rigid_from_parts, rotation_angle, transform_points
from tests.geometry.scenes import generator, random_rigid
from tests.tolerance import TOLERANCE

CLOSE = TOLERANCE[torch.float64]
SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS, st.sampled_from([(), (1,), (2, 3)]))
def test_inverse_times_itself_is_the_identity(seed, batch):
    b_from_a = random_rigid(*batch, draw=generator(seed))
    eye = torch.eye(4, dtype=torch.float64).expand(*batch, 4, 4)
    torch.testing.assert_close(invert_rigid(b_from_a) @ b_from_a, eye, atol=CLOSE, rtol=0)


@given(SEEDS)
def test_chained_transforms_move_points_one_after_the_other(seed):
    draw = generator(seed)
    c_from_b, b_from_a = random_rigid(2, draw=draw), random_rigid(2, draw=draw)
    pts3d_a = torch.randn(2, 7, 3, generator=draw, dtype=torch.float64)
    once = transform_points(c_from_b @ b_from_a, pts3d_a)
    twice = transform_points(c_from_b, transform_points(b_from_a, pts3d_a))
    torch.testing.assert_close(once, twice, atol=CLOSE, rtol=0)


@given(SEEDS, st.sampled_from([0.0, 1e-9, 1e-6, 1e-3, 0.5, 3.0, math.pi - 1e-9, math.pi]))
def test_rotation_angle_is_exact_near_zero_and_near_pi(seed, angle):
    axis = torch.randn(3, generator=generator(seed), dtype=torch.float64)
    R = roma.rotvec_to_rotmat(angle * axis / axis.norm())
    assert float(rotation_angle(R)) == pytest.approx(angle, abs=1e-12)


def test_rotation_angle_of_nan_is_nan():
    assert rotation_angle(torch.full((2, 3, 3), math.nan)).isnan().all()


def test_parts_stand_where_they_belong():
    R = 2 * torch.eye(3)
    matrix = rigid_from_parts(R, torch.tensor([1.0, 2.0, 3.0]))
    expected = [[2.0, 0, 0, 1], [0, 2, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]]
    assert matrix.tolist() == expected
