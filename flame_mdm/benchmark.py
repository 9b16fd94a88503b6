"""Trains and measures small models of all kinds: `python -m flame_mdm.benchmark synthetic`"""

from __future__ import annotations

import base64
import html
import json
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from flame_mdm.config import EXPERIMENTS, Config, UserError, run, settings
from flame_mdm.results import read_json
from flame_mdm.tables import build, evaluate_missing, load_spec, write
from flame_mdm.visualize.page import page
from flame_mdm.visualize.page import table as small_table
from flame_mdm.visualize.scene import written_whole
from flame_mdm.visualize.table import Table

USAGE = """
usage: python -m flame_mdm.benchmark NAME [out=FOLDER]

Trains a motion-CLIP and a small model of each kind, evaluates them, and writes a table and a report page: the whole
chain in one command. What is trained and evaluated already is taken as it is, so the command goes on where it stopped.
NAME is a file of experiments/benchmark: synthetic, which needs no download, or bandai.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    words = sys.argv[1:] if argv is None else argv
    return run(benchmark, words, usage=USAGE, name="benchmark", text=("exp", "out", "data_root"))


def benchmark(config: Config) -> None:
    """Trains, evaluates and reports what a file of experiments/benchmark lists.

    Raises:
        UserError: no such file, a training that failed, or a model that is worse than expected.
    """
    names = sorted(path.stem for path in (EXPERIMENTS / "benchmark").glob("*.yaml"))
    if config["exp"] not in names:
        raise UserError(f"which benchmark? EXP=NAME, one of: {', '.join(names)}")
    from omegaconf import OmegaConf

    plan = OmegaConf.to_container(OmegaConf.load(EXPERIMENTS / "benchmark" / f"{config['exp']}.yaml"), resolve=True)
    assert isinstance(plan, dict)
    out = Path(config["out"] or Path("runs") / "benchmark" / config["exp"])
    out.mkdir(parents=True, exist_ok=True)  # before hours of work
    times = Times(out / "times.json")
    if config["evaluate"]:
        for words in plan["train"]:
            train(words, times, config["data_root"])
    spec = load_spec(plan["table"])
    options = settings("tables") | {name: config[name] for name in ("device", "batch_size", "data_root")}
    results = Path(options["results"])
    begin = time.monotonic()
    failed = evaluate_missing({plan["table"]: spec}, results, options) if config["evaluate"] else []
    times.add("evaluation", time.monotonic() - begin)
    table = build(plan["table"], spec, results)
    body = write(table, out)
    checks = check(table, plan.get("expected", {}))
    report = out / "report.html"
    with written_whole(report) as temporary:
        content = page(table.title, _report(config["exp"], body, times, checks, plan["train"]))
        temporary.write_text(content, encoding="utf-8")
    print(f"{sum(times.seconds.values()) / 60:.0f} minutes in all; see {report}")
    wrong = [line for line, right in checks if not right]
    if failed or wrong:
        raise UserError("; ".join([*failed, *wrong]))


class Times:
    """Seconds by what they were spent on, kept in a file, so that a benchmark that goes on knows of its beginning."""

    def __init__(self, path: Path):
        self.path = path
        self.seconds: dict[str, float] = {}
        if path.exists():
            self.seconds = read_json(path, dict[str, float], "delete it, and the time before is not counted")

    def add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        with written_whole(self.path) as temporary:
            temporary.write_text(json.dumps(self.seconds, indent=1) + "\n")


def train(words: Sequence[str], times: Times, data_root: str | None) -> None:
    """Trains in a process of its own, as `make train` would.

    Raises:
        UserError: it failed. SystemExit: it was interrupted.
    """
    root = [f"data_root={data_root}"] if data_root else []
    print(f"== training {' '.join(words)}", flush=True)
    begin = time.monotonic()
    try:
        code = subprocess.run([sys.executable, "-m", "flame_mdm.train", *words, *root], check=False).returncode
    finally:
        times.add(" ".join(words), time.monotonic() - begin)
    if code >= 128 or code < 0:
        raise SystemExit(code if code > 0 else 128 - code)
    if code:
        raise UserError(f"training {' '.join(words)} failed, see above; the same command goes on from here")


def check(table: Table, expected: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]]) -> list[tuple[str, bool]]:
    """Compares values of a table with what is expected of them; one line each, and whether it holds."""
    found = {
        (part.name, line.label, column): cell.value if cell is not None and not line.state else None
        for part in table.parts
        for line in part.lines
        if line.kind == "measured"
        for column, cell in zip(part.columns, line.cells, strict=True)
    }
    checks = []
    for part, rows in expected.items():
        for row, columns in rows.items():
            for column, (least, most) in columns.items():
                value = found.get((part, row, column))
                told = "not measured" if value is None else f"{value:.3g}"
                line = f"{row}: {column} {told}, expected {least:g} to {most:g}"
                checks.append((line, value is not None and least <= value <= most))
    return checks


def _report(
    name: str, body: str, times: Times, checks: Sequence[tuple[str, bool]], trained: Sequence[Sequence[str]]
) -> str:
    minutes = small_table(["", ""], [[what, f"{s / 60:.1f}"] for what, s in times.seconds.items()], numbers=True)
    lines = "".join(f"<li>{'✓' if right else '✗'} {html.escape(line)}</li>" for line, right in checks)
    out = f"<p>Made by <code>make benchmark EXP={html.escape(name)}</code>.</p>\n{body}"
    out += "<h2>Generated motions</h2>\n"
    for words in trained:
        run_name = next((word.partition("=")[2] for word in words if word.startswith("run.name=")), "default")
        folder = Path("runs") / words[0] / run_name
        movies = sorted(folder.glob("samples/step_*/motions.gif"))
        if movies:
            data = base64.b64encode(movies[-1].read_bytes()).decode()
            out += f'<h3>{html.escape(words[0])}</h3><img alt="motions" src="data:image/gif;base64,{data}">\n'
    out += f"<h2>As good as expected?</h2><ul>{lines}</ul>\n" if lines else ""
    return out + f"<h2>Minutes</h2>{minutes}\n"


if __name__ == "__main__":
    sys.exit(main())
