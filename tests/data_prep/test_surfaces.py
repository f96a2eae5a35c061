import numpy as np
import pytest
import torch

from data_prep.surfaces import GridSurface, MeshSurface, is_scattered, surface_of

SIZE = (48, 64)
K = np.array([[50.0, 0, 30], [0, 50, 25], [0, 0, 1]])


def plane(pts2d):
    """z of the plane 0.1 x + 0.2 y + z = 4 along rays through pixels."""
    rays = np.concatenate([pts2d, np.ones((len(pts2d), 1))], axis=1) @ np.linalg.inv(K).T
    return 4 / (rays @ [0.1, 0.2, 1.0])


def depth_of_plane():
    row, column = np.mgrid[: SIZE[0], : SIZE[1]]
    return plane(np.stack([column, row], axis=-1).reshape(-1, 2) + 0.5).reshape(SIZE)


def keep(depth, share=0.5, seed=0):
    return np.where(np.random.default_rng(seed).random(depth.shape) < share, depth, 0)


def tensor(depth):
    return torch.from_numpy(np.asarray(depth, np.float64))


QUERIES = np.random.default_rng(1).uniform([8, 8], [56, 40], (200, 2))


@pytest.mark.parametrize("depth", [depth_of_plane(), keep(depth_of_plane())])
def test_a_plane_is_interpolated_exactly(depth):
    z, known = surface_of(tensor(depth)).interpolate(torch.from_numpy(QUERIES))
    assert known.double().mean() > 0.95
    np.testing.assert_allclose(z[known], plane(QUERIES)[known.numpy()], rtol=1e-9)


def test_few_known_pixels_are_joined_and_many_are_not():
    assert isinstance(surface_of(tensor(depth_of_plane())), GridSurface)
    assert isinstance(surface_of(tensor(keep(depth_of_plane()))), MeshSurface)
    # Half of an image masked away leaves the other half whole.
    masked = depth_of_plane()
    masked[:, 20:] = 0
    assert not is_scattered(tensor(masked))
    assert not is_scattered(tensor(np.zeros(SIZE)))


def test_nothing_is_known_across_an_edge_in_depth():
    depth = np.where(np.arange(SIZE[1]) < 32, 2.0, 4.0) * np.ones(SIZE)
    pts2d = torch.tensor([[32.0, 20.0], [20.0, 20.0], [45.0, 20.0]])
    for surface in (GridSurface(tensor(depth)), MeshSurface(tensor(keep(depth)))):
        z, known = surface.interpolate(pts2d.double())
        assert known.tolist() == [False, True, True]
        assert z[1:].tolist() == pytest.approx([2, 4])


def test_nothing_is_known_far_from_known_pixels_outside_or_nowhere():
    depth = np.zeros(SIZE)
    depth[10:14:2, 10:14:2] = 2
    depth[10, 40] = depth[40, 10] = 2
    z, known = MeshSurface(tensor(depth)).interpolate(
        torch.tensor([[11.5, 11.5], [20.0, 20.0], [-3.0, 5.0], [torch.nan, 1], [1e30, 1]]).double()
    )
    assert known.tolist() == [True, False, False, False, False]
    assert z[1:].tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("number", [0, 1, 2, 10])
def test_points_that_span_no_triangle_give_nothing(number):
    depth = np.zeros(SIZE)
    depth[20, : 3 * number : 3] = 2
    _, known = MeshSurface(tensor(depth)).interpolate(torch.from_numpy(QUERIES))
    assert not known.any()
