"""Official files as a source: their settings are parsed, their weights held against them."""

import argparse
import math
from pathlib import Path

import pytest
import torch

from l3r.config import GraphConfig
from l3r.errors import CheckpointError
from l3r.model.light3r import Light3R
from l3r.model.official import official_source
from l3r.model.official_args import describe_network, guess_class, parse_constructor
from l3r.model.transfer import plan_transfer
from l3r.model.weight_files import read_weight_file
from tests.model.official import RECORDED, load_manifest, needs_recorded
from tests.model.official_files import (
    MAST3R,
    MODES,
    SMALL,
    SMALL_DPT,
    add_unread,
    call,
    official_state,
    sizes,
    write_hub_folder,
    write_pth,
)

FILE = Path("x.pth")
# As public logs of the released code show it.
RELEASED_MAST3R = (
    "AsymmetricMASt3R(enc_depth=24, dec_depth=12, enc_embed_dim=1024, dec_embed_dim=768, "
    "enc_num_heads=16, dec_num_heads=12, pos_embed='RoPE100',img_size=(512, 512), "
    "head_type='catmlp+dpt', output_mode='pts3d+desc24', depth_mode=('exp', -inf, inf), "
    "conf_mode=('exp', 1, inf), patch_embed_cls='PatchEmbedDust3R', two_confs=True, "
    "desc_conf_mode=('exp', 0, inf), landscape_only=False)"
)


def content(state=None, text=None):
    state = official_state() if state is None else state
    return {"model": state, "args": argparse.Namespace(model=call() if text is None else text)}


def source_of(state=None, text=None):
    return official_source(FILE, content(state, text))


def test_the_released_constructor_is_read():
    name, settings = parse_constructor(RELEASED_MAST3R)
    assert name == "AsymmetricMASt3R"
    assert settings["conf_mode"] == ("exp", 1, math.inf)
    assert settings["depth_mode"] == ("exp", -math.inf, math.inf)
    kind, config, has_heads = describe_network(name, settings)
    assert "MASt3R" in kind
    assert has_heads
    assert (config.head, config.image_size) == ("dpt", [384, 512])
    encoder, decoder = config.encoder, config.decoder
    assert (encoder.width, encoder.depth, encoder.num_heads, encoder.patch_size) == (
        *(1024, 24, 16),
        16,
    )
    assert (decoder.width, decoder.depth, decoder.num_heads) == (768, 12, 12)


def test_the_order_of_keywords_does_not_matter():
    name, rest = RELEASED_MAST3R.split("(", 1)
    words = rest.removesuffix(")").replace("(512, 512)", "[512,512]")
    shuffled = words.replace(", dec_depth=12", "", 1) + ", dec_depth=12"
    first, second = (
        describe_network(*parse_constructor(f"{name}({w})")) for w in (words, shuffled)
    )
    assert first == second == describe_network(*parse_constructor(RELEASED_MAST3R))


@pytest.mark.parametrize(
    ("img_size", "expected"),
    [("(224, 224)", [224, 224]), ("224", [224, 224]), ("(512, 512)", [384, 512])],
)
def test_image_sizes_become_landscapes(img_size, expected):
    settings = parse_constructor(call(img_size=img_size))
    assert describe_network(*settings)[1].image_size == expected


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('touch MARKER')",
        call().replace("pos_embed='RoPE100'", "pos_embed=__import__('os').system('touch MARKER')"),
        call().replace("(224, 224)", "(lambda: open('MARKER', 'w'))()"),
        call().replace("enc_depth=1", "**dict(enc_depth=1)"),
        "AsymmetricCroCo3DStereo(1, 2)",
        "AsymmetricCroCo3DStereo",
        "AsymmetricCroCo3DStereo(",
        "(" * 5000 + ")" * 5000,
        "CroCoNet(" + "-" * 9000 + "1)",
        "CroCoNet(a=\0)",
        "x" * 100_000,
        "",
        None,
        7,
    ],
)
def test_text_that_is_no_plain_constructor_is_refused_and_never_run(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match=r"args\.model is .*expected a constructor") as error:
        parse_constructor(text)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 250
    assert not (tmp_path / "MARKER").exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("AsymmetricCroCo3DStereo(", "AsymmetricCroCo4D(", "class AsymmetricCroCo4D"),
        ("head_type='linear'", "head_type='mlp'", "head_type 'mlp', expected one of"),
        ("head_type='linear'", "head_type=['linear']", "head_type .*'linear'.*expected one of"),
        ("head_type='linear', ", "", "head_type None, expected one of"),
        ("'RoPE100'", "'RoPE10'", "pos_embed is 'RoPE10', expected 'RoPE100'"),
        ("'RoPE100'", "'cosine'", "pos_embed is 'cosine'.*CroCo v1"),
        ("-inf, inf", "0, inf", r"depth_mode is \('exp', 0, inf\), expected"),
        ("1, inf", "0, inf", r"conf_mode is \('exp', 0, inf\), expected"),
        ("='pts3d'", "='pts3d+desc24'", r"output_mode is 'pts3d\+desc24', expected 'pts3d'"),
        ("img_size", "mlp_ratio=8, img_size", "mlp_ratio is 8, expected 4"),
        ("img_size", "patch_size=14, img_size", "patch_size is 14, expected 16"),
        ("img_size", "norm_im2_in_dec=False, img_size", "norm_im2_in_dec is False, expected True"),
        ("img_size", "patch_embed_cls='Conv', img_size", "patch_embed_cls is 'Conv', expected one"),
        ("img_size", "wings=2, img_size", "unknown wings"),
        ("enc_depth=1, ", "", "settings lack enc_depth"),
        ("pos_embed='RoPE100', ", "", "settings lack pos_embed"),
        ("enc_depth=1,", "enc_depth='1',", "enc_depth is '1', expected a positive whole number"),
        ("enc_depth=1,", "enc_depth=True,", "enc_depth is True, expected a positive"),
        ("enc_depth=1,", f"enc_depth=0x1{'0' * 5000},", "enc_depth is a number of 20001 bits"),
        ("enc_num_heads=2", "enc_num_heads=3", r"encoder.num_heads is 3"),
        ("(224, 224)", "(224, 224, 3)", "img_size is .*expected two numbers"),
        ("(224, 224)", "(224, 200)", "image_size"),
    ],
)
def test_settings_of_another_network_are_refused_by_name(old, new, message):
    assert old in call()
    with pytest.raises(CheckpointError, match=message) as error:
        source_of(text=call().replace(old, new))
    assert str(error.value).startswith("x.pth: ")
    assert "\n" not in str(error.value)


def test_a_mast3r_file_has_dpt_heads_and_descriptors_are_left_out():
    rest = f"{MAST3R}, desc_conf_mode=('exp', 0, inf)"
    text = call(SMALL_DPT, name="AsymmetricMASt3R", rest=rest)
    with torch.device("meta"):
        state = add_unread(official_state(SMALL_DPT))
        for head in (1, 2):
            for part in ("fc1", "fc2"):
                state[f"downstream_head{head}.head_local_features.{part}.weight"] = torch.zeros(
                    4, 4
                )
    source = source_of(state, text)
    assert source.config.head == "dpt"
    fates = {row.part: (row.fate, row.num_entries) for row in source.leftover}
    assert fates == {
        "mask_token": ("ignored", 1),
        "refinenet4.resConfUnit1": ("ignored", 2),
        "head_local_features": ("ignored", 4),
        "scratch.layer_rn": ("second name", 8),
    }
    with pytest.raises(CheckpointError, match="AsymmetricMASt3R with head_type 'dpt'"):
        source_of(state, text.replace("catmlp+dpt", "dpt"))


def test_croco_v2_says_its_sizes_in_either_of_two_places():
    state = official_state(heads=False)
    kwargs = official_source(FILE, {"model": state, "croco_kwargs": sizes(SMALL)})
    args = source_of(state, call(name="CroCoNet"))
    assert kwargs.config == args.config
    assert kwargs.rooms == args.rooms == {"encoder", "decoder"}
    assert kwargs.config.image_size == [224, 224]
    with pytest.raises(CheckpointError, match=r"neither args nor croco_kwargs.*CroCo v1"):
        official_source(FILE, {"model": state})
    cosine = {**sizes(SMALL), "pos_embed": "cosine"}
    with pytest.raises(CheckpointError, match=r"pos_embed is 'cosine'.*CroCo v1"):
        official_source(FILE, {"model": state, "croco_kwargs": cosine})
    with pytest.raises(CheckpointError, match="unknown 3"):
        official_source(FILE, {"model": state, "croco_kwargs": {**sizes(SMALL), 3: 4}})


def test_a_folder_of_the_hub_is_the_same_source_as_the_file(tmp_path):
    folder = write_hub_folder(tmp_path / "hub")
    one = official_source(folder, read_weight_file(folder))
    two = source_of()
    assert (one.kind, one.config, one.rooms, one.leftover) == (
        *(two.kind, two.config, two.rooms),
        two.leftover,
    )
    assert one.weights.keys() == two.weights.keys()
    assert all(torch.equal(one.weights[key], value) for key, value in two.weights.items())


def test_a_folder_does_not_name_its_class_but_its_heads_do():
    assert guess_class({"head_type": "catmlp+dpt"}) == "AsymmetricMASt3R"
    assert guess_class({"head_type": "dpt"}) == "AsymmetricCroCo3DStereo"
    assert guess_class({}) == "CroCoNet"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"enc_norm.bias": torch.zeros(16, dtype=torch.int64)}, "enc_norm.bias is .*int64"),
        ({"enc_norm.bias": torch.zeros(16, dtype=torch.complex64)}, "enc_norm.bias is .*complex64"),
        ({"enc_norm.bias": torch.zeros(16).to_sparse()}, "enc_norm.bias is a sparse_coo tensor"),
        ({"enc_norm.bias": torch.zeros(()).expand(16)}, "a tensor larger than what is stored"),
        ({"enc_norm.bias": [0.0] * 16}, "enc_norm.bias is a list"),
        ({7: torch.zeros(16)}, "7 is no name"),
    ],
)
def test_weights_that_are_no_floating_point_tensors_are_refused(change, message):
    with pytest.raises(CheckpointError, match=message):
        source_of({**official_state(), **change})
    with pytest.raises(CheckpointError, match="its weights are a list"):
        source_of([])


def test_sizes_are_held_against_the_weights_before_anything_is_built():
    for old, new in (
        ("enc_depth=1", "enc_depth=1000000000"),
        ("dec_depth=1", "dec_depth=2"),
        ("enc_embed_dim=16", "enc_embed_dim=16000000000"),
        ("dec_embed_dim=16", "dec_embed_dim=32"),
    ):
        with pytest.raises(CheckpointError, match=r"its settings say .*its weights have 1 blocks"):
            source_of(text=call().replace(old, new))
    whole = official_state()
    with pytest.raises(CheckpointError, match="width None"):
        source_of({key: value for key, value in whole.items() if key != "enc_norm.weight"})


@needs_recorded
def test_the_recorded_files_are_read_and_match_their_settings():
    linear, croco = (
        official_source(path, read_weight_file(path, mapped=True))
        for path in (
            RECORDED / "fixtures" / "tiny_dust3r_224_linear.pth",
            RECORDED / "fixtures" / "tiny_croco_v2.pth",
        )
    )
    assert linear.kind.startswith("DUSt3R, linear")
    assert croco.kind.startswith("CroCo v2")
    assert croco.config.encoder == linear.config.encoder
    assert len(croco.copied) == len(croco.weights) - 128


@needs_recorded
@pytest.mark.parametrize(
    ("manifest", "text", "ignored", "total"),
    [
        ("full_dust3r_224_linear", None, 768, 532_342_784),
        ("full_dust3r_512_dpt", "dpt", 768 + 2 * 1_180_160, 571_171_208),
        (
            "full_mast3r_catmlpdpt",
            RELEASED_MAST3R,
            768 + 2 * 1_180_160 + 2 * 58_733_824,
            688_638_856,
        ),
        ("full_croco_v2_vitlarge_basedecoder", "croco", 768 + 768 * 769, 417_918_720),
    ],
)
def test_every_parameter_of_a_full_size_file_is_accounted_for(manifest, text, ignored, total):
    """By names and shapes: nothing here has values."""
    with torch.device("meta"):
        state = {key: torch.empty(shape) for key, shape in load_manifest(manifest).items()}
    for key in [key for key in state if "layer_rn." in key]:  # one tensor, as in the file
        index = int(key.split(".")[-2])
        state[key] = state[key.replace(f"layer_rn.{index}", f"layer{index + 1}_rn")]
    if text != RELEASED_MAST3R:
        words = RELEASED_MAST3R.split("(", 1)[1].split(", img_size")[0].split(",img_size")[0]
        heads = f"img_size=(512, 512), head_type='{text or 'linear'}', output_mode='pts3d', {MODES}"
        text = (
            f"CroCoNet({words})"
            if text == "croco"
            else f"AsymmetricCroCo3DStereo({words}, {heads})"
        )
    source = source_of(state, text)
    with torch.device("meta"):
        network = Light3R(source.config, GraphConfig())
    transfer = plan_transfer(source, network, source.config)
    assert transfer.count("ignored") == ignored
    assert transfer.count("loaded") + transfer.count("ignored") == total
    entries = sum(r.num_entries for r in transfer.rows if r.fate not in ("fresh", "copied"))
    assert entries == len(state)
    in_network = sum(parameter.numel() for parameter in network.parameters())
    assert transfer.count("loaded", "copied", "fresh") == in_network
    fresh = {row.part for row in transfer.rows if row.fate == "fresh"}
    heads = {"parent head", "child head"} if "CroCoNet" in text else set()
    assert fresh == {"alignment", *heads}


def test_a_file_of_half_the_precision_is_a_source_too(tmp_path):
    state = {key: value.half() for key, value in official_state().items()}
    path = write_pth(tmp_path / "half.pth", state)
    source = official_source(path, read_weight_file(path, mapped=True))
    assert {value.dtype for value in source.weights.values()} == {torch.float16}


def endless():
    inner = []
    inner.append(inner)
    return inner


@pytest.mark.parametrize(
    "value", [torch.tensor([1, 1]), endless(), {"a": 1}, [[[[[[1]]]]]]], ids=str
)
def test_settings_that_are_no_plain_values_are_refused(value):
    with pytest.raises(CheckpointError, match=r"mlp_ratio is .*expected") as error:
        describe_network("CroCoNet", {"mlp_ratio": value})
    assert "\n" not in str(error.value)
