"""`flame-mdm report RUN ...`: writes the report pages of runs."""

from __future__ import annotations

from functools import partial

from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.report import paths, write_report

USAGE = """
usage: flame-mdm report RUN

Writes report.html into a run directory: curves, newest samples, evaluations and provenance on one page that needs no
server and no network. Training also writes it at the end. runs="A B" writes several reports.
"""


def report(config: Config) -> None:
    """Writes the report of each run.

    Raises:
        UserError: If no run is named, or a folder holds no run.
    """
    if config["runs"] is None:
        raise UserError("no run named. Name a run directory: flame-mdm report runs/synthetic/mdm/default")
    from flame_mdm.visualize.bodies import load_body

    body = load_body(config["body"])
    for folder in paths("runs", str(config["runs"])):
        say(write_report(folder, body))


main = partial(run, report, usage=USAGE, name="report", objects=("runs*",), text=("runs", "body"))
