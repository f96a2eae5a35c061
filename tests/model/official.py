"""What the official networks computed on tiny weights, and our network with those weights."""

import importlib.util
import json
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from l3r.config.model import AlignmentConfig, DecoderConfig, EncoderConfig, ModelConfig
from l3r.model.decoder import PairDecoder
from l3r.model.encoder import Encoder
from l3r.model.heads import build_head
from l3r.model.weights import official_key, take_weights, translate_official

RECORDED = Path(__file__).parents[2].parent / "shared" / "model"
needs_recorded = pytest.mark.skipif(
    not RECORDED.is_dir(),
    reason=f"the recorded outputs of the official network are not in {RECORDED}",
)
TINY_MANIFEST = "tiny_dust3r_224_linear"
SEEDS = {
    "tiny_dust3r_224_linear": 1,
    "tiny_dust3r_512_dpt": 2,
    "tiny_mast3r_catmlpdpt": 3,
    "tiny_croco_v2": 4,
}
"""The manifests of tiny networks and the seeds of their weights."""


def tiny_config(manifest: str = TINY_MANIFEST, **alignment) -> ModelConfig:
    is_dpt = "dpt" in manifest
    return ModelConfig(
        encoder=EncoderConfig(width=64, depth=2, num_heads=2),
        alignment=AlignmentConfig(**{"num_blocks": 2, **alignment}),
        decoder=DecoderConfig(width=48, depth=12 if is_dpt else 4, num_heads=3),
        head="dpt" if is_dpt else "linear",
    )


class PairNetwork(nn.Module):
    """All parts that the official network has, under the names they have in ours."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.encoder = Encoder(config.encoder)
        self.decoder = PairDecoder(config.decoder, config.encoder.width)
        self.parent_head = build_head(config)
        self.child_head = build_head(config)


def state_dict_from_official(official, expected) -> dict[str, Tensor]:
    """Rename the weights of an official state dict: exactly ``expected``, of the rooms it names."""
    return take_weights(translate_official(official).weights, expected, official_key)


def load_manifest(name: str) -> dict[str, list[int]]:
    return json.loads((RECORDED / "manifests" / f"{name}.json").read_text())


def load_recipe():
    """The module that rebuilds weights and images bit for bit."""
    spec = importlib.util.spec_from_file_location("recipe", RECORDED / "recipe.py")
    recipe = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(recipe)
    return recipe


def recipe_weights(name: str, seed: int) -> dict[str, Tensor]:
    arrays = load_recipe().state_dict(load_manifest(name), seed)
    return {key: torch.from_numpy(array) for key, array in arrays.items()}


@lru_cache(maxsize=6)
def tiny_network(dtype: torch.dtype, manifest: str = TINY_MANIFEST) -> PairNetwork:
    network = PairNetwork(tiny_config(manifest))
    official = recipe_weights(manifest, SEEDS[manifest])
    has_heads = any(key.startswith("downstream_head") for key in official)  # CroCo's has none
    expected = [key for key in network.state_dict() if has_heads or "_head." not in key]
    found = state_dict_from_official(official, expected)
    network.load_state_dict(found, strict=has_heads)
    return network.to(dtype).requires_grad_(requires_grad=False)


def load_case(manifest: str, case: str) -> dict[str, np.ndarray]:
    with np.load(RECORDED / "fixtures" / f"{manifest}_{case}.npz") as arrays:
        return dict(arrays)
