"""Table specs (the files in experiments/tables), and the evaluations that they require."""

import hashlib
import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, FailFast, Field, model_validator

from flame_mdm.config import EXPERIMENTS, Config, plain
from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.safe_io import read_package_yaml, read_yaml
from flame_mdm.schemas import ClosedSchema, Int, Number, Schema, check_shape

SPECS = EXPERIMENTS / "tables"
PUBLISHED = SPECS / "published.yaml"
LABELS: dict[str, dict[str, str]] = read_package_yaml(Path(__file__).with_name("labels.yaml"))
# Labels of values that are not metrics, for columns and for the x-axes of figures
ABOUT = LABELS["values"]
SWEPT = (
    "sampler",
    "num_inference_steps",
    "eta",
    "spacing",
    "guidance_scale",
    "until",
    "strength",
    "batch_size",
)
"""Options of a row that may be lists. A row is expanded to one row per value of a list."""
MOST_ROWS, MOST_COLUMNS, MOST_FIGURES = 1_000, 100, 100
"""Maximum numbers of rows (after expanding lists of options), columns and plots in a table.

Tables in papers have about 20 rows.
"""


class Options(ClosedSchema):
    """Keys of `flame-mdm evaluate` that a part, a row or a column may set."""

    protocol: str = ""
    extractor: str = ""
    data: str = ""
    split: Literal["train", "val", "test"] = "test"
    seed: Int = 0
    replications: Int = 0
    samples: Int = 0
    multimodality: bool = False


class ColumnSpec(Options):
    """A column: a metric, or a key of `ABOUT`."""

    value: str
    better: Literal["higher", "lower", "real", "none"] = "none"


class RowSpec(Options):
    """A row: a model or baseline, and its sampling options. Dotted keys override data options."""

    label: str
    note: str = ""
    ckpt: str = ""
    baseline: str = ""
    from_samples: str = ""
    method: str = ""
    sampler: str | list[str] = ""
    num_inference_steps: Int | list[Int | list[Int]] = 0
    eta: Number | list[Number] = 0
    spacing: str | list[str] = ""
    guidance_scale: Number | list[Number] = 0
    until: Number | list[Number] = 0
    strength: Number | list[Number] = 0
    batch_size: Int | list[Int] = 0

    @model_validator(mode="before")
    @classmethod
    def _overrides(cls, row: Any) -> Any:
        for key in row if isinstance(row, dict) else ():
            if "." in str(key) and not re.fullmatch(r"data(\.(?!_)\w+)+", str(key)):
                raise ValueError(
                    f"{key}: only data keys can be overridden, such as data.crop.max_frames"
                )
        return row

    @model_validator(mode="after")
    def _source_and_options(self) -> Self:
        if len({"ckpt", "baseline", "from_samples"} & self.model_fields_set) != 1:
            raise ValueError("a row must have one of ckpt, baseline and from_samples")
        for name in SWEPT:
            if [] in (getattr(self, name), *as_list(getattr(self, name))):
                raise ValueError(f"{name} contains an empty list. Remove this list")
        return self


class PartSpec(Options):
    """A part of a table: either columns and rows, recipes and keys, lengths, or ratings."""

    columns: dict[str, ColumnSpec] = Field({}, min_length=1, max_length=MOST_COLUMNS)
    rows: list[RowSpec] = Field([])
    recipes: dict[str, str] = Field({}, min_length=1, max_length=MOST_COLUMNS)
    keys: dict[str, str] = Field({}, min_length=1, max_length=MOST_ROWS)
    lengths: list[str] = Field([], max_length=MOST_COLUMNS)
    ratings: str = ""

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        kinds = [{"columns", "rows"}, {"recipes", "keys"}, {"lengths"}, {"ratings"}]
        if sum(kind <= self.model_fields_set for kind in kinds) != 1:
            raise ValueError("needs columns and rows, or recipes and keys, or lengths, or ratings")
        options = [
            [len(as_list(getattr(row, n))) for n in SWEPT if n in row.model_fields_set]
            for row in self.rows
        ]
        _at_most("rows", sum(map(math.prod, options)), MOST_ROWS)
        if self.rows and not self.protocol:
            raise ValueError("needs a protocol")
        return self


def as_list(value: Any) -> list[Any]:
    """Returns a list unchanged, and any other value as a list with one item."""
    return value if isinstance(value, list) else [value]


class Figure(ClosedSchema):
    """A plot of a part's columns against an option of its rows: curves or, with `points`, dots."""

    part: str
    x: str
    y: Annotated[list[str], BeforeValidator(as_list)]
    log: bool = False
    points: bool = False


class Spec(ClosedSchema):
    """A table: the contents of a file in experiments/tables."""

    title: str
    notes: list[str] = Field([])
    parts: Annotated[dict[str, PartSpec], Field(min_length=1)]
    figures: list[Figure] = Field([])

    @model_validator(mode="after")
    def _figures(self) -> Self:
        _at_most("figures", sum(len(figure.y) for figure in self.figures), MOST_FIGURES)
        for figure in self.figures:
            part = self.parts.get(figure.part)
            if part is None or figure.x not in ABOUT:
                raise ValueError(
                    "a figure must have a part of the table and an x, which is one of "
                    f"{', '.join(ABOUT)}"
                )
            for column in figure.y:
                if column not in part.columns:
                    raise ValueError(f"figure: y={column} is not a column of {figure.part}")
        return self


class Lengths(Schema):
    """Motion lengths of a data set, in frames."""

    fingerprint: str
    fps: Annotated[Number, Field(gt=0)]
    lengths: Annotated[list[Annotated[Int, Field(ge=1)]], Field(min_length=1), FailFast()]
    excluded: dict[str, Int] = Field({})


def spec_names() -> list[str]:
    """Returns the sorted names of this project's tables. Numbers in names are sorted numerically."""
    names = [path.stem for path in SPECS.glob("*.yaml") if path != PUBLISHED]
    return sorted(names, key=lambda name: re.sub(r"\d+", lambda number: number[0].zfill(3), name))


def load_spec(name: str) -> Config:
    """Loads the spec of a table by its name in experiments/tables, or by the path of a .yaml file."""
    path = Path(name) if name.endswith((".yaml", ".yml")) else SPECS / f"{name}.yaml"
    if not path.is_file() or path == PUBLISHED:
        names = spec_names()
        raise UserError(
            f"unknown table '{name}'.{did_you_mean(name, names)} Available: {', '.join(names)}"
        )
    spec = load_mapping(path)
    try:
        check_shape(spec, Spec)
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error
    return spec


def _at_most(noun: str, count: int, most: int) -> None:
    if count > most:
        raise UserError(
            f"{noun}: {count:,} exceed the limit of {most:,} per table. Split the table into several tables"
        )


def load_mapping(path: Path) -> Config:
    """Reads a YAML file that contains one mapping of plain values. Raises `UserError` otherwise."""
    content = (read_package_yaml if path.parent == SPECS else read_yaml)(path)
    if not isinstance(content, dict):
        raise UserError(f"{path}: not a mapping")
    plain(content, path)
    return content


@dataclass(frozen=True)
class Evaluation:
    """An evaluation for a table: its row label, and its keys for `flame-mdm evaluate`."""

    label: str
    keys: Mapping[str, Any]

    def path(self, results: Path) -> Path:
        """Returns the path of the result.

        The path depends only on the keys, so that tables can share results.
        """
        digest = hashlib.sha256(json.dumps(dict(self.keys), sort_keys=True).encode()).hexdigest()
        subject = self.keys.get("baseline") or self.keys.get("ckpt") or self.keys["from_samples"]
        name = re.sub(
            r"^runs-|-checkpoints-|-ckpt$|-default",
            "-",
            re.sub(r"[^A-Za-z0-9]+", "-", str(subject)),
        ).strip("-")
        name = re.sub(r"-+", "-", name)[-60:]
        return results / Path(str(self.keys["protocol"])).stem / f"{name}-{digest[:10]}.json"

    @property
    def absent(self) -> dict[str, str]:
        """The missing files, keyed by the reason that the table shows, such as "no checkpoint"."""
        files = {"no checkpoint": "ckpt", "no samples": "from_samples", "no extractor": "extractor"}
        paths = {reason: str(self.keys.get(key) or "none") for reason, key in files.items()}
        return {
            reason: path
            for reason, path in paths.items()
            if path != "none" and not Path(path).exists()
        }


def evaluations(part: Mapping[str, Any]) -> Iterator[tuple[dict[str, Any], list[Evaluation]]]:
    """Yields the rows of a part after expanding lists of options, with one evaluation per column.

    The label of an expanded row lists the options that vary and are not shown in a column.
    """
    shown = {column["value"] for column in part.get("columns", {}).values()}
    for row in part.get("rows", []):
        names = [name for name in SWEPT if name in row]
        varied = [name for name in names if name not in shown and len(as_list(row[name])) > 1]
        for values in itertools.product(*(as_list(row[name]) for name in names)):
            single = row | dict(zip(names, values, strict=True))
            options = ", ".join(f"{ABOUT[name]} {single[name]}" for name in varied)
            single["label"] += f" ({options})" if options else ""
            yield single, [_evaluation(part, single, column) for column in part["columns"].values()]


def _evaluation(
    part: Mapping[str, Any], row: Mapping[str, Any], column: Mapping[str, Any]
) -> Evaluation:
    keys = {name: row[name] for name in row if name not in ("label", "note")}
    for level in (part, row, column):
        keys |= {name: level[name] for name in Options.model_fields if name in level}
    if "ckpt" in keys:
        keys.pop("data", None)  # the recipe of a checkpoint specifies the data set
    return Evaluation(row["label"], keys)
