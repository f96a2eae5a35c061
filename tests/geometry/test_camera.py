import torch
from hypothesis import given
from hypothesis import strategies as st

from l3r.geometry.camera import (
    crop_K,
    pixel_centers,
    project,
    resize_K,
    transpose_K,
    unproject,
    window_centers,
)
from l3r.types import Window
from tests.geometry.scenes import generator, random_K
from tests.tolerance import TOLERANCE

CLOSE = TOLERANCE[torch.float64]
SEEDS = st.integers(0, 2**32 - 1)


def depth_map(draw, *shape):
    return 1 + 5 * torch.rand(shape, generator=draw, dtype=torch.float64)


@given(SEEDS)
def test_projection_undoes_unprojection(seed):
    draw = generator(seed)
    K, depth = random_K(2, draw=draw), depth_map(draw, 2, 6, 8)
    pts2d, z = project(unproject(depth, K), K)
    expected = pixel_centers(6, 8, like=depth).expand(2, -1, -1)
    torch.testing.assert_close(pts2d, expected, atol=CLOSE, rtol=0)
    torch.testing.assert_close(z, depth.flatten(1), atol=CLOSE, rtol=0)


@given(SEEDS, st.floats(0.3, 3), st.floats(0.3, 3))
def test_resizing_scales_every_projection(seed, scale_x, scale_y):
    draw = generator(seed)
    K = random_K(draw=draw)
    pts3d = torch.rand(9, 3, generator=draw, dtype=torch.float64) + torch.tensor([0, 0, 1.0])
    before, _ = project(pts3d, K)
    after, _ = project(pts3d, resize_K(K, scale_x, scale_y))
    torch.testing.assert_close(
        after, before * torch.tensor([scale_x, scale_y], dtype=torch.float64)
    )


@given(SEEDS, st.floats(-20, 20), st.floats(-20, 20))
def test_cropping_shifts_every_projection(seed, left, top):
    draw = generator(seed)
    K = random_K(draw=draw)
    pts3d = torch.rand(9, 3, generator=draw, dtype=torch.float64) + torch.tensor([0, 0, 1.0])
    before, _ = project(pts3d, K)
    after, _ = project(pts3d, crop_K(K, left, top))
    torch.testing.assert_close(after, before - torch.tensor([left, top], dtype=torch.float64))


@given(SEEDS, st.floats(0, 20), st.floats(0, 20), st.floats(5, 40), st.floats(5, 40))
def test_pixels_of_a_window_are_where_the_image_shows_the_same_points(seed, left, top, w, h):
    """Points that the cropped and resized camera sees at its pixels, seen by the whole one."""
    draw = generator(seed)
    K = random_K(draw=draw)
    seen = resize_K(crop_K(K, left, top), 8 / w, 6 / h)
    pts2d, _ = project(unproject(depth_map(draw, 6, 8), seen), K)
    window = Window(left=left, top=top, width=w, height=h)
    torch.testing.assert_close(window_centers(6, 8, window, K), pts2d, atol=CLOSE, rtol=CLOSE)


@given(SEEDS)
def test_a_transposed_depth_map_lifts_to_the_same_points(seed):
    draw = generator(seed)
    K, depth = random_K(draw=draw), depth_map(draw, 6, 8)
    upright = unproject(depth, K).reshape(6, 8, 3)
    transposed = unproject(depth.T.contiguous(), transpose_K(K)).reshape(8, 6, 3)
    assert float(transpose_K(K)[0, 0]) == 0
    torch.testing.assert_close(transposed.transpose(0, 1), upright, atol=CLOSE, rtol=0)


@given(SEEDS)
def test_transposing_twice_changes_nothing(seed):
    K = random_K(draw=generator(seed))
    assert torch.equal(transpose_K(transpose_K(K)), K)


def test_the_first_pixel_centre_is_half_a_pixel_in():
    centers = pixel_centers(2, 3, like=torch.zeros(1))
    assert centers.tolist() == [
        [0.5, 0.5],
        [1.5, 0.5],
        [2.5, 0.5],
        [0.5, 1.5],
        [1.5, 1.5],
        [2.5, 1.5],
    ]


def test_a_point_on_the_camera_plane_projects_to_something_finite():
    pts2d, z = project(torch.tensor([[1.0, 2.0, 0.0]]), torch.eye(3))
    assert pts2d.isfinite().all()
    assert z.tolist() == [0.0]
