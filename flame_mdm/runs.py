"""Run directories: their layout, typed schemas for their files, and functions that read them."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import AliasPath, ConfigDict, Field

from flame_mdm import safe_io
from flame_mdm.config import Config, read_saved
from flame_mdm.errors import UserError
from flame_mdm.records import Result, read_result
from flame_mdm.schemas import Int, Number, Schema, check_shape, read_json

CONFIG, PROVENANCE, FAULT = "config.yaml", "provenance.json", "bad_batch.json"
HISTORY = "metrics.jsonl"  # training curves, with one line per logged step
RESULTS = "evaluation/**/result*.json"
HISTORY_LIMIT = 256 * safe_io.MEBIBYTE
"""Maximum size of a history file in bytes.

A run of a million steps that logs every 50 steps takes about 20 MiB.
"""


class RunConfig(Schema):
    """The keys that the report pages use from a run's configuration."""

    experiment: str | None
    name: Annotated[str | Int | Number, Field(validation_alias=AliasPath("run", "name"))] = (
        "default"
    )
    max_steps: Annotated[Int, Field(validation_alias=AliasPath("trainer", "max_steps"))]


class TrainedOn(Schema):
    """The `data` entry of a provenance file.

    The entry may contain additional facts about the data.
    """

    model_config = ConfigDict(strict=True, extra="allow")
    fingerprint: str = "–"


class Provenance(Schema):
    """Provenance of a run: command, code, machine, versions, device, parameters and data."""

    command: list[str]
    commit: str | None
    python: str
    machine: str
    packages: dict[str, str]
    data: TrainedOn
    changed: str | None = None
    device: str = "–"
    parameters: Int | None = None


class FaultyBatch(Schema):
    """The part of a faulty batch that one rank processed."""

    rank: Int
    batch: Int
    loss: str
    ids: list[str]


class Fault(Schema):
    """The batch whose loss stopped a run, with one part per rank."""

    step: Int
    usual_loss: str
    batches: list[FaultyBatch]


def made_by(path: str | Path) -> str:
    """Returns a hint on how to obtain a missing checkpoint or extractor.

    The hint is the command that creates the file. For a file in `assets/`, which no command
    creates, the hint names the documentation page that explains where to find it.
    """
    name = Path(path).as_posix()
    recipe = re.fullmatch(r"runs/(.+)/default/checkpoints/.+", name)
    where = f"{name} is missing" + '; see "Extractors" in docs/evaluation.md' * name.startswith(
        "assets/"
    )
    return f"make train EXP={recipe[1]}" if recipe else where


@dataclass
class Run:
    """Contents of a run directory.

    `history` maps the name of each curve to a mapping from training steps to values. `results` maps
    paths in the directory to results.
    """

    folder: Path
    config: Config
    provenance: Provenance | None
    curves: dict[str, dict[int, float]]
    results: dict[str, Result]

    @property
    def label(self) -> str:
        """Recipe and name of the run, or only the recipe if the run has the default name."""
        name = self.config["run"].get("name", "default")
        return str(self.config["experiment"]) + (f"/{name}" if name != "default" else "")

    @property
    def samples(self) -> Path | None:
        """Folder with the newest samples, or None if there are no samples."""
        folders = [path.parent for path in self.folder.glob("samples/step_*/motion_000.npz")]
        return max(
            (path for path in folders if path.name.removeprefix("step_").isdecimal()), default=None
        )

    @property
    def steps(self) -> int:
        """Last training step in the curves."""
        trained = (
            curve for name, curve in self.curves.items() if name.startswith(("train/", "samples/"))
        )
        return max((max(curve) + 1 for curve in trained), default=0)


def check_run(folder: Path) -> None:
    """Raises `UserError` if a folder is not a run directory."""
    if not (folder / CONFIG).exists():
        raise UserError(
            f"{folder}: contains no {CONFIG}. Use a run directory, such as runs/synthetic/mdm/default"
        )


def read_run(folder: Path) -> Run:
    """Returns the contents of a run directory.

    Raises:
        UserError: If the folder is not a run directory or if a file is damaged.
    """
    check_run(folder)
    config = read_saved(folder / CONFIG)
    try:
        check_shape(config, RunConfig)
    except ValueError as error:
        raise UserError(f"{folder / CONFIG}: not the configuration of a run: {error}") from error
    provenance: Provenance | None = None
    if (folder / PROVENANCE).exists():
        provenance = read_json(
            folder / PROVENANCE, Provenance, "delete it, and the page will omit it"
        )
    results = {
        path.relative_to(folder).as_posix(): read_result(path)
        for path in sorted(folder.glob(RESULTS))
    }
    return Run(folder, config, provenance, read_history(folder), results)


def read_history(folder: Path) -> dict[str, dict[int, float]]:
    """Returns the training curves, keyed by name.

    Each curve maps steps to values, in the order of the steps.

    Raises:
        UserError: If the file is damaged.
    """
    curves: dict[str, dict[int, float]] = {}
    for record in records(folder / HISTORY):
        for name, value in record.items():
            if name not in ("step", "epoch"):
                curves.setdefault(name, {})[record["step"]] = value
    return {name: dict(sorted(curve.items())) for name, curve in sorted(curves.items())}


def records(path: Path) -> list[dict[str, Any]]:
    """Returns the records of a history file.

    An incomplete last line, which a killed process may leave behind, is ignored.
    """
    if not path.exists():
        return []
    *lines, _ = safe_io.read_text(path, HISTORY_LIMIT).split("\n")
    complete = []
    for number, line in enumerate(lines, 1):
        try:
            record: dict[str, Any] = check_shape(json.loads(line), dict[str, float | int])
            if type(record.get("step")) is not int or record["step"] < 0:
                raise ValueError("it has no integer step")
            "".join(record).encode()  # fails for lone surrogates, which cannot be written again
        except (ValueError, RecursionError) as error:
            raise UserError(
                f"{path}: line {number} is damaged ({error}). Delete this line"
            ) from error
        complete.append(record)
    return complete
