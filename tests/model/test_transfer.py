"""What goes from a file into a network, part by part."""

import dataclasses

import pytest
import torch

from l3r.config import AlignmentConfig, DptConfig, EncoderConfig, GraphConfig
from l3r.errors import CheckpointError
from l3r.model.light3r import Light3R
from l3r.model.transfer import WeightSource, fill_network, plan_transfer
from tests.model.official_files import SMALL, SMALL_DPT

ALIGNED = dataclasses.replace(SMALL, alignment=AlignmentConfig(num_blocks=1, num_heads=2))
EVERYTHING = frozenset({"encoder", "decoder", "parent_head", "child_head", "alignment"})


def build(config, seed=0):
    torch.manual_seed(seed)
    return Light3R(config, GraphConfig())


def source(config=ALIGNED, seed=1, **changes):
    known = {"where": "file", "kind": "Light3R checkpoint", "config": config, "rooms": EVERYTHING}
    return WeightSource(**{**known, "weights": build(config, seed).state_dict(), **changes})


def fates(transfer):
    return {row.part: row.fate for row in transfer.rows}


def test_a_network_of_the_same_configuration_takes_everything():
    network, given = build(ALIGNED), source()
    transfer = plan_transfer(given, network, ALIGNED)
    assert set(fates(transfer).values()) == {"loaded"}
    fill_network(network, transfer, given)
    assert all(torch.equal(v, given.weights[k]) for k, v in network.state_dict().items())
    total = sum(parameter.numel() for parameter in network.parameters())
    assert transfer.count("loaded") == total


@pytest.mark.parametrize(
    ("alignment", "remark"),
    [
        (AlignmentConfig(num_blocks=2, num_heads=2), "identity until trained"),
        (AlignmentConfig(num_blocks=1, num_heads=4), "identity until trained"),
        (AlignmentConfig(num_blocks=1, num_heads=2, output="paper"), "random: no identity"),
    ],
)
def test_another_alignment_stays_fresh_and_the_rest_is_loaded(alignment, remark):
    config = dataclasses.replace(ALIGNED, alignment=alignment)
    network, given = build(config), source()
    before = {key: value.clone() for key, value in network.state_dict().items()}
    transfer = plan_transfer(given, network, config)
    fill_network(network, transfer, given)
    rows = {row.part: row for row in transfer.rows}
    assert (rows["alignment"].fate, rows["alignment"].remark) == ("fresh", remark)
    assert rows["alignment of the file"].fate == "ignored"
    for key, value in network.state_dict().items():
        expected = before if key.startswith("alignment.") else given.weights
        assert torch.equal(value, expected[key])


def test_heads_of_another_kind_stay_fresh():
    linear = dataclasses.replace(SMALL_DPT, head="linear")
    channels = DptConfig(stage_channels=[4, 4, 4, 4], fusion_channels=4, out_channels=4)
    small_dpt = dataclasses.replace(SMALL_DPT, dpt=channels)
    for config, given, remark in (
        (small_dpt, source(linear), "the file's is linear"),
        (linear, source(small_dpt), "the file's is dpt"),
        (
            dataclasses.replace(small_dpt, dpt=DptConfig(fusion_channels=8)),
            source(small_dpt),
            "the file's has other channels",
        ),
    ):
        with torch.device("meta"):
            network = Light3R(config, GraphConfig())
        transfer = plan_transfer(given, network, config)
        rows = {row.part: row for row in transfer.rows}
        for head in ("parent head", "child head"):
            assert (rows[head].fate, rows[head].remark) == ("fresh", remark)
            assert rows[f"{head} of the file"].fate == "ignored"
        assert rows["encoder"].fate == rows["decoder"].fate == rows["alignment"].fate == "loaded"
        in_file = sum(value.numel() for value in given.weights.values())
        assert transfer.count("loaded", "ignored") == in_file
        in_network = sum(parameter.numel() for parameter in network.parameters())
        assert transfer.count("loaded", "fresh") == in_network


def test_a_network_without_alignment_leaves_the_files_out():
    config = dataclasses.replace(SMALL, alignment=AlignmentConfig(num_blocks=0))
    transfer = plan_transfer(source(), build(config), config)
    assert fates(transfer)["alignment of the file"] == "ignored"
    assert "alignment" not in fates(transfer)


@pytest.mark.parametrize(
    "change", [{"width": 32}, {"depth": 2}, {"num_heads": 4}, {"patch_size": 8}]
)
def test_sizes_that_differ_are_refused_even_where_shapes_agree(change):
    encoder = EncoderConfig(**{"width": 16, "depth": 1, "num_heads": 2, **change})
    config = dataclasses.replace(ALIGNED, encoder=encoder)
    ((key, value),) = change.items()
    with pytest.raises(CheckpointError, match=rf"file: its encoder has .*{key} {value}") as error:
        plan_transfer(source(), build(config), config)
    assert "change model.encoder" in str(error.value)


def test_a_file_that_lacks_what_it_claims_is_refused():
    whole = source()
    for dropped in ("encoder.norm.bias", "parent_head.proj.bias", "alignment.out.weight"):
        weights = {key: value for key, value in whole.weights.items() if key != dropped}
        with pytest.raises(CheckpointError, match=rf"file: lacks 1 weights \({dropped}\)"):
            plan_transfer(source(weights=weights), build(ALIGNED), ALIGNED)
    weights = {**whole.weights, "encoder.norm.scale": torch.zeros(1)}
    with pytest.raises(CheckpointError, match=r"file: has 1 unknown weights \(encoder.norm.scale"):
        plan_transfer(source(weights=weights), build(ALIGNED), ALIGNED)


@pytest.mark.parametrize("stray", ["alignment.out.weight", "wings.weight"])
def test_weights_of_a_part_that_the_file_does_not_claim_are_refused(stray):
    weights = {k: v for k, v in source().weights.items() if not k.startswith("alignment.")}
    given = source(weights={**weights, stray: torch.zeros(2)}, rooms=EVERYTHING - {"alignment"})
    with pytest.raises(CheckpointError, match=rf"file: has 1 weights of parts .*\({stray}"):
        plan_transfer(given, build(ALIGNED), ALIGNED)


def test_a_weight_of_another_shape_is_refused_under_the_files_name():
    weights = {**source().weights, "encoder.norm.bias": torch.zeros(17)}
    for official, name in ((True, "enc_norm.bias"), (False, "encoder.norm.bias")):
        given = source(weights=weights, is_official=official)
        with pytest.raises(CheckpointError, match=rf"file: {name} is of shape \[17\], .*\[16\]"):
            plan_transfer(given, build(ALIGNED), ALIGNED)


@pytest.mark.parametrize(
    "bad", [torch.full((16,), torch.nan), torch.full((16,), 1e300, dtype=torch.float64)]
)
def test_a_weight_that_is_not_finite_in_float32_is_refused_by_name(bad):
    network = build(ALIGNED)
    given = source(weights={**source().weights, "encoder.norm.bias": bad})
    transfer = plan_transfer(given, network, ALIGNED)
    before = network.state_dict()["encoder.norm.weight"].clone()
    with pytest.raises(CheckpointError, match=r"file: encoder.norm.bias holds .*not finite"):
        fill_network(network, transfer, given)
    assert torch.equal(network.state_dict()["encoder.norm.weight"], before)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_weights_of_any_precision_become_float32(dtype):
    network, exact = build(ALIGNED), source()
    given = source(weights={key: value.to(dtype) for key, value in exact.weights.items()})
    fill_network(network, plan_transfer(given, network, ALIGNED), given)
    for key, value in network.state_dict().items():
        assert value.dtype == torch.float32
        assert torch.equal(value, exact.weights[key].to(dtype).float())


def test_the_table_fits_80_columns_and_names_every_part():
    config = dataclasses.replace(ALIGNED, alignment=AlignmentConfig(num_blocks=2, num_heads=2))
    transfer = plan_transfer(source(), build(config), config)
    table = transfer.to_table()
    assert max(map(len, table.splitlines())) <= 80
    lines = [" ".join(line.split()) for line in table.splitlines()]
    encoder = sum(p.numel() for p in build(config).encoder.parameters())
    assert f"encoder loaded 16 {encoder:,}" in lines
    assert any(line.startswith("alignment fresh") for line in lines)
    loaded, ignored = transfer.count("loaded"), transfer.count("ignored")
    assert f"file: {loaded:,} parameters loaded + {ignored:,} ignored" in lines
