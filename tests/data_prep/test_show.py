"""One graph, large: points carried from image to image stand on the same things."""

import re

import numpy as np
import pytest

from data_prep.check.lookup import find_graph
from data_prep.check.tars import list_graphs
from data_prep.cli import main
from data_prep.pages.correspondences import count_status, find_correspondences
from data_prep.pages.show_page import draw_edge, render_show
from l3r.data.schema import decode_graph, read_members
from tests.data_prep import damage
from tests.data_prep.browser import open_page
from tests.data_prep.planting import MISTAKES
from tests.data_prep.test_check_page import parse, words


@pytest.fixture(scope="module")
def stored(room_shards):
    return list_graphs(room_shards)[0]


@pytest.fixture(scope="module")
def graph(stored):
    return decode_graph(read_members(stored.shard, stored.entry), stored.entry.num_views)


def pairs(graph):
    return [(i, j) for i in range(graph.num_views) for j in range(graph.num_views) if i != j]


def shades(graph, i, j):
    """Brightness at both ends of every point that j is said to see."""
    ends = [
        (graph.image[i][int(p.start[1]), int(p.start[0])].mean(),
         graph.image[j][int(p.end[1]), int(p.end[0])].mean())
        for p in find_correspondences(graph, i, j)
        if p.status == "seen"
    ]  # fmt: skip
    return np.array(ends, dtype=np.float64).reshape(-1, 2)


def test_points_that_are_seen_have_the_same_color_in_both_images(graph):
    both = np.concatenate([shades(graph, i, j) for i, j in pairs(graph)])
    assert len(both) > 50
    # Nearest pixels of a textured room; edges of texture spoil some.
    assert np.median(np.abs(both[:, 0] - both[:, 1])) < 4


def test_points_of_an_image_carried_into_itself_stay(graph):
    points = find_correspondences(graph, 0, 0)
    assert len(points) == 24
    for point in points:
        assert point.end == pytest.approx(point.start, abs=1e-6)
        # At an edge of depth the four neighbours of a pixel disagree.
        assert point.status in ("seen", "unknown")
    assert sum(point.status == "seen" for point in points) > 12


def test_points_are_within_their_images_and_numbered_once(graph):
    for i, j in pairs(graph):
        points = find_correspondences(graph, i, j)
        assert [point.number for point in points] == list(range(1, len(points) + 1))
        for point in points:
            for at, view in ((point.start, i), (point.end, j)):
                if at:
                    height, width = graph.image_size[view]
                    assert 0 <= at[0] < width
                    assert 0 <= at[1] < height
            assert (point.end is None) == (point.status == "outside")
        assert count_status(points).startswith(f"{len(points)} points: ")


def test_what_stands_before_another_thing_hides_it(graph):
    statuses = {p.status for i, j in pairs(graph) for p in find_correspondences(graph, i, j)}
    assert {"seen", "hidden"} <= statuses


@pytest.mark.parametrize("mistake", ["inverted", "wrong cameras", "swapped axes"])
def test_wrong_cameras_are_contradicted(graph, mistake):
    def seen(sample):
        points = [p for i, j in pairs(sample) for p in find_correspondences(sample, i, j)]
        return np.mean([p.status == "seen" for p in points])

    assert seen(MISTAKES[mistake](graph)) < 0.5 * seen(graph)


def test_scattered_depth_has_correspondences_too(scattered_shards):
    stored = list_graphs(scattered_shards)[0]
    graph = decode_graph(read_members(stored.shard, stored.entry), stored.entry.num_views)
    (edge, *_) = [draw_edge(graph, i, j) for i, j in pairs(graph)]
    assert any(mark.point.status == "seen" for mark in edge.marks)


def test_the_page_holds_all_images_pairs_and_edges(stored, graph):
    html = render_show(stored, graph)
    tags = parse(html).tags
    n = graph.num_views
    assert sum(tag == "img" for tag, _ in tags) == 2 * n
    assert sum(tag == "image" for tag, _ in tags) == 2 * (n - 1)
    (table,) = re.findall(r"<tbody>(.*?)</tbody>", html, re.DOTALL)
    assert table.count("<tr") == n * (n - 1) // 2
    assert table.count('class="joined"') == n - 1
    text = words(html)
    for phrase in (stored.entry.key, *graph.file, "metres", f"{graph.pairs.iou[0, 1]:.3f}"):
        assert phrase in text, phrase


def test_a_browser_opens_the_page(stored, graph, tmp_path):
    page = tmp_path / "graph.html"
    page.write_text(render_show(stored, graph), encoding="utf-8")
    found = open_page(page, tmp_path, 800)
    assert found["console"] == []
    assert found["decoded"] == found["images"] == 2 * graph.num_views + 2 * (graph.num_views - 1)
    assert not found["wide"]


def test_the_command_writes_where_it_says(room_shards, stored, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["show", str(room_shards), stored.entry.key]) == 0
    assert capsys.readouterr().out == f"{stored.entry.key}.html\n"
    assert (tmp_path / f"{stored.entry.key}.html").stat().st_size > 10_000
    assert main(["show", str(room_shards), stored.name, "--out", "graph.html"]) == 0
    assert (tmp_path / "graph.html").is_file()
    assert main(["show", str(room_shards), stored.name, "--out", "graph.png"]) == 2
    assert "expected a name that ends in .html" in capsys.readouterr().err


def test_a_graph_is_found_by_its_key_or_as_training_names_it(room_shards, stored):
    key, tar = stored.entry.key, stored.shard.name
    for name in (key, f"{tar}:{key}", stored.name, f"/elsewhere/{stored.name}"):
        assert find_graph(room_shards, name).entry == stored.entry


def test_an_unknown_key_names_the_nearest(room_shards, stored, capsys):
    wrong = stored.entry.key.replace("room", "rom")
    assert main(["show", str(room_shards), wrong]) == 2
    message = capsys.readouterr().err
    assert f"no graph '{wrong}'; nearest of 5 keys: {stored.entry.key}" in message
    assert main(["show", str(room_shards), f"nothing.tar:{stored.entry.key}"]) == 2
    assert "leave the tar's name out" in capsys.readouterr().err


def test_a_key_of_train_and_val_must_be_told_apart(room_shards, stored, tmp_path, capsys):
    for part in ("train", "val"):
        damage.copy(room_shards, tmp_path / part)
    key, tar = stored.entry.key, stored.shard.name
    assert main(["show", str(tmp_path), key]) == 2
    message = capsys.readouterr().err
    assert f"train/{tar}:{key}, val/{tar}:{key}; name one of them" in message
    assert find_graph(tmp_path, f"val/{tar}:{key}").shard.parent.name == "val"


def test_a_graph_is_found_beside_a_tar_that_is_lost(room_shards, tmp_path, capsys):
    folder = damage.copy(room_shards, tmp_path / "shards")
    lost = damage.first_tar(folder)
    key = damage.keys_of(lost)[0]
    last = list_graphs(folder)[-1].entry.key
    lost.unlink()
    assert find_graph(folder, last).entry.key == last
    assert main(["show", str(folder), key]) == 2
    assert f"1 tars cannot be read, first {lost.name}" in capsys.readouterr().err


def test_a_damaged_graph_is_refused_with_its_fault(room_shards, tmp_path, capsys):
    folder = damage.copy(room_shards, tmp_path / "shards")
    key = damage.edit_first(damage.first_tar(folder), lambda members: members.pop("01.jpg"))
    assert main(["show", str(folder), key, "--out", str(tmp_path / "graph.html")]) == 2
    assert "missing_member" in capsys.readouterr().err
    assert not (tmp_path / "graph.html").exists()
