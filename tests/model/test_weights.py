import pytest
import torch

from l3r.config import GraphConfig, ModelConfig
from l3r.errors import CheckpointError
from l3r.model.light3r import Light3R
from l3r.model.weights import official_key, own_key, take_weights, translate_official
from tests.model.official import (
    PairNetwork,
    load_manifest,
    needs_recorded,
    state_dict_from_official,
    tiny_config,
)
from tests.model.official_files import SMALL_DPT, add_unread, official_state


@pytest.fixture(params=["linear", "dpt"])
def network(request):
    config = tiny_config() if request.param == "linear" else SMALL_DPT
    with torch.device("meta"):
        return Light3R(config, GraphConfig())


@pytest.fixture(scope="module")
def dpt_state():
    """What an official DPT file holds, its tensors without values."""
    with torch.device("meta"):
        return add_unread(official_state(SMALL_DPT))


def test_names_translate_there_and_back(network):
    names = [official_key(key) for key in network.state_dict()]
    for key, theirs in zip(network.state_dict(), names, strict=True):
        assert (theirs is None) == key.startswith("alignment.")
        assert theirs is None or own_key(theirs) == key
    assert len(set(names) - {None}) == len([name for name in names if name])


def test_streams_do_not_swap():
    assert official_key("decoder.parent_blocks.0.norm_y.bias") == "dec_blocks.0.norm_y.bias"
    assert own_key("dec_blocks2.11.mlp.fc1.weight") == "decoder.child_blocks.11.mlp.fc1.weight"
    assert own_key("downstream_head2.proj.bias") == "child_head.proj.bias"
    assert own_key("downstream_head1.dpt.head.4.bias") == "parent_head.out.bias"
    assert own_key("downstream_head2.dpt.scratch.refinenet1.resConfUnit1.conv2.bias") == (
        "child_head.fusions.0.skip.conv2.bias"
    )
    assert own_key("prediction_head.weight") is None
    assert own_key("mask_token") is None


@needs_recorded
@pytest.mark.parametrize(
    ("manifest", "head", "ignored"),
    [
        ("full_dust3r_224_linear", "linear", {"mask_token": 1}),
        ("full_dust3r_512_linear", "linear", {"mask_token": 1}),
        ("full_dust3r_512_dpt", "dpt", {"mask_token": 1, "refinenet4.resConfUnit1": 8}),
        (
            "full_mast3r_catmlpdpt",
            "dpt",
            {"mask_token": 1, "refinenet4.resConfUnit1": 8, "head_local_features": 8},
        ),
        ("full_croco_v2_vitlarge_basedecoder", None, {"mask_token": 1, "prediction_head": 2}),
    ],
)
def test_recorded_names_and_shapes_are_ours_one_to_one(manifest, head, ignored):
    with torch.device("meta"):
        official = {key: torch.empty(shape) for key, shape in load_manifest(manifest).items()}
        network = PairNetwork(ModelConfig(head=head or "linear"))
    for key in [key for key in official if "layer_rn" in key]:  # the same tensor, as in the file
        number = int(key.split(".")[-2]) + 1
        official[key] = official[key.replace(f"layer_rn.{number - 1}", f"layer{number}_rn")]
    translation = translate_official(official)
    assert {name: len(held) for name, held in translation.ignored.items()} == ignored
    assert len(translation.aliases) == (8 if head == "dpt" else 0)
    found = {key: value.shape for key, value in translation.weights.items()}
    wanted = network.state_dict().items()
    assert found == {k: v.shape for k, v in wanted if head or not k.split(".")[0].endswith("head")}
    stored = len(found) - len(translation.copied) + sum(ignored.values())
    assert stored + len(translation.aliases) == len(official)


def test_weights_arrive_under_our_names():
    state = official_state(tiny_config())
    network = PairNetwork(tiny_config())
    network.load_state_dict(state_dict_from_official(state, network.state_dict().keys()))
    found = {official_key(key): value for key, value in network.state_dict().items()}
    del state["mask_token"]
    assert found.keys() == state.keys()
    assert all(torch.equal(found[key], value) for key, value in state.items())


def test_missing_and_unknown_weights_are_refused_by_name():
    state = official_state()
    expected = translate_official(state).weights.keys()
    lacking = {key: value for key, value in state.items() if key != "dec_norm.bias"}
    with pytest.raises(CheckpointError, match=r"^lacks 1 weights \(dec_norm.bias\)"):
        state_dict_from_official(lacking, expected)
    for name in ("dec_norm.scale", "enc_blocks.1.norm1.bias", "head_local_features.fc1.bias"):
        with pytest.raises(CheckpointError, match=rf"^has 1 unknown weights \({name}"):
            state_dict_from_official({**state, name: torch.zeros(2)}, expected)
    many = {f"rope.{index}": torch.zeros(1) for index in range(5)}
    with pytest.raises(
        CheckpointError, match=r"5 unknown weights \(rope.0, rope.1, rope.2, \.\.\)"
    ):
        translate_official({**state, **many})


def test_a_name_made_to_fill_the_screen_stays_in_one_short_line():
    state = {**official_state(), "x\n\x1b[31m" * 1000: torch.zeros(1)}
    with pytest.raises(CheckpointError, match=r"1 unknown weights \(x\\n\\x1b") as error:
        translate_official(state)
    assert str(error.value).isprintable()
    assert len(str(error.value)) < 300


def test_rooms_that_are_not_asked_for_stay_out():
    weights = translate_official(official_state()).weights
    encoder = [key for key in weights if key.startswith("encoder.")]
    assert take_weights(weights, encoder, official_key).keys() == set(encoder)
    with pytest.raises(CheckpointError, match=r"has 1 unknown weights \(enc_norm.bias"):
        take_weights(weights, [k for k in encoder if k != "encoder.norm.bias"], official_key)


def test_the_childs_stream_is_copied_only_where_the_file_has_none():
    croco = translate_official(official_state(heads=False))
    assert all(key.startswith("decoder.child_blocks.") for key in croco.copied)
    assert len(croco.copied) == 24
    for key in croco.copied:
        assert croco.weights[key] is croco.weights[key.replace("child", "parent")]
    whole = official_state()
    assert not translate_official(whole).copied
    del whole["dec_blocks2.0.norm1.bias"]
    expected = translate_official(official_state()).weights.keys()
    with pytest.raises(CheckpointError, match=r"lacks 1 weights \(dec_blocks2.0.norm1.bias"):
        state_dict_from_official(whole, expected)


@pytest.mark.parametrize("kept", ["first", "second", "both"])
def test_either_name_of_the_shared_convolutions_will_do(dpt_state, kept):
    dropped = {"first": "layer_rn.", "second": "_rn.weight", "both": "nothing"}[kept]
    state = {key: value for key, value in dpt_state.items() if dropped not in key}
    assert len(state) == len(dpt_state) - (0 if kept == "both" else 8)
    translation = translate_official(state)
    assert translation.weights.keys() == translate_official(dpt_state).weights.keys()
    assert len(translation.aliases) == (8 if kept == "both" else 0)


def test_two_names_with_different_weights_are_refused():
    name = "downstream_head1.dpt.scratch.layer{}.weight"
    one = torch.ones(2, 2, 3, 3)
    for other in (one * 2, torch.ones(2, 2, 1, 1)):
        state = {name.format("1_rn"): one, name.format("_rn.0"): other}
        for ordered in (state, dict(reversed(state.items()))):
            with pytest.raises(CheckpointError, match=r"layer1_rn.weight and its second name"):
                translate_official(ordered)
    state[name.format("_rn.0")] = one.clone()  # equal, though stored twice
    assert translate_official(state).aliases == (name.format("_rn.0"),)
