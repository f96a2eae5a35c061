"""What a sweep has found so far: means and spreads over seeds, and what is missing from them."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median, stdev
from typing import Any

from l3r.launch.expand import Sweep
from l3r.launch.paper_tables import PAPER_TABLES, PaperTable
from l3r.launch.run_state import Kind, RunState

METRICS = {
    "rra_5": "RRA@5",
    "rta_5": "RTA@5",
    "ate": "ATE",
    "rra_15": "RRA@15",
    "rta_15": "RTA@15",
}
"""Scores shown, by the name that ``scores.json`` has for them."""
LOWER_IS_BETTER = ("ate",)


@dataclass(frozen=True)
class Spread:
    """A score over seeds."""

    values: tuple[float, ...]
    """One of each seed that has it, at least one."""

    @property
    def mean(self) -> float:
        """Of the values."""
        return fmean(self.values)

    @property
    def deviation(self) -> float | None:
        """Sample standard deviation (n - 1); None of a single seed."""
        return stdev(self.values) if len(self.values) > 1 else None

    @property
    def count(self) -> int:
        """Seeds that it is of."""
        return len(self.values)


@dataclass(frozen=True, kw_only=True)
class RowResult:
    """One row of the table."""

    row: str
    label: str
    changes: Mapping[str, tuple[Any, Any]]
    """(base's value, row's value) by key."""
    kinds: Sequence[Kind]
    """Of its runs, one a seed; none for a row of the paper's that the sweep lacks."""
    scores: Mapping[str, Spread]
    """By name in :data:`METRICS`; absent where no run has one."""
    step_seconds: float | None
    """Median over seeds."""
    gpu_gib: float | None
    """Largest over seeds."""
    hours: float | None
    """Of one training."""

    def has_whole(self, metric: str) -> bool:
        """Whether every seed has this score."""
        return metric in self.scores and self.scores[metric].count == len(self.kinds)


@dataclass(frozen=True, kw_only=True)
class SweepResult:
    """All that the tables show."""

    name: str
    paper: PaperTable | None
    rows: Sequence[RowResult]
    scored_on: str
    """What graphs the scores are of."""
    notes: Sequence[str]
    """What a reader of the table must know."""
    problems: Sequence[str]
    """A line for each run that diverged or failed."""


def collect_results(sweep: Sweep, states: Mapping[str, RunState]) -> SweepResult:
    """Join what the runs of a sweep have left.

    Args:
        sweep: The sweep.
        states: Of its runs, by name.
    """
    paper = PAPER_TABLES.get(sweep.spec.table)
    names = _order_rows(sweep.spec.rows, paper.rows if paper else {})
    rows = [_collect_row(sweep, states, row, paper) for row in names]
    return SweepResult(
        name=sweep.out.resolve().name,
        paper=paper,
        rows=rows,
        scored_on=_scored_on(states.values()),
        notes=[*_notes(paper, states.values()), *_twins(sweep, states)],
        problems=[
            f"{name} {state.describe()}"
            for name, state in states.items()
            if state.kind in ("diverged", "failed")
        ],
    )


def best_rows(result: SweepResult, metric: str) -> set[str]:
    """Name the rows with the best mean as it is printed, of those where every seed has scores."""
    means = {
        row.row: round(row.scores[metric].mean, digits_of(metric))
        for row in result.rows
        if row.has_whole(metric) and not _is_unranked(result.paper, row.row)
    }
    return _best(means, metric)


def best_of_paper(paper: PaperTable, column: int) -> set[str]:
    """Name the rows that are best in one of the paper's columns."""
    metric = list(METRICS)[column]
    values = {row: found[column] for row, found in paper.rows.items()}
    return _best({r: v for r, v in values.items() if not _is_unranked(paper, r)}, metric)


def digits_of(metric: str) -> int:
    """How many digits a score is printed with, as in the paper."""
    return 3 if metric == "ate" else 1


def _order_rows(ours: Collection[str], papers: Collection[str]) -> list[str]:
    """Put the paper's rows in its order, and each other one behind the one it stands behind."""
    names, place = list(papers), 0
    for row in ours:
        if row not in names:
            names.insert(place, row)
        place = names.index(row) + 1
    return names


def _best(values: Mapping[str, float], metric: str) -> set[str]:
    if len(set(values.values())) < 2:
        return set()
    best = (min if metric in LOWER_IS_BETTER else max)(values.values())
    return {row for row, value in values.items() if value == best}


def _is_unranked(paper: PaperTable | None, row: str) -> bool:
    return paper is not None and row in paper.unranked


def _collect_row(
    sweep: Sweep, states: Mapping[str, RunState], row: str, paper: PaperTable | None
) -> RowResult:
    own = [states[run.name] for run in sweep.runs if run.row == row]
    scored = [state.scores["network"] for state in own if state.scores is not None]
    values = {
        metric: [float(x[metric]) for x in scored if x[metric] is not None] for metric in METRICS
    }
    seconds = [state.step_seconds for state in own if state.step_seconds is not None]
    memory = [state.gpu_gib for state in own if state.gpu_gib is not None]
    steps = next((state.max_steps for state in own if state.max_steps is not None), None)
    return RowResult(
        row=row,
        label=paper.labels.get(row, row) if paper else row,
        changes=sweep.changes.get(row, {}),
        kinds=[state.kind for state in own],
        scores={metric: Spread(tuple(found)) for metric, found in values.items() if found},
        step_seconds=median(seconds) if seconds else None,
        gpu_gib=max(memory, default=None),
        hours=median(seconds) * steps / 3600 if seconds and steps else None,
    )


def _scored_on(states: Collection[RunState]) -> str:
    """Describe the graphs of the scores that there are."""
    for state in states:
        if state.scores is not None:
            sources = state.scores["sources"]
            parts = [f"{found['num_graphs']} graphs of {name}" for name, found in sources.items()]
            views = next(iter(sources.values()))["num_views"]
            return f"{' and '.join(parts)}, {views} images each"
    return ""


def _notes(paper: PaperTable | None, states: Collection[RunState]) -> list[str]:
    notes = []
    scored = [state.scores for state in states if state.scores is not None]
    graphs = {
        tuple(sorted((name, s["graphs_sha256"]) for name, s in scores["sources"].items()))
        for scores in scored
    }
    if len(graphs) > 1:
        notes.append(
            "The runs were scored on different graphs and must not be compared: shards were built "
            "anew in between. Remove the scores.json of all runs and run the sweep again."
        )
    places = {tuple(sorted(state.trained_on.items())) for state in states if state.trained_on}
    if len(places) > 1:
        named = " and ".join(", ".join(place for _, place in found) for found in sorted(places))
        notes.append(
            f"The runs were trained on shards of different places: {named}. Compare them only if "
            "these hold the same graphs."
        )
    if scored:
        found = scored[0]["identity"]
        shown = ", ".join(
            f"{name} {format_score(found[metric], metric)}" for metric, name in METRICS.items()
        )
        notes.append(
            "Validation scores: full inference on held-out graphs; pairs of unregistered images "
            "count as failed, ATE is of the registered ones alone. All cameras at one place would "
            f"score {shown}."
        )
    return [*notes, *(paper.notes if paper else ())]


def _twins(sweep: Sweep, states: Mapping[str, RunState]) -> list[str]:
    """Name the runs that another sweep has trained, by row."""
    seeds: dict[tuple[str, str], list[int]] = {}
    for run in sweep.runs:
        if twin := states[run.name].twin:
            seeds.setdefault((run.row, "/".join(twin.parts[-3:-1])), []).append(run.seed)
    return [
        f"Row {row}, seed{'s' if len(found) > 1 else ''} {', '.join(map(str, found))}: trained as "
        f"{twin}, with the same configuration."
        for (row, twin), found in seeds.items()
    ]


def format_score(value: float | None, metric: str) -> str:
    """Print a score as the paper does; ``-`` where there is none."""
    return "-" if value is None or math.isnan(value) else f"{value:.{digits_of(metric)}f}"
