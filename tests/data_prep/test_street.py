import torch

from data_prep.converters.synthetic import intrinsics
from data_prep.raycast import render, render_depth
from data_prep.room import clearance
from data_prep.street import REACH, build_street, draw_stroll, street_depth

SIZE = (24, 32)
K = torch.from_numpy(intrinsics(SIZE))


def test_what_is_left_out_for_speed_is_not_in_sight():
    street = build_street(2, length=200.0)
    cameras = draw_stroll(street, 24, seed=3)
    whole = render_depth(street, K, cameras, SIZE)
    found = street_depth(street, K, cameras, SIZE)
    torch.testing.assert_close(found, torch.where(whole <= REACH, whole, 0))
    assert (found == 0).any()
    assert (found > 0).float().mean() > 0.8


def test_depth_alone_is_that_of_the_rendered_image():
    street = build_street(2, length=50.0)
    cameras = draw_stroll(street, 3, seed=3)
    _, depth = render(street, K, cameras, SIZE)
    torch.testing.assert_close(depth, render_depth(street, K, cameras, SIZE), rtol=0, atol=0)


def test_the_walker_goes_up_and_down_the_street_and_through_nothing():
    street = build_street(0)
    cameras = draw_stroll(street, 400, seed=0)
    position = cameras[:, :3, 3].float()
    assert (clearance(street, position) > 0.2).all()
    assert position[0, 0] < -400
    assert position[200, 0] > 400
    assert position[-1, 0] < -400
    R = cameras[:, :3, :3]
    torch.testing.assert_close(R @ R.transpose(-1, -2), torch.eye(3).double().expand_as(R))


def test_the_same_seeds_give_the_same_walk():
    first, again, other = (draw_stroll(build_street(1), 8, seed=seed) for seed in (4, 4, 5))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
