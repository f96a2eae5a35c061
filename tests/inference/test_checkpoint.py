import pickle

import pytest
import torch

import l3r
from l3r import Light3R
from l3r.errors import CheckpointError, ConfigError
from l3r.inference.checkpoint import (
    build_untrained,
    load_model_and_config,
    read_checkpoint,
    write_model,
)
from tests.train.runs import TINY


class Trap:
    """Unpickling this would run code."""

    def __reduce__(self):
        return (exec, ("raise SystemExit('executed')",))


@pytest.fixture
def written(tmp_path):
    model, config = build_untrained(TINY)
    write_model(tmp_path / "model.ckpt", model, config)
    return tmp_path / "model.ckpt", model, config


def test_a_written_model_loads_as_it_was(written):
    path, model, config = written
    loaded, found = load_model_and_config(path, settings=["inference.min_conf=7"])
    assert found.inference.min_conf == 7
    assert found.model == config.model
    for one, two in zip(model.parameters(), loaded.parameters(), strict=True):
        assert torch.equal(one, two)
    assert not l3r.load_model(str(path)).training


def test_untrained_weights_depend_on_the_seed_alone():
    first, second = (build_untrained(TINY)[0] for _ in range(2))
    other, _ = build_untrained([*TINY, "train.seed=1"])
    assert all(
        torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True)
    )
    assert not all(
        torch.equal(a, b) for a, b in zip(first.parameters(), other.parameters(), strict=True)
    )


def test_a_checkpoint_that_would_run_code_is_refused_and_runs_nothing(tmp_path):
    path = tmp_path / "trap.ckpt"
    torch.save({"state_dict": Trap(), "l3r_config": {}}, path)
    with pytest.raises(CheckpointError, match=r"trap\.ckpt: cannot be read safely"):
        read_checkpoint(path)
    path.write_bytes(pickle.dumps(Trap()))  # what torch would take for an old checkpoint
    with pytest.raises(CheckpointError, match="cannot be read safely"):
        read_checkpoint(path)


@pytest.mark.parametrize("content", [b"", b"junk", b"PK\x03\x04 half a zip"])
def test_a_file_that_is_no_checkpoint_gets_one_line(tmp_path, content):
    path = tmp_path / "x.ckpt"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"x\.ckpt") as error:
        read_checkpoint(path)
    assert "\n" not in str(error.value)


def test_a_cut_off_checkpoint_gets_one_line(written):
    path, _, _ = written
    path.write_bytes(path.read_bytes()[:-4000])
    with pytest.raises(CheckpointError, match="cannot be read"):
        l3r.load_model(path)


def test_other_files_of_torch_are_told_apart(tmp_path, written):
    path = tmp_path / "other.pt"
    torch.save({"weights": torch.zeros(2)}, path)
    with pytest.raises(CheckpointError, match="no l3r_config and no state_dict inside"):
        read_checkpoint(path)
    with pytest.raises(CheckpointError, match="no such file"):
        read_checkpoint(tmp_path / "nowhere.ckpt")
    checkpoint = read_checkpoint(written[0])
    checkpoint["l3r_config"]["model"]["decoder"]["width"] = 32
    torch.save(checkpoint, path)
    with pytest.raises(CheckpointError, match="weights do not fit the configuration"):
        l3r.load_model(path)
    checkpoint["l3r_config"]["model"]["decoder"]["wings"] = 2
    torch.save(checkpoint, path)
    with pytest.raises(ConfigError, match=r"other\.pt: Key 'wings'"):
        l3r.load_model(path)


@pytest.mark.parametrize(
    ("part", "key", "value"),
    [
        ("encoder", "width", 2_000_000),
        ("encoder", "width", 4 * 10**18),
        ("encoder", "width", 4 * 10**30),
        ("encoder", "depth", 10**9),
        ("decoder", "width", 1_200_000),
        ("alignment", "num_blocks", 10**9),
    ],
)
@pytest.mark.parametrize("load", [l3r.load_model, Light3R.from_pretrained])
def test_a_checkpoint_that_asks_for_a_giant_is_refused_before_it_is_built(
    written, tmp_path, load, part, key, value
):
    checkpoint = read_checkpoint(written[0])
    checkpoint["l3r_config"]["model"][part][key] = value
    path = tmp_path / "giant.ckpt"
    torch.save(checkpoint, path)
    with pytest.raises(CheckpointError, match=r"giant\.ckpt: .*do not fit the config") as error:
        load(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("damage", ["nan", "meta", "nested"])
@pytest.mark.parametrize("load", [l3r.load_model, Light3R.from_pretrained])
def test_weights_without_finite_numbers_are_refused(written, tmp_path, load, damage):
    checkpoint = read_checkpoint(written[0])
    key = "model.encoder.norm.weight"
    weight = checkpoint["state_dict"][key]
    checkpoint["state_dict"][key] = {
        "nan": torch.full_like(weight, torch.nan),
        "meta": weight.to("meta"),
        "nested": torch.nested.nested_tensor([weight, weight[:2]]),
    }[damage]
    path = tmp_path / "bad.ckpt"
    torch.save(checkpoint, path)
    with pytest.raises(CheckpointError, match=r"bad\.ckpt: .*norm\.weight") as error:
        load(path)
    assert "\n" not in str(error.value)
