"""One page that shows how a training run goes; needs no torch."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import jinja2
import numpy as np

from l3r.config import RunConfig, flatten_plain
from l3r.export.durations import format_seconds
from l3r.export.line_chart import Chart, Curve, Kind, draw_chart
from l3r.export.run_folder import RunFolder, Table
from l3r.version import __version__

MAX_BAD_STEPS = 30
"""Bad steps shown."""
_MIN_IDLE = 120.0
"""Seconds without a row before a run counts as stopped."""
_ROOMS = ("encoder", "alignment", "decoder", "heads")
_ACCURACY = {"rra_5": "RRA@5", "rra_15": "RRA@15", "rta_5": "RTA@5", "rta_15": "RTA@15"}


def render_run_report(run: RunFolder) -> str:
    """Give the report as HTML without scripts; all text from files is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("l3r.export", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("run_report.html").render(
        version=__version__,
        name=run.path.resolve().name,
        note=run.config.train.note if run.config else "",
        verdict=judge_run(run),
        problems=run.problems,
        sections=[
            {"title": title, "charts": charts}
            for title, drawn in _sections(run).items()
            if (charts := [chart for chart in drawn if chart])
        ],
        pictures=_pictures(run.pictures),
        bad_steps=run.bad_steps[-MAX_BAD_STEPS:],
        num_bad_steps=len(run.bad_steps),
        changes=_changes(run.config) if run.config else [],
        machine=run.machine,
    )


def judge_run(run: RunFolder) -> str:
    """Say in one line whether a run is running, how far it is, and what is left."""
    steps = run.training["step"]
    step = int(steps[-1]) if len(steps) else 0
    if run.config is None:
        return f"step {step:,} of an unknown number: config.yaml cannot be read"
    total = run.config.train.max_steps
    share = f"step {step:,} of {total:,} ({100 * step / total:.0f} %)"
    if step >= total and run.is_complete:
        return f"finished: {share}"
    rate = recent_rate(run.training)
    graphs = run.config.data.graphs_per_step
    per_row = run.config.train.log_every * graphs / rate if rate else 0.0
    if run.idle_seconds > max(_MIN_IDLE, 5 * per_row):
        if not np.isfinite(run.idle_seconds):
            return f"not begun, or its log is gone: {share}"
        return (
            f"stopped or stalled: {share}, last row {format_seconds(run.idle_seconds)} ago; the "
            "same l3r train command goes on from last.ckpt"
        )
    left = f", about {format_seconds((total - step) * graphs / rate)} left" if rate else ""
    return f"running: {share}{left}"


def recent_rate(training: Table) -> float:
    """Graphs per second, median of the last 20 rows; 0 where unknown."""
    rates = training.get("graphs_per_second", np.zeros(0))[-20:]
    rates = rates[np.isfinite(rates)]
    return float(np.median(rates)) if len(rates) else 0.0


def _sections(run: RunFolder) -> dict[str, list[Chart | None]]:
    train, held_out = run.training, run.validation
    steps = np.concatenate([train["step"], held_out["step"], [1.0]])
    draw = partial(draw_chart, last_step=float(steps.max()))
    return {
        "Loss": [
            draw("Loss", [*_curves(train, {"loss": "training"}), *_held_out(held_out, "loss")]),
            draw("Terms of the loss", _curves(train, {"pairwise": "pairwise", "global": "global"})),
            draw(
                "Point error, pairwise [mean distance of the scene]",
                [*_curves(train, {"pair_error": "training"}), *_held_out(held_out, "pair_error")],
            ),
            draw("Loss of each data set", _of_each(train, "loss")),
            draw("Point error of each data set", _of_each(train, "pair_error")),
        ],
        "Cameras of the validation graphs": [
            draw("Pairs of images within a limit [%]", _dotted(held_out, _ACCURACY)),
            draw(
                "mAA@30 and images registered [%]",
                _dotted(held_out, {"maa_30": "mAA@30", "reg": "registered"}),
            ),
            draw("ATE, normalised", _dotted(held_out, {"ate": "ATE"})),
            draw("RRA@15 of each data set [%]", _of_each(held_out, "rra_15", kind="dotted")),
            draw("RTA@15 of each data set [%]", _of_each(held_out, "rta_15", kind="dotted")),
        ],
        "Optimisation": [
            draw("Learning rate", _curves(train, {"lr": "learning rate"}, kind="exact")),
            draw(
                "Norm of the gradient, before clipping",
                _curves(
                    train, {"grad_norm": "all", **{f"grad_norm_{room}": room for room in _ROOMS}}
                ),
                is_log=True,
            ),
        ],
        "Confidence and trees": [
            draw("Mean log-confidence", _curves(train, {"log_conf": "log C"})),
            draw("Share of points that inference trusts", _curves(train, {"confident": "share"})),
            draw(
                "Trees: a star has all its edges at the root",
                _curves(
                    train,
                    {
                        "root_degree": "edges at the root",
                        "root_degree_max": "largest",
                        "tree_depth": "depth",
                    },
                ),
            ),
        ],
        "Speed": [
            draw("Graphs per second", _curves(train, {"graphs_per_second": "graphs/s"})),
            draw("Share of a step spent waiting for data", _curves(train, {"data_wait": "share"})),
            draw("Peak memory of the GPU [GiB]", _curves(train, {"gpu_gib": "GiB"})),
        ],
    }


def _curves(table: Table, names: Mapping[str, str], *, kind: Kind = "noisy") -> list[Curve]:
    return [
        Curve(name=shown, steps=table["step"], values=table[column], kind=kind)
        for column, shown in names.items()
        if column in table
    ]


def _dotted(table: Table, names: Mapping[str, str]) -> list[Curve]:
    return _curves(table, names, kind="dotted")


def _held_out(table: Table, column: str) -> list[Curve]:
    return _dotted(table, {column: "held out"})


def _of_each(table: Table, figure: str, *, kind: Kind = "noisy") -> list[Curve]:
    """Curves of the data sets; none where there is only one, which the overall curve shows."""
    names = {c: c.rsplit("/", 1)[0] for c in table if c.endswith(f"/{figure}")}
    return _curves(table, names, kind=kind) if len(names) > 1 else []


def _pictures(paths: Sequence[Path]) -> list[dict[str, str]]:
    """Embed the first, the middle and the last."""
    chosen = sorted({0, len(paths) // 2, len(paths) - 1}) if paths else []
    return [
        {
            "step": f"{int(paths[index].stem.removeprefix('step_')):,}",
            "uri": "data:image/png;base64," + base64.b64encode(paths[index].read_bytes()).decode(),
        }
        for index in chosen
    ]


def _changes(config: RunConfig) -> list[tuple[str, str, str]]:
    """List what differs from the defaults: key, value, default."""
    default = flatten_plain(asdict(RunConfig()))
    return [
        (key, str(value), str(default.get(key, "-")))
        for key, value in flatten_plain(asdict(config)).items()
        if value != default.get(key)
    ]
