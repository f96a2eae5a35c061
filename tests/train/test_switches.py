"""Half precision, recomputed activations, compiled blocks and mixed orientations in training."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from l3r.config import InferenceConfig, load_config
from l3r.data.source import ShardFolder
from l3r.data.steps import read_graph
from l3r.inference.checkpoint import load_model, read_checkpoint
from l3r.inference.reconstruct import reconstruct_views
from l3r.train.run import train
from tests.data.graphs import make_mixed_graph, write_folder
from tests.train.runs import layers, losses, read_log

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.fixture(scope="module")
def plain(hand_shards, tmp_path_factory):
    """Four steps in float32, nothing recomputed."""
    folder = tmp_path_factory.mktemp("plain")
    os.chdir(ROOT)
    train(load_config(layers(hand_shards, folder, max_steps=4)))
    return folder


def run(shards, folder, *settings):
    # Validation included: it runs under the training's precision.
    changes = layers(shards, folder, max_steps=4, validate_every=2)
    train(load_config([*changes, *settings]))
    return losses(folder)


def test_recomputed_activations_train_to_the_same_losses(plain, hand_shards, tmp_path):
    found = run(hand_shards, tmp_path, "train.gradient_checkpointing=true")
    assert found == losses(plain)


def test_bfloat16_trains_close_to_float32_and_keeps_weights_in_float32(
    plain, hand_shards, tmp_path
):
    found = run(hand_shards, tmp_path, "train.precision=bf16")
    expected = losses(plain)
    assert found != expected
    for step, (loss, _) in found.items():
        assert float(loss) == pytest.approx(float(expected[step][0]), rel=0.02)
    model = load_model(tmp_path / "model.ckpt")
    assert {p.dtype for p in model.parameters()} == {torch.float32}


def test_bfloat16_reaches_reconstruction_and_changes_little(plain, hand_shards):
    model = load_model(plain / "model.ckpt")
    views = read_graph(ShardFolder(hand_shards, 3), 0, (16, 16))
    ((full, _),) = reconstruct_views(model, views, InferenceConfig())
    ((half, _),) = reconstruct_views(model, views, InferenceConfig(precision="bf16"))
    expected, found = (torch.stack(scene.pts3d_world) for scene in (full, half))
    assert found.dtype == torch.float32
    assert not torch.equal(found, expected)
    assert (found - expected).norm() < 0.05 * expected.norm()


def test_portrait_and_landscape_images_train_in_one_batch(tmp_path):
    turns = [(False, True, True), (True, False, False), (False, False, False), (True, True, True)]
    graphs = [make_mixed_graph(n, turn, 16, 24) for n, turn in enumerate(turns)]
    shards = write_folder(tmp_path / "shards", graphs)
    run(shards, tmp_path / "run", "model.image_size=[16,24]", "data.num_workers=0")
    rows = read_log(tmp_path / "run")
    assert len(rows) == 4
    assert all(float(row["grad_norm"]) > 0 for row in rows)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_inference_decides_its_own_precision_under_any_autocast(plain, hand_shards, precision):
    model = load_model(plain / "model.ckpt")
    views = read_graph(ShardFolder(hand_shards, 3), 0, (16, 16))
    config = InferenceConfig(precision=precision)
    ((outside, _),) = reconstruct_views(model, views, config)
    with torch.autocast("cpu", torch.bfloat16):
        ((inside, _),) = reconstruct_views(model, views, config)
    for one, other in zip(inside.pts3d_world, outside.pts3d_world, strict=True):
        assert torch.equal(one, other)
    exact = {"rtol": 0, "atol": 0, "equal_nan": True}  # focal lengths of an untrained network
    torch.testing.assert_close(inside.cameras.K, outside.cameras.K, **exact)


@pytest.mark.slow
def test_compiled_blocks_train_to_the_same_losses(plain, hand_shards, tmp_path):
    if shutil.which("g++") is None:
        pytest.skip("no C++ compiler, which torch.compile needs on a CPU")
    # In a process of its own: the shape checks of the test run cannot be compiled.
    settings = [*layers(hand_shards, tmp_path, max_steps=4), "train.compile=true"]
    command = [sys.executable, "-m", "l3r", "train", *settings]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=900)
    assert done.returncode == 0, done.stderr
    for step, (loss, _) in losses(tmp_path).items():
        assert float(loss) == pytest.approx(float(losses(plain)[step][0]), rel=1e-3)


def test_the_gradient_is_clipped_in_bfloat16_too(hand_shards, tmp_path):
    changes = layers(hand_shards, tmp_path, max_steps=1, precision="bf16", clip_norm=1e-3)
    train(load_config(changes))
    assert float(read_log(tmp_path)[0]["grad_norm"]) > 1e-2
    content = read_checkpoint(tmp_path / "last.ckpt")
    moments = content["optimizer_states"][0]["state"].values()
    norm = torch.stack([state["exp_avg"].norm() for state in moments]).norm()
    first_share = 1 - content["l3r_config"]["train"]["betas"][0]
    assert float(norm) == pytest.approx(first_share * 1e-3, rel=1e-3)
