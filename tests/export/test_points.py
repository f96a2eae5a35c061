from dataclasses import replace

import torch

from l3r.export.points import PointSelection, even_shares, sample_points


def test_shares_are_even_and_what_is_left_goes_to_the_others():
    assert even_shares([10, 10, 10], 9) == [3, 3, 3]
    assert even_shares([1, 100, 100], 21) == [1, 10, 10]
    assert even_shares([5, 5], 100) == [5, 5]
    assert even_shares([0, 7], 3) == [0, 3]
    assert even_shares([], 3) == []


def test_the_sample_is_capped_deterministic_and_of_every_image(scene):
    selection = PointSelection(max_points=600)
    a, b = sample_points(scene, selection), sample_points(scene, selection)
    assert torch.bincount(a.view).tolist() == [100] * 6
    assert torch.equal(a.pts2d, b.pts2d)
    assert (a.conf > 3).all()


def test_rules_decide(scene):
    rules = ["none", "quantile", "threshold", "none", "none", "none"]
    sample = sample_points(replace(scene, point_rule=rules), PointSelection(min_conf=2.0))
    share = round(0.1 * scene.conf[1].numel())
    above = int((scene.conf[2] > 2.0).sum())
    assert torch.bincount(sample.view, minlength=6).tolist() == [0, share, above, 0, 0, 0]
    assert sample.conf[sample.view == 1].min() >= scene.conf[1].quantile(0.89)


def test_unregistered_images_and_impossible_points_are_left_out(scene_with_a_loss):
    scene = scene_with_a_loss
    points = [map.clone() for map in scene.pts3d_world]
    conf = [torch.full_like(map, 9.0) for map in scene.conf]
    points[0][:] = torch.nan
    points[1][:] *= 100  # beyond the far wall, hence behind nobody
    points[3][0, 0] = torch.inf
    behind = scene.cameras.cam_from_world[4, 2, :3].float() * -100
    points[4][0, 0] = behind
    sample = sample_points(replace(scene, pts3d_world=points, conf=conf), PointSelection())
    counts = torch.bincount(sample.view, minlength=6).tolist()
    full = conf[0].numel()
    assert counts[0] == counts[2] == 0
    assert counts[3] == counts[4] == full - 1
    assert counts[5] == full


def test_nothing_registered_gives_nothing(scene):
    cameras = replace(scene.cameras, registered=torch.zeros(6, dtype=torch.bool))
    sample = sample_points(replace(scene, cameras=cameras), PointSelection())
    assert len(sample.conf) == len(sample.pts3d_world) == 0
