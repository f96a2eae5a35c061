"""The network gives what the official one gives, layer by layer."""

import argparse

import pytest
import torch
from torch.nn.functional import pixel_unshuffle

from l3r.config.model import ModelConfig
from l3r.model.heads import pointmap_from_raw
from l3r.model.weights import official_key
from tests.model.official import (
    CASES,
    FULL_MANIFEST,
    RECORDED,
    TINY_MANIFEST,
    PairNetwork,
    load_case,
    load_manifest,
    needs_recorded,
    recipe_weights,
    tiny_config,
    tiny_network,
)

pytestmark = needs_recorded

# Relative to each tensor's largest value: two correct float32 networks agree to 6e-6, and the
# smallest plausible mistake (epsilon of the layer norm) shifts 5e-5.
BOUND = {torch.float32: 2e-5, torch.float64: 1e-10}
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["fp32", "fp64"])


def assert_recorded(found, recorded, dtype):
    expected = torch.from_numpy(recorded)
    assert found.dtype == expected.dtype == dtype
    assert found.shape == expected.shape
    assert (found - expected).abs().max() <= BOUND[dtype] * expected.abs().max()


def run_network(arrays, dtype):
    """Tokens, streams, raw outputs, points and confidences of both views, named as recorded."""
    network = tiny_network(dtype)
    images = [((torch.from_numpy(arrays[f"u8_{v}"]) / 255 - 0.5) / 0.5) for v in (1, 2)]
    images = [image.permute(0, 3, 1, 2).to(dtype) for image in images]
    grids = [network.encoder.token_grid(*image.shape[2:]) for image in images]
    tokens = [network.encoder(image) for image in images]
    streams = network.decoder(*tokens, *grids, hooks=range(5))
    heads = (network.parent_head, network.child_head)
    found = {}
    for view, (image, grid, stream, head) in enumerate(
        zip(images, grids, streams, heads, strict=True), start=1
    ):
        raw = head([stream[hook] for hook in head.hooks], grid)
        pts3d, log_conf = pointmap_from_raw(raw)
        size = (len(image), *image.shape[2:])
        frame = "" if view == 1 else "_in_other_view"
        found[f"enc{view}"] = stream[0]
        found |= {f"dec{view}_{block:02d}": stream[block] for block in range(1, 5)}
        found[f"raw{view}"] = pixel_unshuffle(raw, 16).flatten(2).transpose(1, 2)
        found[f"view{view}_pts3d{frame}"] = pts3d.reshape(*size, 3)
        found[f"view{view}_conf"] = log_conf.exp().reshape(size)
    return found


@DTYPES
@pytest.mark.parametrize("case", CASES)
def test_every_layer_gives_the_recorded_values(case, dtype):
    arrays = load_case(case)
    prefix = "f64_" if dtype == torch.float64 else ""
    found = run_network(arrays, dtype)
    compared = [name for name in found if prefix + name in arrays]
    # Of the float64 run only the ends were recorded: tokens, last blocks, outputs.
    assert len(compared) == (8 if prefix else 16)
    for name in compared:
        assert_recorded(found[name], arrays[prefix + name], dtype)


def test_checkpoint_file_holds_the_weights_of_the_recipe():
    path = RECORDED / "fixtures" / f"{TINY_MANIFEST}.pth"
    with torch.serialization.safe_globals([argparse.Namespace]):
        stored = torch.load(path, weights_only=True)["model"]
    rebuilt = recipe_weights(TINY_MANIFEST, seed=1)
    assert stored.keys() == rebuilt.keys()
    assert all(torch.equal(stored[key], rebuilt[key]) for key in stored)


def test_tiny_network_has_the_official_shapes():
    assert_shapes(tiny_config(), TINY_MANIFEST)


def test_full_network_has_the_official_shapes_and_size():
    network = assert_shapes(ModelConfig(), FULL_MANIFEST)
    assert sum(parameter.numel() for parameter in network.parameters()) == 532_342_784 - 768


def assert_shapes(config, manifest_name):
    with torch.device("meta"):
        network = PairNetwork(config)
    found = {official_key(key): list(value.shape) for key, value in network.state_dict().items()}
    assert len(found) == len(network.state_dict())
    manifest = load_manifest(manifest_name)
    assert manifest.pop("mask_token") is not None
    assert found == manifest
    return network
