"""Networks in folders and on the hub; the hub itself is out of reach of tests."""

import json
import re
import sys

import pytest
import torch

import l3r
from l3r import Light3R
from l3r.config import AlignmentConfig, GraphConfig, ModelConfig
from l3r.errors import CheckpointError, ConfigError
from l3r.inference.checkpoint import load_model_and_config
from l3r.model.hub import fetch_folder
from tests.model.official_files import SMALL, write_hub_folder, write_pth

CONFIG = ModelConfig(
    encoder=SMALL.encoder,
    decoder=SMALL.decoder,
    alignment=AlignmentConfig(num_blocks=1, num_heads=2),
    image_size=[32, 48],
)
GRAPH = GraphConfig(algorithm="mst", knn=3)


@pytest.fixture
def network():
    torch.manual_seed(3)
    return Light3R(CONFIG, GRAPH)


def assert_same(one, two):
    assert one.config == two.config
    assert one.graph == two.graph
    first, second = one.state_dict(), two.state_dict()
    assert first.keys() == second.keys()
    assert all(torch.equal(first[key], second[key]) for key in first)


def test_a_saved_network_comes_back_as_it_was(network, tmp_path):
    network.save_pretrained(tmp_path / "net", note="not for sale")
    loaded = Light3R.from_pretrained(tmp_path / "net")
    assert_same(loaded, network)
    assert type(loaded) is Light3R
    assert not loaded.training
    assert_same(l3r.load_model(tmp_path / "net"), network)
    assert load_model_and_config(tmp_path / "net")[1].train.note == "not for sale"
    plain = json.loads((tmp_path / "net" / "config.json").read_text())
    assert plain.keys() == {"l3r_version", "model", "graph", "train"}
    assert plain["l3r_version"] == l3r.__version__
    assert {p.name for p in (tmp_path / "net").iterdir()} == {"config.json", "model.safetensors"}
    network.save_pretrained(str(tmp_path / "net"))  # over the old one, and without a note
    assert "train" not in json.loads((tmp_path / "net" / "config.json").read_text())
    assert_same(Light3R.from_pretrained(str(tmp_path / "net")), network)


def test_a_subclass_comes_back_as_itself(network, tmp_path):
    class Mine(Light3R):
        pass

    network.save_pretrained(tmp_path)
    assert type(Mine.from_pretrained(tmp_path)) is Mine


def test_a_folder_that_contradicts_itself_is_refused(network, tmp_path):
    network.save_pretrained(tmp_path)
    plain = json.loads((tmp_path / "config.json").read_text())
    plain["model"]["decoder"]["width"] = 32
    (tmp_path / "config.json").write_text(json.dumps(plain))
    with pytest.raises(CheckpointError, match="weights do not fit the configuration"):
        Light3R.from_pretrained(tmp_path)
    plain["model"]["decoder"]["wings"] = 2
    (tmp_path / "config.json").write_text(json.dumps(plain))
    with pytest.raises(ConfigError, match="'wings'"):
        l3r.load_model(tmp_path)
    plain["model"] = 3
    (tmp_path / "config.json").write_text(json.dumps(plain))
    with pytest.raises(ConfigError, match=re.escape(str(tmp_path))):
        l3r.load_model(tmp_path)


@pytest.mark.parametrize("load", [l3r.load_model, Light3R.from_pretrained])
def test_an_official_file_is_answered_with_the_command_that_imports_it(load, tmp_path):
    for path in (write_pth(tmp_path / "a.pth"), write_hub_folder(tmp_path / "hub")):
        with pytest.raises(CheckpointError) as error:
            load(path)
        assert f"l3r weights import {path} --out" in str(error.value)
        assert "\n" not in str(error.value)


def test_a_name_of_the_hub_is_fetched_and_a_path_is_not(network, tmp_path, monkeypatch):
    network.save_pretrained(tmp_path / "cache")
    asked = []

    def snapshot_download(name, *, local_dir, allow_patterns):
        asked.append((name, local_dir, allow_patterns))
        return str(tmp_path / "cache")

    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot_download)
    assert_same(Light3R.from_pretrained("me/light3r-512"), network)
    assert_same(Light3R.from_pretrained(tmp_path / "cache"), network)
    patterns = ["config.json", "model.safetensors", "README*", "LICENSE*"]
    assert asked == [("me/light3r-512", None, patterns)]
    with pytest.raises(CheckpointError, match="no such file or folder"):
        Light3R.from_pretrained("a/b/c")


def test_pushing_uploads_what_saving_writes(network, tmp_path, monkeypatch):
    done = []

    class Api:
        def create_repo(self, name, *, private, exist_ok):
            done.append((name, private, exist_ok))
            return f"https://hub/{name}"

        def upload_folder(self, *, repo_id, folder_path):
            assert repo_id == "me/mine"
            assert_same(Light3R.from_pretrained(folder_path), network)
            done.append(json.loads((folder_path / "config.json").read_text())["train"]["note"])
            done.append(folder_path)

    monkeypatch.setattr("huggingface_hub.HfApi", Api)
    assert network.push_to_hub("me/mine", note="a licence") == "https://hub/me/mine"
    *first, folder = done
    assert first == [("me/mine", True, True), "a licence"]
    assert not folder.exists()


@pytest.mark.parametrize(
    "failure",
    [OSError("down\nand out"), ValueError("a bad name"), RuntimeError("half a file")],
)
def test_whatever_the_hub_says_becomes_one_line(network, failure, monkeypatch):
    def fail(*_, **__):
        raise failure

    monkeypatch.setattr("huggingface_hub.snapshot_download", fail)
    monkeypatch.setattr("huggingface_hub.HfApi.create_repo", fail)
    for job in (lambda: fetch_folder("me/mine"), lambda: network.push_to_hub("me/mine")):
        with pytest.raises(CheckpointError, match=r"^me/mine: could not be") as error:
            job()
        assert str(failure).split("\n")[0] in str(error.value)
        assert "\n" not in str(error.value)


def test_an_error_of_the_hubs_http_library_becomes_one_line(monkeypatch):
    from huggingface_hub.errors import HfHubHTTPError

    base = HfHubHTTPError.__bases__[0]

    def fail(*_, **__):
        raise type("ReadTimeout", (base,), {})("timed out")

    monkeypatch.setattr("huggingface_hub.snapshot_download", fail)
    with pytest.raises(CheckpointError, match=r"ReadTimeout: timed out"):
        fetch_folder("me/mine")


def test_without_the_extra_the_line_says_what_to_install(network, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "huggingface_hub"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for job in (lambda: fetch_folder("me/mine"), lambda: network.push_to_hub("me/mine")):
        with pytest.raises(CheckpointError, match=r"pip install 'light3r\[hub\]'"):
            job()


@pytest.mark.parametrize("name", ["light3r", "a/b/c", "me/my net", "/me/net", ""])
def test_a_name_that_no_repository_can_have_is_refused(name):
    with pytest.raises(CheckpointError, match="expected owner/name"):
        fetch_folder(name)
