"""Tables of results as Markdown, LaTeX, CSV and HTML, and their plots. The same table gives the same bytes."""

from __future__ import annotations

import csv
import html
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

ARROWS = {"higher": "↑", "lower": "↓", "real": "→", "none": ""}
LATEX_ARROWS = {"higher": r"$\uparrow$", "lower": r"$\downarrow$", "real": r"$\rightarrow$", "none": ""}
KINDS = {
    "real": "Real motions, measured here",
    "measured": "Measured here",
    "reported real": "Real motions, as reported",
    "reported": "As reported",
}
NO_RESULTS = ("NOT VALID", "QUICK")
"""States of rows whose values must not be taken for results."""
LEGEND = (
    "↑ higher is better, ↓ lower is better, → closer to real motions is better. **Best** and <u>second best</u> of the "
    "rows with the same mark."
)


@dataclass
class Cell:
    """What stands in one place: text as printed, the number it stands for, and 1 for the best, 2 for the second."""

    text: str
    value: float | None = None
    ci: float | None = None
    place: int = 0


@dataclass
class Line:
    """One row.

    Attributes:
        label: its name.
        kind: a key of `KINDS`.
        cells: one a column, None where there is no value.
        marks: footnotes; rows are compared with rows of the same marks only.
        state: "" for a whole row, else why it is not: "no checkpoint", "NOT VALID".
        options: numbers that figures may be drawn over, such as num_inference_steps.
        facts: where its values come from, for the CSV file and the list below the table.
    """

    label: str
    kind: str
    cells: list[Cell | None]
    marks: str = ""
    state: str = ""
    options: dict[str, float] = field(default_factory=dict)
    facts: dict[str, str] = field(default_factory=dict)


@dataclass
class Figure:
    """A plot of columns of a part over an option of its rows; see `draw`."""

    x: str
    y: list[str]
    log: bool = False
    points: bool = False


@dataclass
class Part:
    """One table: columns by label with their direction, rows, footnotes by mark, and figures."""

    name: str
    columns: dict[str, str]
    lines: list[Line]
    notes: list[tuple[str, str]] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    histograms: dict[str, tuple[list[float], list[int]]] = field(default_factory=dict)


@dataclass
class Table:
    """All parts that belong together, as in one table of a paper."""

    name: str
    title: str
    parts: list[Part]
    notes: list[str] = field(default_factory=list)
    drawn: dict[str, str] = field(default_factory=dict)
    """Figures that have points, as SVG, by the names of `figure_names`."""


def _blocks(part: Part) -> list[tuple[str, list[Line]]]:
    return [(title, rows) for kind, title in KINDS.items() if (rows := [x for x in part.lines if x.kind == kind])]


def _label(line: Line) -> str:
    return f"{line.label} ({line.state})" if line.state else line.label


def _head(column: str, better: str) -> str:
    return f"{column}\u00a0{ARROWS[better]}" if ARROWS[better] else column


def _is_ranked(table: Table) -> bool:
    return any(better != "none" for part in table.parts for better in part.columns.values())


def _number(part: Part, index: int) -> str:
    return f"{index + 1}" if len(part.figures) + len(part.histograms) > 1 else ""


def figure_names(table: Table) -> list[tuple[Part, Figure | str, str]]:
    """The figures of a table with the names of their files, without suffix."""
    found: list[tuple[Part, Figure | str, str]] = []
    for part in table.parts:
        slug = f"-{_slug(part.name)}" if len(table.parts) > 1 else ""
        for index, figure in enumerate([*part.figures, *part.histograms]):
            found.append((part, figure, f"{table.name}{slug}-figure{_number(part, index)}"))
    return found


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


# Markdown -------------------------------------------------------------------------------------------------------------


def markdown(table: Table) -> str:
    """The table with its footnotes and figures as Markdown."""
    page = f"# {table.title}\n"
    for part in table.parts:
        page += f"\n## {part.name}\n\n" if len(table.parts) > 1 else "\n"
        page += "| | " + " | ".join(_md(_head(c, b)) for c, b in part.columns.items()) + " |\n"
        page += "|---" * (len(part.columns) + 1) + "|\n"
        blocks = _blocks(part)
        for title, lines in blocks:
            if len(blocks) > 1:
                page += f"| *{title}* |" + " |" * len(part.columns) + "\n"
            for line in lines:
                cells = [_styled(c, _md, "**{}**", "<u>{}</u>") for c in line.cells]
                marks = f" <sup>{line.marks}</sup>" if line.marks else ""
                page += f"| {_md(_label(line))}{marks} | " + " | ".join(cells) + " |\n"
        page += "".join(f"\n{mark}: {_md(text)}  " if mark else f"\n{_md(text)}  " for mark, text in part.notes) + "\n"
        for owner, _, name in figure_names(table):
            if owner is part and name in table.drawn:
                page += f"\n![{part.name}]({name}.svg)\n"
    page += "".join(f"\n- {_md(note)}" for note in table.notes) + "\n" * bool(table.notes)
    page += f"\n{LEGEND}\n" if _is_ranked(table) else ""
    rows = _sources(table)
    if rows:
        page += "\n<details><summary>Where the rows come from</summary>\n\n" + "\n".join(
            f"- {_md(row)}" for row in rows
        )
        page += "\n\n</details>\n"
    return page


def _sources(table: Table) -> list[str]:
    rows = []
    for part in table.parts:
        for line in part.lines:
            if line.facts:
                facts = ", ".join(f"{name} {value}" for name, value in line.facts.items() if value)
                prefix = f"{part.name}: " if len(table.parts) > 1 else ""
                rows.append(f"{prefix}{line.label}: {facts}")
    return rows


def _styled(cell: Cell | None, escape: Callable[[str], str], best: str, second: str) -> str:
    if cell is None:
        return escape("–")
    text = escape(cell.text)
    return best.format(text) if cell.place == 1 else second.format(text) if cell.place == 2 else text


def _md(text: str) -> str:
    return html.escape(re.sub(r"([|*_`\[\]\\])", r"\\\1", text), quote=False)


# LaTeX ----------------------------------------------------------------------------------------------------------------


def latex(table: Table) -> str:
    """The table as LaTeX; needs the packages booktabs and threeparttable."""
    page = "% \\usepackage{booktabs,threeparttable}\n"
    for part in table.parts:
        title = f"{table.title}: {part.name}" if len(table.parts) > 1 else table.title
        page += "\\begin{table}\n\\centering\n\\begin{threeparttable}\n"
        page += f"\\caption{{{_tex(title)}}}\n\\begin{{tabular}}{{l{'r' * len(part.columns)}}}\n\\toprule\n"
        page += " & ".join(["", *(f"{_tex(c)} {LATEX_ARROWS[b]}".strip() for c, b in part.columns.items())]) + " \\\\\n"
        for title, lines in _blocks(part):
            page += f"\\midrule\n\\multicolumn{{{len(part.columns) + 1}}}{{l}}{{\\emph{{{_tex(title)}}}}} \\\\\n"
            for line in lines:
                marks = f"\\tnote{{{_tex(line.marks)}}}" if line.marks else ""
                cells = [_styled(c, _tex, "\\textbf{{{}}}", "\\underline{{{}}}") for c in line.cells]
                page += " & ".join([_tex(_label(line)) + marks, *cells]) + " \\\\\n"
        page += "\\bottomrule\n\\end{tabular}\n"
        if part.notes:
            items = "".join(f"\\item[{_tex(mark)}] {_tex(text)}\n" for mark, text in part.notes)
            page += f"\\begin{{tablenotes}}\n\\footnotesize\n{items}\\end{{tablenotes}}\n"
        page += "\\end{threeparttable}\n\\end{table}\n"
    return page + "".join(f"% {note}\n" for note in table.notes)


def _tex(text: str) -> str:
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--"}
    special |= {"±": r"$\pm$", "†": r"$\dagger$", "≥": r"$\geq$", "×": r"$\times$", "λ": r"$\lambda$", "β": r"$\beta$"}
    special |= {c: "\\" + c for c in "&%$#_{}"}
    return "".join(special.get(c, c) for c in text)


# CSV ------------------------------------------------------------------------------------------------------------------


def comma_separated(table: Table) -> str:
    """One row a line of the table, with number, interval and place of each cell, and where it comes from."""
    facts = list(dict.fromkeys(name for part in table.parts for line in part.lines for name in line.facts))
    columns = list(dict.fromkeys(name for part in table.parts for name in part.columns))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    head = [x for c in columns for x in (c, f"{c}: printed", f"{c}: 95 % interval, half", f"{c}: place")]
    writer.writerow(["part", "row", "kind", "state", "marks", *head, *facts])
    for part in table.parts:
        for line in part.lines:
            by_column = dict(zip(part.columns, line.cells, strict=True))
            values: list[Any] = []
            for name in columns:
                cell = by_column.get(name)
                values += (
                    ["", "", "", ""]
                    if cell is None
                    else [_plain(cell.value), cell.text, _plain(cell.ci), cell.place or ""]
                )
            row = [part.name, line.label, line.kind, line.state, line.marks, *values]
            writer.writerow([*row, *(line.facts.get(name, "") for name in facts)])
    return out.getvalue()


def _plain(value: float | None) -> str:
    return "" if value is None else repr(value)


# HTML -----------------------------------------------------------------------------------------------------------------


def fragment(table: Table) -> str:
    """The table as HTML, to stand in a page of `flame_mdm.visualize.page`."""
    out = f"<h1>{html.escape(table.title)}</h1>\n"
    for part in table.parts:
        out += f"<h2>{html.escape(part.name)}</h2>\n" if len(table.parts) > 1 else ""
        head = "".join(f'<th class="number">{html.escape(_head(c, b))}</th>' for c, b in part.columns.items())
        out += f'<div class="card scroll"><table class="values"><thead><tr><th></th>{head}</tr></thead><tbody>\n'
        blocks = _blocks(part)
        for title, lines in blocks:
            if len(blocks) > 1:
                span = len(part.columns) + 1
                out += f'<tr class="block"><td colspan="{span}"><i>{html.escape(title)}</i></td></tr>\n'
            for line in lines:
                bad, faint = line.state in NO_RESULTS, line.state or line.kind.startswith("reported")
                name = "bad" if bad else "faint" if faint else ""
                marks = f"<sup>{html.escape(line.marks)}</sup>" if line.marks else ""
                cells = "".join(
                    f'<td class="number">{_styled(c, html.escape, "<b>{}</b>", "<u>{}</u>")}</td>' for c in line.cells
                )
                out += f'<tr class="{name}"><td>{html.escape(_label(line))}{marks}</td>{cells}</tr>\n'
        out += "</tbody></table></div>\n"
        notes = "".join(
            f"<p>{f'<sup>{html.escape(mark)}</sup> ' if mark else ''}{html.escape(text)}</p>"
            for mark, text in part.notes
        )
        out += f'<div class="notes faint">{notes}</div>\n' if notes else ""
        for owner, _, name in figure_names(table):
            if owner is part:
                empty = "<p class='faint'>The figure has no points yet.</p>"
                out += f"<figure>{table.drawn[name]}</figure>\n" if name in table.drawn else f"{empty}\n"
    out += "".join(f"<p>{html.escape(note)}</p>" for note in table.notes)
    if _is_ranked(table):
        out += f'<p class="notes faint">{LEGEND.replace("**Best**", "<b>Best</b>")}</p>\n'
    rows = "".join(f"<li>{html.escape(row)}</li>" for row in _sources(table))
    return out + (
        f'<details class="notes faint"><summary>Where the rows come from</summary><ul>{rows}</ul></details>\n'
        if rows
        else ""
    )


# Plots ----------------------------------------------------------------------------------------------------------------

COLORS = ("#2563eb", "#dc2626", "#059669", "#9333ea", "#d97706", "#0891b2", "#be185d", "#4d7c0f")


def draw(part: Part, figure: Figure | str, labels: Mapping[str, str]) -> str | None:
    """A figure of a part as SVG; None where it has no point.

    Lines are named after the rows; measured ones are solid, reported ones dashed. Real motions are a gray line where
    a column is better the closer to them. `points` draws a scatter with a name at each point instead.

    Args:
        part: with the values.
        figure: what to draw, or the name of one of the part's histograms.
        labels: by option, the text for the axis.
    """
    import matplotlib

    with matplotlib.rc_context({"svg.hashsalt": "table", "svg.fonttype": "path", "font.size": 10}):
        from matplotlib.figure import Figure as Canvas

        if isinstance(figure, str):
            canvas = Canvas((6.4, 3.2), layout="constrained")
            axes = canvas.subplots()
            edges, counts = part.histograms[figure]
            axes.stairs(counts, edges, fill=True, color=COLORS[0], alpha=0.85)
            axes.set(xlabel="frames", ylabel="motions", title=figure)
            axes.spines[["top", "right"]].set_visible(False)
            return _svg(canvas)
        canvas = Canvas((5.2 * len(figure.y), 3.8), layout="constrained")
        drawn = False
        for axes, column in zip(canvas.subplots(1, len(figure.y), squeeze=False)[0], figure.y, strict=True):
            drawn |= _plot(axes, part, figure, column)
            arrow = ARROWS[part.columns[column]]
            axes.set(xlabel=labels.get(figure.x, figure.x), ylabel=f"{column} {arrow}".strip())
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(alpha=0.25)
        return _svg(canvas) if drawn else None


def _plot(axes: Any, part: Part, figure: Figure, column: str) -> bool:
    place = list(part.columns).index(column)
    series: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    for line in part.lines:
        cell, x = line.cells[place], line.options.get(figure.x)
        if cell is None or cell.value is None or line.state:
            continue
        if line.kind.endswith("real"):
            if part.columns[column] == "real":
                axes.axhline(
                    cell.value, color="#6b7280", linewidth=1, linestyle=":" if "reported" in line.kind else "-"
                )
        elif x is not None:
            series.setdefault((line.kind, line.label), []).append((x, cell.value, cell.ci or 0.0))
    for number, ((kind, label), found) in enumerate(series.items()):
        color, reported = COLORS[number % len(COLORS)], kind == "reported"
        xs, ys, errors = zip(*sorted(found), strict=True)
        style = {"marker": "s" if reported else "o", "markersize": 4, "color": color}
        style["linestyle"] = "none" if figure.points else "--" if reported else "-"
        if reported:
            style["markerfacecolor"] = "white"
        axes.errorbar(
            xs, ys, errors, capsize=2, linewidth=1.4, label=f"{label}, reported" if reported else label, **style
        )
    if figure.log and series:
        axes.set_xscale("log")
        ticks = sorted({x for found in series.values() for x, _, _ in found})
        if not figure.points and len(ticks) <= 12:
            axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
            axes.minorticks_off()
    if series:
        axes.legend(frameon=False, fontsize=8)
    return bool(series)


def _svg(canvas: Any) -> str:
    out = io.StringIO()
    canvas.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    return text[text.index("<svg") :]


WRITERS: dict[str, Callable[[Table], str]] = {"md": markdown, "tex": latex, "csv": comma_separated}


def places(values: Sequence[float | None], better: str, real: float | None) -> list[int]:
    """1 for the best and 2 for the second best of values, 0 for the others; nothing is best of one.

    Args:
        values: None where there is none.
        better: higher, lower, real (closest to `real`) or none.
        real: the value of real motions.
    """
    there = [v for v in values if v is not None]
    if better == "none" or len(there) < 2 or (better == "real" and real is None):
        return [0] * len(values)

    def badness(value: float) -> float:
        return {"higher": -value, "lower": value}.get(better, abs(value - (real or 0.0)))

    order = sorted({badness(v) for v in there})
    return [0 if v is None else order.index(badness(v)) + 1 if badness(v) in order[:2] else 0 for v in values]
