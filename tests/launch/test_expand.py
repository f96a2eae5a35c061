from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l3r.cli.main import main
from l3r.config import find_changes, load_config
from l3r.data.loader import build_training_loader
from l3r.data.steps import DeviceShare
from l3r.errors import ConfigError
from l3r.launch.expand import expand, require_equal_images
from l3r.launch.paper_tables import PAPER_TABLES
from l3r.launch.sweep_config import load_sweep
from l3r.launch.sweep_file import read_sweep, write_sweep
from tests.data.graphs import make_graph, write_folder
from tests.launch.sweeps import BASE, write_sweep_file

ROOT = Path(__file__).parents[2]
SHIPPED = sorted((ROOT / "configs" / "sweep").glob("*.yaml"))
PAPER_DATA = [
    f"data.{part}.{name}.shards={name}"
    for part in ("sources", "validation")
    for name in ("waymo", "co3d", "megadepth", "tartanair")
]

OVERLAYS = {
    "loss.global_weight": st.floats(0, 2).map(lambda x: round(x, 3)),
    "train.lr": st.floats(1e-6, 1e-2).map(lambda x: float(f"{x:.3g}")),
    "graph.algorithm": st.sampled_from(["spt", "mst", "oracle"]),
    "model.alignment.num_blocks": st.integers(0, 8),
}
overlay = st.fixed_dictionaries({}, optional=OVERLAYS)


# A load of a configuration takes tens of milliseconds, hence few examples of few rows.
@settings(max_examples=8)
@given(
    st.dictionaries(
        st.from_regex(r"[a-z0-9][a-z0-9._-]{0,6}", fullmatch=True), overlay, min_size=1, max_size=3
    ),
    st.lists(st.integers(0, 2**31), min_size=1, max_size=4, unique=True),
)
def test_runs_are_rows_times_seeds_and_differ_from_the_base_in_their_overlay_alone(
    tmp_path_factory, rows, seeds
):
    base = load_config(BASE)
    layers = {row: [f"{k}={v}" for k, v in changed.items()] for row, changed in rows.items()}
    changes = {row: find_changes(base, load_config([*BASE, *own])) for row, own in layers.items()}
    expected = {row: set(changed) for row, changed in changes.items()}
    path = write_sweep_file(tmp_path_factory.mktemp("sweep"), rows=layers, seeds=seeds)
    if len({str(changed) for changed in changes.values()}) < len(rows):
        with pytest.raises(ConfigError, match="are the same run"):
            expand(path)
        return
    sweep = expand(path)
    assert len(sweep.runs) == len(rows) * len(seeds)
    assert len({run.name for run in sweep.runs}) == len({r.folder for r in sweep.runs})
    assert len({run.name for run in sweep.runs}) == len(sweep.runs)
    for run in sweep.runs:
        assert set(sweep.changes[run.row]) == expected[run.row] <= set(rows[run.row])
        own = set(find_changes(base, run.config)) - {"train.seed", "train.output_dir"}
        assert own == expected[run.row]
        assert run.config.train.seed == run.seed
        assert Path(run.config.train.output_dir) == run.folder
        assert load_config(run.layers) == run.config


@settings(max_examples=8)
@given(st.integers(1, 20), st.integers(1, 6))
def test_tasks_share_all_runs_and_no_run_twice(tmp_path_factory, num_seeds, tasks):
    path = write_sweep_file(tmp_path_factory.mktemp("sweep"), seeds=list(range(num_seeds)))
    sweep = expand(path)
    shares = [sweep.share(task, tasks) for task in range(tasks)]
    assert sorted(r.name for s in shares for r in s) == sorted(r.name for r in sweep.runs)
    with pytest.raises(ConfigError, match="--task-index"):
        sweep.share(tasks, tasks)


def test_the_first_seed_of_all_rows_comes_first(tmp_path):
    names = [run.name for run in expand(write_sweep_file(tmp_path)).runs]
    assert names == ["none/seed_0", "paper/seed_0", "none/seed_1", "paper/seed_1"]


def test_layers_of_the_command_line_stand_over_the_base_and_under_the_rows(tmp_path):
    path = write_sweep_file(tmp_path)
    sweep = expand(path, ["loss.global_weight=0.5", "train.lr=1"])
    weights = {run.row: run.config.loss.global_weight for run in sweep.runs}
    assert weights == {"none": 0, "paper": 0.5}
    assert {run.config.train.lr for run in sweep.runs} == {1}


def test_a_sweep_is_read_back_from_its_folder_wherever_that_is(tmp_path):
    sweep = expand(write_sweep_file(tmp_path), ["train.lr=1"])
    write_sweep(sweep)
    assert read_sweep(sweep.out) == sweep
    moved = sweep.out.rename(tmp_path / "moved")
    assert [run.folder.parent.parent for run in read_sweep(moved).runs] == [moved] * 4


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"rowz": {}}, "Did you mean: 'rows'"),
        ({"rows": {}}, "rows is empty"),
        ({"rows": {"a/b": []}}, r"rows is 'a/b', expected a name of a folder"),
        ({"rows": {"..": []}}, "expected a name of a folder"),
        ({"rows": {2: []}}, "Key 2"),
        ({"rows": {"a": 3}}, r"rows\.a is 3, expected a layer"),
        ({"rows": {"a": "loss.alpah=1"}}, "Did you mean: 'alpha'"),
        ({"rows": {"a": "loss.alpha=1", "b": ["loss.alpha=1.0"]}}, "'a' and 'b' are the same run"),
        ({"rows": {"a": "train.seed=3"}}, r"rows\.a sets train\.seed"),
        ({"rows": {"a": "train.output_dir=x"}}, r"rows\.a sets train\.output_dir"),
        ({"seeds": [1, 1]}, r"seeds is \[1, 1\], expected one or more, each once"),
        ({"seeds": []}, "seeds"),
        ({"table": "num_layer"}, r"table is 'num_layer', expected one of num_layers"),
        ({"evaluate": {"num_view": 3}}, "Did you mean: 'num_views'"),
        ({"evaluate": {"num_views": 1}}, "evaluate.num_views is 1"),
        ({"checkpoint": "a.ckpt"}, r"checkpoint is a\.ckpt, expected a path with \{seed\}"),
        ({"checkpoint": "{seed}", "base": [], "rows": {"a": "train.lr=1"}}, "graph or inference"),
        ({"rows": {"a": "data.num_views=4", "b": []}}, r"images a step .*\(a: 32, b: 64\)"),
        (
            {"rows": {"a": "train.max_steps=9", "b": []}},
            r"max_steps differs .*\(a: 9, b: 100,000\)",
        ),
        ({"rows": {"a": "data.validation.hand.span=[0.5,1]"}}, "a sets data.validation.hand.span"),
        ({"base": BASE[:1]}, r"nothing to score on; add data\.validation"),
    ],
)
def test_a_bad_sweep_gets_one_line_that_says_what_to_do(tmp_path, content, message, capsys):
    path = write_sweep_file(tmp_path, **content)
    with pytest.raises(ConfigError, match=message):
        expand(path)
    assert main(["sweep", str(path), "--list"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_two_rows_of_one_name_are_refused_by_that_name(tmp_path, capsys):
    path = tmp_path / "twice.yaml"
    path.write_text("rows:\n  a: []\n  a: loss.alpha=1\n")
    assert main(["sweep", str(path), "--list"]) == 2
    expected = f"l3r sweep: layer {path}: line 3: found duplicate key a\n"
    assert capsys.readouterr().err == expected


@pytest.mark.parametrize("layer", ["train.seed=3", "train.output_dir=x"])
def test_the_command_line_cannot_set_what_the_sweep_sets(tmp_path, layer):
    with pytest.raises(ConfigError, match="the sweep sets it"):
        expand(write_sweep_file(tmp_path), [layer])


def test_rows_of_unequal_images_can_be_asked_for(tmp_path):
    rows = {"4": "data.num_views=4", "8": []}
    path = write_sweep_file(tmp_path, rows=rows, equal_images=False)
    assert {run.config.data.num_views for run in expand(path).runs} == {4, 8}


@given(st.integers(10, 600), st.sampled_from([3, 5, 8, 10]), st.integers(1, 3))
def test_whole_graphs_of_one_number_of_images_are_fair_and_one_more_graph_is_not(images, row, more):
    base = load_config(BASE)
    data = {
        n: replace(base.data, num_views=n, graphs_per_step=max(1, int(images / n + 0.5)))
        for n in (3, 5, 8, 10)
    }
    configs = {str(n): replace(base, data=own) for n, own in data.items()}
    require_equal_images(Path("x.yaml"), configs)
    data[row].graphs_per_step += more + 10 // row + 1
    with pytest.raises(ConfigError, match="images a step differ"):
        require_equal_images(Path("x.yaml"), configs)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_sweep_expands_and_is_a_difference_only(path, monkeypatch):
    monkeypatch.chdir(ROOT)
    spec = load_sweep(path)
    assert len(path.read_text().splitlines()) <= 10
    assert spec.table == path.stem.removeprefix("tiny_")
    data = [] if spec.checkpoint or path.stem.startswith("tiny") else PAPER_DATA
    sweep = expand(path, data)
    assert len(sweep.runs) == 3 * len(spec.rows)
    rows = set(PAPER_TABLES[spec.table].rows)
    # Without official weights a network for pairs stands for them.
    tiny = {"dust3r", "mast3r", "pairwise"} if path.stem.startswith("tiny") else set()
    own = {"global_loss"} | tiny
    assert set(spec.rows) ^ rows <= own
    if not path.stem.startswith("tiny") and sweep.runs[0].config and "512" not in str(spec.base):
        for run in sweep.runs:
            images = run.config.data.num_views * run.config.data.graphs_per_step
            assert run.config.data.graphs_per_step == round(256 / run.config.data.num_views)
            assert abs(images - 256) <= 4
            assert run.config.model.image_size == [224, 224]


def described(run, num_steps=30):
    config = run.config
    loader = build_training_loader(
        config.data, (16, 16), seed=run.seed, num_steps=num_steps, share=DeviceShare()
    )
    return [loader.dataset.describe(step) for step in range(num_steps)]


@pytest.fixture(scope="module")
def ten_views(tmp_path_factory):
    graphs = [make_graph(n, num_views=10, height=16, width=16) for n in range(12)]
    return write_folder(tmp_path_factory.mktemp("ten"), graphs)


@pytest.fixture(scope="module")
def more_views(tmp_path_factory):
    graphs = [make_graph(100 + n, num_views=10, height=16, width=16) for n in range(7)]
    return write_folder(tmp_path_factory.mktemp("more"), graphs)


def reading(**places):
    parts = ("sources", "validation")
    return [
        f"data.{part}.{name}.shards={place}" for part in parts for name, place in places.items()
    ]


def test_runs_of_one_seed_see_the_same_graphs_in_the_same_slots(ten_views, tmp_path):
    rows = {"L2": "model.alignment.num_blocks=2", "global": "loss.global_weight=1", "plain": []}
    sweep = expand(write_sweep_file(tmp_path, base=reading(hand=ten_views), rows=rows))
    plans = {run.name: described(run) for run in sweep.runs}
    for seed in (0, 1):
        own = [plans[f"{row}/seed_{seed}"] for row in rows]
        assert own[0] == own[1] == own[2]
    assert plans["plain/seed_0"] != plans["plain/seed_1"]


def test_rows_of_another_graph_size_see_as_many_images_of_the_same_graphs(
    ten_views, more_views, tmp_path
):
    rows = {"3": ["data.num_views=3", "data.graphs_per_step=5"], "8": "data.graphs_per_step=2"}
    rows["5"] = ["data.num_views=5", "data.graphs_per_step=3"]
    for sources in ({"hand": ten_views}, {"hand": ten_views, "more": more_views}):
        base = reading(**sources)
        sweep = expand(write_sweep_file(tmp_path, base=base, rows=rows, seeds=[0]))
        keys = {}
        for run in sweep.runs:
            slots = [slot for plan in described(run) for slot in plan.slots]
            assert len(slots) * run.config.data.num_views == pytest.approx(30 * 16, rel=0.1)
            keys[run.row] = [(slot.source, slot.key) for slot in slots]
            assert len({source for source, _ in keys[run.row]}) == len(sources)
        # The graphs come in one order; a row of larger graphs stops earlier in it.
        assert keys["5"] == keys["3"][: len(keys["5"])]
        assert keys["8"] == keys["5"][: len(keys["8"])]
