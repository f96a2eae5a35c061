import json
import shutil
import subprocess
import sys

import pytest

from data_prep.cli import main
from data_prep.commands.inspect import DEPTH_BYTES, JPEG_BYTES
from l3r.data.schema import read_manifest

GRAPHS = "--num-graphs 3 --max-views 5"


@pytest.fixture
def raw(raw_room, tmp_path):
    """Three trajectories: one held out, one whole, one too short and with a file missing."""
    names = {"P001": "office2/Easy/P011", "P000": "room/Easy/P000", "P002": "room/Hard/P002"}
    for source, name in names.items():
        shutil.copytree(raw_room / "room000" / "Easy" / source, tmp_path / "raw" / name)
    (tmp_path / "raw" / "room" / "Hard" / "P002" / "image_left" / "000003_left.png").unlink()
    return tmp_path / "raw"


def run(words):
    return main(["inspect", *words.split()])


def test_the_table_says_what_is_there_what_is_missing_and_what_build_leaves_out(raw, capsys):
    assert run(f"tartanair --raw {raw}") == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    rows = {line.split()[0]: line for line in text.splitlines() if line.strip()}
    assert rows["room/Easy/P000"].split()[1:4] == ["24", "0", "160x120"]
    assert rows["room/Hard/P002"].split()[1:4] == ["5", "1", "160x120"]
    assert rows["office2/Easy/P011"].split()[1:6] == ["4", "0", "160x120", "-", "held"]
    assert "left out: 1 scenes, held out for testing" in text
    assert "1 scenes, fewer than 8 images" in text
    assert "3 scenes, 2 of them left out; 24 images to build from, 1 lack" in text


def test_json_holds_the_same_and_what_the_estimate_assumes(raw, capsys):
    assert run(f"tartanair --raw {raw} --json {GRAPHS}") == 0
    plain = json.loads(capsys.readouterr().out)
    assert plain["totals"]["scenes"] == 3
    assert plain["totals"]["images_missing"] == 1
    assert plain["assumed"]["num_graphs"] == 3
    assert plain["assumed"]["graphs_per_image"] == 1
    names = [scene["name"] for scene in plain["scenes"]]
    assert names == ["office2/Easy/P011", "room/Easy/P000", "room/Hard/P002"]
    whole = plain["scenes"][1]
    assert whole["left_out"] == ""
    assert whole["max_bytes"] == 3 * 5 * 120 * 160 * (DEPTH_BYTES + JPEG_BYTES)


def test_a_scene_has_no_more_graphs_than_pairs(raw, capsys):
    assert (
        run(f"tartanair --raw {raw} --json --num-graphs 1000 --graphs-per-image 9 --max-views 4")
        == 0
    )
    short = json.loads(capsys.readouterr().out)["scenes"][2]
    assert short["max_bytes"] == 10 * 4 * 120 * 160 * (DEPTH_BYTES + JPEG_BYTES)


def test_the_disk_foretold_is_not_passed_and_not_by_far_too_much(raw, tmp_path, capsys):
    assert run(f"tartanair --raw {raw} --json {GRAPHS}") == 0
    foretold = json.loads(capsys.readouterr().out)["scenes"][1]["max_bytes"]
    words = f"build tartanair --raw {raw} --scenes room/Easy/* --out {tmp_path}/out {GRAPHS}"
    assert main(words.split()) == 0
    used = read_manifest(tmp_path / "out").num_bytes
    # Small images pay for tar headers; at 480 x 640 these are a thousandth.
    assert 0.7 * foretold < used < 1.1 * foretold


def test_long_lists_are_cut_and_totals_are_not(raw, capsys):
    assert run(f"tartanair --raw {raw} --rows 1") == 0
    text = capsys.readouterr().out
    assert "... and 2 more scenes" in text
    assert "3 scenes, 2 of them left out" in text
    assert "room/Easy/P000" not in text


def test_torch_is_not_imported(raw):
    code = (
        "import sys; from data_prep.cli import main\n"
        "main(sys.argv[1:])\n"
        "sys.exit('torch' in sys.modules)"
    )
    words = ["inspect", "tartanair", "--raw", str(raw)]
    subprocess.run([sys.executable, "-c", code, *words], check=True, stdout=subprocess.DEVNULL)
