"""Tables and figures from results: `flame-mdm tables table="mdm_1 synthetic"`"""

from __future__ import annotations

import difflib
import functools
import hashlib
import itertools
import json
import math
import re
import string
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import FailFast, Field, model_validator

from flame_mdm.config import EXPERIMENTS, Config, plain
from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.reporting.audit import card_of
from flame_mdm.reporting.page import page
from flame_mdm.reporting.plots import standalone
from flame_mdm.reporting.rendering import (
    NEAREST,
    WRITERS,
    Cell,
    Figure,
    Line,
    Part,
    Table,
    draw,
    figure_names,
    fragment,
    places,
)
from flame_mdm.reporting.study import Ratings, wilson
from flame_mdm.runs import made_by
from flame_mdm.safe_io import read_yaml, write_text
from flame_mdm.schemas import (
    Checkpoint,
    ClosedSchema,
    Int,
    Number,
    Result,
    Schema,
    Value,
    check_shape,
    read_json,
    read_result,
)

SPECS = EXPERIMENTS / "tables"
PUBLISHED = SPECS / "published.yaml"
SWEPT = ("sampler", "num_inference_steps", "eta", "spacing", "guidance_scale", "until", "strength", "batch_size")
"""Options of a row that may be lists; each value makes one row."""
ABOUT = {
    "num_inference_steps": "sampling steps",
    "guidance_scale": "guidance scale",
    "sampler": "sampler",
    "eta": "eta",
    "spacing": "spacing",
    "until": "fraction of sampling that is rewritten",
    "strength": "strength of the variation",
    "nfe": "network calls per motion",
    "seconds_per_sample": "seconds per motion",
    "batch_size": "batch size",
    "parameters": "parameters, M",
    "prediction": "prediction",
    "training_steps": "training steps",
    "training_hours": "training hours",
    "training_device": "device of training",
    "training_memory_gib": "peak memory of training, GiB",
}
"""Labels of the values that a column may show besides metrics, and of the x-axes of figures."""
NOT_VALID = "NOT VALID"
"""State of a row that is shown, but not ranked."""
MOST_ROWS, MOST_COLUMNS, MOST_FIGURES = 1_000, 100, 100
"""Limits of a table: rows after expanding lists of options, columns, and plots. Tables of papers have about 20 rows."""


# Specs ----------------------------------------------------------------------------------------------------------------


class Options(ClosedSchema):
    """Keys of `flame-mdm evaluate` that a part, a row or a column may set."""

    protocol: str = ""
    extractor: str = ""
    data: str = ""
    split: str = ""
    seed: Int = 0
    replications: Int = 0
    samples: Int = 0
    multimodality: bool = False


class Column(Options):
    """A column: a metric or a key of `ABOUT`, and which of its values are better."""

    value: str
    better: Literal["higher", "lower", "real", "none"] = "none"


class Row(Options):
    """A row: a model or baseline, and its sampling options. Keys that contain a dot override keys of the data."""

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
                raise ValueError(f"{key}: only keys of the data can be overridden, such as data.crop.max_frames")
        return row

    @model_validator(mode="after")
    def _one_source(self) -> Row:
        if len({"ckpt", "baseline", "from_samples"} & self.model_fields_set) != 1:
            raise ValueError("a row needs one of ckpt, baseline and from_samples")
        return self


class PartSpec(Options):
    """A part of a table: either columns and rows, recipes and keys, lengths, or ratings."""

    columns: dict[str, Column] = Field({}, min_length=1)
    rows: list[Row] = Field([])
    recipes: dict[str, str] = Field({}, min_length=1)
    keys: dict[str, str] = Field({}, min_length=1)
    lengths: list[str] = Field([])
    ratings: str = ""

    @model_validator(mode="after")
    def _one_kind(self) -> PartSpec:
        kinds = [{"columns", "rows"}, {"recipes", "keys"}, {"lengths"}, {"ratings"}]
        if sum(kind <= self.model_fields_set for kind in kinds) != 1:
            raise ValueError("needs columns and rows, or recipes and keys, or lengths, or ratings")
        options = [[len(_list(getattr(row, n))) for n in SWEPT if n in row.model_fields_set] for row in self.rows]
        _at_most("rows", sum(map(math.prod, options)), MOST_ROWS)
        _at_most("keys", len(self.keys), MOST_ROWS)
        for name in ("columns", "recipes", "lengths"):
            _at_most(name, len(getattr(self, name)), MOST_COLUMNS)
        if self.rows and not self.protocol:
            raise ValueError("needs a protocol")
        return self


class FigureSpec(ClosedSchema):
    """A figure that plots columns of a part over an option of its rows; x: nearest plots the distances of its motions
    from the nearest training motion.
    """

    part: str
    x: str
    y: str | list[str] = Field([])
    log: bool = False
    points: bool = False


class Spec(ClosedSchema):
    """A table: the content of a file in experiments/tables."""

    title: str
    notes: list[str] = Field([])
    parts: Annotated[dict[str, PartSpec], Field(min_length=1)]
    figures: list[FigureSpec] = Field([])

    @model_validator(mode="after")
    def _figures(self) -> Spec:
        _at_most("figures", sum(len(_list(figure.y)) for figure in self.figures), MOST_FIGURES)
        for figure in self.figures:
            part = self.parts.get(figure.part)
            if part is None or figure.x not in (*ABOUT, NEAREST):
                raise ValueError(f"a figure needs a part of the table and x, one of {', '.join([*ABOUT, NEAREST])}")
            if not _list(figure.y) and figure.x != NEAREST:
                raise ValueError(f"figure: x={figure.x} needs y, a column or several of {figure.part}")
            for column in _list(figure.y):
                if column not in part.columns:
                    raise ValueError(f"figure: y={column} is not a column of {figure.part}")
        return self


def spec_names() -> list[str]:
    """Returns the names of all tables, in the order of their numbers."""
    names = [path.stem for path in SPECS.glob("*.yaml") if path != PUBLISHED]
    return sorted(names, key=lambda name: re.sub(r"\d+", lambda number: number[0].zfill(3), name))


def load_spec(name: str) -> Config:
    """Loads the spec of a table.

    Args:
        name: a name in experiments/tables, or the path of a .yaml file.

    Raises:
        UserError: If the file does not exist, or is not a valid spec.
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else SPECS / f"{name}.yaml"
    if not path.is_file() or path == PUBLISHED:
        names = spec_names()
        raise UserError(f"no table is called '{name}'.{did_you_mean(name, names)} There are: {', '.join(names)}")
    spec = _load(path)
    try:
        check_shape(spec, Spec)
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error
    return spec


def _at_most(what: str, count: int, most: int) -> None:
    if count > most:
        raise ValueError(f"{what}: {count:,} exceed the limit of {most:,} per table. Split it into several tables")


def _load(path: Path) -> Config:
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise UserError(f"{path}: not a mapping")
    plain(content, path)
    return {str(key): value for key, value in content.items()}


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


# Evaluations ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Request:
    """One evaluation: the label of its row, and the keys of `flame-mdm evaluate` that differ from their defaults."""

    label: str
    keys: Mapping[str, Any]

    def path(self, results: Path) -> Path:
        """Returns the path of the result, a function of the keys alone.

        Tables therefore share results, and are rendered without checkpoints.
        """
        digest = hashlib.sha256(json.dumps(dict(self.keys), sort_keys=True).encode()).hexdigest()
        what = self.keys.get("baseline") or self.keys.get("ckpt") or self.keys["from_samples"]
        name = re.sub(r"^runs-|-checkpoints-|-ckpt$|-default", "-", re.sub(r"[^A-Za-z0-9]+", "-", str(what))).strip("-")
        name = re.sub(r"-+", "-", name)[-60:]
        return results / Path(str(self.keys["protocol"])).stem / f"{name}-{digest[:10]}.json"

    @property
    def absent(self) -> dict[str, str]:
        """Files that do not exist, by what is missing: "no checkpoint"."""
        files = {"no checkpoint": "ckpt", "no samples": "from_samples", "no extractor": "extractor"}
        paths = {what: str(self.keys.get(key) or "none") for what, key in files.items()}
        return {what: path for what, path in paths.items() if path != "none" and not Path(path).exists()}


def requests(part: Mapping[str, Any]) -> Iterator[tuple[dict[str, Any], list[Request]]]:
    """Yields the rows of a part, with lists of options expanded, each with one evaluation per column."""
    for row in part.get("rows", []):
        for values in itertools.product(*(_list(row[name]) for name in SWEPT if name in row)):
            single = row | dict(zip((name for name in SWEPT if name in row), values, strict=True))
            single["label"] = _spread_label(part, row, single)
            yield single, [_request(part, single, column) for column in part["columns"].values()]


def _spread_label(part: Mapping[str, Any], row: Mapping[str, Any], single: Mapping[str, Any]) -> str:
    """Returns the label of an expanded row, with the values of its lists of several that no column shows."""
    shown = {column["value"] for column in part["columns"].values()}
    swept = [name for name in SWEPT if name not in shown and len(_list(row.get(name))) > 1]
    options = [f"{ABOUT[name]} {single[name]}" for name in swept]
    return f"{row['label']} ({', '.join(options)})" if options else row["label"]


def _request(part: Mapping[str, Any], row: Mapping[str, Any], column: Mapping[str, Any]) -> Request:
    keys = {name: row[name] for name in row if name not in ("label", "note")}
    for name in ("protocol", "split", "extractor", "seed", "data", "replications", "samples", "multimodality"):
        for place in (part, row, column):
            if name in place:
                keys[name] = place[name]
    if "ckpt" in keys:
        keys.pop("data", None)  # a checkpoint names its data set
    return Request(row["label"], keys)


# From results to tables -----------------------------------------------------------------------------------------------


def build(name: str, spec: Config, results: Path) -> Table:
    """Builds the table of a spec from existing results and published numbers.

    Raises:
        UserError: If a published number or a result does not match the spec.
    """
    published = _published(PUBLISHED, PUBLISHED.stat().st_mtime_ns).get(name, {}) if PUBLISHED.exists() else {}
    unknown = published.keys() - spec["parts"].keys()
    if unknown:
        raise UserError(f"{PUBLISHED}: {name} has parts that are not in its spec: {', '.join(sorted(unknown))}")
    parts = []
    for part_name, part in spec["parts"].items():
        figures = [
            Figure(f["x"], _list(f.get("y", [])), f.get("log", False), f.get("points", False))
            for f in spec.get("figures", [])
            if f["part"] == part_name
        ]
        reported = published.get(part_name)
        if "recipes" in part:
            parts.append(_hyperparameters(part_name, part, reported))
        elif "lengths" in part:
            parts.append(_lengths(part_name, part, results))
        elif "ratings" in part:
            parts.append(_ratings(part_name, part, reported))
        else:
            parts.append(_measured(part_name, part, reported, results, figures))
    return Table(name, spec["title"], parts, list(spec.get("notes", [])))


@functools.cache
def _published(path: Path, changed: int) -> Config:
    """Returns the published numbers. They are read once for all tables, until the file changes."""
    return _load(path)


@dataclass
class _Marks:
    """Footnote letters by what the footnote says; see `_evaluation`."""

    found: dict[tuple[tuple[str, str], ...], str] = field(default_factory=dict)

    def of(self, facts: Mapping[str, str]) -> str:
        mark = string.ascii_lowercase[len(self.found) % 26] * (1 + len(self.found) // 26)
        return self.found.setdefault(tuple(facts.items()), mark)

    @property
    def notes(self) -> list[tuple[str, str]]:
        """The footnotes. One that is much like the first tells only what is different."""
        notes = []
        for facts, mark in self.found.items():
            own = [
                text or f"no {name}"
                for (name, text), other in zip(facts, next(iter(self.found)), strict=True)
                if (name, text) != other
            ]
            whole = "; ".join(text for _, text in facts if text)
            notes.append((mark, f"as a, but {'; '.join(own)}" if 0 < len(own) <= 3 else whole))
        return notes


def _measured(name: str, part: Config, reported: Config | None, results: Path, figures: list[Figure]) -> Part:
    columns = {label: column.get("better", "none") for label, column in part["columns"].items()}
    values = [column["value"] for column in part["columns"].values()]
    marks = _Marks()
    lines: list[Line] = []
    truths: dict[str, Line] = {}
    todo: list[tuple[str, str]] = []
    for row, requested in requests(part):
        found = [_result(request, results) for request in requested]
        line = _line(row, found, values, [request.path(results).name for request in requested])
        if all(result is None for result in found):
            line.state = next(iter(requested[0].absent), "not evaluated")
        for request, result in zip(requested, found, strict=True):
            if result is None:
                todo += [(line.label, made_by(path)) for path in request.absent.values()] or [
                    (line.label, "make tables evaluates it")
                ]
        timed = [r.path(results) for r, value in zip(requested, values, strict=True) if value == "seconds_per_sample"]
        own = dict.fromkeys(
            marks.of(_evaluation(result, request.path(results) in timed))
            for request, result in zip(requested, found, strict=True)
            if result is not None
        )
        line.marks = ",".join(own)
        lines.append(line)
        if line.marks and line.marks not in truths:
            truth = Line("Real motions", "real", [_truth(r, v) for r, v in zip(found, values, strict=True)], line.marks)
            truth.nearest = next((r.nearest["real"] for r in found if r is not None and "real" in r.nearest), [])
            truths[line.marks] = truth
    lines = [line for line in truths.values() if any(line.cells)] + lines
    notes = [*marks.notes, *_grouped(todo)]
    facts = [(line.label, line.facts) for line in lines]
    notes += _grouped(
        [(label, f"NOT VALID: {why}") for label, known in facts if (why := known.get("not valid because"))]
    )
    chosen = [(label, known.get("chosen by", "").partition(" ")) for label, known in facts]
    texts = {"best": "best checkpoint by {}", "none:": "{} checkpoint, not chosen by validation"}
    notes += _grouped([(label, texts[kind].format(name)) for label, (kind, _, name) in chosen if kind in texts])
    zero = {
        label
        for line in truths.values()
        for label, value, cell in zip(columns, values, line.cells, strict=True)
        if value == "fid" and cell and cell.value == 0
    }
    notes += [
        (
            "",
            f"{label} of real motions is 0 by construction: clips are taken whole, so that both draws of real "
            "motions, which are compared, are the same",
        )
        for label in sorted(zero)
    ]
    if reported is not None:
        more, sources = _reported(reported, columns, values, name)
        lines, notes = lines + more, notes + sources
    _print_cells(lines, len(columns))
    _rank(lines, columns)
    return Part(name, columns, lines, notes, figures)


def _result(request: Request, results: Path) -> Result | None:
    path = request.path(results)
    return read_result(path) if path.exists() else None


def _grouped(lines: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Returns one note per text, with the labels of all rows that it is about."""
    labels: dict[str, dict[str, None]] = {}
    for label, text in lines:
        labels.setdefault(text, {})[label] = None
    return [("", f"{'; '.join(rows)}: {text}") for text, rows in labels.items()]


def _evaluation(result: Result, timed: bool) -> dict[str, str]:
    """Describes the evaluation of a result, and its time if that is shown. Only rows with the same one are compared."""
    protocol, data, extractor, cost = result.protocol, result.data, result.extractor, result.cost
    card = card_of(data.dataset, extractor.sha256 if extractor else None)
    first = next((v for v in (result.values or {}).values() if v and v.n), None)  # later ones may have fewer motions
    changed = ", ".join(f"{k} = {v}" for k, v in result.changed.items())
    return {
        "protocol": f"protocol {protocol.name} version {protocol.version}",
        "data": f"{result.split} split of {data.dataset} (fingerprint {data.fingerprint})",
        "limits": "{} to {} frames".format(*data.frames) if data.frames else "",
        "metrics": f"N = {first.n}, {first.replications} replications" if first else "",
        "time": f"timed in batches of {cost.batch_size or 0:g} on {result.device}" if timed and cost else "",
        "seed": f"seed {result.seed}",
        "extractor": f"extractor sha256 {extractor.sha256[:12]}" if extractor else "no extractor",
        "audit": f"audit {card.as_posix()}" if card else "not audited",
        "exclusions": _left_out(data.excluded),
        "skeleton": _joints_of(result),
        "changes": f"differs from the protocol: {changed}" if changed else "",
        "published split": "published split: test clips are also used for training, or there are no validation clips"
        * result.published_split,
        "force": "forced: real motions do not have the values that the protocol expects" * result.forced,
        "warnings": "; ".join(result.warnings),
        "quick run": "QUICK RUN, NOT FOR PUBLICATION" * result.quick,
    }


def _joints_of(result: Result) -> str:
    """Describes the skeleton of joints that were computed from SMPL's rotations."""
    if result.stand_in_skeleton:
        return "joints of a stand-in skeleton, whose bones are not SMPL's"
    smpl = result.skeleton and result.skeleton.smpl_sha256
    return f"joints of SMPL's model file, sha256 {smpl[:12]}" if smpl else ""


def _left_out(excluded: Mapping[str, int]) -> str:
    """Describes the clips that were left out of a data set, by reason."""
    listed = ", ".join(f"{count:,} {reason}" for reason, count in excluded.items())
    return f"excluded from the data set: {listed}" if listed else ""


def _line(row: Mapping[str, Any], found: Sequence[Result | None], values: Sequence[str], files: Sequence[str]) -> Line:
    cells = [_cell(result, value, row) for result, value in zip(found, values, strict=True)]
    line = Line(row["label"], "measured", cells)
    line.options = {name: float(row[name]) for name in SWEPT if isinstance(row.get(name), int | float)}
    first = next((result for result in found if result is not None), None)
    if first is None:
        return line
    for name, result in (*zip(values, found, strict=True), *((name, first) for name in ABOUT)):
        value = _about(result, name) if result is not None and name in ABOUT else None
        if isinstance(value, int | float):
            line.options.setdefault(name, float(value))
    line.nearest = first.nearest.get("generated", [])
    reasons = list(dict.fromkeys(reason for r in found if r is not None for reason in r.invalid_because))
    line.state = NOT_VALID if reasons else "QUICK" if first.quick else ""
    checkpoint = first.checkpoint
    counts = {
        name: f"{entry.replications} x {entry.n}"
        for result, name in zip(found, values, strict=True)
        if result and (entry := (result.values or {}).get(name)) and entry.n
    }
    most = Counter(counts.values()).most_common(1)[0][0] if counts else ""
    others = "".join(f"; {name} {count}" for name, count in counts.items() if count != most)
    weights = {True: "averaged", False: "raw", None: ""}
    line.facts = {
        "checkpoint sha256": (checkpoint.sha256 if checkpoint else first.samples_sha256 or "")[:16],
        "recipe": (checkpoint and checkpoint.experiment) or "",
        "baseline": first.baseline or "",
        "chosen by": _text(checkpoint and checkpoint.selected_by),
        "weights": weights[checkpoint.averaged_weights if checkpoint else None],
        "guidance": _text(checkpoint and checkpoint.guidance_scale),
        "predicts": _text(checkpoint and checkpoint.prediction),
        "sampler": _sampler(checkpoint) if checkpoint else "",
        "steps": _text(checkpoint and checkpoint.num_inference_steps),
        "replications x motions": most + others,
        "seed": _text(first.seed),
        "device": first.device,
        "speed of training": _text(checkpoint and checkpoint.training_speed),
        "precision of training": _text(checkpoint and checkpoint.training_precision),
        "training steps": _text(checkpoint and checkpoint.training_steps),
        "training hours": _text(checkpoint and checkpoint.training_hours),
        "device of training": _text(checkpoint and checkpoint.training_device),
        "peak memory of training, GiB": _text(checkpoint and checkpoint.training_memory_gib),
        "result": " ".join(dict.fromkeys(file for r, file in zip(found, files, strict=True) if r is not None)),
        "not valid because": "; ".join(reasons),
    }
    return line


def _text(value: Any) -> str:
    if isinstance(value, list):  # chosen steps
        return ", ".join(map(str, value))
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _sampler(checkpoint: Checkpoint) -> str:
    options = {"eta": checkpoint.eta, "spacing": checkpoint.spacing}
    return ", ".join([checkpoint.sampler, *(f"{name} {value}" for name, value in options.items() if value is not None)])


def _about(result: Result, name: str) -> Any:
    """Returns a fact about the model or its cost, by its name in `ABOUT`."""
    checkpoint, cost = result.checkpoint, result.cost
    known: dict[str, Any] = dict(checkpoint or ()) | (checkpoint.edit if checkpoint else {}) | dict(cost or ())
    value = known.get(name)
    return value / 1e6 if name == "parameters" and value is not None else value


def _cell(result: Result | None, value: str, row: Mapping[str, Any]) -> Cell | None:
    if value in ABOUT:
        found = row.get(value) if result is None else _about(result, value)
        if found is None:
            return None
        return Cell(f"{float(found):,g}", float(found)) if isinstance(found, int | float) else Cell(_text(found))
    return None if result is None else _entry((result.values or {}).get(value))


def _truth(result: Result | None, value: str) -> Cell | None:
    return None if result is None or value in ABOUT else _entry((result.ground_truth or {}).get(value))


def _entry(entry: Value | None) -> Cell | None:
    if entry is None or entry.mean is None:
        return None
    return Cell("", entry.mean, entry.ci if (entry.replications or 0) > 1 else None)


def _print_cells(lines: Sequence[Line], columns: int) -> None:
    """Formats the numbers of each column with the same decimals, about three digits for the largest.

    Short settings, with at most one decimal and no interval, keep their text. Numbers that would round to zero show
    two significant digits.
    """
    for index in range(columns):
        cells = [c for line in lines if not line.kind.startswith("reported") and (c := line.cells[index]) is not None]
        numbers = [abs(cell.value) for cell in cells if cell.value is not None]
        decimals = _decimals(max(numbers, default=0.0))
        short = all(cell.value == round(cell.value, 1) for cell in cells if cell.value is not None and cell.ci is None)
        for cell in cells:
            if cell.value is not None and not (cell.ci is None and cell.text and short):
                small = 0 < abs(cell.value) < 10**-decimals
                digits = 1 - math.floor(math.log10(abs(cell.value))) if small else decimals
                cell.text = f"{cell.value:.{digits}f}" + (f" ±{cell.ci:.{digits}f}" if cell.ci is not None else "")


def _decimals(largest: float) -> int:
    if largest == 0 or 0.1 <= largest < 10:
        return 3
    return min(max(2 - math.floor(math.log10(largest)), 1), 6)


def _rank(lines: Sequence[Line], columns: Mapping[str, str]) -> None:
    """Marks best and second best among rows of the same kind with the same marks."""
    for kind in ("measured", "reported"):
        for marks in {line.marks for line in lines}:
            rows = [x for x in lines if x.kind == kind and x.marks == marks and not x.state]
            rows = [x for x in rows if not x.facts.get("baseline")]
            truths = [x for x in lines if x.kind == {"measured": "real", "reported": "reported real"}[kind]]
            truths = [x for x in truths if kind == "reported" or x.marks == marks]
            for index, better in enumerate(columns.values()):
                numbers = [cell.value if (cell := row.cells[index]) else None for row in rows]
                reals = [c.value for x in truths if (c := x.cells[index]) is not None]
                found = places(numbers, better, reals[0] if len(reals) == 1 else None)
                for row, place in zip(rows, found, strict=True):
                    if (cell := row.cells[index]) is not None:
                        cell.place = place


# Published numbers ----------------------------------------------------------------------------------------------------


def _reported(
    reported: Config, columns: Mapping[str, str], values: Sequence[str], part: str
) -> tuple[list[Line], list[tuple[str, str]]]:
    """Returns the rows of a paper, and their footnotes."""
    notes: dict[str, str] = {}
    lines = []
    for row in reported["rows"]:
        unknown = row["values"].keys() - columns.keys()
        if unknown:
            raise UserError(f"{PUBLISHED}: {part}, {row['label']}: no column is called {', '.join(sorted(unknown))}")
        text = f"as reported: {row.get('source') or reported['source']}; measured with {reported['evaluator']}"
        mark = notes.setdefault(text, "†" * (len(notes) + 1))
        cells = [Cell(str(v), _leading(str(v))) if (v := row["values"].get(c)) is not None else None for c in columns]
        line = Line(row["label"], "reported real" if row.get("real") else "reported", cells, mark)
        for value, cell in zip(values, cells, strict=True):
            if value in ABOUT and cell is not None and cell.value is not None:
                line.options[value] = cell.value
        lines.append(line)
    extra = [("", note) for note in reported.get("notes", [])]
    return lines, [(mark, text) for text, mark in notes.items()] + extra


def _leading(text: str) -> float | None:
    """Returns the number at the beginning of a printed value; 1,000 is one thousand."""
    found = re.match(r"[-+]?[\d,]*\.?\d+(?:[eE][-+]?\d+)?", text.strip())
    return float(found[0].replace(",", "")) if found else None


# Other kinds of parts -------------------------------------------------------------------------------------------------


def _hyperparameters(name: str, part: Config, reported: Config | None) -> Part:
    """Builds a table of hyperparameters, read from recipes, each next to its reported value.

    The rows are keys or recipes, whichever are more.
    """
    from flame_mdm.reporting.settings import LABELS, values

    for key in part["keys"].values():
        if key not in LABELS:
            near = difflib.get_close_matches(key, LABELS, 3)
            hint = f"Did you mean {', '.join(near)}?" if near else f"there are: {', '.join(LABELS)}"
            raise UserError(f"part {name}: no setting is called '{key}'; {hint}")
    found = {label: values(recipe) for label, recipe in part["recipes"].items()}
    printed = {row["label"]: row["values"] for row in reported["rows"]} if reported else {}
    ours: dict[tuple[str, str], Cell | None] = {}
    theirs: dict[tuple[str, str], Cell | None] = {}
    for label, key in part["keys"].items():
        for recipe, known in found.items():
            place = (label, recipe) if len(part["keys"]) >= len(found) else (recipe, label)
            ours[place] = Cell(_setting(known[key])) if key in known else None
            theirs[place] = Cell(text) if (text := printed.get(label, {}).get(recipe)) is not None else None
    rows, columns = (list(dict.fromkeys(names)) for names in zip(*ours, strict=True))
    lines = [Line(row, "measured", []) for row in rows]
    heads: list[str] = []
    for column in columns:
        for head, cells in ((column, ours), (f"{column}, reported", theirs)):
            if any(cells[row, column] for row in rows):
                heads.append(head)
                for line in lines:
                    line.cells.append(cells[line.label, column])
    notes = [("", f"{label}: recipe {recipe}") for label, recipe in part["recipes"].items()]
    if reported:
        notes += [("", f"reported: {reported['source']}"), *(("", note) for note in reported.get("notes", []))]
    return Part(name, dict.fromkeys(heads, "none"), lines, notes)


def _setting(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(map(_setting, value))
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


class Lengths(Schema):
    """Motion lengths of a data set, in frames."""

    fingerprint: str
    fps: Annotated[Number, Field(gt=0)]
    lengths: Annotated[list[Annotated[Int, Field(ge=1)]], Field(min_length=1), FailFast()]
    excluded: dict[str, Int] = Field({})


def _lengths(name: str, part: Config, results: Path) -> Part:
    """Builds a table of the motion lengths of data sets."""
    columns = dict.fromkeys(["motions", "hours", "shortest", "median", "mean", "longest"], "none")
    lines, histograms = [], {}
    notes = [("", "lengths are in frames, at the frame rate of each data set")]
    for dataset in part["lengths"]:
        path = results / "lengths" / f"{dataset}.json"
        if not path.exists():
            lines.append(Line(dataset, "measured", [None] * len(columns), state="not prepared"))
            continue
        found: Lengths = read_json(path, Lengths, "delete it; `flame-mdm tables` then counts again")
        lengths, fps = sorted(found.lengths), found.fps
        numbers = [
            (f"{len(lengths):,}", len(lengths)),
            (f"{sum(lengths) / fps / 3600:.2f}", sum(lengths) / fps / 3600),
            *((f"{x:g}", x) for x in (lengths[0], lengths[len(lengths) // 2])),
            (f"{sum(lengths) / len(lengths):.1f}", sum(lengths) / len(lengths)),
            (f"{lengths[-1]}", lengths[-1]),
        ]
        facts = {"fingerprint": found.fingerprint, "frames per second": _text(float(fps))}
        lines.append(Line(dataset, "measured", [Cell(t, float(v)) for t, v in numbers], facts=facts))
        notes += [("", f"{dataset}; {_left_out(found.excluded)}")] if found.excluded else []
        step = max(1, math.ceil(lengths[-1] / 40))
        counts = [0] * (lengths[-1] // step + 1)
        for length in lengths:
            counts[length // step] += 1
        histograms[dataset] = ([float(i * step) for i in range(len(counts) + 1)], counts)
    return Part(name, columns, lines, notes, histograms=histograms)


def _ratings(name: str, part: Config, reported: Config | None) -> Part:
    """Builds the table of a user study: how often one model was preferred to another."""
    columns = {"Preferred": "none", "votes": "none", "raters": "none"}
    lines = []
    path = Path(part["ratings"])
    if path.exists():
        ratings: Ratings = read_json(path, Ratings, "run `flame-mdm compare ratings=...` to count again")
        for pair in ratings.pairs:
            votes = pair.wins_a + pair.wins_b
            share, low, high = wilson(pair.wins_a, votes)
            cells = [
                Cell(f"{share:.1%} [{low:.1%}, {high:.1%}]", share),
                Cell(str(votes), votes),
                Cell(str(pair.raters)),
            ]
            lines.append(Line(f"{pair.a} over {pair.b}", "measured", list(cells)))
    notes = [("", "share of votes, with its 95 % interval (Wilson)")]
    if not lines:
        notes = [("", f'{path} is missing. make compare RUNS="a b" RATE=true writes a page for rating motions')]
    if reported:
        more, sources = _reported(reported, columns, ["", "", ""], name)
        lines, notes = lines + more, notes + sources
    return Part(name, columns, lines, notes)


# Files ----------------------------------------------------------------------------------------------------------------


def write(table: Table, out: Path) -> str:
    """Writes a table in all formats and its figures; returns its HTML, without the head of the page."""
    table.folder = out
    for part, figure, name in figure_names(table):
        if drawn := draw(part, figure, ABOUT):
            table.drawn[name] = drawn
            write_text(out / f"{name}.svg", standalone(drawn))
    for suffix, writer in WRITERS.items():
        write_text(out / f"{table.name}.{suffix}", writer(table))
    body = fragment(table)
    write_text(out / f"{table.name}.html", page(table.title, body))
    return body
