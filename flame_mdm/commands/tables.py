"""`flame-mdm tables [NAME ...]`: renders tables and figures from results, and evaluates what is missing."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say
from flame_mdm.safe_io import write_text

INVALID = 3
"""Exit code if a requested row is not valid."""
USAGE = """
usage: flame-mdm tables [table="NAME ..."] [evaluate=false] [out=FOLDER]

Renders tables and figures as Markdown, LaTeX, CSV and HTML. A table is described by a file in experiments/tables, or by
your own file, which names checkpoints, a protocol and columns. Checkpoints without a result are evaluated first;
evaluate=false uses existing results only. Without table=, all tables are rendered. Output is deterministic: the same
results give the same bytes.
Exit codes: 0; 1 = wrong input, or an evaluation failed; 3 = a requested row is NOT VALID, the tables are written.
Keys, with their defaults: experiments/tables.yaml
"""


def tables(config: Config) -> None:
    """Runs missing evaluations and renders the tables.

    Raises:
        UserError: If a spec is malformed, or an evaluation fails. After a failed evaluation, the tables are still
            written.
        SystemExit: With code `INVALID` if a row is not valid; the tables are written, and each reason is printed.
    """
    from evaluators.evaluation import evaluate_missing
    from flame_mdm.reporting.page import page, render
    from flame_mdm.reporting.tables import NOT_VALID, build, load_spec, spec_names, write

    names = str(config["table"]).split() if config["table"] is not None else spec_names()
    if not names:
        raise UserError("table= names no table. Give names of experiments/tables, or leave it out for all tables")
    specs = {Path(name).stem: load_spec(name) for name in names}
    results = Path(config["results"])
    failed = evaluate_missing(specs, results, config) if config["evaluate"] else []
    out = Path(config["out"])
    built = {name: build(name, spec, results) for name, spec in specs.items()}
    counts = {}
    invalid = False
    for name, table in built.items():
        write(table, out)
        lines = [line for part in table.parts for line in part.lines if line.kind == "measured"]
        counts[name] = f"{sum(not line.state for line in lines)} of {len(lines)}"
        say(f"{name}: {counts[name]} rows measured: {out / name}.html, .md, .tex, .csv")
        for part in table.parts:
            for line in (line for line in part.lines if line.state == NOT_VALID):
                invalid = True
                say(f"NOT VALID: {name}, {part.name}, {line.label}: {line.facts['not valid because']}", error=True)
    if len(specs) > 1:
        write_text(out / "index.html", page("Tables", render("index.html", tables=built, measured=counts)))
        say(f"all tables: {out / 'index.html'}")
    if failed:
        raise UserError(f"{len(failed)} evaluations failed: {'; '.join(failed)}")
    if invalid:
        raise SystemExit(INVALID)


main = partial(
    run, tables, usage=USAGE, name="tables", objects=("table*",), text=("table", "out", "results", "data_root")
)
