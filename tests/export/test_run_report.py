import json
import os
import re
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l3r.cli.main import main
from l3r.config import RunConfig, load_config, to_yaml
from l3r.errors import DataError
from l3r.export.line_chart import BOTTOM, LEFT, RIGHT, TOP, Curve, draw_chart, even_ticks
from l3r.export.run_folder import read_run_folder
from l3r.export.run_report import judge_run, render_run_report

HEADER = "step,lr,loss,pairwise,global,grad_norm,graphs_per_second,a/loss,b/loss\n"


def write_run(folder, steps=50, max_steps=100):
    config = load_config([f"train.max_steps={max_steps}", "train.log_every=1"])
    (folder / "config.yaml").write_text(to_yaml(config))
    rows = [f"{n},0.01,{2 / n},{1 / n},{10 / n},{3 / n},16,{1 / n}," for n in range(1, steps + 1)]
    (folder / "metrics.csv").write_text(HEADER + "\n".join(rows) + "\n")
    (folder / "validation.csv").write_text("step,loss,rra_15,reg\n20,0.5,30,100\n40,0.4,50,100\n")
    return folder


def report(folder):
    return render_run_report(read_run_folder(folder))


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
def test_ticks_are_few_rising_and_inside(low, length):
    ticks = even_ticks(low, low + length)
    assert 2 <= len(ticks) <= 7
    assert all(a < b for a, b in pairwise(ticks))
    slack = 1e-6 * length + 1e-9 * abs(low)
    assert low - slack <= ticks[0]
    assert ticks[-1] <= low + length + slack


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(1, 2500), st.floats(0, 1), st.booleans())
def test_smooth_curves_and_dots_stay_between_the_axes(seed, count, missing, is_log):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=count) * 10.0 ** rng.integers(-3, 4)
    values[rng.random(count) < missing] = np.nan
    steps = np.arange(1.0, len(values) + 1)
    kinds = ("noisy", "exact", "dotted")
    curves = [Curve(name=kind, steps=steps, values=values, kind=kind) for kind in kinds]
    chart = draw_chart("any", curves, last_step=float(len(values)), is_log=is_log)
    if chart is None:
        assert not (values > 0).any()
        assert is_log or np.isnan(values).all()
        return
    for line in chart.lines:
        points = [tuple(map(float, p.split())) for p in line.smooth[1:].split("L")]
        assert len(points) <= 802
        assert all(LEFT <= x <= RIGHT and TOP <= y <= BOTTOM for x, y in points + line.dots)


def test_a_logarithmic_axis_names_the_values_themselves():
    steps = np.arange(1.0, 5.0)
    values = np.array([0.01, 1.0, 100.0, 1000.0])
    curve = Curve(name="norm", steps=steps, values=values, kind="exact")
    chart = draw_chart("norm", [curve], last_step=4.0, is_log=True)
    assert [float(tick.text) for tick in chart.y_ticks] == [0.01, 0.1, 1, 10, 100, 1000]
    assert chart.lines[0].last == "1e+03"


def test_a_running_run_says_how_far_it_is_and_what_is_left(tmp_path):
    write_run(tmp_path)
    # 50 steps of 8 graphs at 16 graphs per second.
    assert judge_run(read_run_folder(tmp_path)) == (
        "running: step 50 of 100 (50 %), about 25.0 s left"
    )
    hour_ago = time.time() - 3600
    os.utime(tmp_path / "metrics.csv", (hour_ago, hour_ago))
    verdict = judge_run(read_run_folder(tmp_path))
    assert re.match(r"stopped or stalled: step 50 of 100 .* 1 h 00 min ago", verdict)


def test_a_run_is_finished_when_its_weights_and_its_last_step_are_there(tmp_path):
    write_run(tmp_path, steps=100)
    assert judge_run(read_run_folder(tmp_path)).startswith("running")
    (tmp_path / "model.ckpt").write_bytes(b"")
    assert judge_run(read_run_folder(tmp_path)) == "finished: step 100 of 100 (100 %)"
    write_run(tmp_path, steps=100, max_steps=200)  # resumed for longer
    assert judge_run(read_run_folder(tmp_path)).startswith("running: step 100 of 200")


def test_the_page_stands_alone_and_escapes_what_it_shows(tmp_path):
    write_run(tmp_path)
    row = {"step": 7, "loss": "nan", "grad_norm": "inf", "keys": ["<b>key</b>"]}
    (tmp_path / "bad_steps.jsonl").write_text(json.dumps(row) + "\n")
    (tmp_path / "pictures").mkdir()
    for step in (20, 40, 60, 80):
        (tmp_path / "pictures" / f"step_{step:06d}.png").write_bytes(b"PNG%d" % step)
    page = report(tmp_path)
    assert "<script" not in page
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "&lt;b&gt;key&lt;/b&gt;" in page
    assert "<b>key</b>" not in page
    assert re.findall(r"<h3>Step (\d+)</h3>", page) == ["20", "60", "80"]
    assert re.search(r"train\.max_steps</code></td><td>100</td><td class=\"soft\">100000", page)
    ids = re.findall(r'clipPath id="([^"]+)"', page)
    assert len(ids) == len(set(ids)) > 5


def test_data_sets_are_compared_where_there_are_several(tmp_path):
    write_run(tmp_path)
    log = tmp_path / "metrics.csv"
    assert "Loss of each data set" in report(tmp_path)
    log.write_text(log.read_text().replace(",b/loss", ",b_loss"))
    assert "Loss of each data set" not in report(tmp_path)


def test_damaged_files_are_named_and_the_rest_is_shown(tmp_path):
    write_run(tmp_path)
    with (tmp_path / "metrics.csv").open("ab") as stream:
        stream.write(b"51,0.0\nabc,,,,,,,,\n")
    (tmp_path / "validation.csv").write_bytes(b"\xff\xfe\0\0")
    (tmp_path / "bad_steps.jsonl").write_text('{"step": 3\n')
    (tmp_path / "machine.json").write_text("[1")
    (tmp_path / "config.yaml").write_text("train: {sed: 1}")
    run = read_run_folder(tmp_path)
    problems = "\n".join(run.problems)
    for text in (
        "metrics.csv: 2 damaged rows",
        "validation.csv: no column 'step'",
        "bad_steps.jsonl: a damaged line",
        "machine.json: cannot be read",
        "Did you mean: &#39;seed&#39;",
    ):
        assert text.replace("&#39;", "'") in problems
        assert text.replace("'", "&#39;") in render_run_report(run)
    assert judge_run(run).startswith("step 50 of an unknown number")
    assert "Terms of the loss" in render_run_report(run)


def test_a_run_without_a_row_has_a_page(tmp_path):
    (tmp_path / "config.yaml").write_text(to_yaml(RunConfig()))
    assert "not begun" in report(tmp_path)
    (tmp_path / "metrics.csv").write_text("")
    assert "no column &#39;step&#39;" in report(tmp_path)


def test_a_folder_that_is_no_run_is_refused(tmp_path, capsys):
    with pytest.raises(DataError, match=r"no config\.yaml and no metrics\.csv"):
        read_run_folder(tmp_path)
    assert main(["report", str(tmp_path)]) == 2
    assert main(["report", str(tmp_path / "nowhere")]) == 2
    assert "train.output_dir" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_command_needs_no_torch(tmp_path):
    write_run(tmp_path)
    code = (
        "import sys; from l3r.cli.main import main; code = main(sys.argv[1:]);"
        "assert 'torch' not in sys.modules; sys.exit(code)"
    )
    out = tmp_path / "page.html"
    command = [sys.executable, "-c", code, "report", str(tmp_path), "--out", str(out)]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("running: step 50 of 100")
    assert "</html>" in out.read_text()
