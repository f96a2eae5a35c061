"""Weights shared out over processes train as whole ones do; gloo on this machine's CPU."""

import os
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.tensor import DTensor, Shard
from torch.testing._internal.distributed.fake_pg import FakeStore

from l3r.config import load_config
from l3r.errors import ConfigError
from l3r.inference.checkpoint import build_untrained, read_checkpoint
from l3r.train.optim import build_optimizer
from l3r.train.sharding import (
    collect,
    gather,
    gather_network,
    own_share,
    shard_like,
    shard_network,
    total_norm,
)
from tests.data.graphs import make_mixed_graph, write_folder
from tests.train.runs import TINY, read_log
from tests.train.test_ranks import assert_same_run, launch

ROOT = Path(__file__).parents[2]
DPT = [
    "model.image_size=[32,32]",
    "model.encoder.patch_size=16",
    "model.decoder.depth=4",
    "model.head=dpt",
    "model.dpt.stage_channels=[4,4,4,4]",
    "model.dpt.fusion_channels=4",
    "model.dpt.out_channels=4",
]
SETTINGS = [
    *DPT,
    "data.graphs_per_step=5",  # which two processes share unevenly
    "train.lr=1e-3",
    "train.ema_decay=0.7",
    "train.clip_norm=1",
    "train.validate_every=3",
]
SHARDED = ["train.devices=2", "train.strategy=fsdp"]


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.fixture(scope="module")
def alone(hand_shards, tmp_path_factory):
    """Six steps in one process."""
    folder = tmp_path_factory.mktemp("alone")
    os.chdir(ROOT)
    launch(hand_shards, folder, *SETTINGS, max_steps=6)
    return folder


def assert_same_figures(folder, expected):
    assert_same_run(folder, expected)
    for name in ("metrics.csv", "validation.csv"):
        for row, true in zip(*(read_log(f, name) for f in (folder, expected)), strict=True):
            figures = {
                key for key in row if key not in ("data_wait", "graphs_per_second", "gpu_gib")
            }
            for key in figures:
                close = pytest.approx(float(true[key]), rel=1e-3, abs=1e-5, nan_ok=True)
                assert float(row[key]) == close, key


@pytest.mark.slow
def test_shared_out_weights_give_the_losses_weights_and_validation_of_whole_ones(
    hand_shards, alone, tmp_path
):
    memory = ["train.accumulate=2", "train.gradient_checkpointing=true"]
    launch(hand_shards, tmp_path, *SETTINGS, *SHARDED, *memory, max_steps=6)
    assert_same_figures(tmp_path, alone)


@pytest.mark.slow
def test_a_run_changes_between_whole_and_shared_out_weights(hand_shards, alone, tmp_path):
    for step, way in ((2, SHARDED), (4, []), (6, SHARDED)):
        launch(hand_shards, tmp_path, *SETTINGS, *way, max_steps=step)
    assert_same_figures(tmp_path, alone)
    found, expected = (read_checkpoint(f / "last.ckpt") for f in (tmp_path, alone))
    assert found.keys() == expected.keys()
    moments, true = (content["optimizer_states"][0]["state"] for content in (found, expected))
    assert moments.keys() == true.keys()
    for number, state in true.items():
        for name, value in state.items():
            assert moments[number][name].stride() == value.stride()
            torch.testing.assert_close(moments[number][name], value, rtol=1e-3, atol=1e-5)


@pytest.mark.slow
def test_a_bad_step_in_one_process_changes_no_share(hand_shards, tmp_path):
    settings = [*SETTINGS, *SHARDED]
    launch(hand_shards, tmp_path, *settings, max_steps=1, env={"NAN_AT": "1:1"})
    assert len((tmp_path / "bad_steps.jsonl").read_text().splitlines()) == 1
    content = read_checkpoint(tmp_path / "last.ckpt")
    start, _ = build_untrained([*TINY, *DPT])
    for part in ("state_dict", "average"):
        for name, value in start.state_dict().items():
            assert torch.equal(content[part][f"model.{name}"], value)


@pytest.mark.slow
def test_processes_may_have_images_of_different_orientations(tmp_path):
    # The heads run once for each orientation: once in some processes, twice in others.
    turns = [(False,) * 3, (True,) * 3, (True, False, False), (False, False, True)]
    graphs = [make_mixed_graph(n, turn, 16, 24) for n, turn in enumerate(turns)]
    shards = write_folder(tmp_path / "shards", graphs)
    settings = ["model.image_size=[16,24]", "train.validate_every=2"]
    launch(shards, tmp_path / "alone", *settings, max_steps=4, lr=1e-3)
    launch(shards, tmp_path / "shared", *settings, *SHARDED, max_steps=4, lr=1e-3)
    assert_same_figures(tmp_path / "shared", tmp_path / "alone")


def test_compilation_of_shared_out_weights_is_refused():
    with pytest.raises(ConfigError, match=r"train\.compile.*false under train\.strategy=fsdp"):
        load_config(["train.strategy=fsdp", "train.compile=true"])


@pytest.fixture
def mesh(tmp_path):
    """A group of this process alone."""
    dist.init_process_group("gloo", init_method=f"file://{tmp_path}/store", rank=0, world_size=1)
    yield init_device_mesh("cpu", (1,))
    dist.destroy_process_group()


def test_a_network_is_shared_out_and_gathered_again(mesh):
    layers = [*TINY, *DPT]
    network, config = build_untrained(layers)
    whole, _ = build_untrained(layers)
    strides = {value.stride() for value in whole.parameters() if not value.is_contiguous()}
    assert strides, "heads have their channels last, which FSDP does not know"
    shard_network(network, mesh)
    gathered = gather_network(network)
    assert gathered.state_dict().keys() == whole.state_dict().keys()
    for name, value in whole.state_dict().items():
        assert torch.equal(gathered.state_dict()[name], value)
        shared = network.state_dict()[name]
        assert torch.equal(gather(shard_like(value, shared)), value)
        assert collect(shared, keep=False).numel() == 0
        assert own_share(shared).data_ptr() == own_share(network.get_parameter(name)).data_ptr()
    image, shape = torch.rand(1, 3, 3, 32, 32), torch.full((1, 3, 2), 32)
    prediction, expected = network.train()(image, shape), whole.train()(image, shape)
    for answer in (prediction, expected):
        answer.world.pts3d_world.sum().backward()
    norms = [
        total_norm(p.grad for p in one.parameters() if p.grad is not None)
        for one in (network, whole)
    ]
    torch.testing.assert_close(*norms)
    assert len(build_optimizer(network, config).param_groups[0]["params"])


@pytest.mark.parametrize("keep", [True, False])
def test_a_checkpoint_is_put_together_on_the_host_not_on_one_device(keep):
    # Two GPUs that only pretend, of which this process has the first.
    dist.init_process_group("fake", store=FakeStore(), rank=0, world_size=2)
    try:
        gpus = init_device_mesh("cuda", (2,))
        with FakeTensorMode():
            share = torch.empty(3, 4, device="cuda:0")
            shared = DTensor.from_local(share, gpus, [Shard(0)], run_check=False)
            assert gather(shared).device.type == "cuda"
            whole = collect(shared, keep=keep)
    finally:
        dist.destroy_process_group()
    assert (whole.device.type, tuple(whole.shape)) == ("cpu", (6, 4) if keep else (0,))
