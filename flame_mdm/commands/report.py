"""`flame-mdm report RUN ...`: writes the report pages of runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from flame_mdm.commands import BodySettings, check_words
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.report import write_report
from flame_mdm.runs import check_run
from flame_mdm.sampler_options import option


@dataclass(frozen=True, kw_only=True)
class ReportSettings(BodySettings):
    """usage: flame-mdm report RUN ...

    Writes report.html into a run directory: curves, newest samples, evaluations and provenance on one page that needs
    no server and no network. Training also writes it at the end.
    """

    OBJECTS: ClassVar = ("runs",)
    runs: list[str] | None = option(None, "run directories, separated by spaces")


def main(settings: ReportSettings) -> None:
    if settings.runs is None:
        raise UserError("no run named. Name a run directory: flame-mdm report runs/synthetic/mdm/default")
    check_words(settings)
    for folder in settings.runs:
        check_run(Path(folder))
    from flame_mdm.visualize.bodies import load_body

    body = load_body(settings.body)
    for folder in settings.runs:
        say(write_report(Path(folder), body))
