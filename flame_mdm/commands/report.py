"""`flame-mdm report RUN ...`: writes the report pages of runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from flame_mdm.commands import BodySettings
from flame_mdm.config.options import required
from flame_mdm.errors import say
from flame_mdm.reporting.report import write_report
from flame_mdm.runs import check_run


@dataclass(frozen=True, kw_only=True)
class ReportSettings(BodySettings):
    """usage: flame-mdm report RUN ...

    Writes report.html to each run directory: a single page with training curves, the newest
    samples, evaluations and provenance. The page needs neither a server nor a network connection.
    It is also written at the end of training.
    """

    OBJECTS: ClassVar = ("runs",)
    runs: list[str] = required("run directories, separated by spaces")


def main(settings: ReportSettings) -> None:
    """Writes the page for each run."""
    for folder in settings.runs:
        check_run(Path(folder))
    body = settings.read_body()
    for folder in settings.runs:
        say(write_report(Path(folder), body))
