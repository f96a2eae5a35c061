import itertools
import logging

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from l3r.config import DataConfig, SourceConfig
from l3r.data.loader import SkipGuard, build_training_loader
from l3r.data.sampling import SampleChooser
from l3r.data.schema import index_path
from l3r.data.source import ShardFolder, open_folders
from l3r.data.steps import DeviceShare, read_graph, read_or_another
from l3r.errors import ConfigError, DataError
from tests.data.graphs import make_graph, make_mixed_graph, write_folder


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shards") / "train"
    return write_folder(folder, [make_graph(n, height=16, width=16) for n in range(10)])


def config(*folders, **changes):
    sources = {f"s{i}": SourceConfig(shards=str(folder)) for i, folder in enumerate(folders)}
    return DataConfig(
        sources=sources, **{"num_views": 3, "graphs_per_step": 4, "num_workers": 0, **changes}
    )


def loader(data, num_steps=6, seed=0, **share):
    return build_training_loader(
        data, (16, 16), seed=seed, num_steps=num_steps, share=DeviceShare(**share)
    )


def keys(batches):
    return [batch.key for batch in batches]


def test_the_same_seed_gives_the_same_batches_and_another_seed_others(shards):
    first, second = loader(config(shards)), loader(config(shards))
    for one, two in zip(first, second, strict=True):
        assert one.key == two.key
        assert torch.equal(one.image, two.image)
    assert keys(loader(config(shards), seed=1)) != keys(loader(config(shards)))


def test_going_on_from_a_saved_step_gives_what_would_have_come(shards):
    everything = keys(loader(config(shards)))
    stopped = loader(config(shards))
    assert keys(itertools.islice(stopped, 2)) == everything[:2]
    # The loader counted a batch when it was asked for: two were handed out.
    state = stopped.state_dict()
    assert state == {"step": 2}
    resumed = loader(config(shards))
    resumed.load_state_dict(state)
    assert keys(resumed) == everything[2:]


def test_workers_change_nothing_even_over_a_resume(shards):
    everything = keys(loader(config(shards)))
    resumed = loader(config(shards, num_workers=2))
    resumed.load_state_dict({"step": 3})
    assert keys(resumed) == everything[3:]


@pytest.mark.parametrize("world_size", [2, 4])
def test_devices_share_out_exactly_the_samples_of_one(shards, world_size):
    whole = keys(loader(config(shards)))
    parts = [keys(loader(config(shards), rank=r, world_size=world_size)) for r in range(world_size)]
    for step, expected in enumerate(whole):
        slots = [None] * 4
        for rank in range(world_size):
            slots[rank::world_size] = parts[rank][step]
        assert slots == expected


def test_every_graph_comes_once_before_any_comes_again(shards):
    drawn = list(itertools.chain.from_iterable(keys(loader(config(shards), num_steps=5))))
    assert len(set(drawn[:10])) == 10
    assert len(set(drawn[10:20])) == 10
    assert drawn[10:20] != drawn[:10], "each time in another order"


@given(st.integers(0, 2**31), st.lists(st.integers(1, 30), min_size=1, max_size=3))
def test_the_choice_depends_on_seed_step_and_slot_alone(seed, sizes):
    weights = [1.0 + i for i in range(len(sizes))]
    forwards = SampleChooser(sizes, weights, 4, seed)
    backwards = SampleChooser(sizes, weights, 4, seed)
    table = {(s, t): forwards.choose(s, t) for s in range(8) for t in range(4)}
    again = {(s, t): backwards.choose(s, t) for s in reversed(range(8)) for t in reversed(range(4))}
    assert table == again
    for source, graph in table.values():
        assert 0 <= graph < sizes[source]


def test_sources_come_as_often_as_they_weigh():
    chooser = SampleChooser([50, 50], [3.0, 1.0], 8, 0)
    draws = [chooser.choose(step, slot)[0] for step in range(250) for slot in range(8)]
    assert draws.count(0) / len(draws) == pytest.approx(0.75, abs=0.04)


def test_a_graph_is_read_in_greedy_order_and_cut_to_its_first_views(shards):
    folder = ShardFolder(shards, 3)
    sample = folder.read(7)
    assert sample.key == "train/hand-000001.tar:hand-000007"
    assert sample.graph.file == ["7-0.png", "7-1.png", "7-2.png"]
    views = read_graph(folder, 7, (16, 16))
    assert views.image.shape == (1, 3, 3, 16, 16)
    assert views.depth[0, 2, 0, 0] == 3


def test_graphs_of_portrait_and_landscape_images_load(tmp_path):
    ways = [(False, True, True), (True, True, True), (False, False, False), (True, False, True)]
    graphs = [make_mixed_graph(n, ways[n], height=24, width=32) for n in range(4)]
    data = config(write_folder(tmp_path, graphs))
    share = DeviceShare()
    (batch,) = build_training_loader(data, (16, 24), seed=0, num_steps=1, share=share)
    assert batch.image.shape == (4, 3, 3, 16, 24)
    assert batch.depth.shape == (4, 3, 16, 24)
    for key, true_shape in zip(batch.key, batch.true_shape.tolist(), strict=True):
        upright = ways[int(key.rpartition("-")[2])]
        assert true_shape == [[24, 16] if portrait else [16, 24] for portrait in upright]


def test_shards_without_an_index_are_scanned(tmp_path):
    folder = write_folder(tmp_path, [make_graph(n, height=16, width=16) for n in range(2)])
    assert not index_path(folder / "hand-000000.tar").exists()
    assert [len(f) for f in open_folders(config(folder).sources, config(folder))] == [2]


def spoil(folder, number):
    """Overwrite the first bytes of a graph's first JPEG."""
    shard = folder / f"hand-{number // 4:06d}.tar"
    content = bytearray(shard.read_bytes())
    at = content.index(f"hand-{number:06d}.00.jpg".encode()) + 512
    content[at : at + 64] = b"\0" * 64
    shard.write_bytes(content)


def test_an_unreadable_sample_is_named_and_another_takes_its_place(tmp_path, caplog):
    folder = write_folder(tmp_path, [make_graph(n, height=16, width=16) for n in range(10)])
    spoil(folder, 2)
    with caplog.at_level(logging.WARNING):
        batches = keys(loader(config(folder, max_skip_rate=0.5), num_steps=5))
    assert all(len(batch) == 4 for batch in batches)
    drawn = list(itertools.chain.from_iterable(batches))
    assert not any(key.endswith(":hand-000002") for key in drawn)
    assert "hand-000002" in caplog.text
    assert "00.jpg" in caplog.text


def test_a_sample_that_cannot_be_cropped_is_skipped_too(tmp_path):
    graphs = [make_graph(n, height=16, width=16) for n in range(6)]
    graphs[3].K[:, 0, 2] = 900.0
    folder = ShardFolder(write_folder(tmp_path, graphs), 3)
    skipped = []
    graph = read_or_another(folder, 3, (16, 16), skipped)
    assert not graph.key.endswith("hand-000003")
    assert len(skipped) == 1
    assert "principal point" in skipped[0]


def test_a_span_takes_a_share_of_the_graphs_and_its_complement_the_rest(shards):
    kept, held = ShardFolder(shards, 3, (0.0, 0.7)), ShardFolder(shards, 3, (0.7, 1.0))
    names = [folder.key(i) for folder in (kept, held) for i in range(len(folder))]
    assert (len(kept), len(held)) == (7, 3)
    assert names == [ShardFolder(shards, 3).key(i) for i in range(10)]
    with pytest.raises(ConfigError, match=r"span.*rising"):
        SourceConfig(shards="x", span=[0.5, 0.5])


def test_what_a_span_holds_out_for_one_number_of_images_it_holds_out_for_all(tmp_path):
    graphs = [make_graph(n, num_views=8 if n < 5 else 3, height=16, width=16) for n in range(10)]
    folder = write_folder(tmp_path, graphs)
    kept, held = ShardFolder(folder, 3, (0.0, 0.4)), ShardFolder(folder, 8, (0.4, 1.0))
    assert (len(kept), len(held)) == (4, 1)
    assert not {kept.key(i) for i in range(4)} & {held.key(0)}


class Unreadable(ShardFolder):
    """Writes down what it is asked for."""

    def __init__(self, total, asked):
        self.total, self.asked = total, asked

    def __len__(self):
        return self.total

    def key(self, index):
        return str(index)

    def read(self, index):
        self.asked.append(index)
        raise DataError("gone")


@given(st.integers(1, 400), st.data())
def test_what_stands_in_for_an_unreadable_graph_lies_elsewhere(total, data):
    """Twenty different graphs are tried, no two in a row of one shard of a tenth of them."""
    first, asked = data.draw(st.integers(0, total - 1)), []
    assert read_or_another(Unreadable(total, asked), first, (16, 16), []) is None
    assert asked[0] == first
    assert len(set(asked)) == len(asked) == min(total, 20)
    if total >= 20:
        assert all(abs(a - b) > total / 10 for a, b in itertools.pairwise(asked))


def test_too_many_unreadable_samples_stop_the_run(tmp_path):
    folder = write_folder(tmp_path, [make_graph(n, height=16, width=16) for n in range(10)])
    for number in range(0, 10, 2):
        spoil(folder, number)
    with pytest.raises(DataError, match=r"max_skip_rate=0.01.*last: .*l3r-prep check"):
        keys(loader(config(folder), num_steps=200))


@pytest.mark.parametrize(("max_rate", "borne"), [(0.0, 0), (0.01, 10), (0.0005, 0), (1.0, 3000)])
def test_the_share_of_the_last_thousand_samples_is_bounded(max_rate, borne):
    guard = SkipGuard(max_rate)
    guard.count(100_000, [])  # what went well long ago excuses nothing
    for _ in range(borne):
        guard.count(0, ["bad"])
    if max_rate < 1:
        with pytest.raises(DataError, match="cannot be read"):
            guard.count(1, ["one too many"])


def test_unreadable_samples_far_apart_are_borne(caplog):
    guard = SkipGuard(0.01)
    with caplog.at_level(logging.WARNING):
        for number in range(250):
            guard.count(100, [f"bad {number}"])
    said = [record.getMessage().rpartition(" ")[2] for record in caplog.records]
    assert said == ["0", "99", "199"]  # the first and each hundredth


def test_a_shard_deleted_during_a_run_costs_its_samples_and_no_more(tmp_path, caplog):
    folder = write_folder(tmp_path, [make_graph(n, height=16, width=16) for n in range(40)])
    strict = iter(loader(config(folder, max_skip_rate=0.001), num_steps=30))
    batches = iter(loader(config(folder, max_skip_rate=0.5), num_steps=30))
    next(strict), next(batches)
    (folder / "hand-000003.tar").unlink()
    with caplog.at_level(logging.WARNING):
        drawn = list(itertools.chain.from_iterable(keys(batches)))
    assert len(drawn) == 29 * 4
    assert not any("hand-000003.tar" in key for key in drawn)
    assert "hand-000003.tar:hand-0000" in caplog.text
    with pytest.raises(DataError, match=r"last: .*hand-000003\.tar:hand-0000"):
        keys(strict)


def test_nothing_readable_stops_at_once(tmp_path):
    folder = write_folder(tmp_path, [make_graph(n, height=16, width=16) for n in range(2)])
    for number in range(2):
        spoil(folder, number)
    for num_workers in (0, 1):
        data = config(folder, max_skip_rate=1.0, num_workers=num_workers)
        with pytest.raises(DataError, match="no graph can be read; last: ") as error:
            keys(loader(data))
        assert "\n" not in str(error.value)  # even out of a worker


def test_requests_that_cannot_be_met_say_what_to_do(shards, tmp_path):
    with pytest.raises(ConfigError, match=r"data\.sources is empty"):
        loader(config())
    with pytest.raises(ConfigError, match="at least 5: 5 devices"):
        loader(config(shards), world_size=5)
    with pytest.raises(DataError, match=r"manifest\.json: no such file"):
        loader(config(tmp_path))
    small = write_folder(tmp_path / "small", [make_graph(0, num_views=2, height=16, width=16)])
    with pytest.raises(DataError, match="no graph of 3 images"):
        loader(config(small))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"cache_gb": 1.0}, "cache_gb: no data.cache_dir"),
        ({"cache_dir": "CACHE"}, "cache_dir: data.cache_gb is 0"),
        ({"cache_dir": "CACHE", "cache_gb": 1.0}, "cache_dir: no source is an http"),
        ({"prefetch_factor": 4}, "prefetch_factor: data.num_workers is 0"),
        ({}, ""),
    ],
)
def test_settings_without_effect_are_named(shards, tmp_path, monkeypatch, caplog, settings, words):
    monkeypatch.chdir(tmp_path)
    with caplog.at_level(logging.WARNING):
        loader(config(shards, **settings))
        loader(config(shards, **settings), rank=1, world_size=2)  # once, not on each device
    found = [record.getMessage() for record in caplog.records]
    assert len(found) == bool(words)
    assert all(f"no effect of data.{words}" in line for line in found)
