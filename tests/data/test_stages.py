import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from l3r.data.stages import KeyedGraph, collate, resize_crop, to_views
from l3r.errors import DataError
from l3r.geometry.camera import unproject
from tests.data.graphs import make_graph


def keyed(graph, key="shard:key"):
    return KeyedGraph(key=key, graph=graph)


def plane_graph(height, width, center, target=None):
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
    st.sampled_from([(32, 32), (16, 32), (32, 16), (48, 64)]),
)
def test_points_stay_where_they_are(height, width, share_x, share_y, size):
    """After any crop and scale, K and depth still lift pixels onto the same plane."""
    graph = plane_graph(height, width, (share_x * width, share_y * height))
    (sample,) = resize_crop([keyed(graph)], image_size=size)
    (views,) = to_views([sample])
    assert views.image.shape == (1, 1, 3, *size)
    points = unproject(views.depth[0, 0].double(), views.K[0, 0].double())
    error = (points[:, 2] - (2 + 0.1 * points[:, 0])).abs()
    # A nearest sample lies up to half a source pixel off; the plane rises 0.1 per metre.
    assert float(error.max()) < 0.1 * 4 * 0.6 / (0.9 * width) * max(1, width / size[1])


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
    list(to_views(resize_crop([keyed(graph)], image_size=(16, 24))))
    assert all(np.array_equal(a, b) for a, b in zip(graph.image, before[0], strict=True))
    assert np.array_equal(graph.K, before[1])


def test_views_carry_everything_in_the_documented_form():
    graph = make_graph(number=3, num_views=4)
    graph.depth[1][:5] = 0
    (views,) = to_views([keyed(graph)])
    assert 0 <= float(views.image.min()) <= float(views.image.max()) <= 1
    assert views.true_shape.tolist() == [[[48, 64]] * 4]
    assert views.valid[0, 1, :5].any() == False  # noqa: E712
    assert views.valid[0, 1, 5:].all()
    eye = torch.eye(4).expand(4, 4, 4)
    product = views.world_from_cam[0] @ torch.from_numpy(graph.cam_from_world).float()
    torch.testing.assert_close(product, eye, atol=1e-6, rtol=0)
    both = collate([views, views])
    assert both.image.shape[0] == len(both.key) == 2
    assert both.key == ["shard:key"] * 2


def test_a_principal_point_outside_the_image_names_the_image():
    graph = plane_graph(48, 64, (70.0, 24.0))
    with pytest.raises(DataError, match=r"shard:key: 0-0\.png: principal point .*outside"):
        list(resize_crop([keyed(graph)], image_size=(16, 16)))
