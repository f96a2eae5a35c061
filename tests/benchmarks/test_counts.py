"""What the benchmarks say of cost without measuring: operations and memory."""

from pathlib import Path

import pytest
import torch

from benchmarks.bare import record_bare
from benchmarks.flops import count_flops, flops_of
from l3r.config import GraphConfig, load_config
from l3r.model.activations import count_kept
from l3r.model.light3r import Light3R
from l3r.model.rope import rope_tables

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch):
    monkeypatch.chdir(ROOT)


def model_config(name):
    return load_config(["configs/base.yaml", f"configs/model/{name}.yaml"]).model


def test_counted_operations_are_those_of_the_closed_forms():
    """Of ViT-L and base decoders at 384x512; a DPT head costs what the released ones do."""
    flops = count_flops(model_config("l3r_512"), 2)
    t = 24 * 32
    encoder = 24 * (24 * t * 1024**2 + 4 * t**2 * 1024) + 2 * t * 768 * 1024
    decoder = 24 * (32 * t * 768**2 + 8 * t**2 * 768) + 4 * t * 1024 * 768
    assert flops["encoder"] == 2 * encoder
    assert flops["decoder"] == decoder
    # 373.41 GFLOP as released; four 1x1 convolutions before the upsampling save three quarters
    # of theirs in each of two heads.
    pixels = 96 * 128 + 48 * 64 + 24 * 32 + 12 * 16
    saved = 2 * 3 * (2 * 256**2 * pixels)
    assert flops["heads"] == pytest.approx(373.41e9 - saved, rel=1e-4)


def test_recomputed_activations_keep_a_tenth():
    config = model_config("l3r_512")
    kept, recomputed = (
        count_kept(config, 4, precision="bf16", recompute=recompute) for recompute in (False, True)
    )
    assert sum(recomputed.values()) < 0.15 * sum(kept.values())
    assert all(recomputed[part] < kept[part] for part in kept)


def test_counting_leaves_no_table_without_data_behind():
    count_flops(model_config("tiny"), 2)
    assert type(rope_tables(5, 5, 32, torch.zeros(1)).cos) is torch.Tensor


def test_bare_operations_count_as_many_operations_as_the_network():
    config = model_config("tiny")
    model = Light3R(config, GraphConfig()).eval().requires_grad_(False)
    grid = model.encoder.token_grid(*config.image_size)
    image = torch.rand(2, 3, *config.image_size)

    def pair():
        tokens = model.encode(image)
        return model.decode(tokens[:1], tokens[1:], grid, grid)

    with torch.inference_mode(), torch.nn.attention.sdpa_kernel(torch.nn.attention.SDPBackend.MATH):
        bare = record_bare(model, pair)
        assert flops_of(bare) == flops_of(pair) > 0
