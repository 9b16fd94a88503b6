"""`flame-mdm benchmark NAME`: trains and evaluates a set of small models, and writes a report page."""

from __future__ import annotations

import base64
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from flame_mdm.commands.tables import TablesSettings, evaluate_missing
from flame_mdm.config import EXPERIMENTS
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.page import page, render
from flame_mdm.reporting.tables.build import build
from flame_mdm.reporting.tables.format import Table, write
from flame_mdm.reporting.tables.specs import load_spec
from flame_mdm.runs import newest_samples
from flame_mdm.safe_io import read_yaml, write_json, write_text
from flame_mdm.sampler_options import option
from flame_mdm.schemas import Number, read_json

if TYPE_CHECKING:
    from markupsafe import Markup


@dataclass(frozen=True, kw_only=True)
class BenchmarkSettings:
    """usage: flame-mdm benchmark NAME [out=FOLDER]

    Trains a motion-CLIP and a model of each kind, evaluates them, and writes a table and a report page, all in one
    command. If interrupted, the same command continues where it stopped.
    NAME is a file in experiments/benchmark: synthetic and synthetic_medium, which need no download, bandai and
    few_steps, or bandai_full, for one GPU.
    """

    OBJECTS: ClassVar = ("exp",)
    exp: str | None = option(None, "a file in experiments/benchmark")
    evaluate: bool = option(True, "false = train and evaluate nothing, render existing results")
    out: str | None = option(None, "folder; default runs/benchmark/<exp>")
    device: str | None = option(None, "device and batch_size: as for make evaluate")
    batch_size: int = option(64, "motions at once")
    data_root: str = option("", "folder of the prepared data sets; default: the checkpoint's, or FLAME_MDM_DATA")


def main(settings: BenchmarkSettings) -> None:
    names = sorted(path.stem for path in (EXPERIMENTS / "benchmark").glob("*.yaml"))
    if settings.exp not in names:
        raise UserError(f"no benchmark named. Add EXP=NAME, one of: {', '.join(names)}")
    plan = read_yaml(EXPERIMENTS / "benchmark" / f"{settings.exp}.yaml")
    out = Path(settings.out or Path("runs") / "benchmark" / settings.exp)
    out.mkdir(parents=True, exist_ok=True)  # fails before hours of work, not after
    times = Times(out / "times.json")
    if settings.evaluate:
        for words in plan["train"]:
            train(words, times, settings.data_root)
    spec = load_spec(plan["table"])
    options = TablesSettings(device=settings.device, batch_size=settings.batch_size, data_root=settings.data_root)
    results = Path(options.results)
    begin = time.monotonic()
    failed = evaluate_missing({plan["table"]: spec}, results, options) if settings.evaluate else []
    times.add("evaluation", time.monotonic() - begin)
    table = build(plan["table"], spec, results)
    body = write(table, out)
    checks = check(table, plan.get("expected", {}))
    report = out / "report.html"
    write_text(report, page(table.title, _report(settings.exp, body, times, checks, plan["train"])))
    say(f"{sum(times.seconds.values()) / 60:.0f} minutes in total; report: {report}")
    wrong = [line for line, right in checks if not right]
    if failed or wrong:
        raise UserError("; ".join([*failed, *wrong]))


class Times:
    """Seconds spent per activity, kept in a file so that a resumed benchmark reports its total time."""

    def __init__(self, path: Path):
        self.path = path
        self.seconds: dict[str, float] = {}
        if path.exists():
            self.seconds = read_json(path, dict[str, Number], "delete it; the time spent so far is then not counted")

    def add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        write_json(self.path, self.seconds, indent=1)


def train(words: Sequence[str], times: Times, data_root: str | None) -> None:
    """Runs `flame-mdm train` in a separate process; raises `SystemExit` if it is interrupted."""
    root = [f"data_root={data_root}"] if data_root else []
    say(f"== training {' '.join(words)}")
    begin = time.monotonic()
    try:
        code = subprocess.run([sys.executable, "-m", "flame_mdm", "train", *words, *root], check=False).returncode
    finally:
        times.add(" ".join(words), time.monotonic() - begin)
    if code >= 128 or code < 0:
        raise SystemExit(code if code > 0 else 128 - code)
    if code:
        raise UserError(f"training {' '.join(words)} failed (see above). Run the benchmark again to continue")


def check(table: Table, expected: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]]) -> list[tuple[str, bool]]:
    """Returns a line for each expected range of a value of a table, and whether the value is within it."""
    values = {
        (part.name, line.label, column): cell.value if cell is not None and not line.state else None
        for part in table.parts
        for line in part.lines
        if line.kind == "measured"
        for column, cell in zip(part.columns, line.cells, strict=True)
    }
    checks = []
    for part, rows in expected.items():
        for row, columns in rows.items():
            for column, (low, high) in columns.items():
                value = values.get((part, row, column))
                measured = "not measured" if value is None else f"{value:.3g}"
                line = f"{row}: {column} {measured}, expected {low:g} to {high:g}"
                checks.append((line, value is not None and low <= value <= high))
    return checks


def _report(
    name: str, body: str, times: Times, checks: Sequence[tuple[str, bool]], trained: Sequence[Sequence[str]]
) -> Markup:
    movies = []
    for words in trained:
        run_name = next((word.partition("=")[2] for word in words if word.startswith("run.name=")), "default")
        if folder := newest_samples(Path("runs") / words[0] / run_name, "motions.gif"):
            movies.append((words[0], base64.b64encode((folder / "motions.gif").read_bytes()).decode()))
    minutes = [[what, f"{s / 60:.1f}"] for what, s in times.seconds.items()]
    return render("benchmark.html", name=name, table_body=body, movies=movies, checks=checks, minutes=minutes)
