"""Shards from a real web server: ranges, connections, faults."""

import contextlib
import json
import pickle
import shutil

import pytest
import torch

from l3r.config import DataConfig, SourceConfig
from l3r.data import http_store, schema
from l3r.data.http_store import HttpStore
from l3r.data.loader import build_training_loader
from l3r.data.source import ShardFolder, open_store
from l3r.data.steps import DeviceShare, read_or_another
from l3r.data.store import FolderStore, UnreachableError
from l3r.errors import DataError
from tests.data.graphs import make_graph, write_folder
from tests.data.range_server import serve


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """Six graphs in two tars, with indices as ``l3r-prep build`` writes them."""
    folder = write_folder(
        tmp_path_factory.mktemp("www") / "room set", [make_graph(n, 3, 32, 40) for n in range(6)]
    )
    for tar in folder.glob("*.tar"):
        schema.write_index(tar, schema.index_shard(tar))
    return folder


@pytest.fixture
def server(shards):
    with serve(shards.parent) as running:
        yield running


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch):
    monkeypatch.setattr(http_store, "PAUSES", (0.0, 0.01, 0.01))
    monkeypatch.setenv("no_proxy", "127.0.0.1")


@pytest.fixture
def remote(server, shards):
    return ShardFolder(HttpStore(f"{server.url}/{shards.name}"), 3)


def test_graphs_come_over_http_as_they_lie_on_disk(remote, shards):
    local = ShardFolder(shards, 3)
    assert len(remote) == len(local) == 6
    for index in range(6):
        one, two = remote.read(index), local.read(index)
        assert one.key == two.key
        assert one.graph.file == two.graph.file
        assert all((a == b).all() for a, b in zip(one.graph.image, two.graph.image, strict=True))


def test_a_graph_is_one_request_for_its_range_on_one_kept_connection(server, shards):
    store = HttpStore(f"{server.url}/{shards.name}/")
    manifest = store.read_manifest()
    (first, second) = (store.read_index(shard) for shard in manifest.shards)
    server.requests.clear()
    for entry in first.graphs:
        store.read_graph(manifest.shards[0], entry)
    store.read_graph(manifest.shards[1], second.graphs[1])
    ranges = [f"bytes={e.offset}-{e.offset + e.size - 1}" for e in first.graphs]
    assert [asked for _, asked in server.requests][:-1] == ranges
    assert server.requests[0][0] == "/room%20set/hand-000000.tar"
    assert len(server.connections) == 1


@pytest.mark.parametrize("fault", [500, 503, 429, "close", "cut"])
def test_what_passes_is_tried_again(remote, server, fault):
    server.requests.clear()
    server.faults.extend([fault, fault])
    assert remote.read(2).graph.file[0] == "2-0.png"
    assert len(server.requests) == 3


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (500, "answers 500 Internal Server Error, 4 times in a row"),
        ("cut", "4 times in a row"),
        ("close", "4 times in a row"),
    ],
)
def test_what_does_not_pass_is_an_error_that_names_the_graph(remote, server, fault, words):
    server.faults.extend([fault] * 4)
    with pytest.raises(DataError, match=rf"hand-000000\.tar:hand-000002: .*{words}") as error:
        remote.read(2)
    assert "\n" not in str(error.value)
    assert remote.read(2).graph.file[0] == "2-0.png"


@pytest.mark.parametrize("status", [403, 404, 416])
def test_a_refusal_is_not_asked_for_again(remote, server, status):
    server.requests.clear()
    server.faults.append(status)
    with pytest.raises(DataError, match=f"tar:hand-000001: the server answers {status}"):
        remote.read(1)
    assert len(server.requests) == 1


def test_a_short_answer_is_an_error(remote, server):
    server.faults.append("short")
    with pytest.raises(DataError, match=r"gave \d+ of \d+ bytes, its tar is cut off"):
        remote.read(1)


def test_a_server_without_ranges_is_an_error(remote, server):
    server.knows_ranges = False
    with pytest.raises(DataError, match="sends the whole tar, expected the range"):
        remote.read(1)


def test_a_range_other_than_asked_for_is_refused(remote, server, monkeypatch):
    monkeypatch.setattr(
        "tests.data.range_server.Handler.answer_range",
        lambda handler, path, asked, fault: handler.answer(
            206, path.read_bytes()[:9], {"Content-Range": "bytes 0-8/9"}
        ),
    )
    with pytest.raises(DataError, match=r"sends 'bytes 0-8/9' of 9 bytes, expected bytes \d{3,}-"):
        remote.read(1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda first, last: (f"bytes {first}-{last + 1}/99999999", 0), "the server sends 'bytes"),
        (lambda first, last: (f"bytes {first}-{last - 1}/99999999", 0), "the server sends 'bytes"),
        (lambda first, last: ("", 0), "the server sends ''"),
        (lambda first, last: (f"bytes {first}-{last}/99999999", -1), "the server sends 'bytes"),
        (lambda first, last: (f"bytes {first}-{last}/99999999", 1), "sends more than was asked"),
    ],
)
def test_a_range_or_length_other_than_asked_is_refused(remote, server, monkeypatch, change, words):
    def answer_range(handler, path, asked, fault):
        first, last = map(int, asked.removeprefix("bytes=").split("-"))
        span, more = change(first, last)
        handler.answer(206, bytes(last - first + 1 + more), {"Content-Range": span})

    monkeypatch.setattr("tests.data.range_server.Handler.answer_range", answer_range)
    with pytest.raises(DataError, match=words):
        remote.read(1)


def test_a_flood_is_not_drunk(remote, server, shards, monkeypatch):
    """Without a length, for as long as somebody reads."""
    sent = []

    def flood(handler, status, data, headers=None, fault=None):
        handler.send_response(status)
        for name, value in {**(headers or {}), "Connection": "close"}.items():
            handler.send_header(name, value)
        handler.end_headers()
        handler.close_connection = True
        sent.append(0)
        with contextlib.suppress(OSError):
            while sent[-1] < 2**30:
                sent[-1] += handler.wfile.write(data)

    monkeypatch.setattr("tests.data.range_server.Handler.answer", flood)
    monkeypatch.setattr(http_store, "MAX_FILE_BYTES", 10_000)
    with pytest.raises(DataError, match="the server sends more than was asked"):
        remote.read(1)
    with pytest.raises(DataError, match=r"manifest\.json: the server sends more than was asked"):
        remote.store.read_manifest()
    assert max(sent) < 2**26  # buffers of the system


def test_a_trickle_ends(remote, monkeypatch):
    monkeypatch.setattr(http_store, "MAX_SECONDS", -1.0)
    with pytest.raises(DataError, match=r"bytes in .* s, 1 times in a row"):
        remote.read(1)


def test_a_server_that_is_gone_stops_a_run_without_trying_other_graphs(shards):
    with serve(shards.parent) as running:
        folder = ShardFolder(HttpStore(f"{running.url}/{shards.name}"), 3)
    folder.store = pickle.loads(pickle.dumps(folder.store))  # without the connection it kept
    skipped = []
    assert read_or_another(folder, 0, (32, 32), skipped) is None
    (line,) = skipped
    assert "refused" in line
    assert "4 times in a row; look after the server" in line
    with pytest.raises(UnreachableError):
        folder.read(0)


def test_a_server_that_fails_on_one_graph_is_asked_for_another(remote, server):
    server.faults.extend(["close"] * 4)
    skipped = []
    assert read_or_another(remote, 0, (32, 32), skipped) is not None
    assert len(skipped) == 1


def test_redirects_are_followed_range_and_all(remote, server, shards):
    with serve(shards.parent) as other:
        server.redirect = other.url
        assert remote.read(4).graph.file[0] == "4-0.png"
        assert other.requests[-1][1] is not None


def test_no_server_at_all_is_an_error_of_one_line(server, shards):
    with serve(shards) as gone:
        pass
    with pytest.raises(DataError, match=r"manifest\.json: .*refused.*4 times in a row") as error:
        HttpStore(gone.url).read_manifest()
    assert "\n" not in str(error.value)


def test_what_is_missing_or_does_not_belong_together_is_said(server, shards, tmp_path):
    copied = shutil.copytree(shards, tmp_path / "copied")
    server.folder = tmp_path
    with pytest.raises(DataError, match=r"nothing/manifest\.json: .*404.*finished shards"):
        ShardFolder(HttpStore(f"{server.url}/nothing"), 3)
    index = schema.index_path(copied / "hand-000001.tar")
    index.write_text(json.dumps({**json.loads(index.read_text()), "tar_bytes": 10**9}))
    with pytest.raises(DataError, match=r"index\.json: made of a tar of 1000000000 bytes"):
        ShardFolder(HttpStore(f"{server.url}/copied"), 3)
    index.unlink()
    with pytest.raises(DataError, match=r"hand-000001\.index\.json: .*404.*l3r-prep build"):
        ShardFolder(HttpStore(f"{server.url}/copied"), 3)


def test_loader_processes_open_connections_of_their_own(server, shards):
    url = f"{server.url}/{shards.name}"
    batches = [
        list(
            build_training_loader(
                DataConfig(
                    sources={"x": SourceConfig(shards=place)},
                    num_views=3,
                    graphs_per_step=2,
                    num_workers=num_workers,
                ),
                (32, 32),
                seed=0,
                num_steps=4,
                share=DeviceShare(),
            )
        )
        for place, num_workers in ((str(shards), 0), (url, 1))
    ]
    for one, two in zip(*batches, strict=True):
        assert one.key == two.key
        assert torch.equal(one.image, two.image)
    used = HttpStore(url)
    used.read_manifest()
    assert pickle.loads(pickle.dumps(used)).read_manifest() == used.read_manifest()


def test_places_that_cannot_be_read_by_ranges_say_what_to_do():
    assert isinstance(open_store("shards/train"), FolderStore)
    assert isinstance(open_store("https://host/shards"), HttpStore)
    with pytest.raises(DataError, match=r"pipe has no ranges.*to a disk first"):
        open_store("pipe:cat x.tar")
    with pytest.raises(DataError, match="found 's3:', expected a folder or an http"):
        open_store("s3://bucket/shards")
    for secret in ("https://me:secret@host/x", "https://host/x?signature=secret"):
        with pytest.raises(DataError, match="expected https://HOST/FOLDER") as error:
            open_store(secret)
        assert "secret" not in str(error.value)


@pytest.mark.parametrize("data", [b"{", b"[]", b'{"schema_version": 99}'])
def test_files_that_are_no_index_or_manifest_are_named(data):
    with pytest.raises(DataError, match="https://host/x: no index"):
        schema.parse_index(data, "https://host/x")
    with pytest.raises(DataError, match="https://host/x: "):
        schema.parse_manifest(data, "https://host/x")


def test_a_range_beyond_the_end_of_a_tar_on_disk_is_named(shards):
    tar = shards / "hand-000000.tar"
    entry = schema.index_shard(tar).graphs[0]
    assert schema.members_from_bytes(schema.read_range(tar, entry), "x", entry.key)
    beyond = schema.IndexEntry(key="k", offset=tar.stat().st_size - 5, size=10, num_views=1)
    with pytest.raises(DataError, match=r"hand-000000\.tar:k: 5 of 10 bytes"):
        schema.read_range(tar, beyond)
