import pytest
import torch

from l3r.errors import CheckpointError
from l3r.model.alignment import LatentAlignment
from l3r.model.weights import official_key, own_key, state_dict_from_official
from tests.model.official import PairNetwork, tiny_config


@pytest.fixture
def network():
    network = PairNetwork(tiny_config())
    network.alignment = LatentAlignment(tiny_config().alignment, 64)
    return network


@pytest.fixture
def official(network):
    """An official state dict with this network's weights."""
    named = {official_key(key): value for key, value in network.state_dict().items()}
    named.pop(None)
    return {**named, "mask_token": torch.zeros(1, 1, 48)}


def test_names_translate_there_and_back(network):
    for key in network.state_dict():
        theirs = official_key(key)
        assert (theirs is None) == key.startswith("alignment.")
        assert theirs is None or own_key(theirs) == key


def test_streams_do_not_swap():
    assert official_key("decoder.parent_blocks.0.norm_y.bias") == "dec_blocks.0.norm_y.bias"
    assert own_key("dec_blocks2.11.mlp.fc1.weight") == "decoder.child_blocks.11.mlp.fc1.weight"
    assert own_key("downstream_head2.proj.bias") == "child_head.proj.bias"
    assert own_key("prediction_head.weight") is None
    assert own_key("mask_token") is None


def test_official_weights_arrive_and_leave_the_alignment_alone(network, official):
    found = state_dict_from_official(official, network.state_dict().keys())
    result = network.load_state_dict(found, strict=False)
    assert not result.unexpected_keys
    assert all(key.startswith("alignment.") for key in result.missing_keys)
    assert all(torch.equal(network.state_dict()[key], value) for key, value in found.items())


def test_missing_and_unknown_weights_are_refused_by_name(network, official):
    expected = network.state_dict().keys()
    del official["dec_norm.bias"]
    with pytest.raises(CheckpointError, match=r"lacks 1 weights \(dec_norm.bias"):
        state_dict_from_official(official, expected)
    official["dec_norm.bias"] = official["dec_norm.weight"]
    official["prediction_head.bias"] = torch.zeros(768)
    with pytest.raises(CheckpointError, match=r"has unknown 1 weights \(prediction_head.bias"):
        state_dict_from_official(official, expected)
