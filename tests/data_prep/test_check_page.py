"""The page of a check: one file, true to the shards, readable in a browser."""

import base64
import re
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_prep.check import CheckOptions, check_shards
from data_prep.check.histograms import Histogram
from data_prep.check.tars import list_graphs
from data_prep.cli import main
from data_prep.pages.charts import BOTTOM, LEFT, RIGHT, TOP, draw_counts, draw_histogram
from data_prep.pages.check_page import Section, limits_of, render_check
from data_prep.pages.pictures import DepthScale, depth_picture, image_picture
from data_prep.pages.sheets import draw_sheet
from data_prep.pages.tree_plan import draw_tree, oracle_tree
from l3r.data.schema import decode_graph, read_members
from tests.data_prep import damage
from tests.data_prep.browser import open_page


class Balanced(HTMLParser):
    """Fails on tags that are not closed in order."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.text = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "br", "link"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def parse(html):
    parser = Balanced()
    parser.feed(html)
    parser.close()
    assert not parser.open
    return parser


def words(html):
    return " ".join(" ".join(parse(html).text).split())


@pytest.fixture(scope="module")
def stored(room_shards):
    return list_graphs(room_shards)[1]


@pytest.fixture(scope="module")
def graph(stored):
    return decode_graph(read_members(stored.shard, stored.entry), stored.entry.num_views)


@pytest.fixture(scope="module")
def section(room_shards):
    sheets = []
    report = check_shards(
        room_shards,
        CheckOptions(max_graphs=3, num_shown=2),
        show=lambda stored, sample: sheets.append(draw_sheet(stored, sample)),
    )
    return Section(report=report, limits=limits_of(report.dataset), sheets=sheets)


def test_the_page_is_one_file_without_script_or_network(section):
    html = render_check([section])
    tags = parse(html).tags
    assert not [tag for tag, _ in tags if tag in ("script", "iframe", "object")]
    for tag, attributes in tags:
        for name in ("src", "href"):
            assert attributes.get(name, "data:").startswith("data:"), tag
    assert "http" not in re.sub(r"data:[^\"]*", "", html)
    assert "url(" not in html


def test_the_page_says_what_was_measured_and_allowed(section):
    text = words(render_check([section]))
    for phrase in (
        "Shards passed",
        "depth disagreement 0.0",
        "0.035% or less pass",
        "0.25 px or less pass",
        "0.05 m to 500 m pass",
        "not read checksums (SHA-256)",
        "3 graphs that were read of 5",
        "160 x 120",
        "l3r-prep show",
    ):
        assert phrase in text, phrase


def test_faults_come_before_the_histograms_and_a_failed_limit_is_marked(room_shards, tmp_path):
    folder = damage.copy(room_shards, tmp_path / "shards")
    tar = damage.first_tar(folder)
    tar.unlink()
    report = check_shards(folder, CheckOptions(max_graphs=2))
    html = render_check([Section(report=report, limits=limits_of("synthetic"))])
    text = words(html)
    assert "Shards failed" in text
    assert f"missing_tar: {tar.name}: no such file" in text
    assert text.index("missing_tar") < text.index("What the graphs are like")
    assert html.count('class="failed"') == 2


def test_a_folder_of_which_nothing_can_be_read_has_a_page(room_shards, tmp_path):
    folder = damage.copy(room_shards, tmp_path / "shards")
    for tar in folder.glob("*.tar"):
        tar.unlink()
    section = Section(report=check_shards(folder), limits=limits_of("synthetic"))
    text = words(render_check([section]))
    assert "geometry was not measured" in text
    assert "What the graphs are like" not in text


def test_odd_names_are_escaped(section, stored, graph):
    evil = '"><script>alert(1)</script>'
    odd = replace(graph, file=[evil] * graph.num_views, scene=evil)
    report = replace(section.report, folder=evil, dataset=evil, problems={evil: 1})
    html = render_check(
        [Section(report=report, limits=section.limits, sheets=[draw_sheet(stored, odd)])]
    )
    assert "<script" not in html
    parse(html)


def pixels(picture):
    data = base64.b64decode(picture.uri.split(",")[1])
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert image.shape == (picture.height, picture.width, 3)
    return image.astype(int)


def test_pictures_are_upright_and_small():
    image = np.zeros((480, 640, 3), np.uint8)
    image[:240, :320] = [255, 0, 0]
    picture = image_picture(image, 200)
    assert (picture.width, picture.height) == (200, 150)
    shown = pixels(picture)
    assert shown[10, 10] == pytest.approx([255, 0, 0], abs=6)
    assert shown[140, 10] == pytest.approx([0, 0, 0], abs=6)
    portrait = image_picture(np.zeros((640, 480, 3), np.uint8), 200)
    assert (portrait.width, portrait.height) == (150, 200)


def test_depth_is_red_near_blue_far_and_striped_where_unknown():
    depth = np.tile(np.geomspace(1, 10, 64, dtype=np.float32), (48, 1))
    depth[:16] = 0
    scale = DepthScale.of([depth], is_metric=True)
    shown = pixels(depth_picture(depth, np.zeros((48, 64, 3), np.uint8), scale, 200))
    assert shown[40, 2, 0] > shown[40, 2, 2] + 60
    assert shown[40, -6, 2] > shown[40, -6, 0] + 60
    unknown = shown[2:14]
    assert np.ptp(unknown, axis=-1).max() < 30  # grey
    assert unknown.mean(-1).max() - unknown.mean(-1).min() > 20  # in stripes
    assert scale.labels[0].endswith(" m")
    assert scale.low == pytest.approx(1, rel=0.1)


def test_scattered_depth_is_drawn_as_dots_where_it_is_known():
    depth = np.zeros((96, 128), np.float32)
    depth[20, 30] = depth[70, 90] = 2.0
    depth[5, 120] = 8.0
    scale = DepthScale.of([depth], is_metric=False)
    shown = pixels(depth_picture(depth, np.full((96, 128, 3), 128, np.uint8), scale, 200))
    colored = np.ptp(shown, axis=-1) > 60
    assert colored[20, 30]
    assert colored[70, 90]
    assert not colored[40:60].any()


@pytest.mark.parametrize("num_views", [2, 5, 10])
def test_the_tree_drawn_is_the_oracle_tree(num_views):
    draw = np.random.default_rng(num_views)
    iou = draw.uniform(0.02, 0.7, (num_views, num_views))
    iou = (iou + iou.T) / 2
    np.fill_diagonal(iou, 1)
    tree, plan = oracle_tree(iou), draw_tree(iou)
    assert [(e.parent, e.child) for e in plan.edges] == list(
        zip(tree.parent[0].tolist(), tree.child[0].tolist(), strict=True)
    )
    assert [node.view for node in plan.nodes if node.is_root] == [int(tree.root[0])]
    for edge in plan.edges:
        assert edge.label == f"{iou[edge.parent, edge.child]:.2f}"
        assert edge.end[0] > edge.start[0]
    places = np.array([(node.x, node.y) for node in plan.nodes])
    apart = np.abs(places[:, None] - places).max(-1) + 1e3 * np.eye(num_views)
    assert apart.min() >= 19  # half a row: circles of radius 12 stand in columns of 104
    assert (places >= 12).all()
    assert (places <= [plan.width - 12, plan.height - 12]).all()


@given(st.lists(st.floats(0, 180), min_size=1, max_size=60))
def test_a_histogram_counts_every_value_and_its_median_is_within_a_bin(values):
    histogram = Histogram(title="t", unit="deg", of="pairs", edges=np.linspace(0, 180, 73))
    for value in values:
        histogram.add(np.array([value]))
    histogram.add(np.array([np.nan]))
    assert histogram.total == len(values)
    assert histogram.num_unknown == 1
    assert (histogram.lowest, histogram.highest) == (min(values), max(values))
    below = np.searchsorted(np.sort(values), histogram.median() + 2.5, side="right")
    above = np.searchsorted(np.sort(values), histogram.median() - 2.5, side="left")
    assert below >= len(values) / 2 >= above
    chart = draw_histogram(histogram)
    assert {tick.text for tick in chart.x_ticks} >= {"0"}
    for bar in chart.bars:
        assert LEFT <= bar.x <= bar.x + bar.width <= RIGHT
        assert TOP - 0.1 <= bar.y <= bar.y + bar.height <= BOTTOM + 0.1
    assert max(bar.height for bar in chart.bars) == BOTTOM - TOP


@given(st.dictionaries(st.integers(1, 500), st.integers(1, 10**7), min_size=1, max_size=20))
def test_bars_of_whole_numbers_stand_over_their_ticks(counts):
    chart = draw_counts(Counter(counts), "uses", "images")
    assert len(chart.bars) == len(counts)
    for tick in chart.x_ticks + chart.y_ticks:
        assert min(LEFT, TOP) <= tick.at <= RIGHT
    ticks = {tick.text: tick.at for tick in chart.x_ticks}
    for bar in chart.bars:
        number = bar.title.partition(":")[0]
        if number in ticks:
            assert bar.x - 1 <= ticks[number] <= bar.x + bar.width + 1.5


@pytest.mark.parametrize(
    ("lengths", "ticks"),
    [
        ([0.9, 1.0, 2.0, 3.0], ["1", "2"]),
        ([0.5, 1.0, 2.0, 4.0], ["0.5", "1", "2", "5"]),
        ([3.0, 3.1], ["3", "4"]),
        ([0.03, 1.0, 500.0], ["0.1", "1", "10", "100"]),
    ],
)
def test_lengths_have_logarithmic_axes_of_round_numbers(lengths, ticks):
    edges = 10.0 ** np.linspace(-4, 6, 161)
    histogram = Histogram(title="t", unit="m", of="images", edges=edges, is_log=True)
    histogram.add(np.array(lengths))
    assert [tick.text for tick in draw_histogram(histogram).x_ticks] == ticks


def test_the_report_is_written_beside_the_manifest(room_shards, tmp_path, capsys):
    folder = damage.copy(room_shards, tmp_path / "shards")
    assert main(["check", str(folder), "--max-graphs", "1"]) == 0
    page = folder / "report.html"
    assert page.stat().st_size < 3_000_000
    assert capsys.readouterr().out.endswith(f"{page}\n")


def test_a_folder_nobody_may_write_to_is_checked_all_the_same(
    room_shards, tmp_path, caplog, monkeypatch
):
    def refuse(path, data):
        raise PermissionError(13, "Permission denied", str(path))

    folder = damage.copy(room_shards, tmp_path / "shards")
    monkeypatch.setattr("data_prep.commands.check.write_atomic", refuse)
    assert main(["check", str(folder), "--max-graphs", "1"]) == 0
    assert "--report PATH" in caplog.text
    # Who asks for a page gets it, or an error.
    assert main(["check", str(folder), "--max-graphs", "1", "--report", str(tmp_path)]) == 2


def test_one_page_of_several_folders_has_a_section_for_each(room_shards, tmp_path):
    folders = [damage.copy(room_shards, tmp_path / name) for name in ("a", "b")]
    page = tmp_path / "both.html"
    assert main(["check", *map(str, folders), "--max-graphs", "2", "--report", str(page)]) == 0
    text = words(page.read_text())
    for folder in folders:
        assert str(folder) in text
        assert not (folder / "report.html").exists()
    assert text.count("Verdict") == 2


def test_a_page_in_a_folder_that_is_not_there_is_refused_before_reading(room_shards, capsys):
    page = "nowhere/at/all.html"
    assert main(["check", str(room_shards), "--report", page]) == 2
    assert "no folder nowhere/at" in capsys.readouterr().err


@pytest.mark.parametrize("width", [1400, 800])
def test_a_browser_decodes_every_picture_and_complains_of_nothing(section, tmp_path, width):
    page = tmp_path / "report.html"
    page.write_text(render_check([section]), encoding="utf-8")
    found = open_page(page, tmp_path, width)
    assert found["console"] == []
    assert found["images"] == 2 * sum(len(sheet.views) for sheet in section.sheets)
    assert found["decoded"] == found["images"]
    assert found["first"] == [160, 120]
    assert not found["wide"]
    assert found["sticking_out"] == 0
