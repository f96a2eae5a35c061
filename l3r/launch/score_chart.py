"""Scores of a sweep's rows, every seed a dot, in the pixels of small drawings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from l3r.export.line_chart import Tick, even_ticks
from l3r.launch.results import LOWER_IS_BETTER, METRICS, Spread, SweepResult, format_score

LEFT, RIGHT, TOP = 150.0, 580.0, 10.0
"""Where the axes stand in a drawing 600 wide."""
LINE = 28.0
"""Height of a row."""
_OTHER = "#45505a"
_ROOM = 0.06
"""Share of the span of all values that is left free on both sides."""


@dataclass(frozen=True, kw_only=True)
class ScoreLine:
    """One row of the table."""

    label: str
    color: str
    at: float
    """Height of its middle."""
    dots: list[float]
    """One a seed."""
    mean: float
    reach: tuple[float, float] | None
    """The mean less and more the deviation; None of a single seed."""
    text: str
    """The mean, as the table prints it."""


@dataclass(frozen=True, kw_only=True)
class ScoreChart:
    """All rows by one score."""

    title: str
    lines: list[ScoreLine]
    ticks: list[Tick]
    bottom: float
    """Height of the axis."""


def draw_scores(result: SweepResult, colors: Mapping[str, str]) -> list[ScoreChart]:
    """Draw each score that two rows or more have.

    Args:
        result: The sweep's.
        colors: Of rows by label, as their curves have them.
    """
    charts = [_draw_score(result, colors, metric) for metric in METRICS]
    return [chart for chart in charts if len(chart.lines) > 1]


def _draw_score(result: SweepResult, colors: Mapping[str, str], metric: str) -> ScoreChart:
    rows = [row for row in result.rows if metric in row.scores]
    spreads = [row.scores[metric] for row in rows]
    low, high = _span([value for x in spreads for value in (*x.values, *_ends(x))])
    lines = []
    for number, (row, spread) in enumerate(zip(rows, spreads, strict=True)):
        reach = tuple(_scale(value, low, high) for value in _ends(spread))
        lines.append(
            ScoreLine(
                label=row.label,
                color=colors.get(row.label, _OTHER),
                at=TOP + LINE * (number + 0.5),
                dots=[_scale(value, low, high) for value in spread.values],
                mean=_scale(spread.mean, low, high),
                reach=(reach[0], reach[1]) if reach else None,
                text=format_score(spread.mean, metric),
            )
        )
    better = "lower" if metric in LOWER_IS_BETTER else "higher"
    unit = "" if metric == "ate" else " [%]"
    return ScoreChart(
        title=f"{METRICS[metric]}{unit}, {better} is better",
        lines=lines,
        ticks=[Tick(at=_scale(x, low, high), text=f"{x:g}") for x in even_ticks(low, high)],
        bottom=TOP + LINE * len(rows),
    )


def _ends(spread: Spread) -> tuple[float, ...]:
    """Give the mean less and more the deviation; nothing of a single seed."""
    if spread.deviation is None:
        return ()
    return spread.mean - spread.deviation, spread.mean + spread.deviation


def _span(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values, default=0.0), max(values, default=1.0)
    room = _ROOM * (high - low) or 0.05 * abs(high) or 1.0
    return low - room, high + room


def _scale(value: float, low: float, high: float) -> float:
    return round(LEFT + (value - low) / (high - low) * (RIGHT - LEFT), 1)
