"""The cache of what is read from web servers: limit, order of leaving, damage, full disks."""

import logging
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from l3r.config import DataConfig, SourceConfig
from l3r.data import schema
from l3r.data.cache import LEDGER_NAME, CachedStore, GraphCache
from l3r.data.http_store import HttpStore
from l3r.data.source import ShardFolder, open_folders
from l3r.errors import ConfigError, DataError
from tests.data.caching import payload
from tests.data.graphs import make_graph, write_folder
from tests.data.range_server import serve

ROOT = Path(__file__).parents[2]


def entries(folder):
    return [path for path in folder.rglob("*") if path.is_file() and path.name != LEDGER_NAME]


def size(folder):
    total = 0
    for path in entries(folder):
        try:
            total += path.stat().st_size
        except FileNotFoundError:  # made room for another
            continue
    return total


@given(st.lists(st.integers(0, 30), max_size=40), st.integers(1000, 20_000))
def test_what_comes_back_is_what_was_kept_and_the_limit_always_holds(
    tmp_path_factory, numbers, limit
):
    folder = tmp_path_factory.mktemp("cache")
    cache = GraphCache(folder, limit)
    for number in numbers:
        cache.write(str(number), payload(number))
        assert size(folder) <= limit
        found = cache.read(str(number))
        fits = len(payload(number)) + 4 <= limit
        assert found == (payload(number) if fits else None)
    assert cache.read("never written") is None


def test_what_was_unused_for_longest_makes_room(tmp_path):
    cache = GraphCache(tmp_path, 10 * 1004)
    for number in range(10):
        cache.write(str(number), bytes(1000))
    for number in (0, 3):
        assert cache.read(str(number)) is not None
    cache.write("new", bytes(1000))
    kept = {name for name in [*map(str, range(10)), "new"] if cache.read(name) is not None}
    assert {"0", "3", "9", "new"} <= kept
    assert not {"1"} & kept


def test_many_processes_share_one_cache_within_its_limit(tmp_path):
    limit = 20_000
    command = [sys.executable, "-m", "tests.data.caching", str(tmp_path), str(limit)]
    running = [
        subprocess.Popen([*command, str(seed)], cwd=ROOT, stderr=subprocess.PIPE, text=True)
        for seed in range(4)
    ]
    largest = 0
    while any(process.poll() is None for process in running):
        largest = max(largest, size(tmp_path))
    assert 0 < largest <= limit
    for process in running:
        assert process.returncode == 0, process.stderr.read()
        process.stderr.close()
    assert not [path for path in entries(tmp_path) if path.name.endswith(".tmp")]


@pytest.mark.parametrize("damage", ["cut", "flip", "empty"])
def test_a_damaged_entry_is_dropped_and_read_again(tmp_path, damage, caplog):
    cache = GraphCache(tmp_path, 10_000)
    cache.write("x", payload(3))
    (path,) = entries(tmp_path)
    data = path.read_bytes()
    flipped = data[:50] + bytes([data[50] ^ 1]) + data[51:]
    path.write_bytes({"cut": data[:-9], "flip": flipped, "empty": b""}[damage])
    with caplog.at_level(logging.WARNING):
        assert cache.read("x") is None
    assert "damaged" in caplog.text
    cache.write("x", payload(3))
    assert cache.read("x") == payload(3)


@pytest.mark.parametrize("text", ["", "many", "-5"])
def test_a_damaged_ledger_is_measured_anew(tmp_path, text):
    cache = GraphCache(tmp_path, 5000)
    for number in range(4):
        cache.write(str(number), bytes(1000))
    (tmp_path / LEDGER_NAME).write_text(text)
    for number in range(4, 9):
        cache.write(str(number), bytes(1000))
        assert size(tmp_path) <= 5000
    assert int((tmp_path / LEDGER_NAME).read_text()) == size(tmp_path)


def test_what_a_killed_process_left_counts_and_leaves_in_its_turn(tmp_path):
    cache = GraphCache(tmp_path, 5000)
    (tmp_path / "ab").mkdir()
    (tmp_path / "ab" / ".half.tmp").write_bytes(bytes(3000))
    for number in range(5):
        cache.write(str(number), bytes(1000))
        assert size(tmp_path) <= 5000
    assert not (tmp_path / "ab" / ".half.tmp").exists()


@pytest.fixture
def small_files():
    """The kernel refuses files of more than 60 kB, as it would on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_write_that_fails_is_said_once_and_reading_goes_on(tmp_path, small_files, caplog):
    cache = GraphCache(tmp_path, 10**6)
    cache.write("small", bytes(100))
    with caplog.at_level(logging.WARNING):
        for number in range(3):
            cache.write(str(number), bytes(100_000))
    assert [r.getMessage().count("goes on without keeping") for r in caplog.records] == [1]
    assert size(tmp_path) == 104
    assert cache.read("small") == bytes(100)


@pytest.fixture
def server(tmp_path, monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    folder = write_folder(tmp_path / "www", [make_graph(n, 3, 32, 40) for n in range(4)])
    for tar in folder.glob("*.tar"):
        schema.write_index(tar, schema.index_shard(tar))
    with serve(folder) as running:
        yield running


def open_cached(server, folder, **changes):
    sources = {"x": SourceConfig(shards=server.url)}
    config = DataConfig(sources=sources, num_views=3, cache_dir=str(folder), **changes)
    (opened,) = open_folders(config.sources, config)
    return opened


def test_a_graph_is_fetched_once_and_then_read_from_disk(server, tmp_path):
    folder = open_cached(server, tmp_path / "cache", cache_gb=0.1)
    server.requests.clear()
    first, second = folder.read(1), folder.read(1)
    assert [asked is not None for _, asked in server.requests] == [True]
    assert all((a == b).all() for a, b in zip(first.graph.image, second.graph.image, strict=True))
    again = open_cached(server, tmp_path / "cache", cache_gb=0.1)
    server.requests.clear()
    assert again.read(1).key == first.key
    assert server.requests == []


def test_without_a_size_nothing_is_kept(server, tmp_path):
    open_cached(server, tmp_path / "cache").read(1)
    assert not (tmp_path / "cache").exists()
    with pytest.raises(ConfigError, match=r"data\.cache_gb is -1"):
        DataConfig(cache_gb=-1.0)


def test_shards_built_anew_at_the_same_address_are_read_anew(server, tmp_path):
    assert open_cached(server, tmp_path / "cache", cache_gb=0.1).read(0).graph.file[0] == "0-0.png"
    changed = write_folder(server.folder, [make_graph(n, 3, 32, 40) for n in (5, 1, 2, 3)])
    for tar in changed.glob("*.tar"):
        schema.write_index(tar, schema.index_shard(tar))
    assert open_cached(server, tmp_path / "cache", cache_gb=0.1).read(0).graph.file[0] == "5-0.png"


def test_bytes_that_are_no_graph_are_not_kept(server, tmp_path):
    cache = GraphCache(tmp_path / "cache", 10**8)
    folder = ShardFolder(CachedStore(HttpStore(server.url), cache), 3)
    tar = server.folder / "hand-000000.tar"
    good = tar.read_bytes()
    tar.write_bytes(bytes([255]) * len(good))
    with pytest.raises(DataError, match="hand-000000"):
        folder.read(0)
    tar.write_bytes(good)
    assert folder.read(0).graph.file[0] == "0-0.png"
