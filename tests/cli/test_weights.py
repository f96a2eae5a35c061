"""``l3r weights``: import, inspect, download."""

import os
import pickle
import subprocess
import sys
import time

import torch

import l3r
from l3r.cli.main import main
from tests.inference.test_photos import save
from tests.model.official_files import call, official_state, write_hub_folder, write_pth
from tests.model.test_weight_files import Trap

FEW = ["model.alignment.num_blocks=1", "model.alignment.num_heads=2", "model.image_size=[32,48]"]


def run(capsys, *words):
    code = main(["weights", *map(str, words)])
    shown = capsys.readouterr()
    return code, shown.out, shown.err


def test_an_imported_file_reconstructs_photos(tmp_path, capsys):
    official, out = write_pth(tmp_path / "official.pth"), tmp_path / "init.ckpt"
    code, shown, errors = run(capsys, "import", official, "--out", out, "--seed", "4", *FEW)
    assert (code, errors) == (0, "")
    assert "loaded" in shown
    assert "ignored" in shown
    assert shown.endswith(f"wrote {out}\n")
    for number in range(2):
        save(tmp_path / "photos" / f"{number}.jpg", 64, 96)
    words = ["reconstruct", str(tmp_path / "photos"), "--checkpoint", str(out)]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    told = capsys.readouterr().out
    assert "of 2 images registered" in told
    assert "CC BY-NC-SA 4.0" in told


def test_import_takes_its_options(tmp_path, capsys):
    croco = write_pth(tmp_path / "c.pth", official_state(heads=False), call(name="CroCoNet"))
    out = tmp_path / "c.ckpt"
    words = ("import", croco, "--out", out, "--head", "linear", *FEW)
    assert run(capsys, *words)[0] == 0
    code, _, errors = run(capsys, *words)
    assert code == 2
    assert "exists already" in errors
    assert run(capsys, *words, "--force")[0] == 0
    code, _, errors = run(capsys, "import", out, "--out", tmp_path / "d.ckpt")
    assert code == 2
    assert "this is already a Light3R checkpoint" in errors


def bad_files(folder):
    """Files that no command may take, or execute anything of."""
    torch.save({"model": {}, "args": Trap(folder / "MARKER")}, folder / "zip_trap.pth")
    (folder / "bare_trap.pth").write_bytes(pickle.dumps({"model": Trap(folder / "MARKER")}))
    whole = write_pth(folder / "cut.pth").read_bytes()
    (folder / "cut.pth").write_bytes(whole[: len(whole) // 2])
    (folder / "empty.pth").touch()
    (folder / "text.pth").write_text("weights to follow\n")
    (folder / "no_config").mkdir()
    hub = write_hub_folder(folder / "cut_hub") / "model.safetensors"
    hub.write_bytes(hub.read_bytes()[:-10])
    (write_hub_folder(folder / "bad_json") / "config.json").write_text("{'a': 1}")
    write_pth(folder / "call.pth", text=f"__import__('os').system('touch {folder / 'MARKER'}')")
    torch.save({"weights": torch.zeros(2)}, folder / "other.pth")
    return sorted(path.name for path in folder.iterdir())


def test_bad_files_get_one_line_and_are_not_executed(tmp_path, capsys):
    names = bad_files(tmp_path)
    assert len(names) == 10
    for name in [*names, "nowhere.pth"]:
        path = tmp_path / name
        for words in (("inspect", path), ("import", path, "--out", tmp_path / "out.ckpt")):
            code, shown, errors = run(capsys, *words)
            assert (code, shown) == (2, ""), name
            assert errors.startswith(f"l3r weights {words[0]}: {path}"), name
            assert errors.count("\n") == 1, name
    assert not (tmp_path / "MARKER").exists()
    assert not (tmp_path / "out.ckpt").exists()


def test_inspect_prints_what_a_file_is(tmp_path, capsys):
    code, shown, errors = run(capsys, "inspect", write_pth(tmp_path / "official.pth"))
    assert (code, errors) == (0, "")
    assert "DUSt3R, linear heads" in shown


def test_a_hub_out_of_reach_gives_one_line_within_seconds(tmp_path):
    """For real, but for the address: nobody listens on this machine's port 9."""
    words = [sys.executable, "-m", "l3r", "weights", "download", "mast3r-512", "--out", "dir"]
    env = {**os.environ, "HF_ENDPOINT": "http://127.0.0.1:9", "HF_HOME": str(tmp_path / "home")}
    began = time.monotonic()
    done = subprocess.run(words, capture_output=True, text=True, env=env, cwd=tmp_path, timeout=60)
    assert time.monotonic() - began < 30
    assert done.returncode == 2
    assert "CC BY-NC-SA 4.0, non-commercial" in done.stdout
    repository = "naver/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric"
    assert done.stderr.startswith(f"l3r weights download: {repository}: could not be fetched (")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "dir").exists()


def test_download_says_the_licence_before_and_the_next_command_after(tmp_path, capsys, monkeypatch):
    seen = {}

    def snapshot_download(name, *, local_dir, allow_patterns):
        seen.update(name=name, before=capsys.readouterr().out)
        write_hub_folder(local_dir)
        return str(local_dir)

    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot_download)
    folder = tmp_path / "weights"
    code, shown, _ = run(capsys, "download", "dust3r-224-linear", "--out", folder)
    assert code == 0
    assert seen["name"] == "naver/DUSt3R_ViTLarge_BaseDecoder_224_linear"
    assert "licence of the weights: CC BY-NC-SA 4.0, non-commercial" in seen["before"]
    following = shown.removeprefix("next: l3r ").split()
    assert following == ["weights", "import", str(folder), "--out", "dust3r-224-linear.ckpt"]
    monkeypatch.chdir(tmp_path)
    assert main([*following, *FEW]) == 0
    assert (tmp_path / "dust3r-224-linear.ckpt").is_file()


def test_download_takes_any_repository_and_knows_our_own(tmp_path, capsys, monkeypatch):
    run(capsys, "import", write_pth(tmp_path / "a.pth"), "--out", tmp_path / "a.ckpt", *FEW)
    network = l3r.load_model(tmp_path / "a.ckpt")

    def snapshot_download(name, *, local_dir, allow_patterns):
        assert name == "me/light3r"
        network.save_pretrained(local_dir)
        return str(local_dir)

    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot_download)
    code, shown, _ = run(capsys, "download", "me/light3r", "--out", tmp_path / "net")
    assert code == 0
    assert "licence of the weights: see the repository's README" in shown
    assert f"next: l3r reconstruct photos/ --checkpoint {tmp_path / 'net'} --out" in shown
    code, _, errors = run(capsys, "download", "no-such-name", "--out", tmp_path / "net")
    assert code == 2
    assert "expected owner/name" in errors
