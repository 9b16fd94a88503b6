"""Web pages of charts, tables and players: one file, no network, opens from disk. Same input, same bytes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path

WIDE, HIGH = 460, 230
LEFT, RIGHT, TOP, BOTTOM = 58, 10, 8, 24
MOST = 300
"""Stretches of a curve that are drawn; of each, its lowest and its highest point."""
LOG_RANGE = 15
"""Positive values that span more than this factor get a logarithmic axis."""
COLORS = 8

Curve = Mapping[int, float]
"""Values by step."""


def page(title: str, body: str, script: str = "") -> str:
    """A page. `body` is HTML whose texts are escaped, `script` runs at its end."""
    style = Path(__file__).with_suffix(".css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n{body}\n"
        + (f"<script>\n{script}\n</script>\n" if script else "")
        + "</body>\n</html>\n"
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: bool = False) -> str:
    """A table of texts, which are escaped; with `numbers`, all columns but the first stand to the right."""

    def row(tag: str, cells: Sequence[str]) -> str:
        kinds = ["", *([" class='number'"] if numbers else [""]) * (len(cells) - 1)]
        return "".join(f"<{tag}{kind}>{escape(cell)}</{tag}>" for kind, cell in zip(kinds, cells, strict=True))

    body = "".join(f"<tr>{row('td', cells)}</tr>" for cells in rows)
    first = f"<tr>{row('th', head)}</tr>" if any(head) else ""
    return f"<div class='card scroll'><table>{first}{body}</table></div>"


def frame(player: str, height: int) -> str:
    """A player, as `flame_mdm.visualize.player_page` gives it, within a page; `height` in pixels."""
    return f'<iframe sandbox="allow-scripts allow-downloads" height="{height}" srcdoc="{escape(player)}"></iframe>'


def chart(title: str, curves: Mapping[str, Curve], bands: Mapping[str, Curve] | None = None) -> str:
    """Curves over the steps, overlaid, with their last values; the axis is logarithmic where values span much.

    Args:
        title: what the values are.
        curves: by name; values that are not finite are left out.
        bands: of some of the curves, half the width of their 95 % interval.
    """
    found = {name: _finite(curve) for name, curve in curves.items()}
    values = [y for points in found.values() for _, y in points]
    lasts = {name: number(points[-1][1]) if points else "–" for name, points in found.items()}
    key = "".join(
        f"<span><i style='background:var(--c{k % COLORS})'></i>{escape(name)} {value}</span>"
        for k, (name, value) in enumerate(lasts.items())
    )
    head = f"<h3>{escape(title)}</h3>"
    if not values:
        return f"<div class='card'>{head}<p class='faint'>no value is finite</p><div class='key'>{key}</div></div>"
    logarithmic = min(values) > 0 and max(values) > LOG_RANGE * min(values)
    spread = {name: {x: abs(w) for x, w in _finite(curve)} for name, curve in (bands or {}).items()}
    reach = [
        y + sign * spread.get(n, {}).get(x, 0) for n, points in found.items() for x, y in points for sign in (-1, 1)
    ]
    low, high, ticks = _log_axis(min(values), max(values)) if logarithmic else _linear_axis(min(reach), max(reach))
    last = max([x for points in found.values() for x, _ in points] + [1])
    scale = math.log if logarithmic else float

    def at(x: float, y: float) -> str:
        share = (scale(min(max(y, low), high)) - scale(low)) / (scale(high) - scale(low))
        across, down = WIDE - LEFT - RIGHT, HIGH - TOP - BOTTOM
        return f"{LEFT + across * x / last:.1f},{TOP + down * (1 - share):.1f}"

    parts = [_grid(ticks, last, at)]
    for k, (name, points) in enumerate(found.items()):
        color = f"var(--c{k % COLORS})"
        if wide := spread.get(name):
            rim = [at(x, y + wide[x]) for x, y in points if x in wide]
            rim += [at(x, y - wide[x]) for x, y in reversed(points) if x in wide]
            parts.append(f"<polygon points='{' '.join(rim)}' style='fill:{color};opacity:.18'/>")
        shown = [at(x, y) for x, y in _thinned(points)]
        parts.append(f"<polyline points='{' '.join(shown)}' style='fill:none;stroke:{color};stroke-width:1.5'/>")
        if len(points) <= 40:
            parts += [
                f"<circle cx='{p.split(',')[0]}' cy='{p.split(',')[1]}' r='2.6' style='fill:{color}'/>" for p in shown
            ]
    svg = f"<svg viewBox='0 0 {WIDE} {HIGH}' role='img' aria-label='{escape(title)}'>{''.join(parts)}</svg>"
    return f"<div class='card'>{head}{svg}<div class='key'>{key}</div></div>"


def number(value: float | None) -> str:
    """A number as tables show it: four digits; a dash for what has no value."""
    if value is None:
        return "–"
    if isinstance(value, float) and math.isfinite(value) and 0 < abs(value) < 1e-3:
        return f"{value:.2e}"
    return f"{value:,.0f}" if abs(value) >= 10_000 else f"{value:.4g}"


def short(step: float) -> str:
    """A number of steps: 1500 -> 1.5k."""
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if abs(step) >= size:
            return f"{step / size:.4g}{unit}"
    return f"{step:.4g}"


def _finite(curve: Curve) -> list[tuple[int, float]]:
    return [(x, y) for x, y in sorted(curve.items()) if abs(y) < 1e300]  # no NaN, nothing that overflows when drawn


def _thinned(points: Sequence[tuple[int, float]]) -> list[tuple[int, float]]:
    if len(points) <= 2 * MOST:
        return list(points)
    size = -(-len(points) // MOST)
    parts = [points[begin : begin + size] for begin in range(0, len(points), size)]
    return [p for part in parts for p in sorted({min(part, key=lambda q: q[1]), max(part, key=lambda q: q[1])})]


def _linear_axis(low: float, high: float) -> tuple[float, float, list[float]]:
    """Ends of the axis and where its numbers stand."""
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        low, high = low - (abs(low) or 1) / 10, high + (abs(high) or 1) / 10
    step = _round_step((high - low) / 4)
    begin, end = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    ticks = [k * step for k in range(begin, end + 1)]
    return ticks[0], ticks[-1], ticks


def _round_step(least: float) -> float:
    power = 10 ** math.floor(math.log10(least))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= least * 0.999)


def _log_axis(low: float, high: float) -> tuple[float, float, list[float]]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    every = -(-len(decades) // 6)
    steps = (1, 2, 5) if len(decades) <= 3 else (1,)
    ticks = [m * 10.0**d for d in decades if (d - decades[0]) % every == 0 for m in steps]
    within = [tick for tick in ticks if low * 0.999 <= tick <= high * 1.001]
    return min([low, *within]) / 1.15, max([high, *within]) * 1.15, within


def _grid(ticks: Sequence[float], last: float, at: Callable[[float, float], str]) -> str:
    parts = []
    for tick in ticks:
        _, y = at(0, tick).split(",")
        parts.append(f"<line x1='{LEFT}' x2='{WIDE - RIGHT}' y1='{y}' y2='{y}' style='stroke:var(--line)'/>")
        parts.append(f"<text x='{LEFT - 6}' y='{float(y) + 4:.1f}' text-anchor='end'>{_tick(tick)}</text>")
    step = max(1, _round_step(last / 5))
    for k in range(math.floor(last / step + 0.02) + 1):  # 2999 steps have a number 3k, too
        x = LEFT + (WIDE - LEFT - RIGHT) * min(1, k * step / last)
        anchor = "end" if x > WIDE - RIGHT - 12 else "middle"
        parts.append(f"<text x='{x:.1f}' y='{HIGH - 8}' text-anchor='{anchor}'>{short(k * step)}</text>")
    return "".join(parts)


def _tick(value: float) -> str:
    if value == 0 or abs(value) < 1e-12:
        return "0"
    return f"{value:.0e}".replace("e-0", "e-") if abs(value) < 1e-3 else short(float(f"{value:.6g}"))
