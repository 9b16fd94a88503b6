"""Curves, scatter plots and histograms as SVG. The same values always yield the same bytes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from flame_mdm.reporting.page import TEMPLATES, number, render, short

if TYPE_CHECKING:
    from markupsafe import Markup

WIDE, HIGH = 460, 230
LEFT, RIGHT, TOP, BOTTOM = 58, 10, 8, 24
# Height of a line of text
ROW = 16
# Maximum number of segments per curve. The lowest and highest points of each segment are drawn.
MOST = 300
LOG_RANGE = 15  # positive values that span more than this factor get a logarithmic axis
COLORS = 8
# Numbers closer to 0 than this are treated as 0 on axes, because steps between ticks would
# underflow
SMALLEST = 1e-300

Curve = Mapping[int, float]  # values by step


@dataclass
class Series:
    """Points (x, y) in ascending order, drawn in one color as a line, a dashed line or dots.

    A point may have a 95 % interval, given by its half width.
    """

    name: str
    points: Sequence[tuple[float, float]]
    spread: Mapping[float, float] = field(default_factory=dict)
    kind: str = "line"


@dataclass
class Histogram:
    """Histogram of motion lengths. The first bar covers 0 to `step` frames."""

    step: int
    counts: Sequence[int]


@dataclass
class Panel:
    """A pair of axes with labels.

    The x-axis may be logarithmic or begin at 0. `levels` are the y-values of horizontal lines.
    """

    content: Sequence[Series] | Histogram
    x: str = ""
    y: str = ""
    log_x: bool = False
    from_zero: bool = False
    levels: Sequence[float] = ()
    legend: bool = True


def svg(title: str, panels: Sequence[Panel]) -> Markup | None:
    """Draws panels side by side, with the styles of the page. Returns None if there are no points."""
    drawn = [_drawn(panel) for panel in panels]
    if not any(drawn):
        return None
    high = max(panel["high"] for panel in drawn if panel)
    return render(
        "plot.svg", title=title, panels=drawn, width=WIDE, high=high, left=LEFT, right=WIDE - RIGHT
    )


def svg_file(drawing: Markup) -> str:
    """Returns a drawing and its styles as the text of a standalone SVG file."""
    style = (TEMPLATES / "plot.css").read_text(encoding="utf-8")
    return str(drawing).replace(">", f"><style>{style}</style>", 1)


def chart(
    title: str, curves: Mapping[str, Curve], bands: Mapping[str, Curve] | None = None
) -> Markup:
    """Draws curves over training steps and lists their last finite values.

    `bands` maps the names of curves to the half widths of their intervals.
    """
    spread = {
        name: {x: abs(width) for x, width in _finite(curve)}
        for name, curve in (bands or {}).items()
    }
    series = [Series(name, _finite(curve), spread.get(name, {})) for name, curve in curves.items()]
    key = [(s.name, number(s.points[-1][1]) if s.points else "–") for s in series]
    plot = svg(title, [Panel(series, from_zero=True, legend=False)])
    return render("chart.html", title=title, plot=plot, key=key, colors=COLORS)


@dataclass(frozen=True)
class _Axis:
    low: float
    high: float
    ticks: Sequence[float]
    log: bool = False

    def share(self, value: float) -> float:
        scale = math.log if self.log else float
        value = min(max(value, self.low), self.high)
        return (scale(value) - scale(self.low)) / (scale(self.high) - scale(self.low))


def _drawn(panel: Panel) -> dict[str, Any] | None:
    histogram = panel.content if isinstance(panel.content, Histogram) else None
    series = [] if isinstance(panel.content, Histogram) else panel.content
    points = {s.name: [(x, y) for x, y in s.points if x > 0 or not panel.log_x] for s in series}
    everything = [point for curve in points.values() for point in curve]
    if histogram:
        everything = [(0, 0), (histogram.step * len(histogram.counts), max(histogram.counts))]
    if not everything:
        return None
    xs, ys = zip(*everything, strict=True)
    low, high = min(ys), max(ys)
    logarithmic = panel.from_zero and low > 0 and high > LOG_RANGE * low
    if not logarithmic:
        reach = [
            y + sign * s.spread.get(x, 0)
            for s in series
            for x, y in points[s.name]
            for sign in (-1, 1)
        ]
        low, high = min([low, *reach, *panel.levels]), max([high, *reach, *panel.levels])
    y_axis = _log_axis(low, high) if logarithmic else _linear_axis(low, high, to_ticks=True)
    first = 0 if panel.from_zero else min(xs)
    x_axis = (
        _log_axis(min(xs), max(xs)) if panel.log_x else _linear_axis(first, max(xs), to_ticks=False)
    )

    def at(x: float, y: float) -> tuple[str, str]:
        across, down = WIDE - LEFT - RIGHT, HIGH - TOP - BOTTOM
        return f"{LEFT + across * x_axis.share(x):.1f}", f"{TOP + down * (1 - y_axis.share(y)):.1f}"

    def path(line: Iterable[tuple[float, float]]) -> str:
        return " ".join(",".join(at(x, y)) for x, y in line)

    lines = []
    for k, s in enumerate(series):
        curve = points[s.name]
        wide = [(x, y) for x, y in curve if x in s.spread]
        rim = [(x, y + s.spread[x]) for x, y in wide] + [
            (x, y - s.spread[x]) for x, y in reversed(wide)
        ]
        errors = [(*at(x, y - s.spread[x]), at(x, y + s.spread[x])[1]) for x, y in wide]
        shown = _thinned(curve)
        dots = [at(x, y) for x, y in shown] if len(curve) <= 40 or s.kind == "dots" else []
        lines.append((k % COLORS, s.kind, path(shown), path(rim), errors, dots))
    names = ["motions"] if histogram else [s.name for s in series]
    legend = [(k % COLORS, HIGH + ROW * (k + bool(panel.x)), name) for k, name in enumerate(names)]
    return {
        "rows": [(at(x_axis.low, tick)[1], _tick(tick)) for tick in y_axis.ticks],
        "columns": [(at(tick, low)[0], _tick(tick)) for tick in x_axis.ticks],
        "levels": [at(x_axis.low, level)[1] for level in panel.levels],
        "bars": _bars(histogram, at) if histogram else [],
        "lines": lines,
        "legend": legend if panel.legend else [],
        "x": panel.x,
        "y": panel.y,
        "high": HIGH + ROW * (bool(panel.x) + len(names) * panel.legend),
    }


def _bars(histogram: Histogram, at: Any) -> list[tuple[int, str, str, str, str, str]]:
    bars = []
    for begin, count in zip(itertools.count(0, histogram.step), histogram.counts, strict=False):
        (left, top), (right, bottom) = at(begin, count), at(begin + histogram.step, 0)
        size = (f"{float(right) - float(left) - 1:.1f}", f"{float(bottom) - float(top):.1f}")
        bars.append(
            (0, left, top, *size, f"{begin} to {begin + histogram.step} frames: {count} motions")
        )
    return bars


def _finite(curve: Curve) -> list[tuple[float, float]]:
    """Returns the points of a curve, sorted by step, without NaN or values that would overflow."""
    return [(x, y) for x, y in sorted(curve.items()) if abs(y) < 1e300]


def _thinned(points: Sequence[tuple[float, float]]) -> Sequence[tuple[float, float]]:
    if len(points) <= 2 * MOST:
        return points
    # The smallest and the largest value of each segment are kept, so that no spike is lost.
    size = math.ceil(len(points) / MOST)
    parts = [points[begin : begin + size] for begin in range(0, len(points), size)]
    return [
        p
        for part in parts
        for p in sorted({min(part, key=lambda q: q[1]), max(part, key=lambda q: q[1])})
    ]


def _linear_axis(low: float, high: float, to_ticks: bool) -> _Axis:
    """Returns an axis that ends at the extreme values or at ticks."""
    low, high = (value if abs(value) > SMALLEST else 0.0 for value in (low, high))
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        low, high = low - (abs(low) or 1) / 10, high + (abs(high) or 1) / 10
    least = (high - low) / (4 if to_ticks else 5)
    power = 10 ** math.floor(math.log10(least))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= least * 0.999)
    if to_ticks:
        begin, end = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
        low, high = begin * step, end * step
    else:
        # A tick may lie slightly beyond the end of an axis. For example, an axis that ends at step
        # 2999 has a tick at 3k.
        begin, end = math.ceil(low / step - 0.02), math.floor(high / step + 0.02)
    return _Axis(low, high, [k * step for k in range(begin, end + 1)])


def _log_axis(low: float, high: float) -> _Axis:
    low, high = max(low, SMALLEST), max(high, SMALLEST)
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    every = math.ceil(len(decades) / 6)  # at most six powers of ten have ticks
    steps = (1, 2, 5) if len(decades) <= 3 else (1,)
    ticks = [m * 10.0**d for d in decades if (d - decades[0]) % every == 0 for m in steps]
    within = [tick for tick in ticks if low * 0.999 <= tick <= high * 1.001]
    return _Axis(min([low, *within]) / 1.15, max([high, *within]) * 1.15, within, True)


def _tick(value: float) -> str:
    if abs(value) < 1e-12:
        return "0"
    return (
        f"{value:.0e}".replace("e-0", "e-") if abs(value) < 1e-3 else short(float(f"{value:.6g}"))
    )
