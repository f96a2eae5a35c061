import shutil
import subprocess
import sys

import pytest

from data_prep.cli import COMMANDS, main
from data_prep.plan_file import read_plan
from l3r.data.schema import read_manifest
from l3r.export.cameras_json import read_cameras


def run(words):
    return main(words.split())


@pytest.mark.parametrize("command", list(COMMANDS))
def test_every_command_explains_itself_with_an_example(command, capsys):
    with pytest.raises(SystemExit, match="0"):
        run(f"{command} --help")
    text = capsys.readouterr().out
    assert "example" in text
    assert f"l3r-prep {command} " in text


def test_help_lists_the_commands_without_importing_torch(capsys):
    assert run("--help") == 0
    text = capsys.readouterr().out
    assert all(command in text for command in COMMANDS)
    code = (
        "import sys; from data_prep.cli import main\n"
        "try: main(['build', '--help'])\nexcept SystemExit: pass\n"
        "sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_an_unknown_command_is_refused(capsys):
    assert run("bild") == 2
    assert "no command 'bild'" in capsys.readouterr().err


def test_a_room_is_rendered_built_and_checked(tmp_path, capsys):
    room = f"--raw {tmp_path}/raw --views 14 --held-out-views 12 --walk-views 3 --size 96x128"
    graphs = "--num-graphs 4 --max-views 4 --min-views 3"
    assert run(f"render {room}") == 0
    assert run(f"build synthetic {room} --out {tmp_path}/out {graphs}") == 0
    assert read_manifest(tmp_path / "out" / "train").num_graphs == 4
    assert read_manifest(tmp_path / "out" / "val").num_graphs == 3
    assert run(f"check {tmp_path}/out/train") == 0
    out = capsys.readouterr().out
    assert "room000" in out
    assert "train: 4 graphs in 1 shards" in out
    assert "val: 3 graphs" in out
    assert out.count("left out: none") == 2


def test_what_is_left_out_is_said_at_the_end_and_in_the_manifest(raw_room, tmp_path, capsys):
    raw = shutil.copytree(raw_room / "room000" / "Easy" / "P000", tmp_path / "r" / "e" / "l" / "P0")
    (raw / "depth_left" / "000002_left_depth.npy").unlink()
    image = raw / "image_left" / "000005_left.png"
    image.write_bytes(image.read_bytes()[:-40])
    graphs = "--num-graphs 4 --max-views 4 --min-views 3"
    assert run(f"build tartanair --raw {tmp_path}/r --out {tmp_path}/out {graphs}") == 0
    assert "left out: 1 missing_depth, 1 unreadable_frame" in capsys.readouterr().out
    counts = read_manifest(tmp_path / "out").request["problems"]
    assert counts == {"missing_depth": 1, "unreadable_frame": 1}
    # The same command again has nothing to do, and says the same.
    assert run(f"build tartanair --raw {tmp_path}/r --out {tmp_path}/out {graphs}") == 0
    assert "left out: 1 missing_depth, 1 unreadable_frame" in capsys.readouterr().out


def test_tasks_share_a_build_and_the_last_one_says_what_there_is(raw_room, tmp_path, capsys):
    words = f"build tartanair --raw {raw_room} --scenes */P000 --out {tmp_path}"
    words += (
        " --graphs-per-shard 2 --num-graphs 4 --max-views 4 --min-views 3 --tasks 2 --task-index"
    )
    assert run(f"{words} 0") == 0
    assert "task 0 of 2 has written its shards; others have not" in capsys.readouterr().out
    assert run(f"{words} 1") == 0
    assert "4 graphs in 2 shards" in capsys.readouterr().out
    assert run(f"{words} 2") == 2
    assert "task 2 of 2, expected a number from 0" in capsys.readouterr().err


def test_several_tasks_do_not_render_the_same_room(tmp_path, capsys):
    room = f"--raw {tmp_path}/raw --views 14 --held-out-views 0 --walk-views 0 --size 96x128"
    words = f"build synthetic {room} --out {tmp_path}/out --num-graphs 2 --max-views 3 --tasks 2"
    assert run(words) == 2
    assert "run 'l3r-prep render' with the same options first" in capsys.readouterr().err
    assert run(f"render {room}") == 0
    assert run(words) == 0


def test_the_last_frames_can_be_held_out(raw_room, tmp_path):
    words = f"build tartanair --raw {raw_room} --scenes */P000 --out {tmp_path} --held-out 0.5"
    assert run(f"{words} --num-graphs 4 --max-views 4 --min-views 3") == 0
    files = {}
    for part in ("train", "val"):
        manifest = read_manifest(tmp_path / part)
        assert manifest.request["source"]["held_out"] == 0.5
        record = next((tmp_path / part / ".build").glob("*.plan.npz"))
        files[part] = read_plan(record).fingerprint
    assert files["train"] != files["val"]
    assert read_manifest(tmp_path / "val").num_graphs == 2


def test_true_cameras_of_one_scene_are_written(raw_room, room_scene, tmp_path):
    words = f"cameras tartanair --raw {raw_room} --scenes */P002 --out {tmp_path}/c/cameras.json"
    assert run(words) == 0
    cameras = read_cameras(tmp_path / "c" / "cameras.json")
    assert cameras.file == [f"{n:06d}_left.png" for n in range(6)]
    assert cameras.registered.all()


def test_cameras_of_several_scenes_are_refused(raw_room, tmp_path, capsys):
    assert run(f"cameras tartanair --raw {raw_room} --out {tmp_path}/c.json") == 2
    message = capsys.readouterr().err
    assert "2 scenes match '*' (room000/Easy/P000, room000/Easy/P001, ...)" in message


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("build tartanair --raw {t}/no --out {t}/o", "no pose_left.txt below"),
        ("build tartanair --raw {t} --out {t}/o --views 3", "--views has no effect on tartanair"),
        ("build synthetic --raw {t} --out {t}/o --split all", "--split has no effect"),
        (
            "build tartanair --raw {t} --out {t}/o --include-excluded",
            "--include-excluded has no effect on tartanair",
        ),
        ("build synthetic --raw {t} --out {t}/o --size 48", "expected HEIGHTxWIDTH"),
        ("build tartanair --raw {t} --out {t}/o --held-out 1", "expected a share"),
        ("build tartanair --raw {t} --out {t}/o --max-views 1", "expected 2 <= min_views"),
        ("check {t} --max-graphs 0", "expected 1 or more"),
        ("inspect tartanair --raw {t}/no", "no pose_left.txt below"),
        ("inspect tartanair --raw {t} --num-graphs 0", "expected 1 or more"),
        ("cameras tartanair --raw {t} --out {t}/c.json", "no pose_left.txt below"),
    ],
)
def test_a_user_error_is_one_line_and_exit_code_two(tmp_path, capsys, words, message):
    assert run(words.format(t=tmp_path)) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert error.startswith(f"l3r-prep {words.split()[0]}: ")
