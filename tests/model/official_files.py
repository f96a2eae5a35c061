"""Files as the official training codes write them, of any size, with weights of our making."""

import argparse
import json
import math

import torch
from safetensors.torch import save_file

from l3r.config.model import DecoderConfig, EncoderConfig, ModelConfig
from l3r.model.weights import official_key
from tests.model.official import PairNetwork

SMALL = ModelConfig(
    encoder=EncoderConfig(width=16, depth=1, num_heads=2),
    decoder=DecoderConfig(width=16, depth=1, num_heads=2),
)
SMALL_DPT = ModelConfig(
    encoder=EncoderConfig(width=16, depth=1, num_heads=2),
    decoder=DecoderConfig(width=16, depth=4, num_heads=2),
    head="dpt",
)
MODES = "depth_mode=('exp', -inf, inf), conf_mode=('exp', 1, inf)"
MAST3R = "head_type='catmlp+dpt', output_mode='pts3d+desc24', two_confs=True"


def sizes(config):
    """The arguments that give the sizes of both transformers."""
    parts = (("enc", config.encoder), ("dec", config.decoder))
    given = {}
    for name, part in parts:
        given[f"{name}_embed_dim"] = part.width
        given[f"{name}_depth"] = part.depth
        given[f"{name}_num_heads"] = part.num_heads
    return {**given, "pos_embed": "RoPE100"}


def call(config=SMALL, *, name="AsymmetricCroCo3DStereo", img_size=(224, 224), rest=None):
    """``args.model`` as the released files have it."""
    written = ", ".join(f"{key}={value!r}" for key, value in sizes(config).items())
    if name == "CroCoNet":
        return f"CroCoNet({written})"
    rest = rest or f"head_type='{config.head}', output_mode='pts3d'"
    return f"{name}({written}, img_size={img_size}, {rest}, {MODES})"


def official_state(config=SMALL, *, heads=True, seed=0):
    """An official state dict with fresh weights; without heads it is CroCo's."""
    torch.manual_seed(seed)
    weights = PairNetwork(config).state_dict()
    named = {official_key(key): value for key, value in weights.items()}
    if not heads:
        named = {k: v for k, v in named.items() if not k.startswith(("downstream", "dec_blocks2"))}
        named["prediction_head.weight"] = torch.zeros(768, config.decoder.width)
        named["prediction_head.bias"] = torch.zeros(768)
    return {"mask_token": torch.zeros(1, 1, config.decoder.width), **named}


def add_unread(state):
    """Add what official DPT files hold besides: second names, and a unit that nothing reads."""
    unit = "scratch.refinenet4.resConfUnit1.conv1.weight"
    for head in ("downstream_head1.dpt.", "downstream_head2.dpt."):
        for index in range(4):
            value = state[f"{head}scratch.layer{index + 1}_rn.weight"]
            state[f"{head}scratch.layer_rn.{index}.weight"] = value
        state[head + unit] = torch.zeros(256, 256, 3, 3)
    return state


def write_pth(path, state=None, text=None):
    """Write a ``.pth``."""
    args = argparse.Namespace(model=call() if text is None else text, output_dir="", lr=1e-4)
    state = official_state() if state is None else state
    torch.save({"args": args, "model": state, "epoch": 0, "best_so_far": 0.0}, path)
    return path


def write_hub_folder(folder, state=None, settings=None):
    """Write a folder as a download from the hub makes it."""
    folder.mkdir()
    modes = {"depth_mode": ["exp", -math.inf, math.inf], "conf_mode": ["exp", 1, math.inf]}
    rest = {"head_type": "linear", "output_mode": "pts3d", "img_size": [224, 224]}
    plain = {**sizes(SMALL), **modes, **rest, "landscape_only": False, **(settings or {})}
    (folder / "config.json").write_text(json.dumps(plain))  # infinities as bare Infinity
    save_file(official_state() if state is None else state, folder / "model.safetensors")
    return folder
