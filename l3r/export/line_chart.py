"""Curves over optimisation steps, in the pixels of a small drawing."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float64

LEFT, RIGHT, TOP, BOTTOM = 56.0, 592.0, 10.0, 222.0
"""Where the axes stand in a drawing of 600 x 250."""
COLORS = ("#2563a8", "#c8541d", "#2e8550", "#8a3fa0", "#b08a10", "#c2337a", "#4b5563", "#1a8c99")
"""Of the curves, in order; dark enough on white."""
Kind = Literal["noisy", "exact", "dotted"]
"""How a curve is drawn, see :class:`Curve`."""
_MAX_POINTS = 800
_MAX_TICKS = 6


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Values over steps."""

    name: str
    steps: Float64[np.ndarray, " r"]
    values: Float64[np.ndarray, " r"]
    """NaN where there is none."""
    kind: Kind = "noisy"
    """``noisy``: drawn faint, with a running mean; ``exact``: as it is; ``dotted``: as it is, with
    a dot for each value."""


@dataclass(frozen=True, kw_only=True)
class Tick:
    """One mark on an axis."""

    at: float
    text: str


@dataclass(frozen=True, kw_only=True)
class Line:
    """One curve ready for a page."""

    name: str
    color: str
    raw: str
    """Path of the values as they are, where ``smooth`` is a running mean; else empty."""
    smooth: str
    """Path of their running mean, or of the values themselves."""
    dots: list[tuple[float, float]]
    last: str
    """Last value of ``smooth``."""


@dataclass(frozen=True, kw_only=True)
class Chart:
    """A drawing ready for a page."""

    title: str
    lines: list[Line]
    x_ticks: list[Tick]
    y_ticks: list[Tick]


class _Axes(NamedTuple):
    x: tuple[float, float]
    y: tuple[float, float]
    """Logarithms where ``is_log``."""
    is_log: bool


def draw_chart(
    title: str, curves: Sequence[Curve], *, last_step: float, is_log: bool = False
) -> Chart | None:
    """Draw curves from step 0; None where no curve has a value.

    Args:
        title: What is drawn, with its unit.
        curves: At most as many as there are colours are told apart.
        last_step: Where the horizontal axis ends, the same for all charts of a run.
        is_log: Logarithmic; values that are not positive are left out.
    """
    known = [_known(curve, is_log) for curve in curves]
    drawn = [curve for curve in known if len(curve.values)]
    if not drawn:
        return None
    smooth = [_smooth(c.values) if c.kind == "noisy" else c.values for c in drawn]
    x_range = (0.0, last_step)
    ticks, y_range = _y_axis(_spread(drawn, smooth), is_log)
    lines = [
        _line(curve, mean, COLORS[number % len(COLORS)], _Axes(x_range, y_range, is_log))
        for number, (curve, mean) in enumerate(zip(drawn, smooth, strict=True))
    ]
    return Chart(
        title=title,
        lines=lines,
        x_ticks=[
            Tick(at=_scale(x, x_range, LEFT, RIGHT), text=f"{x:,.0f}")
            for x in even_ticks(*x_range)
            if x == int(x)
        ],
        y_ticks=[
            Tick(at=_scale(y, y_range, BOTTOM, TOP), text=f"{10**y if is_log else y:g}")
            for y in ticks
        ],
    )


def even_ticks(low: float, high: float) -> list[float]:
    """Give two to seven round numbers from ``low`` to ``high``; one where both are the same."""
    if high <= low:
        return [low]
    rough = (high - low) / _MAX_TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(s * power for s in (1, 2, 5, 10) if s * power >= rough * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [float(f"{k * step:.10g}") for k in range(first, last + 1)]


def _known(curve: Curve, is_log: bool) -> Curve:
    kept = np.isfinite(curve.values) & ((curve.values > 0) | (not is_log))
    values = np.log10(curve.values[kept]) if is_log else curve.values[kept]
    return Curve(name=curve.name, steps=curve.steps[kept], values=values, kind=curve.kind)


def _smooth(values: Float64[np.ndarray, " r"]) -> Float64[np.ndarray, " r"]:
    """Mean over a window around each value, of a twentieth of the curve, shorter at its ends."""
    half = len(values) // 40
    sums = np.concatenate([[0.0], np.cumsum(values)])
    places = np.arange(len(values))
    first = np.maximum(places - half, 0)
    last = np.minimum(places + half, len(values) - 1) + 1
    return np.asarray((sums[last] - sums[first]) / (last - first))


def _spread(
    curves: Sequence[Curve], smooth: Sequence[Float64[np.ndarray, " _"]]
) -> tuple[float, float]:
    """What to show: all means, and the raw values but for the rarest."""
    low = min(
        min(float(np.quantile(c.values, 0.005)), float(m.min()))
        for c, m in zip(curves, smooth, strict=True)
    )
    high = max(
        max(float(np.quantile(c.values, 0.995)), float(m.max()))
        for c, m in zip(curves, smooth, strict=True)
    )
    return low, high


def _y_axis(spread: tuple[float, float], is_log: bool) -> tuple[list[float], tuple[float, float]]:
    low, high = spread
    if high - low < 1e-12 * max(1.0, abs(high)):
        low, high = low - 0.5 * (abs(low) or 1), high + 0.5 * (abs(high) or 1)
    if not is_log:
        # Zero belongs to the picture where it is not far.
        low = 0.0 if 0 < low < 0.5 * high else low
        room = 0.04 * (high - low)
        low, high = low if low == 0 else low - room, high + room
        return even_ticks(low, high), (low, high)
    powers = range(math.floor(low), math.ceil(high) + 1)
    for factors in ((1,), (1, 3), (1, 2, 5), range(1, 10)):
        marks = [p + math.log10(f) for p in powers for f in factors]
        ticks = [mark for mark in marks if low <= mark <= high]
        if len(ticks) >= 3:
            break
    while len(ticks) > _MAX_TICKS + 1:
        ticks = ticks[::2]
    return ticks, (low, high)


def _scale(value: float, span: tuple[float, float], start: float, end: float) -> float:
    length = span[1] - span[0]
    share = (value - span[0]) / length if length else 0.5
    return round(start + share * (end - start), 1)


def _line(
    curve: Curve,
    smooth: Float64[np.ndarray, " r"],
    color: str,
    axes: _Axes,
) -> Line:
    def places(values: Float64[np.ndarray, " r"]) -> list[tuple[float, float]]:
        kept = _extremes(values)
        return [
            (_scale(x, axes.x, LEFT, RIGHT), _scale(y, axes.y, BOTTOM, TOP))
            for x, y in zip(curve.steps[kept].tolist(), values[kept].tolist(), strict=True)
        ]

    last = float(smooth[-1])
    return Line(
        name=curve.name,
        color=color,
        raw=_path(places(curve.values)) if curve.kind == "noisy" else "",
        smooth=_path(places(smooth)),
        dots=places(smooth) if curve.kind == "dotted" or len(smooth) == 1 else [],
        last=f"{10**last if axes.is_log else last:.3g}",
    )


def _extremes(values: Float64[np.ndarray, " r"]) -> list[int]:
    """Choose points to draw: of each short stretch its lowest and its highest."""
    if len(values) <= _MAX_POINTS:
        return list(range(len(values)))
    stretches = np.array_split(np.arange(len(values)), _MAX_POINTS // 2)
    found = {int(s[pick(values[s])]) for s in stretches for pick in (np.argmin, np.argmax)}
    return sorted(found | {0, len(values) - 1})


def _path(points: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:g} {y:g}" for x, y in points)
