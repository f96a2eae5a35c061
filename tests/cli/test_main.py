import json
import subprocess
import sys

import pytest

from l3r.cli.main import COMMANDS, main
from l3r.inference.checkpoint import build_untrained, write_model
from tests.data.graphs import make_graph, write_folder
from tests.inference.test_photos import save
from tests.train.runs import TINY


def test_help_lists_every_command_and_an_example(capsys):
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in COMMANDS)
    assert "example: l3r reconstruct" in shown
    assert max(len(line) for line in shown.splitlines()) <= 80


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself_with_an_example(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as done:
        main([*name.split(), "--help"])
    assert done.value.code == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"usage: l3r {name}")
    assert f"\n  l3r {name}" in shown
    assert max(len(line) for line in shown.splitlines()) <= 80


@pytest.mark.parametrize("words", [[], ["-h"], ["eval", "--help"], ["weights", "-h"]])
def test_help_is_shown_wherever_it_is_asked_for(words, capsys):
    assert main(words) == 0
    assert capsys.readouterr().out.startswith("usage: l3r COMMAND")


@pytest.mark.parametrize(
    "words", [["recontruct"], ["eval"], ["eval", "pose"], ["-x"], ["weights"], ["weights", "impot"]]
)
def test_an_unknown_command_lists_the_known_ones(words, capsys):
    assert main(words) == 2
    shown = capsys.readouterr().err
    assert f"expected one of: {', '.join(COMMANDS)}" in shown
    assert "eval graphs, weights import, weights inspect" in shown
    assert shown.count("\n") == 1


def test_a_user_error_is_one_line_and_exit_code_2(capsys):
    assert main(["config", "graph.algoritm=mst"]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("l3r config: override 'graph.algoritm=mst'")
    assert shown.err.count("\n") == 1


def test_config_prints_what_would_run(capsys):
    assert main(["config", "configs/base.yaml", "train.seed=7"]) == 0
    assert "seed: 7" in capsys.readouterr().out


def test_the_module_runs_as_a_program():
    done = subprocess.run(
        [sys.executable, "-m", "l3r", "--version"], capture_output=True, text=True
    )
    assert done.returncode == 0
    assert done.stdout.startswith("l3r ")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    model, config = build_untrained([*TINY, "train.note=fresh weights"])
    path = tmp_path_factory.mktemp("weights") / "model.ckpt"
    write_model(path, model, config)
    return path


def test_photos_of_mixed_shapes_become_a_folder(tmp_path, checkpoint, capsys):
    photos, out = tmp_path / "photos", tmp_path / "out"
    for number, (height, width) in enumerate([(60, 80), (80, 60), (64, 64), (60, 80)]):
        save(photos / f"{number}.jpg", height, width, exif=6 if number == 3 else None)
    (photos / "broken.jpg").write_bytes(b"x")
    words = ["reconstruct", str(photos), "--checkpoint", str(checkpoint), "--out", str(out)]
    assert main(words) == 0
    shown = capsys.readouterr().out
    assert "of 4 images registered" in shown
    assert "fresh weights" in shown
    expected = {"sparse", "points.ply", "cameras.json", "run.json", "report.html", "images"}
    assert {path.name for path in out.iterdir()} == expected
    cameras = json.loads((out / "cameras.json").read_text())
    sizes = [(c["height"], c["width"]) for c in cameras["images"]]
    assert sizes == [(60, 80), (80, 60), (64, 64), (80, 60)]
    run = json.loads((out / "run.json").read_text())
    stages = ("load", "encode", "tree", "align", "decode", "accumulate", "focal", "cameras")
    assert all(stage in json.dumps(run) for stage in stages)
    assert "broken.jpg" in json.dumps(run)
    # A second run replaces the first; a folder of other things is left alone.
    assert main([*words, "inference.min_conf=1.5"]) == 0
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("x")
    assert main([*words[:-1], str(tmp_path / "mine")]) == 2
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "x"


def test_reconstruct_refuses_what_it_cannot_use(tmp_path, checkpoint, capsys):
    save(tmp_path / "photos" / "a.jpg")
    words = ["--checkpoint", str(checkpoint), "--out", str(tmp_path / "out")]
    for photos, extra, message in (
        ("nowhere", [], "no such folder"),
        ("photos", [], "1 usable photo(s) of 1"),
        ("photos", ["train.seed=2"], "expected key=value of inference or graph"),
        ("photos", ["--device", "abacus"], "expected auto, cpu or cuda"),
    ):
        assert main(["reconstruct", str(tmp_path / photos), *words, *extra]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_an_earlier_run_wrote_among_the_photos_is_not_read_again(tmp_path, checkpoint, capsys):
    for number in range(2):
        save(tmp_path / f"{number}.jpg", 60, 80, exif=6)
    out = tmp_path / "out"
    words = ["reconstruct", str(tmp_path), "--checkpoint", str(checkpoint), "--out", str(out)]
    for _ in range(2):
        assert main(words) == 0
        assert "of 2 images registered" in capsys.readouterr().out


def test_graphs_are_scored_beside_the_identity(tmp_path, checkpoint, capsys):
    folder = write_folder(
        tmp_path / "shards", [make_graph(n, num_views=4, height=16, width=16) for n in range(3)]
    )
    out = tmp_path / "scores.json"
    words = ["eval", "graphs", str(folder), "--num-views", "4"]
    assert main([*words, "--checkpoint", str(checkpoint), "--json", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "3 graphs of 4 images" in shown
    assert max(len(line) for line in shown.splitlines()) <= 80
    scores = json.loads(out.read_text())
    assert scores["identity"]["rta_15"] == 0  # all cameras at one place have no direction
    assert scores["num_graphs"] == 3
    assert main([*words, "--max-graphs", "1", "--untrained", *TINY]) == 0
    assert "1 graphs of 4 images" in capsys.readouterr().out
    assert main([*words, "--untrained", *TINY, "train.sed=1"]) == 2
    assert main([*words, "--max-graphs", "0", "--untrained", *TINY]) == 2
    nowhere = str(tmp_path / "nowhere" / "scores.json")
    assert main([*words, "--untrained", *TINY, "--json", nowhere]) == 2
    assert "nowhere" in capsys.readouterr().err
