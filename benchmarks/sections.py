"""Common form of the benchmarks: each has a function `measure` that returns a section of docs/benchmarks/speed.md."""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch

Row = dict[str, str | float | None]
Section = dict[str, Any]  # a title, a text, a summary in one sentence, and tables by caption


def section(title: str, text: str, summary: str, **tables: list[Row]) -> Section:
    """Returns a section; the names of the tables are their captions, with spaces for underscores."""
    captions = {name.replace("_", " "): rows for name, rows in tables.items()}
    return {"title": title, "text": " ".join(text.split()), "summary": summary, "tables": captions}


def cell(value: str | float | None) -> str:
    """Returns text with three significant digits."""
    if value is None or isinstance(value, str):
        return value or ""
    return f"{value:,.0f}" if abs(value) >= 100 or value == round(value) else f"{value:#.3g}".rstrip(".")


def table(rows: list[Row]) -> str:
    lines = [list(rows[0]), ["---", *["---:"] * (len(rows[0]) - 1)], *([cell(v) for v in row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def body(content: Section) -> str:
    tables = (f"{caption[:1].upper()}{caption[1:]}:\n\n{table(rows)}" for caption, rows in content["tables"].items())
    return "\n\n".join([content["text"], *tables])


def show(content: Section) -> None:
    print(f"{body(content)}\n\n{content['summary']}")


def take_turns(runs: Mapping[str, Callable[[], object]], rounds: int, device: str = "cpu") -> dict[str, float]:
    """Returns the median seconds of each function. They take turns, so that a busy machine slows all of them.

    The first round warms up.
    """
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds + 1):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            if device == "cuda":
                torch.cuda.synchronize()
            times[name].append(time.perf_counter() - start)
    return {name: statistics.median(taken[1:]) for name, taken in times.items()}
