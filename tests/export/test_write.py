import json
from dataclasses import replace

import pycolmap
import pytest
import torch
from plyfile import PlyData

from l3r.errors import DataError
from l3r.export.cameras_json import read_cameras
from l3r.export.colmap_read import read_colmap
from l3r.export.folder import check_output, staged_folder
from l3r.export.write import write_reconstruction


def write(out, scene, **changes):
    options = {
        "diagnostics": {"root": 0},
        "config": {"inference": {"min_conf": 3.0, "fallback_share": 0.1}},
        "command": ["l3r", "reconstruct"],
        "skipped": [],
        "warnings": [],
        "upright": None,
    }
    return write_reconstruction(out, scene, **(options | changes))


def names(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def test_the_folder_holds_everything_and_nothing_else(tmp_path, scene_with_a_loss):
    out = tmp_path / "deep" / "out"
    (tmp_path / "turned.jpg").write_bytes(b"from a file")
    upright = {"a/b.jpg": b"jpeg", "c.jpg": tmp_path / "turned.jpg"}
    seconds = write(out, scene_with_a_loss, upright=upright)
    run = json.loads((out / "run.json").read_text())
    assert {"points.ply", "cameras.json", "run.json", "report.html"} <= set(names(out))
    assert "sparse/0/points3D.bin" in names(out)
    assert (out / "images/a/b.jpg").read_bytes() == b"jpeg"
    assert (out / "images/c.jpg").read_bytes() == b"from a file"
    assert run["files"] == names(out)
    assert run["seconds"] == seconds
    exports = {"images", "colmap", "ply", "cameras", "report"}
    assert {f"export_{name}" for name in exports} == set(seconds) - set(scene_with_a_loss.seconds)
    assert [entry.name for entry in out.parent.iterdir()] == ["out"]


def test_all_files_tell_of_the_same_cameras(tmp_path, scene_with_a_loss):
    write(tmp_path / "out", scene_with_a_loss)
    own = read_cameras(tmp_path / "out" / "cameras.json")
    colmap = read_colmap(tmp_path / "out" / "sparse" / "0")
    kept = [own.file.index(file) for file in colmap.file]
    assert len(kept) == 5
    torch.testing.assert_close(colmap.K, own.K[kept])
    torch.testing.assert_close(colmap.cam_from_world, own.cam_from_world[kept])


def test_the_configured_confidence_decides_the_points(tmp_path, scene):
    write(tmp_path / "out", scene, config={"inference": {"min_conf": 5.0}})
    expected = sum(int((conf > 5).sum()) for conf in scene.conf)
    vertices = PlyData.read(tmp_path / "out" / "points.ply")["vertex"]
    assert len(vertices) == expected
    assert pycolmap.Reconstruction(tmp_path / "out/sparse/0").num_points3D() == expected


def test_a_former_reconstruction_is_replaced(tmp_path, scene, scene_with_a_loss):
    out = tmp_path / "out"
    write(out, scene, upright={"old.jpg": b"old"})
    write(out, scene_with_a_loss)
    assert not (out / "images").exists()
    assert read_cameras(out / "cameras.json").registered.sum() == 5
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]


def test_an_empty_folder_is_used(tmp_path, scene):
    out = tmp_path / "out"
    out.mkdir()
    write(out, scene)
    assert (out / "run.json").is_file()


@pytest.mark.parametrize("name", ["holiday.jpg", "sub/notes.txt"])
def test_a_folder_of_other_files_is_refused(tmp_path, scene, name):
    out = tmp_path / "out"
    (out / name).parent.mkdir(parents=True)
    (out / name).write_text("mine")
    with pytest.raises(DataError, match=f"holds '{name}'"):
        write(out, scene)
    assert names(out) == [name]


def test_files_that_a_user_added_to_a_reconstruction_are_not_lost(tmp_path, scene):
    out = tmp_path / "out"
    write(out, scene, upright={"turned.jpg": b"x"})
    (out / "images" / "mine.jpg").write_bytes(b"the only copy")
    with pytest.raises(DataError, match=r"images/mine.jpg"):
        check_output(out)
    with pytest.raises(DataError, match=r"images/mine.jpg"):
        write(out, scene)
    assert (out / "images" / "mine.jpg").read_bytes() == b"the only copy"


def test_a_forged_list_of_files_reaches_nothing_outside(tmp_path, scene, monkeypatch):
    monkeypatch.setattr("pathlib.Path.is_mount", lambda self: True)
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "outside").mkdir()
    (out / "run.json").write_text(json.dumps({"files": ["run.json", "../outside", "/etc/x", ""]}))
    write(out, scene)
    assert (tmp_path / "outside").is_dir()


def test_a_file_in_the_way_is_refused(tmp_path, scene):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(DataError, match="is not a folder"):
        write(tmp_path / "out", scene)


def test_a_failure_keeps_the_former_reconstruction(tmp_path, scene, scene_with_a_loss):
    out = tmp_path / "out"
    write(out, scene)
    before = {name: (out / name).read_bytes() for name in names(out)}
    cameras = scene_with_a_loss.cameras
    lying = replace(cameras, registered=torch.ones_like(cameras.registered))
    with pytest.raises((DataError, ValueError)):
        write(out, replace(scene_with_a_loss, cameras=lying))
    assert {name: (out / name).read_bytes() for name in names(out)} == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]


def test_a_mounted_folder_keeps_its_identity(tmp_path, scene, scene_with_a_loss, monkeypatch):
    monkeypatch.setattr("pathlib.Path.is_mount", lambda self: True)
    out = tmp_path / "out"
    out.mkdir()
    inode = out.stat().st_ino
    write(out, scene, upright={"old.jpg": b"old"})
    write(out, scene_with_a_loss)
    assert out.stat().st_ino == inode
    assert json.loads((out / "run.json").read_text())["files"] == names(out)
    assert not (out / "images").exists()


def test_a_full_disk_is_one_line(tmp_path):
    def full():
        with staged_folder(tmp_path / "out"):
            raise OSError(28, "No space left on device")

    with pytest.raises(DataError, match="No space left on device"):
        full()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("file", ["../x.jpg", "/tmp/x.jpg"])
def test_upright_photos_stay_in_the_folder(tmp_path, scene, file):
    with pytest.raises(DataError, match="out of the output folder"):
        write(tmp_path / "out", scene, upright={file: b""})


def test_nothing_registered_is_still_written(tmp_path, scene):
    n = len(scene.conf)
    cameras = replace(
        scene.cameras,
        registered=torch.zeros(n, dtype=torch.bool),
        cam_from_world=torch.full((n, 4, 4), torch.nan, dtype=torch.float64),
    )
    write(tmp_path / "out", replace(scene, cameras=cameras, point_rule=["none"] * n))
    assert "No image is registered" in (tmp_path / "out" / "report.html").read_text()
