"""Self-contained web pages from templates. The same input always yields the same bytes."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flame_mdm.errors import markdown_text, one_line

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'"
)
"""Content security policy for pages, which blocks all network access."""

TEMPLATES = Path(__file__).parent / "templates"


def render(template: str, **values: Any) -> Markup:
    """Renders a file in `templates/`.

    In HTML and SVG, all text is escaped except for the output of other templates.
    """
    from markupsafe import Markup

    return Markup(_environment().get_template(template).render(**values))


def page(title: str, body: str) -> str:
    """Returns a complete page around `body`, the output of `render`."""
    return str(render("page.html", title=title, body=body, policy=POLICY))


@functools.cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=lambda name: not str(name).endswith((".md", ".tex")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(number=number, markdown=markdown_text, one_line=one_line)
    return environment


def number(value: float | None) -> str:
    """Formats a number with four significant digits for a table, or as a dash if it is missing."""
    if value is None:
        return "–"
    if isinstance(value, float) and math.isfinite(value) and 0 < abs(value) < 1e-3:
        return f"{value:.2e}"
    return f"{value:,.0f}" if abs(value) >= 10_000 else f"{value:.4g}"


def filled(head: Sequence[str], rows: Sequence[Sequence[str]]) -> tuple[list[str], list[list[str]]]:
    """Removes a table's empty columns and rows. The first column contains the row names."""
    rows = [row for row in rows if {*row[1:]} - {"–", ""}]
    kept = [k for k in range(len(head)) if not k or {row[k] for row in rows} - {"–", ""}]
    return [head[k] for k in kept], [[row[k] for k in kept] for row in rows]


def interval(mean: float | None, half: float | None) -> str:
    """Formats a mean, followed by the half width of its interval if it has one."""
    return number(mean) + (f" ± {half:.2g}" if mean is not None and half is not None else "")


def short(step: float) -> str:
    """Formats a number of steps: 1500 -> 1.5k."""
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if abs(step) >= size:
            return f"{step / size:.4g}{unit}"
    return f"{step:.4g}"
