import argparse
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l3r.cli import eval_poses
from l3r.errors import DataError
from l3r.eval.poses import evaluate_cameras, load_cameras, match_files
from l3r.export.cameras_json import write_cameras
from l3r.geometry.rigid import rigid_from_parts
from l3r.types import Cameras

REAL = Path(__file__).parents[2] / ".." / "shared" / "data" / "scenes"


def cameras(n=5, seed=0, names="{}.jpg"):
    rng = np.random.default_rng(seed)
    R = torch.from_numpy(Rotation.random(n, rng=rng).as_matrix())
    return Cameras(
        file=[names.format(index) for index in range(n)],
        image_size=[(30, 40)] * n,
        K=torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]]).double().repeat(n, 1, 1),
        cam_from_world=rigid_from_parts(R, torch.from_numpy(rng.normal(size=(n, 3)))),
        registered=torch.ones(n, dtype=torch.bool),
        component=torch.zeros(n, dtype=torch.int64),
    )


def take(cams, views):
    return Cameras(
        file=[cams.file[v] for v in views],
        image_size=[cams.image_size[v] for v in views],
        K=cams.K[views],
        cam_from_world=cams.cam_from_world[views],
        registered=cams.registered[views],
        component=cams.component[views],
    )


def disturbed(cams, seed=1):
    rng = np.random.default_rng(seed)
    n = len(cams.file)
    turn = Rotation.from_rotvec(rng.normal(size=(n, 3)) * 0.1).as_matrix()
    move = rigid_from_parts(torch.from_numpy(turn), torch.from_numpy(rng.normal(size=(n, 3)) * 0.1))
    return replace(cams, cam_from_world=move @ cams.cam_from_world)


@settings(max_examples=20, deadline=None)
@given(st.permutations(range(6)), st.permutations(range(6)))
def test_no_score_depends_on_the_order_of_images(first, second):
    gt = cameras(6)
    pred = disturbed(gt)
    straight = evaluate_cameras(pred, gt).metrics.to_dict()
    shuffled = evaluate_cameras(take(pred, first), take(gt, second)).metrics.to_dict()
    assert shuffled == pytest.approx(straight, rel=1e-9)


def test_absent_images_count_as_not_registered():
    gt = cameras(5)
    result = evaluate_cameras(take(gt, [3, 1, 0]), gt)
    assert (result.num_images, result.num_found, result.num_registered) == (5, 3, 3)
    assert result.metrics.reg == pytest.approx(60)
    assert result.metrics.rra_5 == pytest.approx(100 * 3 / 10)
    assert evaluate_cameras(take(gt, [3, 1, 0]), gt, "exclude_image").metrics.rra_5 == 100


def test_a_lost_scene_is_left_out_on_request():
    gt = cameras(4)
    lost = replace(
        gt,
        registered=torch.zeros(4, dtype=torch.bool),
        cam_from_world=torch.full((4, 4, 4), torch.nan, dtype=torch.float64),
    )
    assert evaluate_cameras(lost, gt).metrics.rra_5 == 0
    result = evaluate_cameras(lost, gt, "exclude_scene")
    assert math.isnan(result.metrics.rra_5)
    assert result.metrics.reg == 0
    assert json.loads(json.dumps(result.to_dict(), allow_nan=False))["metrics"]["rra_5"] is None


def test_extra_predictions_and_unknown_truths_are_left_out():
    everything = cameras(6)
    known = torch.tensor([True, True, True, True, False, False])
    gt = replace(everything, registered=known)
    result = evaluate_cameras(everything, gt)
    assert (result.num_images, result.num_extra) == (4, 2)
    assert result.metrics.reg == 100


def test_near_coincident_pairs_are_counted():
    gt = cameras(4)
    gt.cam_from_world[1] = gt.cam_from_world[0]
    assert evaluate_cameras(gt, gt).num_short == 1
    gt.cam_from_world[:] = gt.cam_from_world[0].clone()
    assert evaluate_cameras(gt, gt).num_short == 6


def test_names_match_whole_or_by_base_name():
    assert match_files(["b.jpg", "a.jpg"], ["a.jpg", "c.jpg"]) == [1, None]
    assert match_files(["0.jpg", "1.jpg"], ["images/1.jpg", "images/7.jpg"]) == [1, None]
    # A whole name in common rules base names out.
    assert match_files(["r/1.jpg", "x/2.jpg"], ["r/1.jpg", "l/2.jpg"]) == [0, None]


@pytest.mark.parametrize(
    ("pred", "gt", "message"),
    [
        (["a.jpg"], ["b.jpg"], r"no image in common: predicted 'a.jpg'.*'b.jpg'"),
        ([], ["b.jpg"], r"predicted no image at all.*'b.jpg'"),
        (["x/a.jpg", "y/a.jpg"], ["a.jpg"], r"ambiguous.*'a.jpg'.*x/a.jpg.*y/a.jpg"),
        (["a.jpg"], ["x/a.jpg", "y/a.jpg"], r"ambiguous.*x/a.jpg"),
    ],
)
def test_names_that_do_not_match_are_named(pred, gt, message):
    with pytest.raises(DataError, match=message) as caught:
        match_files(pred, gt)
    assert "\n" not in str(caught.value)


def test_no_truth_is_an_error():
    gt = cameras(3)
    with pytest.raises(DataError, match="no registered image"):
        evaluate_cameras(gt, replace(gt, registered=torch.zeros(3, dtype=torch.bool)))


def write_text_model(folder, cams):
    folder.mkdir(parents=True)
    lines, images = [], []
    for view, file in enumerate(cams.file):
        lines.append(f"{view + 1} PINHOLE 40 30 50 50 20 15")
        x, y, z, w = Rotation.from_matrix(cams.cam_from_world[view, :3, :3].numpy()).as_quat()
        t = " ".join(str(float(value)) for value in cams.cam_from_world[view, :3, 3])
        images.append(f"{view + 1} {w} {x} {y} {z} {t} {view + 1} {file}\n")
    (folder / "cameras.txt").write_text("\n".join(lines))
    (folder / "images.txt").write_text("\n".join(images))


def test_cameras_are_found_in_every_form(tmp_path):
    gt = cameras(3)
    write_cameras(tmp_path / "cameras.json", gt)
    write_text_model(tmp_path / "project" / "sparse" / "0", gt)
    write_text_model(tmp_path / "other" / "sparse", gt)
    for path in (
        tmp_path / "cameras.json",
        tmp_path,
        tmp_path / "project",
        tmp_path / "project" / "sparse" / "0",
        tmp_path / "other",
    ):
        assert evaluate_cameras(load_cameras(path), gt).metrics.maa_30 == 100
    with pytest.raises(DataError, match="no cameras; expected"):
        load_cameras(tmp_path / "nowhere")


def run(*arguments):
    parser = argparse.ArgumentParser()
    eval_poses.add_arguments(parser)
    return eval_poses.run(parser.parse_args([str(argument) for argument in arguments]))


def test_the_command_prints_a_narrow_table_and_writes_json(tmp_path, capsys):
    gt = cameras(6)
    write_cameras(tmp_path / "gt.json", gt)
    write_cameras(tmp_path / "[b]pred.json", take(disturbed(gt), [0, 1, 2, 3]))
    out = tmp_path / "scores.json"
    assert (
        run("--pred", tmp_path / "[b]pred.json", "--gt", tmp_path / "gt.json", "--json", out) == 0
    )
    printed = capsys.readouterr().out
    assert max(len(line) for line in printed.splitlines()) <= 80
    assert "registered 4 of 6 images" in printed
    assert "missing: fail" in printed
    assert "near-coincident" in printed
    scores = json.loads(out.read_text())
    assert scores["missing"] == "fail"
    assert scores["metrics"]["reg"] == pytest.approx(400 / 6)


@pytest.mark.skipif(not REAL.is_dir(), reason="real scenes not at ../shared/data/scenes")
def test_a_real_scene_agrees_with_itself_and_not_with_its_inverse():
    gt = load_cameras(REAL / "strecha_fountain_P11")
    assert evaluate_cameras(gt, gt).metrics.maa_30 == 100
    inverse = replace(gt, cam_from_world=torch.linalg.inv(gt.cam_from_world))
    assert evaluate_cameras(inverse, gt).metrics.maa_30 < 60
