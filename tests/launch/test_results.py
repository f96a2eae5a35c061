import re
import subprocess
import sys
from pathlib import Path
from statistics import fmean, stdev

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l3r.cli.main import main
from l3r.errors import DataError
from l3r.launch.expand import expand
from l3r.launch.paper_tables import METRICS, PAPER_TABLES
from l3r.launch.results import Spread, best_of_paper, best_rows, collect_results
from l3r.launch.run_state import FAILURE, read_states
from l3r.launch.score_chart import LEFT, RIGHT, draw_scores
from l3r.launch.score_file import scoring_request
from l3r.launch.sweep_file import write_sweep
from l3r.launch.sweep_markdown import format_spread, render_markdown
from l3r.launch.sweep_report import mean_table, render_sweep_page, report_sweep, select_runs
from tests.launch.sweeps import note_bad_steps, score_by_hand, train_by_hand, write_sweep_file

GOLDEN = Path(__file__).parents[1] / "golden" / "sweep_table.md"


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=9))
def test_a_spread_is_mean_and_sample_deviation(values):
    spread = Spread(tuple(values))
    assert spread.mean == pytest.approx(fmean(values))
    assert spread.count == len(values)
    assert spread.deviation == (pytest.approx(stdev(values)) if len(values) > 1 else None)


@pytest.fixture
def done(sweep):
    """All runs but three: one that diverged, one that failed, one that is under way."""
    request = scoring_request(sweep)
    for number, run in enumerate(sweep.runs):
        train_by_hand(run, rate=8.0 if run.row == "0.1" else 16.0, machine="NVIDIA H200")
        score_by_hand(run, request, rra_5=40.0 + number, ate=0.05 + 0.001 * number)
    write_sweep(sweep)
    return sweep


def undo(run, *, steps=30):
    for name in ("model.ckpt", "scores.json"):
        (run.folder / name).unlink()
    train_by_hand(run, steps=steps)


def test_the_table_is_as_recorded(done):
    diverged, failed = done.runs[2], done.runs[5]
    undo(diverged)
    note_bad_steps(diverged, [30, 31, 32])
    undo(failed)
    (failed.folder / FAILURE).write_text("exit code 1: l3r train: no room\n")
    states = read_states(done)
    text = render_markdown(collect_results(done, states)).replace(str(done.out), "OUT")
    assert text == GOLDEN.read_text()


def test_a_run_that_diverged_or_failed_is_shown_and_never_averaged_away(done):
    undo(done.runs[2])
    note_bad_steps(done.runs[2], [30, 31, 32])
    result = collect_results(done, read_states(done))
    row, other = result.rows[:2]
    assert row.scores["rra_5"] == Spread((40.0, 44.0))
    text = render_markdown(result)
    assert "42.0 ± 2.8 (n = 2)" in text
    assert "2 of 3, diverged 1 of 3" in text
    assert "0.01/seed_1 diverged: 3 steps in a row" in text
    # The row whose seeds are not all there cannot be the best.
    assert best_rows(result, "ate") == set()
    assert row.scores["ate"].mean < other.scores["ate"].mean


def test_the_best_row_is_bold_by_what_is_printed_and_the_oracle_competes_with_none(done):
    result = collect_results(done, read_states(done))
    assert best_rows(result, "rra_5") == {"0.1"}
    assert best_rows(result, "ate") == {"0.01"}
    assert best_rows(result, "rta_5") == set(), "all the same"
    layers = PAPER_TABLES["num_layers"]
    assert [best_of_paper(layers, n) for n in range(3)] == [{"4"}, {"4", "8"}, {"4", "8"}]
    assert best_of_paper(PAPER_TABLES["graph"], 0) == {"spt"}


IN_THE_SOURCE = {
    "neither": "mast3r no no spt",
    "alignment": "mast3r no yes spt",
    "dust3r": "dust3r yes yes spt",
    "both": "mast3r yes yes spt",
    "oracle": "mast3r yes yes oracle",
    "mst": "mast3r yes yes mst",
    "spt": "mast3r yes yes spt",
}
"""The first cells of the rows of tables/ablat_model."""


def read_rows(text):
    """Numbers of a LaTeX table by the cells before them."""
    rows = {}
    for line in text.split("\\\\"):
        plain = re.sub(r"\\(?:bfseries|midrule|text..|multirow\{.\}\{\*\})", " ", line)
        cells = re.sub(r"[{}]", " ", plain).split("&")
        if len(cells) > 3 and re.fullmatch(r"\s*\d\.\d+\s*", cells[-1]):
            label = " ".join(" ".join(cells[:-3]).lower().split())
            rows[re.sub(r"^\([ab]\) ", "", label)] = tuple(float(cell) for cell in cells[-3:])
    return rows


def test_the_tables_of_the_paper_are_those_of_its_source(shared):
    source = (shared / "paper" / "light3r-sfm.tex.txt").read_text()
    for name, table in PAPER_TABLES.items():
        where = re.search(r"tables/\S+", table.source)[0]
        found = read_rows(source.split(f"%% file: {where}.tex")[1].split("%% file:")[0])
        is_model = where == "tables/ablat_model"
        rows = {IN_THE_SOURCE[row] if is_model else row: v for row, v in table.rows.items()}
        assert rows == {key: found[key] for key in rows}, name
        assert is_model or rows == found, name
        assert len(METRICS) == 3


def test_the_notes_quote_numbers_that_the_paper_prints(shared):
    source = (shared / "paper" / "light3r-sfm.tex.txt").read_text()
    for name, table in PAPER_TABLES.items():
        quoted = re.findall(r"\b\d+\.\d+\b", " ".join(table.notes))
        assert set(quoted) <= set(re.findall(r"\b\d+\.\d+\b", source)), name
        for where in re.findall(r"tables/\w+(?:/\w+)?", " ".join(table.notes)):
            assert f"%% file: {where}.tex" in source, name


def test_rows_stand_in_the_order_of_the_paper_with_ours_in_between(tmp_path):
    rows = {"1": "loss.global_weight=1", "own": "loss.global_weight=2", "0.1": []}
    path = write_sweep_file(tmp_path, rows=rows, table="global_weight")
    sweep = expand(path)
    result = collect_results(sweep, read_states(sweep))
    assert [row.row for row in result.rows] == ["0.01", "0.1", "1", "own"]


def test_a_diverged_run_has_a_curve_of_its_own_and_cuts_no_other_short(done):
    diverged, begun = done.runs[0], done.runs[3]
    undo(diverged, steps=30)
    note_bad_steps(diverged, [30, 31, 32])
    undo(begun, steps=2)
    states = read_states(done)
    result = collect_results(done, states)
    shown = select_runs(done, result, states)
    names = {label: [run.name for run in runs] for label, runs in shown.items()}
    assert names == {
        "0.01": ["0.01/seed_1", "0.01/seed_2"],
        "0.01, seed 0 diverged": ["0.01/seed_0"],
        "0.1": ["0.1/seed_0", "0.1/seed_2"],
        "1": [],
    }
    assert "0.01, seed 0 diverged" in render_sweep_page(done, result, states)


def test_one_seed_has_no_deviation_and_missing_values_are_a_dash():
    assert format_spread(Spread((41.23,)), "rra_5", 1) == "41.2 (n = 1)"
    assert format_spread(Spread((0.1, 0.2)), "ate", 2) == "0.150 ± 0.071"
    assert format_spread(None, "ate", 2) == "-"


def test_scores_of_different_graphs_are_called_so(done):
    score_by_hand(done.runs[0], scoring_request(done), graphs="b" * 64)
    text = render_markdown(collect_results(done, read_states(done)))
    assert "scored on different graphs and must not be compared" in text


def test_the_report_prints_the_table_and_writes_table_and_page(done, capsys):
    assert main(["report", str(done.out)]) == 0
    text = capsys.readouterr().out
    assert text == (done.out / "table.md").read_text()
    page = (done.out / "report.html").read_text()
    assert "<script" not in page
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert page.count("<svg") >= 1
    for cell in ("30.6", "42.0 ± 2.0", "<b>43.0 ± 2.0</b>", "3 of 3", "loss.global_weight=0.01"):
        assert cell in page
    ids = re.findall(r'clipPath id="([^"]+)"', page)
    assert len(ids) == len(set(ids)) >= 1


def test_a_row_with_a_score_of_some_seeds_alone_is_not_the_best(done):
    request = scoring_request(done)
    for run in done.runs:
        is_lucky = run.row == "0.1" or run.seed == 0
        score_by_hand(run, request, ate=(0.05 if run.row == "0.1" else 0.01) if is_lucky else None)
    result = collect_results(done, read_states(done))
    assert result.rows[0].scores["ate"] == Spread((0.01,))
    assert best_rows(result, "ate") == set()


def test_trainings_on_shards_of_other_places_are_called_so(done):
    text = render_markdown(collect_results(done, read_states(done)))
    assert "different places" not in text
    config = done.runs[0].folder / "config.yaml"
    config.write_text(config.read_text().replace("shards: shards", "shards: moved", 1))
    text = render_markdown(collect_results(done, read_states(done)))
    assert "trained on shards of different places: moved and shards." in text


def test_a_report_looks_again_after_it_has_written(done, monkeypatch):
    """Another task may finish between what it read and what it wrote."""
    from l3r.launch import sweep_report

    last = done.runs[-1]
    (last.folder / "scores.json").rename(last.folder / "kept")
    real = sweep_report.render_sweep_page

    def finish_meanwhile(*arguments):
        if (last.folder / "kept").exists():
            (last.folder / "kept").rename(last.folder / "scores.json")
        return real(*arguments)

    monkeypatch.setattr(sweep_report, "render_sweep_page", finish_meanwhile)
    text = report_sweep(done.out)
    assert text.count("3 of 3") == 2
    assert (done.out / "table.md").read_text() == text


def test_the_report_of_a_sweep_needs_no_torch(done):
    code = (
        "import sys; from l3r.cli.main import main; code = main(sys.argv[1:]);"
        "assert 'torch' not in sys.modules; sys.exit(code)"
    )
    command = [sys.executable, "-c", code, "report", str(done.out)]
    root = Path(__file__).parents[2]
    finished = subprocess.run(command, capture_output=True, text=True, cwd=root)
    assert finished.returncode == 0, finished.stderr


def test_every_seed_is_a_dot_in_the_colour_of_its_row(done):
    score_by_hand(done.runs[0], scoring_request(done), rra_5=47.0)
    result = collect_results(done, read_states(done))
    charts = draw_scores(result, {"0.1": "red"})
    chart = charts[0]
    assert [line.label for line in chart.lines] == ["0.01", "0.1"]
    assert [line.color == "red" for line in chart.lines] == [False, True]
    for line in chart.lines:
        assert len(line.dots) == 3
        assert LEFT < line.reach[0] < line.mean < line.reach[1] < RIGHT
        assert LEFT < min(line.dots) <= line.mean <= max(line.dots) < RIGHT
    # By the same ruler: 47 less 41 is six times 42 less 41.
    first, second = chart.lines
    assert first.dots[0] - second.dots[0] == pytest.approx(
        6 * (first.dots[1] - second.dots[0]), abs=0.5
    )
    assert "lower is better" in charts[2].title
    page = render_sweep_page(done, result, read_states(done))
    assert page.count("<circle") >= 3 * 2 * len(charts)
    alone = expand(write_sweep_file(done.out.parent, "one.yaml", rows={"one": []}, seeds=[0]))
    assert draw_scores(collect_results(alone, read_states(alone)), {}) == []


def test_a_damaged_description_is_refused(done):
    (done.out / "sweep.json").write_text("{}")
    with pytest.raises(DataError, match=r"sweep\.json: not the file that l3r sweep writes"):
        report_sweep(done.out)


def test_a_sweep_without_a_table_of_the_paper_has_its_own(tmp_path):
    sweep = expand(write_sweep_file(tmp_path, seeds=[0]))
    text = render_markdown(collect_results(sweep, read_states(sweep)))
    assert "\n| row   | RRA@5 ↑ | RTA@5 ↑ |" in text
    assert "paper" not in text.replace("| paper |", "")
    assert "1 to come" in text


def test_logs_are_averaged_over_the_steps_that_all_have():
    one = {"step": np.array([1.0, 2, 3]), "loss": np.array([1.0, 2, 3]), "own": np.zeros(3)}
    two = {"step": np.array([2.0, 3, 4]), "loss": np.array([4.0, 5, 6])}
    mean = mean_table([one, two])
    assert mean.keys() == {"step", "loss"}
    assert mean["step"].tolist() == [2, 3]
    assert mean["loss"].tolist() == [3, 4]
