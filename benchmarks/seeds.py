"""Tables of models trained with several seeds: `python benchmarks/seeds.py FOLDER/NAME ...`.

The runs of a row are FOLDER/NAME-0, FOLDER/NAME-1 and so on, each trained with another seed and evaluated by
`make evaluate`. Prints a Markdown table of the means over the seeds and their 95 % intervals by Student's t.
"""

from __future__ import annotations

import sys
from pathlib import Path

from quality import METRICS, shown, values
from sections import Row, table

from flame_mdm.schemas import CONFIG, read_run


def main(*names: str) -> None:
    """Prints the table, one row per name."""
    rows: list[Row] = []
    for name in map(Path, names):
        runs = [read_run(path.parent) for path in sorted(name.parent.glob(f"{name.name}-[0-9]*/{CONFIG}"))]
        if len(runs) < 2:
            raise SystemExit(f"{name}: {len(runs)} runs {name}-0, {name}-1, ...; an interval needs two or more")
        measured = [values(run) for run in runs]
        row: Row = {"": name.name.split("-", 1)[-1], "steps": f"{runs[0].config['trainer']['max_steps']:,}"}
        row["seeds"] = str(len(runs))
        model = list(runs[0].results.values())[-1].checkpoint
        row["parameters, M"] = f"{model.parameters / 1e6:.2f}" if model and model.parameters else ""
        rows.append(row | {m: shown([each[m] for each in measured]) for m in METRICS.values() if m in measured[0]})
    print(table(rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
