"""TensorFloat-32 is on where the network multiplies and off where geometry and loss do."""

from pathlib import Path

import pytest
import torch

import l3r.model.light3r
from l3r.config import load_config
from l3r.loss.joint import JointLoss
from l3r.model.encoder import Encoder
from l3r.model.heads import LinearHead
from l3r.train.run import train
from tests.train.runs import layers


class Watched(torch.autograd.Function):
    """Hands a tensor on; notes the switch on the way there and back."""

    @staticmethod
    def forward(ctx, x, name, notes):
        ctx.name, ctx.notes = name, notes
        note(notes, name)
        return x.clone()

    @staticmethod
    def backward(ctx, grad):
        note(ctx.notes, f"{ctx.name} backward")
        return grad, None, None


def note(notes, name):
    state = (torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32)
    notes.setdefault(name, set()).add(state)


@pytest.fixture
def notes(monkeypatch):
    """What the switch is in each part of a step."""
    monkeypatch.chdir(Path(__file__).parents[2])
    notes = {}

    def watch(owner, name, label, picked=lambda result: result):
        run = getattr(owner, name)

        def watched(*args, **kwargs):
            result = run(*args, **kwargs)
            where = label
            if isinstance(args[0], torch.nn.Module):
                where = label if args[0].training else f"{label} in validation"
            value = Watched.apply(picked(result), where, notes)
            if isinstance(result, torch.Tensor):
                return value
            field = next(key for key, held in vars(result).items() if held is picked(result))
            object.__setattr__(result, field, value)
            return result

        monkeypatch.setattr(owner, name, watched)

    watch(Encoder, "forward", "encoder")
    watch(LinearHead, "forward", "head")
    watch(l3r.model.light3r, "similarity_scores", "scores")
    watch(l3r.model.light3r, "accumulate", "accumulation", lambda world: world.pts3d_world)
    watch(JointLoss, "forward", "loss", lambda terms: terms.total)
    return notes


@pytest.mark.parametrize("extra", [[], ["train.gradient_checkpointing=true", "train.tf32=false"]])
def test_only_the_network_is_rounded_forward_and_backward(hand_shards, tmp_path, notes, extra):
    settings = layers(hand_shards, tmp_path, max_steps=2, validate_every=1)
    train(load_config([*settings, *extra]))
    exact, rounded, inference = {(False, False)}, {(not extra, not extra)}, {(False, True)}
    expected = {
        **dict.fromkeys(["scores", "accumulation", "accumulation backward"], exact),
        **dict.fromkeys(["loss", "loss backward"], exact),
        **dict.fromkeys(["encoder", "encoder backward", "head", "head backward"], rounded),
        **{f"{part} in validation": inference for part in ("encoder", "head", "loss")},
    }
    assert notes == expected
