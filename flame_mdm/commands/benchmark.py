"""`flame-mdm benchmark NAME`: trains and evaluates a set of small models and writes a table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from flame_mdm.commands.tables import TablesSettings, evaluate_missing
from flame_mdm.commands.trainings import plan, run_trainings
from flame_mdm.config import EXPERIMENTS
from flame_mdm.config.options import option, required
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.tables.build import build
from flame_mdm.reporting.tables.format import Table, write
from flame_mdm.reporting.tables.specs import load_spec
from flame_mdm.safe_io import read_package_yaml


@dataclass(frozen=True, kw_only=True)
class BenchmarkSettings:
    """usage: flame-mdm benchmark NAME [out=FOLDER] [jobs=N]

    Trains a motion-CLIP and one model of each kind, evaluates the models, writes a table, and
    checks whether the values are within the expected ranges. After an interruption, the same
    command continues where it stopped.

    NAME is a file in experiments/benchmark: synthetic, synthetic_medium, bandai, few_steps or
    bandai_full. The first two require no download, and bandai_full is meant for one GPU.
    """

    OBJECTS: ClassVar = ("exp",)
    exp: str = required("a file in experiments/benchmark")
    out: str | None = option(None, "folder; default: runs/benchmark/<exp>")
    jobs: int = option(
        1,
        "number of models to train at the same time; they share the CPU cores and need about "
        "2 GiB of memory each",
    )
    device: str | None = option(
        None, "device for the evaluations, such as cpu or cuda; default: cuda if available"
    )
    batch_size: int = option(64, "motions per batch")
    data_root: str = option(
        "", "folder of the prepared data sets; default: the checkpoint's, or FLAME_MDM_DATA"
    )


def main(settings: BenchmarkSettings) -> None:
    """Prepares, trains, evaluates and tabulates all models of a benchmark."""
    names = sorted(path.stem for path in (EXPERIMENTS / "benchmark").glob("*.yaml"))
    if settings.exp not in names:
        raise UserError(f"unknown benchmark '{settings.exp}'. Available: {', '.join(names)}")
    if settings.jobs < 1:
        raise UserError(
            f"jobs={settings.jobs}: expected the number of models to train at the same time, at least 1"
        )
    described = read_package_yaml(EXPERIMENTS / "benchmark" / f"{settings.exp}.yaml")
    out = Path(settings.out or Path("runs") / "benchmark" / settings.exp)
    out.mkdir(parents=True, exist_ok=True)  # reports errors before hours of work
    run_trainings(plan(described["train"], settings.data_root), settings.jobs, out)
    name, spec = described["table"], load_spec(described["table"])
    options = TablesSettings(
        device=settings.device, batch_size=settings.batch_size, data_root=settings.data_root
    )
    faults = evaluate_missing({name: spec}, Path(options.results), options)
    table = build(name, spec, Path(options.results))
    write(table, out)
    for line, right in check(table, described.get("expected", {})):
        say(f"{'as expected' if right else 'NOT AS EXPECTED'}: {line}")
        faults += [] if right else [line]
    say(f"{out / name}.html, .md, .tex, .csv")
    if faults:
        raise UserError("; ".join(faults))


def check(
    table: Table, expected: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]]
) -> list[tuple[str, bool]]:
    """Returns a line for each expected range, and whether the measured value is in that range."""
    parts = {part.name: part for part in table.parts}
    checks = []
    for part, rows in expected.items():
        lines = {
            line.label: line
            for line in parts[part].lines
            if line.kind == "measured" and not line.state
        }
        for row, columns in rows.items():
            cells = (
                dict(zip(parts[part].columns, lines[row].cells, strict=True))
                if row in lines
                else {}
            )
            for column, (low, high) in columns.items():
                value = cell.value if (cell := cells.get(column)) else None
                measured = "not measured" if value is None else f"{value:.3g}"
                line = f"{row}: {column} {measured}, expected {low:g} to {high:g}"
                checks.append((line, value is not None and low <= value <= high))
    return checks
