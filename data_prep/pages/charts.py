"""Histograms as bars and ticks, in the pixels of a small drawing."""

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from data_prep.check.histograms import Histogram

LEFT, RIGHT, TOP, BOTTOM = 46.0, 350.0, 12.0, 146.0
"""Where the axes stand."""
_MAX_TICKS = 6


@dataclass(frozen=True, kw_only=True)
class Bar:
    """One bin."""

    x: float
    y: float
    width: float
    height: float
    title: str
    """What it holds, shown on hovering."""


@dataclass(frozen=True, kw_only=True)
class Tick:
    """One mark on an axis."""

    at: float
    text: str


@dataclass(frozen=True, kw_only=True)
class Chart:
    """A histogram ready for a page."""

    title: str
    axis: str
    """Name of the horizontal axis, with its unit."""
    of: str
    """Name of the vertical axis."""
    bars: list[Bar]
    x_ticks: list[Tick]
    y_ticks: list[Tick]
    note: str
    """Lowest, median and highest value."""


def draw_histogram(histogram: Histogram) -> Chart:
    """Draw a histogram over the range that holds its values."""
    counts = histogram.counts
    first, last = _used_bins(histogram)
    edges = histogram.edges[first : last + 1]
    places = np.log(edges) if histogram.is_log else edges
    unit = f" {histogram.unit}" if histogram.unit else ""
    titles = [
        f"{low:.3g} to {high:.3g}{unit}: {count}"
        for low, high, count in zip(edges, edges[1:], counts[first:last], strict=False)
    ]
    ticks = (
        _log_ticks(edges) if histogram.is_log else _even_ticks(float(edges[0]), float(edges[-1]))
    )
    marks = np.log(ticks) if histogram.is_log else np.array(ticks)
    return Chart(
        title=histogram.title,
        axis=f"{histogram.title} [{histogram.unit}]" if histogram.unit else histogram.title,
        of=histogram.of,
        bars=_bars(places, counts[first:last], titles),
        x_ticks=[
            Tick(at=at, text=f"{value:g}")
            for at, value in zip(_to_x(places, marks), ticks, strict=True)
        ],
        y_ticks=_count_ticks(int(counts.max())),
        note=_note(histogram, unit),
    )


def draw_counts(counts: Counter[int], title: str, of: str) -> Chart:
    """Draw how often each whole number was met.

    Args:
        counts: By number, not empty.
        title: What the number is.
        of: What is counted.
    """
    low, high = min(counts), max(counts)
    if high - low < 5:
        low, high = max(0, low - 2), high + 2
    numbers = list(range(low, high + 1))
    edges = np.arange(low, high + 2) - 0.5
    heights = np.array([counts[number] for number in numbers], dtype=np.int64)
    ticks = [t for t in _even_ticks(float(low), float(high)) if t == int(t)]
    return Chart(
        title=title,
        axis=title,
        of=of,
        bars=_bars(edges, heights, [f"{n}: {c}" for n, c in zip(numbers, heights, strict=True)]),
        x_ticks=[
            Tick(at=at, text=f"{value:.0f}")
            for at, value in zip(_to_x(edges, np.array(ticks)), ticks, strict=True)
        ],
        y_ticks=_count_ticks(int(heights.max())),
        note=f"{min(counts)} to {max(counts)}, {counts.total():,} {of}",
    )


def _used_bins(histogram: Histogram) -> tuple[int, int]:
    """Give the first bin to draw and the one after the last."""
    used = np.nonzero(histogram.counts)[0]
    if not len(used):
        return 0, len(histogram.counts)
    first, last = int(used[0]), int(used[-1]) + 1
    if histogram.is_log:
        return max(0, first - 2), min(len(histogram.counts), last + 2)
    # Shares keep their whole range: that nothing lies above one half is worth seeing.
    return 0, len(histogram.counts) if histogram.edges[-1] != 180 else max(8, last)


def _to_x(places: Float64[np.ndarray, " e"], marks: Float64[np.ndarray, " m"]) -> list[float]:
    span = places[-1] - places[0]
    return [round(LEFT + float(x) * (RIGHT - LEFT), 1) for x in (marks - places[0]) / span]


def _bars(
    places: Float64[np.ndarray, " e"], counts: Int64[np.ndarray, " b"], titles: list[str]
) -> list[Bar]:
    x = _to_x(places, places)
    highest = max(1, int(counts.max()))
    bars = []
    for bin_, count in enumerate(counts.tolist()):
        if count:
            # A single graph among a million must still be seen.
            height = max(1.0, round(count / highest * (BOTTOM - TOP), 1))
            width = round(max(0.8, x[bin_ + 1] - x[bin_] - 0.8), 1)
            bar = Bar(x=x[bin_], y=BOTTOM - height, width=width, height=height, title=titles[bin_])
            bars.append(bar)
    return bars


def _count_ticks(highest: int) -> list[Tick]:
    highest = max(1, highest)
    ticks = [t for t in _even_ticks(0.0, float(highest)) if t == int(t)]
    return [Tick(at=round(BOTTOM - t / highest * (BOTTOM - TOP), 1), text=_short(t)) for t in ticks]


def _short(count: float) -> str:
    if count >= 1e6:
        return f"{count / 1e6:g}M"
    return f"{count / 1e3:g}k" if count >= 1e4 else f"{count:.0f}"


def _even_ticks(low: float, high: float) -> list[float]:
    """Give at most six round numbers between two."""
    rough = (high - low) / (_MAX_TICKS - 1) or 1.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(s * power for s in (1, 2, 5, 10) if s * power >= rough * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(k * step, 10) for k in range(first, last + 1)]


def _log_ticks(edges: Float64[np.ndarray, " e"]) -> list[float]:
    """Give powers of ten, or 1, 2 and 5 times them where the range is short."""
    low, high = float(edges[0]), float(edges[-1])
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors, enough in (((1,), 3), ((1, 2, 5), 2), (range(1, 10), 0)):
        ticks = [f * 10.0**p for p in powers for f in factors if low <= f * 10.0**p <= high]
        if len(ticks) >= enough:
            break
    return ticks


def _note(histogram: Histogram, unit: str) -> str:
    if not histogram.total:
        return f"no {histogram.of}"
    unknown = f"; {histogram.num_unknown:,} unknown" if histogram.num_unknown else ""
    return (
        f"{histogram.lowest:.3g} to {histogram.highest:.3g}{unit}, median"
        f" {histogram.median():.3g}; {histogram.total:,} {histogram.of}{unknown}"
    )
