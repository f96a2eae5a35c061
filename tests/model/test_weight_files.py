"""Whatever the bytes are: one line, and nothing is executed."""

import json
import os
import pickle
import struct
import zipfile

import numpy as np
import pytest
import torch

from l3r.errors import CheckpointError
from l3r.model.weight_files import read_weight_file, write_checkpoint, write_folder
from tests.model.official_files import write_hub_folder, write_pth

BOTH_WAYS = pytest.mark.parametrize("mapped", [False, True])


class Trap:
    """Unpickling this makes a file."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return (os.system, (f"touch '{self.marker}'",))


def refuse(path, message, *, mapped):
    with pytest.raises(CheckpointError, match=message) as error:
        read_weight_file(path, mapped=mapped)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


@BOTH_WAYS
def test_a_file_that_would_run_code_is_refused_and_runs_nothing(tmp_path, mapped):
    marker, path = tmp_path / "ran", tmp_path / "trap.pth"
    torch.save({"model": {}, "args": Trap(marker)}, path)
    refuse(path, r"it holds (posix|nt)\.system, which is no weight", mapped=mapped)
    path.write_bytes(pickle.dumps({"model": Trap(marker)}))  # what torch takes for an old file
    refuse(path, "no zip archive", mapped=mapped)
    assert not marker.exists()
    pickle.loads(path.read_bytes())  # the trap is a trap
    assert marker.exists()


@BOTH_WAYS
@pytest.mark.parametrize(
    "content", [b"", b"junk", "gr\u00fc\u00df dich\n".encode(), b"PK\x03\x04 half a zip"]
)
def test_a_file_of_something_else_is_refused(tmp_path, content, mapped):
    path = tmp_path / "x.pth"
    path.write_bytes(content)
    refuse(path, "cannot be read safely", mapped=mapped)
    refuse(tmp_path / "nowhere.pth", "no such file or folder", mapped=mapped)


@BOTH_WAYS
@pytest.mark.parametrize("share", [0.01, 0.5, 0.9, 0.999])
def test_a_cut_off_file_is_refused(tmp_path, share, mapped):
    path = write_pth(tmp_path / "cut.pth")
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refuse(path, "cannot be read safely", mapped=mapped)


@BOTH_WAYS
def test_a_flipped_bit_is_found(tmp_path, mapped):
    path = write_pth(tmp_path / "rotten.pth")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    refuse(path, "cannot be read safely", mapped=mapped)


def test_a_compressed_archive_is_not_taken_for_stored_bytes(tmp_path):
    write_pth(tmp_path / "a.pth")
    deflated = zipfile.ZIP_DEFLATED
    with (
        zipfile.ZipFile(tmp_path / "a.pth") as whole,
        zipfile.ZipFile(tmp_path / "b.pth", "w", deflated) as packed,
    ):
        for name in whole.namelist():
            packed.writestr(name, whole.read(name))
    refuse(tmp_path / "b.pth", "a compressed archive", mapped=True)


@BOTH_WAYS
def test_a_checkpoint_of_anything_but_a_dict_is_refused(tmp_path, mapped):
    for content in ([1, 2], torch.zeros(2), {1: torch.zeros(2)}):
        torch.save(content, tmp_path / "x.pth")
        refuse(tmp_path / "x.pth", "cannot be read safely", mapped=mapped)
    torch.save({"model": {}, "best": np.float64(1)}, tmp_path / "x.pth")
    refuse(tmp_path / "x.pth", r"it holds numpy.*scalar, which is no weight", mapped=mapped)


def header(length, text=b"{}"):
    return struct.pack("<Q", length) + text


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"junk",
        header(2**62),
        header(8),
        header(40, b'{"a": {"dtype": "F32", "shape": [2]}}   '),
    ],
)
def test_a_folder_with_damaged_weights_is_refused(tmp_path, content):
    folder = write_hub_folder(tmp_path / "hub")
    (folder / "model.safetensors").write_bytes(content)
    refuse(folder, r"model\.safetensors: cannot be read safely", mapped=False)


def test_a_folder_with_cut_off_weights_is_refused(tmp_path):
    folder = write_hub_folder(tmp_path / "hub")
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-4])
    refuse(folder, r"model\.safetensors: cannot be read safely", mapped=False)


@pytest.mark.parametrize("text", ["", "{", "[1]", "null", '{"a": ' + "[" * 100_000, "\udcff"])
def test_a_folder_with_broken_settings_is_refused(tmp_path, text):
    folder = write_hub_folder(tmp_path / "hub")
    (folder / "config.json").write_text(text, errors="surrogateescape")
    refuse(folder, r"config\.json: cannot be read safely", mapped=False)


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_a_folder_that_lacks_a_file_is_refused(tmp_path, name):
    folder = write_hub_folder(tmp_path / "hub")
    (folder / name).unlink()
    refuse(folder, f"no {name} inside", mapped=False)


def test_an_interrupted_write_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "model.ckpt"
    write_checkpoint(path, {"a": torch.zeros(2)})
    before = path.read_bytes()
    with pytest.raises(AttributeError):
        write_checkpoint(path, {"a": torch.zeros(2), "b": lambda: None})  # cannot be pickled
    assert path.read_bytes() == before
    assert [child.name for child in tmp_path.iterdir()] == ["model.ckpt"]


def test_the_bytes_of_a_checkpoint_depend_on_its_content_alone(tmp_path):
    for name in ("a.ckpt", "b.ckpt"):
        write_checkpoint(tmp_path / name, {"a": torch.zeros(2), "b": 1})
    assert (tmp_path / "a.ckpt").read_bytes() == (tmp_path / "b.ckpt").read_bytes()


def test_a_written_folder_reads_in_the_form_of_a_checkpoint(tmp_path):
    striped = torch.randn(2, 3, 4, 5).to(memory_format=torch.channels_last)
    weights = {"a": striped, "b": torch.ones(2)}
    write_folder(tmp_path / "net", {"model": {"head": "linear"}}, weights, "1.2")
    assert json.loads((tmp_path / "net" / "config.json").read_text())["l3r_version"] == "1.2"
    content = read_weight_file(tmp_path / "net")
    assert content["l3r_config"] == {"model": {"head": "linear"}}
    assert content["state_dict"].keys() == {"model.a", "model.b"}
    assert torch.equal(content["state_dict"]["model.a"], striped)
