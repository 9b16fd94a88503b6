"""Functions shared by the benchmark scripts.

Each script has a function `measure`, which returns a section of docs/benchmarks/speed.md.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

Row = dict[str, str | float | None]
Section = dict[str, Any]
"""A page section: a title, a text, a one-sentence summary, and tables by caption."""

QUIET = [
    "trainer.accelerator=cpu",
    "trainer.enable_progress_bar=false",
    "trainer.val_check_interval=1000000",
    "callbacks.samples=null",
    "callbacks.best=null",
    "callbacks.checkpoints.every_n_steps=1000000",
    "logger=csv",
]
"""Settings for runs whose training steps are timed: no validation, samples or checkpoints."""


@dataclass(frozen=True)
class Settings:
    """The settings that `make bench` passes to each script."""

    quick: bool = False  # use tiny sizes, to check only that everything runs
    device: str = "cpu"  # cpu or cuda
    mdm_repo: str | None = (
        None  # path of a clone of the authors' code, GuyTevet/motion-diffusion-model
    )
    runs: str | None = None  # folder with trained and evaluated runs, for quality.py


def section(title: str, text: str, summary: str, tables: Mapping[str, Sequence[Row]]) -> Section:
    """Returns the content of a page section."""
    return {
        "title": title,
        "text": " ".join(text.split()),
        "summary": summary,
        "tables": dict(tables),
    }


def ratios(
    times: Mapping[str, float], reference: str, name: str, unit: str = "ms per step"
) -> list[Row]:
    """Returns one row per measurement, with its time in milliseconds and the ratio to a reference time.

    Args:
        times: seconds, by label.
        reference: label of the measurement that the ratios refer to.
        name: heading of the first column, which contains the labels.
        unit: heading of the column with the times.
    """
    return [
        {name: key, unit: 1000 * taken, "ratio": taken / times[reference]}
        for key, taken in times.items()
    ]


def cell(value: str | float | None) -> str:
    """Returns the text of a table cell. Numbers are rounded to three significant digits or to integers."""
    if value is None or isinstance(value, str):
        return value or ""
    if abs(value) >= 100 or value == round(value):
        return f"{value:,.0f}"
    return f"{value:#.3g}".rstrip(".")


def table(rows: Sequence[Row]) -> str:
    """Returns a Markdown table with the columns of the first row."""
    head = list(rows[0])
    lines = [head, ["---", *["---:"] * (len(head) - 1)]]
    lines += [[cell(value) for value in row.values()] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def body(content: Section) -> str:
    """Returns the text and tables of a section as Markdown."""
    tables = [
        f"{caption[:1].upper()}{caption[1:]}:\n\n{table(rows)}"
        for caption, rows in content["tables"].items()
    ]
    return "\n\n".join([content["text"], *tables])


def show(content: Section) -> None:
    """Prints a section and its summary."""
    print(f"{body(content)}\n\n{content['summary']}")


def take_turns(
    runs: Mapping[str, Callable[[], object]],
    rounds: int,
    device: str = "cpu",
    clock: Callable[[], float] = time.perf_counter,
    warm_up: bool = True,
) -> dict[str, float]:
    """Returns the median time per call of each function, in seconds.

    The functions take turns, so that load on the machine slows down all of them.

    Args:
        runs: the functions, by name.
        rounds: number of timed calls of each function.
        device: cpu or cuda. With cuda, the time of a call includes waiting for the GPU.
        clock: function that returns the time in seconds. With `time.process_time`, other programs
            on the machine are not counted.
        warm_up: whether another round comes first, which is not counted.
    """
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds + warm_up):
        for name, run in runs.items():
            start = clock()
            run()
            if device == "cuda":
                torch.cuda.synchronize()
            times[name].append(clock() - start)
    return {name: statistics.median(taken[warm_up:]) for name, taken in times.items()}
