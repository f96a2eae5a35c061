import pytest
import torch

from l3r.config import InferenceConfig
from l3r.inference.cameras import (
    SelfViews,
    choose_points,
    collect_self_views,
    fit_cameras,
    fit_intrinsics,
    padded_pixels,
)
from l3r.types import PairPointmaps, Photos, Window, WorldPointmaps
from tests.geometry.scenes import generator
from tests.graph.scenes import exact_scene


def log_conf(*confs):
    return torch.tensor(confs, dtype=torch.float64).log()


def test_confident_points_pass_the_threshold():
    values = torch.cat([log_conf(*[5.0] * 40), log_conf(*[2.0] * 60)])
    chosen, rule = choose_points(values, InferenceConfig(), 0)
    assert rule == "threshold"
    assert sorted(chosen.tolist()) == list(range(40))


def test_too_few_confident_points_give_way_to_the_most_confident_tenth():
    values = torch.linspace(1.0, 2.9, 1000).log()
    chosen, rule = choose_points(values, InferenceConfig(), 0)
    assert rule == "quantile"
    assert sorted(chosen.tolist()) == list(range(900, 1000))


def test_a_tenth_is_never_less_than_what_pnp_needs():
    chosen, rule = choose_points(torch.linspace(1.0, 2.0, 100).log(), InferenceConfig(), 0)
    assert (len(chosen), rule) == (32, "quantile")


def test_without_the_fallback_such_an_image_has_no_points():
    config = InferenceConfig(fallback_share=0.0)
    chosen, rule = choose_points(torch.zeros(1000), config, 0)
    assert (len(chosen), rule) == (0, "none")
    assert choose_points(torch.zeros(20), InferenceConfig(), 0)[1] == "none"


def test_the_sample_is_bounded_and_repeats():
    config = InferenceConfig(pnp_points=50)
    values = torch.full((400,), 2.0)
    first, second = (choose_points(values, config, 3)[0] for _ in range(2))
    assert len(first) == len(set(first.tolist())) == 50
    assert torch.equal(first, second)
    assert not torch.equal(first, choose_points(values, config, 4)[0])


def test_self_views_of_parents_are_averaged_and_leaves_take_the_reverse():
    tree, pairs, _, _ = exact_scene(3, 1, 6)
    draw = generator(3)
    reverse = PairPointmaps(
        **{k: torch.rand(v.shape, generator=draw).double() for k, v in vars(pairs).items()}
    )
    views = collect_self_views(pairs, reverse, tree)
    parent, child = tree.parent[0].tolist(), tree.child[0].tolist()
    for view in range(6):
        edges = [e for e in range(5) if parent[e] == view]
        if edges:
            weights = pairs.parent_log_conf[0, edges]
            maps = pairs.parent_pts3d[0, edges]
            expected = (maps * weights[..., None]).sum(0) / weights.sum(0)[..., None]
        else:
            expected = reverse.parent_pts3d[0, child.index(view)]
        torch.testing.assert_close(views.pts3d_cam[view], expected)


def blank_photos(original, size, window=None, count=1):
    return Photos(
        image=[torch.zeros(3, *size)] * count,
        original_size=[original] * count,
        window=[window or Window.whole(*original)] * count,
        file=[f"{view}.jpg" for view in range(count)],
    )


@pytest.mark.parametrize("window", [None, Window(left=61.5, top=38.25, width=304.0, height=224.0)])
def test_focal_lengths_come_in_original_pixels_whatever_the_network_saw(window):
    """A photo of 300 x 410 px seen at 224 x 304: sides scaled by different factors, or cut."""
    size, original, focal = (224, 304), (300, 410), 333.0
    photos = blank_photos(original, size, window)
    pixels = padded_pixels(photos, torch.zeros(1, 224 * 304).double())
    first = [0.5 * 410 / 304, 0.5 * 300 / 224] if window is None else [62.0, 38.75]
    assert pixels[0, 0].tolist() == pytest.approx(first)
    centered = pixels - torch.tensor([205.0, 150.0]).double()
    rays = torch.cat([centered / focal, torch.ones_like(centered[..., :1])], -1)
    depth = 1 + torch.rand(1, 224 * 304, 1, generator=generator(1), dtype=torch.float64)
    views = SelfViews(pts3d_cam=rays * depth, log_conf=torch.ones(1, 224 * 304).double())
    (K,) = fit_intrinsics(views, photos)
    assert K[0, 0] == K[1, 1] == pytest.approx(focal, rel=1e-6)
    assert K[:2, 2].tolist() == [205, 150]


def test_an_image_whose_points_are_garbage_is_not_registered():
    draw = generator(5)
    world = WorldPointmaps(
        pts3d_world=torch.randn((1, 2, 1024, 3), generator=draw).double() * torch.zeros(3).double(),
        log_conf=torch.full((1, 2, 1024), 2.0).double(),
        residual=torch.zeros(1, 1).double(),
    )
    K = torch.tensor([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]).double().expand(2, 3, 3).clone()
    K[1, 0, 0] = torch.nan
    photos = blank_photos((32, 32), (32, 32), count=2)
    fits = fit_cameras(world, K, photos, InferenceConfig())
    assert fits.registered.tolist() == [False, False]
    assert fits.cam_from_world.isnan().all()
    assert fits.point_rule == ["threshold", "threshold"]
