"""An official file becomes a checkpoint that answers for pairs as the original."""

import re
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import torch

import l3r
from l3r.errors import CheckpointError, ConfigError
from l3r.inference.checkpoint import build_untrained, load_model_and_config, read_checkpoint
from l3r.inference.weights import describe_weights, import_official, initialise, open_weights
from tests.model.official import (
    RECORDED,
    PairNetwork,
    load_case,
    needs_recorded,
    recipe_weights,
    state_dict_from_official,
    tiny_config,
)
from tests.model.official_files import (
    MAST3R,
    SMALL,
    call,
    official_state,
    write_hub_folder,
    write_pth,
)
from tests.model.test_official_files import RELEASED_MAST3R

LINEAR = "tiny_dust3r_224_linear"
FEW = ["model.alignment.num_blocks=1", "model.alignment.num_heads=2"]
BOUND = 2e-5  # of a tensor's largest value, as in tests/model/test_official.py


def imported(path, out, *settings, **options):
    report = import_official(path, out, list(settings), **options)
    return report, l3r.load_model(out)


def pairs(model, arrays):
    """Points and confidences of both views of recorded pairs, through the latent alignment."""
    images = [((torch.from_numpy(arrays[f"u8_{v}"]) / 255 - 0.5) / 0.5) for v in (1, 2)]
    images = [image.permute(0, 3, 1, 2) for image in images]
    grids = [model.encoder.token_grid(*image.shape[2:]) for image in images]
    tokens = [model.encoder(image) for image in images]
    levels = model.alignment.update_summaries(torch.stack([t.mean(1) for t in tokens], 1))
    aligned = [model.alignment.align(t, levels) for t in tokens]
    edges = model.decode(*aligned, *grids)
    return tokens, aligned, edges


@needs_recorded
@pytest.mark.parametrize("case", ["landscape", "mixed"])
def test_an_imported_network_answers_for_pairs_as_the_recorded_one(tmp_path, case):
    path = RECORDED / "fixtures" / f"{LINEAR}.pth"
    arrays = load_case(LINEAR, case)
    report, model = imported(path, tmp_path / "init.ckpt", "model.alignment.num_heads=4")
    with torch.no_grad():
        tokens, aligned, edges = pairs(model, arrays)
    # The alignment is there and is the identity, to the last bit.
    assert len(model.alignment.cross_blocks) == 4
    assert all(torch.equal(one, two) for one, two in zip(tokens, aligned, strict=True))
    for found, name in (
        (edges.parent_pts3d, "view1_pts3d"),
        (edges.child_pts3d, "view2_pts3d_in_other_view"),
        (edges.parent_log_conf.exp(), "view1_conf"),
        (edges.child_log_conf.exp(), "view2_conf"),
    ):
        expected = torch.from_numpy(arrays[name]).reshape(found.shape)
        assert (found - expected).abs().max() <= BOUND * expected.abs().max()
    assert "555,856 parameters loaded + 48 ignored" in report


@needs_recorded
def test_an_imported_mast3r_answers_for_pairs_as_the_recorded_one(tmp_path):
    name = "tiny_mast3r_catmlpdpt"
    text = call(tiny_config(name), name="AsymmetricMASt3R", img_size=(512, 512), rest=MAST3R)
    path = write_pth(tmp_path / "tiny.pth", recipe_weights(name, seed=3), text)
    report, model = imported(path, tmp_path / "init.ckpt", *FEW)
    assert (model.config.head, model.config.image_size) == ("dpt", [384, 512])
    arrays = load_case(name, "odd")
    with torch.no_grad():
        _, _, edges = pairs(model, arrays)
    for found, view in (
        (edges.parent_pts3d, "view1_pts3d"),
        (edges.child_pts3d, "view2_pts3d_in_other_view"),
    ):
        expected = torch.from_numpy(arrays[view]).reshape(found.shape)
        assert (found - expected).abs().max() <= BOUND * expected.abs().max()
    for family in ("head_local_features", "refinenet4.resConfUnit1", "scratch.layer_rn"):
        assert family in report
    assert max(map(len, report.splitlines())) <= 80


def test_file_and_folder_give_the_official_weights_bit_for_bit(tmp_path):
    state = official_state(seed=5)
    write_pth(tmp_path / "a.pth", state)
    write_hub_folder(tmp_path / "hub", state)
    network = PairNetwork(SMALL)
    network.load_state_dict(state_dict_from_official(state, network.state_dict().keys()))
    for path in (tmp_path / "a.pth", tmp_path / "hub"):
        _, model = imported(path, tmp_path / f"{path.name}.ckpt", *FEW)
        found = model.state_dict()
        for key, value in network.state_dict().items():
            assert torch.equal(found.pop(key), value)
        assert all(key.startswith("alignment.") for key in found)
        assert model.config.encoder == SMALL.encoder
        assert model.config.image_size == [224, 224]


def test_the_checkpoint_says_where_it_comes_from(tmp_path):
    path = write_pth(tmp_path / "official.pth")
    report, _ = imported(path, tmp_path / "deep" / "init.ckpt", *FEW, "graph.algorithm=mst")
    _, config = load_model_and_config(tmp_path / "deep" / "init.ckpt")
    note = config.train.note
    for word in ("official.pth", "DUSt3R", "untrained: alignment", "CC BY-NC-SA 4.0", "non-comm"):
        assert word in note
    assert " ".join(note.split()) in " ".join(report.split())
    assert config.graph.algorithm == "mst"
    assert max(map(len, report.splitlines())) <= 80
    again = torch.load(tmp_path / "deep" / "init.ckpt", weights_only=True)
    assert again.keys() == {"state_dict", "l3r_config", "l3r_version"}
    assert all(key.startswith("model.") for key in again["state_dict"])


def test_what_is_fresh_depends_on_the_seed_alone(tmp_path):
    path = write_pth(tmp_path / "croco.pth", official_state(heads=False), call(name="CroCoNet"))
    models = [
        imported(path, tmp_path / f"{number}.ckpt", *FEW, seed=seed)[1].state_dict()
        for number, seed in enumerate((0, 0, 1))
    ]
    for key, value in models[0].items():
        assert torch.equal(value, models[1][key])
        is_fresh = key.startswith(("parent_head", "child_head", "alignment"))
        is_constant = value.unique().numel() == 1  # norms, zero biases, the zero output
        assert torch.equal(value, models[2][key]) == (not is_fresh or is_constant)
    parents = {k: v for k, v in models[0].items() if k.startswith("decoder.parent_blocks")}
    assert parents
    for key, value in parents.items():
        assert torch.equal(models[0][key.replace("parent", "child")], value)


def test_heads_are_chosen_for_a_file_without_any_and_for_no_other(tmp_path):
    croco = write_pth(
        tmp_path / "croco.pth",
        official_state(tiny_config(), heads=False),
        call(tiny_config(), name="CroCoNet"),
    )
    settings = [*FEW, "model.image_size=[384,512]"]
    report, model = imported(croco, tmp_path / "dpt.ckpt", *settings, head="dpt")
    assert (model.config.head, model.config.image_size) == ("dpt", [384, 512])
    assert "untrained: parent head (not in the file)" in " ".join(report.split())
    linear = write_pth(tmp_path / "linear.pth")
    imported(linear, tmp_path / "same.ckpt", *FEW, head="linear")
    with pytest.raises(ConfigError, match=r"--head dpt: .* holds linear heads; .*model.head=dpt"):
        import_official(linear, tmp_path / "other.ckpt", head="dpt")
    shallow = write_pth(tmp_path / "c.pth", official_state(heads=False), call(name="CroCoNet"))
    with pytest.raises(ConfigError, match="4 or more decoder blocks"):
        import_official(shallow, tmp_path / "other.ckpt", head="dpt")
    assert not (tmp_path / "other.ckpt").exists()


@pytest.mark.parametrize(
    "setting", ["model.encoder.width=32", "model.head=dpt", "train.seed=1", "alignment", "x=1"]
)
def test_settings_that_the_file_has_settled_are_refused(tmp_path, setting):
    path = write_pth(tmp_path / "a.pth")
    with pytest.raises(ConfigError, match=rf"override '{setting}': expected key=value of model.al"):
        import_official(path, tmp_path / "out.ckpt", [setting])
    with pytest.raises(ConfigError, match="'num_block'"):
        import_official(path, tmp_path / "out.ckpt", ["model.alignment.num_block=1"])
    assert not (tmp_path / "out.ckpt").exists()


def test_an_alignment_that_is_no_identity_is_called_so(tmp_path):
    path = write_pth(tmp_path / "a.pth")
    report, _ = imported(path, tmp_path / "paper.ckpt", *FEW, "model.alignment.output=paper")
    assert "untrained: alignment (random: no identity)" in " ".join(report.split())
    report, model = imported(path, tmp_path / "none.ckpt", "model.alignment.num_blocks=0")
    assert "untrained" not in report
    assert not list(model.alignment.parameters())


def test_an_existing_file_is_replaced_only_if_told_so(tmp_path):
    path, out = write_pth(tmp_path / "a.pth"), tmp_path / "out.ckpt"
    out.write_text("mine")
    with pytest.raises(ConfigError, match=r"--out .*out\.ckpt: exists already; .*--force"):
        import_official(path, out, FEW)
    assert out.read_text() == "mine"
    imported(path, out, *FEW, overwrite=True)
    with pytest.raises(ConfigError, match="exists already; give a file name"):
        import_official(path, tmp_path, FEW, overwrite=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"enc_norm.bias": torch.full((16,), torch.inf)}, "enc_norm.bias holds .*not finite"),
        ({"enc_norm.bias": torch.zeros(17)}, r"enc_norm.bias is of shape \[17\], expected \[16\]"),
        ({"enc_norm.scale": torch.zeros(16)}, r"1 unknown weights \(enc_norm.scale"),
    ],
)
def test_a_file_that_cannot_be_used_leaves_nothing_behind(tmp_path, change, message):
    path = write_pth(tmp_path / "bad.pth", {**official_state(), **change})
    (tmp_path / "out").mkdir()
    with pytest.raises(CheckpointError, match=rf"bad\.pth: .*{message}") as error:
        import_official(path, tmp_path / "out" / "x.ckpt", FEW)
    assert "\n" not in str(error.value)
    assert not list((tmp_path / "out").iterdir())


def test_weights_that_are_not_read_may_be_anything_finite_or_not(tmp_path):
    state = official_state()
    state["mask_token"] = torch.full_like(state["mask_token"], torch.nan)
    imported(write_pth(tmp_path / "a.pth", state), tmp_path / "a.ckpt", *FEW)


def test_half_precision_becomes_float32(tmp_path):
    state = {key: value.half() for key, value in official_state().items()}
    _, model = imported(write_pth(tmp_path / "half.pth", state), tmp_path / "a.ckpt", *FEW)
    assert {value.dtype for value in model.state_dict().values()} == {torch.float32}
    assert torch.equal(model.encoder.norm.bias, state["enc_norm.bias"].float())
    assert "stored as   float16" in describe_weights(tmp_path / "half.pth")


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A checkpoint of ours and the same network as a folder."""
    folder = tmp_path_factory.mktemp("own")
    write_pth(folder / "a.pth")
    import_official(folder / "a.pth", folder / "own.ckpt", FEW)
    l3r.load_model(folder / "own.ckpt").save_pretrained(folder / "net", note="mine")
    return folder


@pytest.mark.parametrize("name", ["own.ckpt", "net"])
def test_what_is_ours_already_is_not_imported(own, name, tmp_path):
    with pytest.raises(CheckpointError, match=r"this is already a Light3R (checkpoint|folder)"):
        import_official(own / name, tmp_path / "out.ckpt", FEW)


def test_another_file_of_torch_is_named_as_such(tmp_path):
    torch.save({"weights": torch.zeros(2), "step": 3}, tmp_path / "x.pt")
    with pytest.raises(CheckpointError, match=r"neither .* nor .*; it holds step, weights"):
        open_weights(tmp_path / "x.pt")


def fill(name, own, *overrides, depth=1):
    encoder = {"width": 16, "depth": 1, "num_heads": 2}
    sizes = [f"model.encoder.{key}={value}" for key, value in encoder.items()]
    sizes += [f"model.decoder.{key}={value}" for key, value in {**encoder, "depth": depth}.items()]
    model, _ = build_untrained(["configs/base.yaml", *sizes, *overrides, "train.seed=9"])
    before = {key: value.clone() for key, value in model.state_dict().items()}
    return initialise(model, own / name), model.state_dict(), before


@pytest.mark.parametrize("name", ["own.ckpt", "net", "a.pth"])
def test_training_starts_from_any_file(own, name):
    shown, found, before = fill(name, own, *FEW)
    expected = l3r.load_model(own / "own.ckpt").state_dict()
    is_official = name == "a.pth"
    for key, value in found.items():
        stays = is_official and key.startswith("alignment.")
        assert torch.equal(value, (before if stays else expected)[key])
    assert "alignment    " + ("fresh" if is_official else "loaded") in shown
    assert max(map(len, shown.splitlines()[1:])) <= 80
    assert ("mine" if name == "net" else "CC BY-NC-SA") in shown


def test_training_refuses_a_file_of_other_sizes(own):
    with pytest.raises(CheckpointError, match=r"a\.pth: its decoder has .*depth 1.*has .*depth 2"):
        fill("a.pth", own, *FEW, depth=2)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.pth", ["DUSt3R, linear heads", "one file", "weights import' would", "mask_token"]),
        (
            "own.ckpt",
            ["Light3R checkpoint", "alignment   1 blocks, 2 heads", "imported from a.pth"],
        ),
        ("net", ["Light3R folder", "folder of config.json", "about these weights: mine"]),
        ("hub", ["DUSt3R, linear heads", "folder of config.json", "weights import' would"]),
        ("croco.pth", ["CroCo v2, no heads", "heads       none", "copied", "prediction_head"]),
    ],
)
def test_every_kind_of_file_is_described_in_80_columns(own, name, words):
    if name == "hub" and not (own / "hub").exists():
        write_hub_folder(own / "hub")
    write_pth(own / "croco.pth", official_state(heads=False), call(name="CroCoNet"))
    shown = describe_weights(own / name)
    assert shown.splitlines()[0] == str(own / name)
    assert max(map(len, shown.splitlines()[1:])) <= 80
    for word in [*words, "width 16, 1 blocks, 2 heads", "float32"]:
        assert word in shown
    stored = open_weights(own / name)
    entries = re.search(r"([\d,]+) entries, ([\d,]+) parameters", shown)
    if name == "a.pth":
        state = official_state()
        assert entries[1] == f"{len(state):,}"
        assert entries[2] == f"{sum(value.numel() for value in state.values()):,}"
    assert stored.kind in shown


@pytest.mark.slow
@needs_recorded
def test_a_full_size_mast3r_arrives_whole(tmp_path):
    """2.8 GB of weights by recipe, through the file and back, none missing and none changed."""
    manifest = "full_mast3r_catmlpdpt"
    # Gone at the end: pytest would keep these gigabytes for the next three runs.
    with TemporaryDirectory(dir=tmp_path) as folder:
        state = recipe_weights(manifest, seed=7)
        path = write_pth(Path(folder) / "mast3r.pth", state, RELEASED_MAST3R)
        del state
        report = import_official(path, Path(folder) / "init.ckpt")
        assert "568,810,120 parameters loaded + 119,828,736 ignored" in report
        source = open_weights(path)
        written = read_checkpoint(Path(folder) / "init.ckpt", mapped=True)["state_dict"]
        for key, value in source.weights.items():
            assert torch.equal(written.pop(f"model.{key}"), value)
        assert all(key.startswith("model.alignment.") for key in written)
        assert not written["model.alignment.out.weight"].any()
        model = l3r.load_model(Path(folder) / "init.ckpt")
        assert (model.config.head, model.config.image_size) == ("dpt", [384, 512])
