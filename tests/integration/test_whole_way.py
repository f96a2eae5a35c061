"""Raw frames to a scored reconstruction, by the command lines a user types."""

import json

import pycolmap
import pytest

from data_prep.cli import main as prep
from l3r.cli.main import main as l3r

TINY = [
    "configs/base.yaml",
    "configs/model/tiny.yaml",
    "model.encoder.depth=1",
    "model.decoder.depth=1",
    "model.alignment.num_blocks=1",
    "data.graphs_per_step=2",
    "data.num_views=4",
    "data.num_workers=0",
    "train.max_steps=20",
    "train.checkpoint_every=10",
    "train.validate_every=10",
    "train.validation_graphs=2",
    "train.log_every=1",
    "train.accelerator=cpu",
    "train.lr=2e-3",
]


@pytest.mark.slow
def test_every_command_takes_what_the_one_before_it_made(tmp_path, monkeypatch, capsys):
    raw, shards, run = tmp_path / "raw", tmp_path / "shards", tmp_path / "run"
    room = ["--views", "80", "--held-out-views", "40", "--walk-views", "12"]
    build = ["build", "synthetic", "--raw", str(raw), "--out", str(shards), *room]
    assert prep([*build, "--num-graphs", "24", "--max-views", "8", "--min-views", "4"]) == 0
    assert prep(["check", str(shards / "train")]) == 0
    layers = [
        *TINY,
        f"data.sources.room.shards={shards / 'train'}",
        f"data.validation.room.shards={shards / 'val'}",
        f"train.output_dir={run}",
    ]
    assert l3r(["train", *layers]) == 0
    losses = [float(line.split(",")[6]) for line in (run / "metrics.csv").open().readlines()[1:]]
    assert len(losses) == 20
    weights = ["--checkpoint", str(run / "model.ckpt")]
    scores = tmp_path / "scores.json"
    graphs = ["eval", "graphs", str(shards / "val"), *weights, "--num-views", "4"]
    assert l3r([*graphs, "--max-graphs", "4", "--json", str(scores)]) == 0
    assert json.loads(scores.read_text())["num_graphs"] == 4
    (photos,) = raw.glob("*/Easy/P002/image_left")
    out, truth = tmp_path / "out", tmp_path / "truth.json"
    assert l3r(["reconstruct", str(photos), *weights, "--out", str(out)]) == 0
    assert (
        prep(["cameras", "tartanair", "--raw", str(raw), "--scenes", "*/P002", "--out", str(truth)])
        == 0
    )
    assert l3r(["eval", "poses", "--pred", str(out), "--gt", str(truth)]) == 0
    assert "12 images" in capsys.readouterr().out
    model = pycolmap.Reconstruction(str(out / "sparse" / "0"))
    registered = sum(
        c["registered"] for c in json.loads((out / "cameras.json").read_text())["images"]
    )
    assert len(model.images) == registered
