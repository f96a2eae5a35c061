import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from l3r.data.stages import KeyedGraph, lay_out, resize_crop
from l3r.errors import DataError
from l3r.geometry.camera import unproject
from tests.data.graphs import make_graph, make_mixed_graph


def keyed(graph, key="shard:key"):
    return KeyedGraph(key=key, graph=graph)


def plane_graph(height, width, center):
    """A camera before the plane z = 2 + 0.1 x, so that depth follows from the ray."""
    graph = make_graph(num_views=1, height=height, width=width)
    focal = 0.9 * width
    K = np.array([[[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]]])
    x = (np.arange(width) + 0.5 - center[0]) / focal
    depth = np.broadcast_to(2 / (1 - 0.1 * x), (height, width)).astype(np.float32)
    return dataclasses.replace(graph, K=K, depth=[depth.copy()])


@given(
    st.integers(40, 90),
    st.integers(40, 90),
    st.floats(0.35, 0.65),
    st.floats(0.35, 0.65),
    st.sampled_from([(32, 32), (16, 32), (48, 64)]),
)
def test_points_stay_where_they_are(height, width, share_x, share_y, size):
    """After any crop, scale and transposition, K and depth still lift pixels onto one plane."""
    graph = plane_graph(height, width, (share_x * width, share_y * height))
    (sample,) = resize_crop([keyed(graph)], image_size=size)
    views = lay_out([sample]).unpack()
    assert views.image.shape == (1, 1, 3, *size)
    points = unproject(views.depth[0, 0].double(), views.K[0, 0].double())
    error = (points[:, 2] - (2 + 0.1 * points[:, 0])).abs()
    # A nearest sample lies up to half a source pixel off; the plane rises 0.1 per metre.
    columns = int(views.true_shape[0, 0, 1])
    assert float(error.max()) < 0.1 * 4 * 0.6 / (0.9 * width) * max(1, width / columns)


@given(
    st.integers(40, 90),
    st.integers(40, 90),
    st.floats(0.35, 0.65),
    st.floats(0.35, 0.65),
    st.sampled_from([(32, 32), (16, 32), (48, 64)]),
)
def test_the_layout_moves_pixels_and_leaves_points(height, width, share_x, share_y, size):
    """Points of what is laid out are those of the upright image; portrait ones swap pixel axes."""
    graph = plane_graph(height, width, (share_x * width, share_y * height))
    (sample,) = resize_crop([keyed(graph)], image_size=size)
    views = lay_out([sample]).unpack()
    upright = sample.graph.depth[0].shape
    assert upright == (size[::-1] if height > width else size)
    assert views.true_shape.tolist() == [[list(upright)]]
    points, pixels, z = (
        unproject(views.depth, views.K)[0, 0].reshape(*size, 3),
        views.image[0, 0].permute(1, 2, 0),
        views.depth[0, 0],
    )
    if upright != size:
        points, pixels, z = (laid_out.transpose(0, 1) for laid_out in (points, pixels, z))
    depth = torch.from_numpy(sample.graph.depth[0])
    expected = unproject(depth.double(), torch.from_numpy(sample.graph.K[0])).reshape(*upright, 3)
    torch.testing.assert_close(points.double(), expected, rtol=1e-5, atol=1e-5)
    assert torch.equal(z, depth)
    assert torch.equal(pixels, torch.from_numpy(sample.graph.image[0]).float() / 255)


@given(st.integers(40, 90), st.integers(40, 90), st.floats(0.3, 0.7), st.floats(0.3, 0.7))
def test_the_principal_point_ends_up_in_the_middle(height, width, share_x, share_y):
    graph = plane_graph(height, width, (share_x * width, share_y * height))
    (sample,) = resize_crop([keyed(graph)], image_size=(32, 32))
    # Whole source pixels are cut off: the rest is at most half of one, or one where sizes round.
    scale = 32 / (min(share_x, 1 - share_x) * width * 2)
    assert sample.graph.K[0, 0, 2] == pytest.approx(16, abs=1.5 * max(1, scale))
    assert sample.graph.K[0, 1, 2] == pytest.approx(16, abs=1.5 * max(1, scale) + 0.5)


def test_a_size_that_fits_changes_nothing():
    graph = make_graph(num_views=3)
    (sample,) = resize_crop([keyed(graph)], image_size=(48, 64))
    assert all(np.array_equal(a, b) for a, b in zip(sample.graph.image, graph.image, strict=True))
    assert np.array_equal(sample.graph.K, graph.K)


def test_stages_do_not_edit_their_input():
    graph = make_graph(num_views=2)
    before = [image.copy() for image in graph.image], graph.K.copy()
    lay_out(list(resize_crop([keyed(graph)], image_size=(16, 24))))
    assert all(np.array_equal(a, b) for a, b in zip(graph.image, before[0], strict=True))
    assert np.array_equal(graph.K, before[1])


def test_views_carry_everything_in_the_documented_form():
    graph = make_graph(number=3, num_views=4)
    graph.depth[1][:5] = 0
    views = lay_out([keyed(graph)]).unpack()
    assert 0 <= float(views.image.min()) <= float(views.image.max()) <= 1
    assert views.true_shape.tolist() == [[[48, 64]] * 4]
    assert views.valid[0, 1, :5].any() == False  # noqa: E712
    assert views.valid[0, 1, 5:].all()
    eye = torch.eye(4).expand(4, 4, 4)
    product = views.world_from_cam[0] @ torch.from_numpy(graph.cam_from_world).float()
    torch.testing.assert_close(product, eye, atol=1e-6, rtol=0)
    both = lay_out([keyed(graph), keyed(graph)]).unpack()
    assert both.image.shape[0] == len(both.key) == 2
    assert both.key == ["shard:key"] * 2


def test_portrait_and_landscape_images_stack_in_one_batch():
    mixed = make_mixed_graph(portrait=(False, True, True, False))
    samples = [keyed(mixed), keyed(make_graph(num_views=4)), keyed(mixed)]
    for size in ((48, 64), (16, 32)):
        views = lay_out(list(resize_crop(samples, image_size=size))).unpack()
        assert views.image.shape == (3, 4, 3, *size)
        assert views.depth.shape == views.valid.shape == (3, 4, *size)
        landscape, portrait = list(size), list(size)[::-1]
        of_mixed = [landscape, portrait, portrait, landscape]
        assert views.true_shape.tolist() == [of_mixed, [landscape] * 4, of_mixed]
        assert (views.K[0, [1, 2], 0, 0] == 0).all()
        assert (views.K[1, :, 0, 0] > 0).all()
        # The camera's own axes stay as photographed.
        torch.testing.assert_close(views.world_from_cam[0], views.world_from_cam[1])
    # Red counts columns of the upright image, which are rows of the layout.
    red = views.image[0, 1, 0]
    assert float(red.diff(dim=0).abs().min()) > 0
    assert float(red.diff(dim=1).abs().max()) == 0


def test_a_square_target_transposes_nothing():
    graph = make_mixed_graph(portrait=(False, True))
    (sample,) = resize_crop([keyed(graph)], image_size=(32, 32))
    views = lay_out([sample]).unpack()
    assert views.true_shape.tolist() == [[[32, 32]] * 2]
    assert torch.equal(views.K[0], torch.from_numpy(sample.graph.K).float())
    for view, pixels in enumerate(sample.graph.image):
        assert torch.equal(views.image[0, view].permute(1, 2, 0) * 255, torch.from_numpy(pixels))


def test_a_principal_point_outside_the_image_names_the_image():
    graph = plane_graph(48, 64, (70.0, 24.0))
    with pytest.raises(DataError, match=r"shard:key: 0-0\.png: principal point .*outside"):
        list(resize_crop([keyed(graph)], image_size=(16, 16)))


def test_a_batch_moves_to_a_device_but_for_its_true_shapes():
    views = lay_out([keyed(make_graph(num_views=2))]).unpack()
    moved = views.to("meta")
    assert moved.true_shape.device.type == "cpu"
    assert torch.equal(moved.true_shape, views.true_shape)
    assert {moved.image.device.type, moved.K.device.type, moved.depth.device.type} == {"meta"}
