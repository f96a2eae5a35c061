"""What the official DUSt3R network computed on tiny weights, and our network with those weights."""

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
from l3r.model.weights import state_dict_from_official

RECORDED = Path(__file__).parents[2].parent / "shared" / "model"
needs_recorded = pytest.mark.skipif(
    not RECORDED.is_dir(),
    reason=f"the recorded outputs of the official network are not in {RECORDED}",
)
TINY_MANIFEST = "tiny_dust3r_224_linear"
FULL_MANIFEST = "full_dust3r_224_linear"
CASES = ["landscape", "portrait", "mixed", "square", "odd"]


def tiny_config(**alignment) -> ModelConfig:
    return ModelConfig(
        encoder=EncoderConfig(width=64, depth=2, num_heads=2),
        alignment=AlignmentConfig(**{"num_blocks": 2, **alignment}),
        decoder=DecoderConfig(width=48, depth=4, num_heads=3),
    )


class PairNetwork(nn.Module):
    """All parts that the official network has, under the names they have in ours."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.encoder = Encoder(config.encoder)
        self.decoder = PairDecoder(config.decoder, config.encoder.width)
        self.parent_head = build_head(config)
        self.child_head = build_head(config)


def load_manifest(name: str) -> dict[str, list[int]]:
    return json.loads((RECORDED / "manifests" / f"{name}.json").read_text())


def recipe_weights(name: str, seed: int) -> dict[str, Tensor]:
    spec = importlib.util.spec_from_file_location("recipe", RECORDED / "recipe.py")
    recipe = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(recipe)
    arrays = recipe.state_dict(load_manifest(name), seed)
    return {key: torch.from_numpy(array) for key, array in arrays.items()}


@lru_cache(maxsize=2)
def tiny_network(dtype: torch.dtype) -> PairNetwork:
    network = PairNetwork(tiny_config())
    official = recipe_weights(TINY_MANIFEST, seed=1)
    network.load_state_dict(state_dict_from_official(official, network.state_dict().keys()))
    return network.to(dtype).requires_grad_(requires_grad=False)


def load_case(case: str) -> dict[str, np.ndarray]:
    with np.load(RECORDED / "fixtures" / f"{TINY_MANIFEST}_{case}.npz") as arrays:
        return dict(arrays)
