"""Writes tables of results as Markdown, LaTeX, CSV and HTML, with figures.

The same table always yields the same bytes.
"""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flame_mdm.errors import one_line, shortened
from flame_mdm.reporting.page import page, render
from flame_mdm.reporting.plots import Histogram, Panel, Series, svg, svg_file
from flame_mdm.reporting.tables.specs import ABOUT, Figure
from flame_mdm.safe_io import write_text

if TYPE_CHECKING:
    from markupsafe import Markup

ARROWS = {"higher": "↑", "lower": "↓", "real": "→", "none": ""}
KINDS = {
    "real": "Real motions, measured",
    "measured": "Measured",
    "reported real": "Real motions, as reported",
    "reported": "As reported",
}
# States of rows whose values must not be mistaken for results
NO_RESULTS = ("NOT VALID", "QUICK")
# Paths of audit cards in footnotes
CARD = re.compile(r"(?<=\baudit )([\w./-]+\.html)")
# Rows with identical values for these facts share a line in the list of sources
SHARED = (
    "checkpoint sha256",
    "recipe",
    "sampler",
)


@dataclass
class Cell:
    """A cell: text, number, half width of its 95 % interval, and rank (1 = best, 2 = second)."""

    text: str
    value: float | None = None
    ci: float | None = None
    rank: int = 0


@dataclass
class Line:
    """One row of a table, with one cell per column. Cells without a value are None."""

    label: str
    kind: str  # a key of `KINDS`
    cells: list[Cell | None]
    # Footnote marks. Only rows with the same marks are compared.
    marks: str = ""
    # "" if the row is complete and valid; otherwise a reason, such as "no checkpoint"
    state: str = ""
    # Options for the x-axis of figures
    options: dict[str, float] = field(default_factory=dict)
    # Provenance of the values
    facts: dict[str, str] = field(default_factory=dict)


@dataclass
class Part:
    """One part of a `Table`, with its own columns and rows."""

    name: str
    columns: dict[
        str, str
    ]  # by column label, a key of `ARROWS` that states which values are better
    lines: list[Line]
    # Mark and text of each footnote; the mark may be empty
    notes: list[tuple[str, str]] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    histograms: dict[str, Histogram] = field(default_factory=dict)
    # Name and SVG of figures, set by `write`
    drawn: list[tuple[str, Markup | None]] = field(default_factory=list)


@dataclass
class Table:
    """A table of one or more parts, like a table in a paper.

    Links are relative to the folder of the written table.
    """

    name: str
    title: str
    parts: list[Part]
    notes: list[str] = field(default_factory=list)
    folder: Path = Path()


def write(table: Table, out: Path) -> None:
    """Writes a table in all formats, and its figures."""
    table.folder = out
    for part in table.parts:
        drawn = [draw(part, figure) for figure in part.figures]
        for title, histogram in part.histograms.items():
            drawn.append(svg(title, [Panel(histogram, "frames", shortened(title, 40))]))
        slug = (
            re.sub(r"[^a-z0-9]+", "-", f"-{part.name.lower()}").rstrip("-")
            if len(table.parts) > 1
            else ""
        )
        numbers = range(1, len(drawn) + 1) if len(drawn) > 1 else [""]
        part.drawn = [
            (f"{table.name}{slug}-figure{n}", plot) for n, plot in zip(numbers, drawn, strict=False)
        ]
        for name, plot in part.drawn:
            if plot:
                write_text(out / f"{name}.svg", svg_file(plot))
    texts = {
        "md": rendered(table, "md"),
        "tex": rendered(table, "tex"),
        "csv": comma_separated(table),
    }
    for suffix, text in (texts | {"html": page(table.title, rendered(table, "html"))}).items():
        write_text(out / f"{table.name}.{suffix}", text)


def rendered(table: Table, suffix: str) -> Markup:
    """Returns a table as "md", "tex" (for booktabs and threeparttable) or "html" (without a page)."""
    values = {
        "several": len(table.parts) > 1,
        "sources": _sources(table),
        "ranked": any(better != "none" for part in table.parts for better in part.columns.values()),
        "unranked": _unranked(table),
        "bad": NO_RESULTS,
    }
    functions = {"blocks": _blocks, "head": _head, "label": _label, "linked": _linked, "tex": _tex}
    return render(f"table.{suffix}", table=table, **values, **functions)


def _unranked(table: Table) -> str:
    """Returns the kinds of rows that are not ranked, or "" if all rows are ranked."""
    lines = [line for part in table.parts for line in part.lines]
    kinds = []
    if any(line.facts.get("baseline") for line in lines):
        kinds.append("sanity-check baselines")
    if any(line.state in NO_RESULTS for line in lines):
        kinds.append("rows that are quick or not valid")
    return " and ".join(kinds)


def _linked(table: Table, text: str) -> list[tuple[str, str]]:
    """Splits a footnote into pieces of text and their links.

    The link is "" for plain text and for a card that is not on this machine.
    """
    return [
        (
            part,
            Path(os.path.relpath(part, table.folder)).as_posix()
            if i % 2 and Path(part).exists()
            else "",
        )
        for i, part in enumerate(CARD.split(text))
    ]


def _blocks(part: Part) -> list[tuple[str, list[Line]]]:
    return [
        (title, rows)
        for kind, title in KINDS.items()
        if (rows := [x for x in part.lines if x.kind == kind])
    ]


def _label(line: Line) -> str:
    return f"{line.label} ({line.state})" if line.state else line.label


def _head(column: str, better: str) -> str:
    return f"{column}\u00a0{ARROWS[better]}" if ARROWS[better] else column


def _sources(table: Table) -> list[str]:
    """Returns the provenance of rows.

    Rows with identical values for the facts in `SHARED` share a line, in which `/` separates their
    other facts.
    """
    rows = []
    for part in table.parts:
        lines = [line for line in part.lines if line.facts]
        for _, group in groupby(lines, lambda line: [line.facts.get(name) for name in SHARED]):
            some = list(group)
            values = {name: [line.facts[name] for line in some] for name in some[0].facts}
            joined = {
                n: texts[:1] if len(set(texts)) == 1 else [t or "–" for t in texts]
                for n, texts in values.items()
            }
            facts = "; ".join(
                f"{name} = {' / '.join(texts)}"
                for name, texts in joined.items()
                if any(values[name])
            )
            prefix = f"{part.name}: " if len(table.parts) > 1 else ""
            rows.append(
                f"{prefix}{' / '.join(dict.fromkeys(line.label for line in some))}: {facts}"
            )
    return rows


def _tex(text: str) -> str:
    special = {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "–": "--",
    }
    special |= {
        "±": r"$\pm$",
        "†": r"$\dagger$",
        "≥": r"$\geq$",
        "×": r"$\times$",
        "λ": r"$\lambda$",
        "β": r"$\beta$",
    }
    # LaTeX would read brackets after \\ as an optional argument, so brackets are put in braces.
    special |= {c: "\\" + c for c in "&%$#_{}"} | {
        "[": "{[}",
        "]": "{]}",
    }
    return one_line(text).translate(str.maketrans(special))


def comma_separated(table: Table) -> str:
    """Returns the table as CSV.

    A row contains the number, interval and rank of each cell, and the provenance.
    """
    facts = list(
        dict.fromkeys(name for part in table.parts for line in part.lines for name in line.facts)
    )
    columns = list(dict.fromkeys(name for part in table.parts for name in part.columns))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    head = [
        x for c in columns for x in (c, f"{c}: printed", f"{c}: 95 % interval, half", f"{c}: place")
    ]
    writer.writerow([_inert(x) for x in ("part", "row", "kind", "state", "marks", *head, *facts)])
    for part in table.parts:
        for line in part.lines:
            by_column = dict(zip(part.columns, line.cells, strict=True))
            values: list[Any] = []
            for name in columns:
                cell = by_column.get(name)
                values += [cell.value, cell.text, cell.ci, cell.rank or ""] if cell else [""] * 4
            row = [part.name, line.label, line.kind, line.state, line.marks, *values]
            row += [line.facts.get(name, "") for name in facts]
            writer.writerow(["" if x is None else _inert(str(x)) for x in row])
    return out.getvalue()


def _inert(text: str) -> str:
    """Puts an apostrophe before the text of a cell if a spreadsheet would read it as a formula."""
    text = one_line(text)
    number = re.fullmatch(r"[-+]?[\d.,]+([eE][-+]?\d+)?( ?± ?[\d.,]+)?", text)
    return text if number or not text.lstrip().startswith(("=", "+", "-", "@")) else f"'{text}"


def draw(part: Part, figure: Figure) -> Markup | None:
    """Draws a figure of a part as SVG. Returns None if the figure has no points.

    Curves are labeled with the names of the rows, and curves of reported values are dashed. If
    values should be close to the value of real motions, this value is drawn as a dotted line.
    """
    panels = []
    for column in figure.y:
        series, levels = _series(part, figure, column)
        head = f"{shortened(one_line(column), 40)} {ARROWS[part.columns[column]]}".strip()
        panels.append(Panel(series, ABOUT[figure.x], head, figure.log, levels=levels))
    return svg(part.name, panels)


def _series(part: Part, figure: Figure, column: str) -> tuple[list[Series], list[float]]:
    """Returns a column's points as one series per row, and the column's values for real motions."""
    index = list(part.columns).index(column)
    curves: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    levels = []
    for line in part.lines:
        cell, x = line.cells[index], line.options.get(figure.x)
        if cell is None or cell.value is None or line.state:
            continue
        if line.kind.endswith("real"):
            levels += [cell.value] if part.columns[column] == "real" else []
        elif x is not None:
            curves.setdefault((line.kind, line.label), []).append((x, cell.value, cell.ci or 0.0))
    series = []
    for (kind, label), points in curves.items():
        reported = kind == "reported"
        name = shortened(one_line(label), 60) + (", reported" if reported else "")
        xy = [(x, y) for x, y, _ in sorted(points)]
        spread = {x: ci for x, _, ci in points if ci}
        series.append(
            Series(name, xy, spread, "dots" if figure.points else "dashed" if reported else "line")
        )
    return series, levels


def ranks(values: Sequence[float | None], better: str, real: float | None) -> list[int]:
    """Ranks values: 1 for the best, 2 for the second best, 0 for all others.

    A single value is not ranked. `better` is "higher", "lower", "real" (closest to `real`, the
    value of real motions) or "none". Missing values are None.
    """
    if (
        better == "none"
        or sum(v is not None for v in values) < 2
        or (better == "real" and real is None)
    ):
        return [0] * len(values)
    distances = {
        "higher": lambda v: -v,
        "lower": lambda v: v,
        "real": lambda v: abs(v - (real or 0.0)),
    }
    badness = [None if v is None else distances[better](v) for v in values]
    best = sorted({bad for bad in badness if bad is not None})[:2]
    return [best.index(bad) + 1 if bad in best else 0 for bad in badness]
