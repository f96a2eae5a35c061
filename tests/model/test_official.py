"""The network gives what the official ones give, layer by layer, whatever shapes it is fed."""

import argparse

import numpy as np
import pytest
import torch
from torch.nn.functional import pixel_unshuffle

from l3r.config import GraphConfig, load_config
from l3r.config.model import ModelConfig
from l3r.model.grid import TokenGrid, find_transposed
from l3r.model.heads import pointmap_from_raw, run_head
from l3r.model.light3r import Light3R
from l3r.model.weights import official_key
from tests.model.official import (
    RECORDED,
    TINY_MANIFEST,
    PairNetwork,
    load_case,
    load_manifest,
    load_recipe,
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
DPT, MAST3R, CROCO = "tiny_dust3r_512_dpt", "tiny_mast3r_catmlpdpt", "tiny_croco_v2"
CASES = [
    *[(TINY_MANIFEST, case) for case in ("landscape", "portrait", "mixed", "square", "odd")],
    *[(DPT, case) for case in ("landscape", "mixed", "odd")],
    (MAST3R, "odd"),
]
MANIFEST_CASES = pytest.mark.parametrize(("manifest", "case"), CASES, ids=str)
NUM_CHECKED_ENDS = 8  # of the float64 run: tokens, last blocks, points and confidences


def assert_recorded(found, recorded, dtype):
    expected = torch.from_numpy(recorded)
    assert found.dtype == expected.dtype == dtype
    assert found.shape == expected.shape
    assert (found - expected).abs().max() <= BOUND[dtype] * expected.abs().max()


def assert_all_recorded(found, arrays, dtype):
    prefix = "f64_" if dtype == torch.float64 else ""
    compared = [name for name in found if prefix + name in arrays]
    for name in compared:
        assert_recorded(found[name], arrays[prefix + name], dtype)
    return compared


def load_images(arrays, dtype):
    images = [(torch.from_numpy(arrays[f"u8_{v}"]) / 255 - 0.5) / 0.5 for v in (1, 2)]
    return [image.permute(0, 3, 1, 2).to(dtype) for image in images]


def run_network(network, images, transposed=(None, None)):
    """Tokens, streams, raw outputs, points and confidences of both views, named as recorded."""
    grids = [
        network.encoder.token_grid(*image.shape[2:], turned)
        for image, turned in zip(images, transposed, strict=True)
    ]
    tokens = [
        network.encoder(image, turned) for image, turned in zip(images, transposed, strict=True)
    ]
    depth = network.decoder.depth
    streams = network.decoder(*tokens, *grids, hooks=range(depth + 1))
    heads = (network.parent_head, network.child_head)
    found = {}
    for view, (image, grid, stream, head) in enumerate(
        zip(images, grids, streams, heads, strict=True), start=1
    ):
        raw = run_head(head, [stream[hook] for hook in head.hooks], grid, recompute=False)
        pts3d, log_conf = pointmap_from_raw(raw)
        size = (len(image), *image.shape[2:])
        frame = "" if view == 1 else "_in_other_view"
        found[f"enc{view}"] = stream[0]
        found |= {f"dec{view}_{block:02d}": stream[block] for block in range(1, depth + 1)}
        is_linear = head.hooks == (-1,)
        found[f"raw{view}"] = pixel_unshuffle(raw, 16).flatten(2).mT if is_linear else raw
        found[f"view{view}_pts3d{frame}"] = pts3d.reshape(*size, 3)
        found[f"view{view}_conf"] = log_conf.exp().reshape(size)
    return found


@DTYPES
@MANIFEST_CASES
def test_every_layer_gives_the_recorded_values(manifest, case, dtype):
    network = tiny_network(dtype, manifest)
    arrays = load_case(manifest, case)
    compared = assert_all_recorded(run_network(network, load_images(arrays, dtype)), arrays, dtype)
    num_layers = 2 * (1 + network.decoder.depth + 3)
    assert len(compared) == (NUM_CHECKED_ENDS if dtype == torch.float64 else num_layers)


def test_training_layout_of_mixed_orientations_gives_the_recorded_values():
    arrays = load_case(TINY_MANIFEST, "train_mixed")
    network = tiny_network(torch.float32)
    images = [torch.from_numpy(arrays[f"img{view}"]) for view in (1, 2)]
    shapes = [torch.from_numpy(arrays[f"true_shape{view}"]) for view in (1, 2)]
    turned = [
        find_transposed(shape, *image.shape[2:])
        for shape, image in zip(shapes, images, strict=True)
    ]
    assert [flags.tolist() for flags in turned] == [[False, True, False], [True, True, False]]
    found = run_network(network, images, turned)
    del found["raw1"], found["raw2"]  # recorded with their activations alone
    assert len(assert_all_recorded(found, arrays, torch.float32)) == 2 * (1 + 4 + 2)


def test_croco_weights_give_the_recorded_tokens():
    network = tiny_network(torch.float32, CROCO)
    arrays = load_case(CROCO, "into_dust3r")
    found = run_network(network, load_images(arrays, torch.float32))
    tokens = {name: value for name, value in found.items() if name.startswith(("enc", "dec"))}
    assert len(assert_all_recorded(tokens, arrays, torch.float32)) == 2 * (1 + 4)
    large = (torch.from_numpy(arrays["c224_u8"]).permute(0, 3, 1, 2) / 255 - 0.5) / 0.5
    encoded = network.encoder(large)
    assert_recorded(encoded[:1], arrays["c224_enc1"], torch.float32)
    assert_recorded(encoded[1:], arrays["c224_enc2"], torch.float32)


def test_every_step_of_the_dpt_head_gives_the_recorded_values():
    network = tiny_network(torch.float32, DPT)
    arrays = load_case(DPT, "odd")
    inside = load_case(DPT, "odd_dpt_internals_every8thchannel")
    head, seen = network.parent_head, {}

    def watch(module, name):
        module.register_forward_hook(lambda _, __, output: seen.__setitem__(name, output))

    hooked = []
    for number, stage in enumerate(head.stages, start=1):
        hooked += [(stage.resample, f"act{number}"), (stage.reduce, f"rn{number}")]
    hooked += [(fusion, f"path{number}") for number, fusion in enumerate(head.fusions, start=1)]
    hooked += [(head.reduce, "head0")]
    for module, name in hooked:
        watch(module, name)
    run_network(network, load_images(arrays, torch.float32))
    assert len(seen) == 13
    for name, found in seen.items():
        assert list(found.shape) == inside[f"{name}_shape"].tolist()
        assert_recorded(found[:, ::8].contiguous(), inside[name], torch.float32)


@pytest.mark.parametrize(("manifest", "case"), [(TINY_MANIFEST, "landscape"), (DPT, "landscape")])
def test_pairs_of_a_batch_do_not_touch_each_other(manifest, case):
    network = tiny_network(torch.float64, manifest)
    images = load_images(load_case(manifest, case), torch.float64)
    together = run_network(network, images)
    alone = [run_network(network, [image[i : i + 1] for image in images]) for i in range(2)]
    for name, both in together.items():
        one_by_one = torch.cat([pair[name] for pair in alone])
        assert (both - one_by_one).abs().max() <= 1e-12 * both.abs().max()


def test_chunks_of_a_head_do_not_show(monkeypatch):
    network = tiny_network(torch.float64, DPT)
    images = load_images(load_case(DPT, "landscape"), torch.float64)
    whole = run_network(network, images)
    monkeypatch.setattr("l3r.model.heads.CHUNK_TOKENS", 1)
    chunked = run_network(network, images)
    for name, value in whole.items():
        assert (value - chunked[name]).abs().max() <= 1e-12 * value.abs().max()


def test_whole_network_with_fresh_alignment_gives_the_official_pair():
    """What the composed network says of an edge is what the official network says of the pair."""
    arrays = load_case(DPT, "landscape")
    model = Light3R(tiny_config(DPT), GraphConfig())
    model.load_state_dict(tiny_network(torch.float32, DPT).state_dict(), strict=False)
    image = torch.from_numpy(np.stack([arrays["u8_1"], arrays["u8_2"]], axis=1))
    image = image.permute(0, 1, 4, 2, 3) / 255
    true_shape = torch.tensor(image.shape[-2:]).expand(2, 2, 2)
    with torch.no_grad():
        prediction = model(image, true_shape)
    # The tree chooses which image is the parent; the recorded run made it the first.
    first = [graph for graph in range(2) if prediction.tree.parent[graph, 0] == 0]
    for graph in first:
        found = prediction.pairs.child_pts3d[graph, 0].reshape(64, 96, 3)
        assert_recorded(found, arrays["view2_pts3d_in_other_view"][graph], torch.float32)
    assert first


def test_checkpoint_file_holds_the_weights_of_the_recipe():
    path = RECORDED / "fixtures" / f"{TINY_MANIFEST}.pth"
    with torch.serialization.safe_globals([argparse.Namespace]):
        stored = torch.load(path, weights_only=True)["model"]
    rebuilt = recipe_weights(TINY_MANIFEST, seed=1)
    assert stored.keys() == rebuilt.keys()
    assert all(torch.equal(stored[key], rebuilt[key]) for key in stored)


def test_recorded_images_are_those_of_the_recipe():
    arrays = load_case(DPT, "odd")
    normalised = load_recipe().normalise(arrays["u8_1"])
    assert np.array_equal(normalised, arrays["img1"])
    grid = TokenGrid(3, 5)
    positions = np.stack(np.divmod(np.arange(15), grid.columns), axis=-1)
    assert np.array_equal(arrays["pos1"][0], positions)


@pytest.mark.parametrize("manifest", [TINY_MANIFEST, DPT])
def test_tiny_network_has_the_official_shapes(manifest):
    assert_shapes(tiny_config(manifest), manifest)


def test_full_network_has_the_official_shapes_and_size():
    network = assert_shapes(ModelConfig(), "full_dust3r_224_linear")
    assert sum(parameter.numel() for parameter in network.parameters()) == 532_342_784 - 768
    config = load_config(["configs/base.yaml", "configs/model/l3r_512.yaml"]).model
    network = assert_shapes(config, "full_dust3r_512_dpt")
    unused = 768 + 2 * 1_180_160
    assert sum(parameter.numel() for parameter in network.parameters()) == 571_171_208 - unused


def assert_shapes(config, manifest_name):
    with torch.device("meta"):
        network = PairNetwork(config)
    found = {official_key(key): list(value.shape) for key, value in network.state_dict().items()}
    assert len(found) == len(network.state_dict())
    manifest = load_manifest(manifest_name)
    unread = ("mask_token", "refinenet4.resConfUnit1", "scratch.layer_rn.")
    expected = {k: v for k, v in manifest.items() if not any(word in k for word in unread)}
    assert found == expected
    return network
