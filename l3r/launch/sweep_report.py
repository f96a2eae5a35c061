"""Tables and page of a sweep, from its folder; needs no torch."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import jinja2
import numpy as np

from l3r.export.line_chart import Chart, Curve, Kind, draw_chart
from l3r.export.run_folder import Table, read_run_folder
from l3r.files import write_atomic
from l3r.launch.expand import Run, Sweep
from l3r.launch.paper_tables import METRICS as PAPER_METRICS
from l3r.launch.results import (
    LOWER_IS_BETTER,
    METRICS,
    RowResult,
    SweepResult,
    best_of_paper,
    best_rows,
    collect_results,
    format_score,
)
from l3r.launch.run_state import RunState, read_states
from l3r.launch.score_chart import draw_scores
from l3r.launch.sweep_file import read_sweep
from l3r.launch.sweep_markdown import cost_table, describe_kinds, format_spread, render_markdown
from l3r.version import __version__

TABLE, PAGE = "table.md", "report.html"


def report_sweep(folder: Path, page: Path | None = None) -> str:
    """Write ``table.md`` and the page of a sweep, and give the table.

    Of several processes that do so at the same time, the last one to write has seen everything
    that was there when the first one began: each looks again after it has written.

    Args:
        folder: The sweep's.
        page: Where the page goes; default: ``report.html`` of the folder.

    Raises:
        ConfigError: A folder of a run holds another one.
        DataError: It is not a sweep's folder.
    """
    sweep = read_sweep(folder)
    states = read_states(sweep)
    while True:
        result = collect_results(sweep, states)
        text = render_markdown(result)
        write_atomic(folder / TABLE, text)
        write_atomic(page or folder / PAGE, render_sweep_page(sweep, result, states))
        before, states = states, read_states(sweep)
        if _kinds(before) == _kinds(states):
            return text


def render_sweep_page(sweep: Sweep, result: SweepResult, states: Mapping[str, RunState]) -> str:
    """Give the page as HTML without scripts; all text from files is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(
            [jinja2.PackageLoader("l3r.launch", ""), jinja2.PackageLoader("l3r.export", "")]
        ),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    headers, cost = cost_table(result)
    charts = [chart for chart in draw_curves(sweep, result, states) if chart]
    colors = {line.name: line.color for line in charts[0].lines} if charts else {}
    return environment.get_template("sweep_report.html").render(
        version=__version__,
        result=result,
        columns=[(name, "↓" if key in LOWER_IS_BETTER else "↑") for key, name in METRICS.items()],
        num_paper=len(PAPER_METRICS) if result.paper else 0,
        rows=[_page_row(result, row) for row in result.rows],
        scores=draw_scores(result, colors),
        charts=charts,
        cost_headers=headers,
        cost=[[cell.replace("`", "") for cell in row] for row in cost],
        runs=[(name, state.describe()) for name, state in states.items()],
        seeds=len(sweep.spec.seeds),
    )


def draw_curves(
    sweep: Sweep, result: SweepResult, states: Mapping[str, RunState]
) -> list[Chart | None]:
    """Draw how the rows train."""
    shown = select_runs(sweep, result, states)
    folders = {
        label: [read_run_folder(run.folder) for run in runs] for label, runs in shown.items()
    }
    training = {label: mean_table([x.training for x in found]) for label, found in folders.items()}
    held_out = {
        label: mean_table([x.validation for x in found]) for label, found in folders.items()
    }
    steps = np.concatenate([[1.0], *(table["step"] for table in training.values())])
    draw = partial(draw_chart, last_step=float(steps.max()))
    return [
        draw("Loss", _curves(training, "loss", "noisy")),
        draw("Point error, pairwise [mean distance of the scene]", _curves(training, "pair_error")),
        draw("RRA@15 on validation graphs [%]", _curves(held_out, "rra_15", "dotted")),
        draw("RTA@15 on validation graphs [%]", _curves(held_out, "rta_15", "dotted")),
    ]


def select_runs(
    sweep: Sweep, result: SweepResult, states: Mapping[str, RunState]
) -> dict[str, list[Run]]:
    """Give the runs of which each curve is the mean, by its label.

    These are the seeds of a row that came to the end, as others would cut them short; or else those
    under way. Each run that diverged has a curve of its own.
    """
    shown: dict[str, list[Run]] = {}
    for row in result.rows:
        begun = [
            run
            for run in sweep.runs
            if run.row == row.row and (run.folder / "metrics.csv").is_file()
        ]
        diverged = [run for run in begun if states[run.name].kind == "diverged"]
        others = [run for run in begun if run not in diverged]
        whole = [run for run in others if states[run.name].kind in ("trained", "scored")]
        shown[row.label] = whole or others
        shown |= {f"{row.label}, seed {run.seed} diverged": [run] for run in diverged}
    return shown


def mean_table(tables: Sequence[Table]) -> Table:
    """Average logs over the steps and the columns that all of them have."""
    if not tables:
        return {"step": np.zeros(0)}
    steps = tables[0]["step"]
    for table in tables[1:]:
        steps = np.intersect1d(steps, table["step"])
    columns = [name for name in tables[0] if all(name in table for table in tables)]
    return {
        name: np.mean([table[name][np.isin(table["step"], steps)] for table in tables], axis=0)
        for name in columns
    }


def _curves(tables: Mapping[str, Table], column: str, kind: Kind = "noisy") -> list[Curve]:
    return [
        Curve(name=label, steps=table["step"], values=table[column], kind=kind)
        for label, table in tables.items()
        if column in table
    ]


def _page_row(result: SweepResult, row: RowResult) -> dict[str, object]:
    paper = []
    for column, metric in enumerate(list(METRICS)[: len(PAPER_METRICS) if result.paper else 0]):
        assert result.paper is not None
        found = result.paper.rows.get(row.row)
        is_best = row.row in best_of_paper(result.paper, column)
        paper.append((format_score(found[column] if found else None, metric), is_best))
    ours = [
        (
            format_spread(row.scores.get(metric), metric, len(row.kinds)),
            row.row in best_rows(result, metric),
        )
        for metric in METRICS
    ]
    return {"label": row.label, "paper": paper, "ours": ours, "runs": describe_kinds(row)}


def _kinds(states: Mapping[str, RunState]) -> dict[str, str]:
    return {name: state.kind for name, state in states.items()}
