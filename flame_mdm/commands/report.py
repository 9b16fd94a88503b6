"""`flame-mdm report RUN ...`: writes the report pages of runs."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.report import paths, write_report

USAGE = """
usage: flame-mdm report RUN

Writes report.html into a run directory: curves, newest samples, evaluations and provenance on one page that needs no
server and no network. Training also writes it at the end. runs="A B" writes several reports.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    words = sys.argv[1:] if argv is None else argv
    return run(report, words, usage=USAGE, name="report", objects=("runs*",), text=("runs",))


def report(config: Config) -> None:
    """Writes the report of each run.

    Raises:
        UserError: If no run is named, or a folder holds no run.
    """
    if config["runs"] is None:
        raise UserError("no run named. Name a run directory: flame-mdm report runs/synthetic/mdm/default")
    for folder in paths("runs", str(config["runs"])):
        say(write_report(folder))


if __name__ == "__main__":
    sys.exit(main())
