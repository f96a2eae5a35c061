import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from l3r.config import RunConfig, from_plain, load_config, override_config, to_plain, to_yaml
from l3r.errors import ConfigError

CONFIGS = Path(__file__).parents[2] / "configs"
BASE = str(CONFIGS / "base.yaml")
FILES = sorted(path for path in CONFIGS.rglob("*.yaml") if path.parent.name != "sweep")


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(CONFIGS)))
def test_every_shipped_file_loads_on_the_base(path):
    sources = OmegaConf.load(path).get("data", {}).get("sources", {})
    folders = [f"data.sources.{name}.shards=folder" for name in sources]
    assert isinstance(load_config([BASE, str(path), *folders]), RunConfig)


@pytest.mark.parametrize(("size", "gpus"), [("512", 8), ("224", 16)])
def test_the_trainings_of_the_paper_want_shards_and_spread_over_its_gpus(size, gpus):
    files = [
        BASE,
        str(CONFIGS / f"model/l3r_{size}.yaml"),
        str(CONFIGS / f"train/paper_{size}.yaml"),
    ]
    with pytest.raises(ConfigError, match=r"no value for data\.sources\.co3d\.shards"):
        load_config(files)
    names = ("waymo", "co3d", "megadepth", "tartanair")
    config = load_config([*files, *[f"data.sources.{name}.shards={name}" for name in names]])
    assert [source.weight for source in config.data.sources.values()] == [1] * 4
    assert config.train.devices * config.train.num_nodes == gpus
    assert config.data.graphs_per_step / gpus == (1 if size == "512" else 2)
    assert (config.data.num_views, config.train.max_steps) == (8, 100_000)
    assert len(config.data.image_sizes) == (5 if size == "512" else 0)


@pytest.mark.parametrize(
    "path", sorted((CONFIGS / "ablation").glob("*.yaml")), ids=lambda p: p.name
)
def test_every_ablation_changes_something(path):
    assert to_plain(load_config([BASE, str(path)])) != to_plain(load_config([BASE]))


def test_the_base_is_the_recipe_of_the_paper():
    config = load_config([BASE, str(CONFIGS / "model/l3r_224.yaml")])
    assert (config.model.encoder.width, config.model.encoder.depth) == (1024, 24)
    assert (config.model.encoder.num_heads, config.model.encoder.patch_size) == (16, 16)
    decoder = config.model.decoder
    assert (decoder.width, decoder.depth, decoder.num_heads) == (768, 12, 12)
    assert (config.model.alignment.num_blocks, config.model.alignment.num_heads) == (4, 8)
    assert (config.loss.alpha, config.loss.global_weight) == (0.2, 0.1)
    assert (config.train.lr, config.train.weight_decay) == (1e-6, 5e-4)
    assert config.train.betas == [0.9, 0.95]
    assert (config.train.max_steps, config.train.clip_norm) == (100_000, None)
    assert config.graph.algorithm == "spt"


def test_the_later_layer_wins():
    config = load_config([BASE, "train.seed=1", "train.seed=2", "graph.algorithm=mst"])
    assert config.train.seed == 2
    assert config.graph.algorithm == "mst"


def test_an_override_can_add_a_source():
    config = load_config(["data.sources.co3d.shards=a b", "data.sources.co3d.weight=2"])
    assert config.data.sources["co3d"].shards == "a b"
    assert config.data.sources["co3d"].weight == 2


@given(st.integers(0, 2**31), st.floats(1e-8, 1), st.sampled_from(["spt", "mst", "oracle"]))
def test_plain_form_and_yaml_give_back_an_equal_object(seed, rate, algorithm):
    config = load_config([f"train.seed={seed}", f"train.lr={rate}", f"graph.algorithm={algorithm}"])
    assert from_plain(to_plain(config), "here") == config


def test_printed_yaml_loads_as_a_layer(tmp_path):
    config = load_config([BASE, "train.note='a: b'", "data.sources.x.shards=y"])
    path = tmp_path / "printed.yaml"
    path.write_text(to_yaml(config))
    assert load_config([str(path)]) == config


@pytest.mark.parametrize(
    ("layer", "message"),
    [
        ("graph.algoritm=mst", "override 'graph.algoritm=mst'.*Did you mean: 'algorithm'"),
        ("modle.head=linear", "Did you mean: 'model'"),
        ("graph.algorithm=dfs", "'dfs'.*spt"),
        ("train.lr=fast", "'fast'.*could not be converted to Float"),
        ("graph.knn=-1", "graph.knn is -1, expected 0 or more"),
        ("model.image_size=[50,48]", "multiples of the patch size 16"),
        ("model.image_size=[64,48]", r"\[64, 48\], expected .*height at most width"),
        ("inference.crop=centre", "'centre'.*official"),
        ("model.encoder.num_heads=7", "splits width 1024 into multiples of 4"),
        ("data.sources.a.weight=2", "no value for data.sources.a.shards"),
        ("nowhere.yaml", "layer nowhere.yaml: no such file"),
        ("train.seed", "section.key=value"),
        ("loss.alpha=-1", "loss.alpha is -1.0, expected 0 or more"),
        ("data.num_views=11", "data.num_views is 11, expected 2 to 10"),
        ("train.lr=0", "train.lr is 0.0, expected more than 0"),
        ("inference.pnp_error=0", "inference.pnp_error is 0.0"),
        ("train.clip_norm=-1", "train.clip_norm is -1.0"),
        ("train.accelerator=abacus", "'abacus'.*gpu"),
        ("train.betas=[0.9,1.5]", "from 0 to less than 1"),
        ("inference.min_conf=-1", "inference.min_conf is -1.0"),
    ],
)
def test_a_bad_layer_gets_one_line_that_says_what_to_do(layer, message):
    with pytest.raises(ConfigError, match=message) as error:
        load_config([layer])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("- a\n", "expected sections such as 'model:'"),
        ("model: {\n", "bad.yaml"),
        ("train: {sed: 1}\n", "Did you mean: 'seed'"),
        ("\xff\xfe", "bad.yaml"),
    ],
)
def test_a_bad_file_is_named(tmp_path, content, message):
    path = tmp_path / "bad.yaml"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(ConfigError, match=message) as error:
        load_config([str(path)])
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_finished_configuration_can_be_overridden_in_allowed_sections_only():
    config = load_config(["train.seed=3"])
    changed = override_config(config, ["inference.min_conf=5"], ("inference", "graph"))
    assert changed.inference.min_conf == 5
    assert changed.train.seed == 3
    for override in ("train.seed=4", "inference", "inference.min_cnf=5"):
        with pytest.raises(ConfigError, match="override"):
            override_config(config, [override], ("inference", "graph"))


def test_a_plain_form_of_another_version_names_its_file():
    plain = to_plain(load_config([]))
    plain["model"]["flavour"] = "new"
    with pytest.raises(ConfigError, match=r"x\.ckpt: Key 'flavour'"):
        from_plain(plain, "x.ckpt")


@pytest.mark.parametrize("argv", [["--help"], ["config", BASE], ["--version"], ["eval", "--help"]])
def test_light_commands_never_import_torch(argv):
    code = (
        "import sys; from l3r.cli.main import main; code = main(sys.argv[1:]);"
        "assert 'torch' not in sys.modules; sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code, *argv], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_a_stored_configuration_cannot_have_the_environment_read_into_it(monkeypatch):
    monkeypatch.setenv("A_SECRET", "swordfish")
    plain = to_plain(RunConfig())
    plain["train"]["note"] = "see ${oc.env:A_SECRET}"
    with pytest.raises(ConfigError, match=r"file\.ckpt.*expected plain values") as error:
        from_plain(plain, "file.ckpt")
    assert "swordfish" not in str(error.value)
