"""Typed schemas of files, and readers whose errors name file and key; results of evaluations and audits."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from flame_mdm import safe_io
from flame_mdm.errors import UserError, did_you_mean

MAX_INTEGER = 2**63 - 1
"""Maximum integer in a file; larger ones overflow when they are plotted or logged."""
LIMIT = 4 * safe_io.MEBIBYTE
"""Maximum size of a file of results, ratings, lengths or provenance. Typical files have 10 to 300 KiB."""
T = TypeVar("T")
Int = Annotated[int, Field(gt=-(2**63), lt=2**63)]
Number = Annotated[float, Field(gt=-1e300, lt=1e300)]
"""A finite number that does not overflow when it is plotted."""
Plain = str | bool | Int | Number | None


# Schema ---------------------------------------------------------------------------------------------------------------


class Schema(BaseModel):
    """Content of a file. Types are not converted: "1" is not a number. Unlisted keys are ignored."""

    model_config = ConfigDict(strict=True)


class ClosedSchema(Schema):
    """Content of a file written by people: unknown keys are errors, except overrides such as data.crop.max_frames."""

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, content: Any) -> Any:
        for name in content if isinstance(content, dict) else ():
            if name not in cls.model_fields and "." not in str(name):
                raise ValueError(f"unknown key: {name}.{did_you_mean(str(name), cls.model_fields)}")
        return content


class Value(Schema):
    """A metric over replications: mean, half-width of its 95 % interval, number of motions; None if not computable.

    `each` is the value of each replication, and `resampled` that of each set of a bootstrap over the motions of the
    first one. Results of earlier versions have neither.
    """

    mean: Number | None
    ci: Number | None
    replications: Int | None
    n: Int | None
    each: list[Number | None] = []
    resampled: list[Number | None] = []


class Protocol(Schema):
    """The evaluation protocol."""

    name: str
    version: Int


class Data(Schema):
    """The data set of an evaluation or training."""

    dataset: str
    fingerprint: str
    frames: Annotated[list[Int], Field(min_length=2, max_length=2)] | None = None
    excluded: dict[str, Int] = {}
    representation: str = ""


class ExtractorRecord(Schema):
    """The feature extractor."""

    sha256: str


class Checkpoint(Schema):
    """The checkpoint that generated the motions, and its sampling options."""

    path: str
    sha256: str
    sampler: str
    num_inference_steps: Int | list[Int]
    eta: Number | None = None
    spacing: str | None = None
    guidance_scale: Number
    experiment: str | None = None
    selected_by: str = ""
    averaged_weights: bool | None = None
    parameters: Int | None = None
    prediction: str | None = None
    training_steps: Int | None = None
    training_hours: Number | None = None
    training_device: str | None = None
    training_speed: str | None = None
    training_precision: str | None = None
    training_memory_gib: Number | None = None
    edit: dict[str, Plain] = {}


class Skeleton(Schema):
    """Whose joints SMPL's rotations were given: those of SMPL's model file, or of a stand-in."""

    stand_in: bool
    smpl_sha256: str | None = None


class Cost(Schema):
    """Cost per motion."""

    nfe: Number | None = None
    seconds_per_sample: Number | None = None
    batch_size: Number | None = None


class Result(Schema):
    """A result of `flame-mdm evaluate`, with the keys that tables and pages read."""

    quick: bool
    protocol: Protocol
    split: str
    data: Data
    seed: Int
    extractor: ExtractorRecord | None
    checkpoint: Checkpoint | None
    device: str
    values: dict[str, Value | None] | None
    ground_truth: dict[str, Value | None] | None
    not_computed: dict[str, str]
    invalid_because: list[str]
    published_split: bool = False
    samples_sha256: str | None = None
    baseline: str | None = None
    changed: dict[str, Plain] = {}
    forced: bool = False
    warnings: list[str] = []
    cost: Cost | None = None
    skeleton: Skeleton | None = None
    audit: str | None = None
    nearest: dict[str, list[Number]] = {}

    @property
    def stand_in_skeleton(self) -> bool:
        """Whether joints are those of a stand-in skeleton; results of earlier versions do not say so."""
        return self.skeleton.stand_in if self.skeleton else self.data.representation in ("smpl147", "rot6d-25")


class AuditedGrade(ClosedSchema):
    """One grade of a perturbation; by metric: value, half width of its 95 % interval, difference from real motions,
    and half width of the interval of that difference; None if not computable.
    """

    grade: Number
    values: dict[str, Annotated[list[Number | None], Field(min_length=4, max_length=4)]]


class AuditedPerturbation(ClosedSchema):
    """A perturbation of real motions, and its grades from weak to strong."""

    name: str
    group: str
    about: str
    unit: str
    grades: Annotated[list[AuditedGrade], Field(min_length=1)]


class AuditedExtractor(ExtractorRecord):
    """The extractor of an audit, by its recipe or file."""

    name: str


class AuditCard(ClosedSchema):
    """An evaluator audit, as `flame-mdm audit` writes it.

    Attributes:
        metrics: whether higher values are better; None = values near those of real motions.
        real: value and half width of its 95 % interval, by metric.
        truth: agreement with exact attributes: `auc` and `correlation`, by metric.
    """

    format: Int
    extractor: AuditedExtractor | None
    protocol: Protocol
    data: Data
    split: str
    motions: Int
    seed: Int
    resamples: Int
    packages: dict[str, str]
    metrics: dict[str, bool | None]
    real: dict[str, Annotated[list[Number | None], Field(min_length=2, max_length=2)]]
    perturbations: Annotated[list[AuditedPerturbation], Field(min_length=1)]
    not_computed: dict[str, str]
    truth: dict[str, dict[str, Number | None]]


# Reading --------------------------------------------------------------------------------------------------------------

EXPECTED = {
    **{"string": "a text", "bool": "true or false", "int": "a whole number", "float": "a number", "finite": "a number"},
    **{
        "less": "a smaller number",
        "greater": "a larger number",
        "none": "null",
        "dict": "a mapping",
        "model": "a mapping",
        "list": "a list",
    },
    **{"string_too_short": "a non-empty text", "too_short": "a longer list or mapping", "too_long": "a shorter list"},
}
"""Expected content, by the type of a pydantic error or its first word."""

_adapter = functools.cache(TypeAdapter)


def check_shape(content: Any, kind: type[T] | Any) -> T:
    """Returns content of a file converted to the expected type.

    Args:
        content: mappings, lists, texts, numbers.
        kind: a `Schema`, or any other type that pydantic supports.

    Raises:
        ValueError: the content has another type; the message gives key, found value and expected type.
    """
    if large := _too_large(content):
        raise ValueError(f"{large[:40]} ... is too large for a JSON integer; the maximum is {MAX_INTEGER:,}")
    try:
        return _adapter(kind).validate_python(content, strict=True)
    except ValidationError as error:
        raise ValueError(_first_error(error, content)) from error


def _too_large(content: Any) -> str:
    """Returns the first integer beyond `MAX_INTEGER` in some content, as text; "" if there is none."""
    if isinstance(content, dict | list):
        values = content.values() if isinstance(content, dict) else content
        return next(filter(None, map(_too_large, values)), "")
    return hex(content) if isinstance(content, int) and abs(content) > MAX_INTEGER else ""


def _first_error(error: ValidationError, content: Any) -> str:
    first: Any = error.errors(include_url=False)[0]
    keys, kind, context = [], first["type"], first.get("ctx", {})
    for key in first["loc"]:  # of which some name a type of a union, not a key
        if (isinstance(content, dict) and key in content) or (isinstance(content, list) and isinstance(key, int)):
            content = content[key]
            keys.append(str(key))
    name = ".".join(keys) or "the file"
    if first["loc"] and first["loc"][-1] == "[key]":
        return f"{name}: a key is not a text; put it in quotes"
    if kind == "missing":
        return f"{name} has no {first['loc'][-1]}"
    if kind == "value_error":
        return ": ".join(filter(None, [".".join(keys), str(context["error"])]))
    shown = json.dumps(content, default=str)
    shown = shown if len(shown) < 40 else f"{shown[:36]} ..."
    expected = context["expected"] if kind == "literal_error" else EXPECTED.get(kind, EXPECTED.get(kind.split("_")[0]))
    return f"{name} is {shown}, not {expected}" if expected else f"{name} is {shown}: {first['msg']}"


def read_json(path: Path, kind: type[T] | Any, remedy: str = "") -> T:
    """Returns the content of a JSON file of at most `LIMIT` bytes, converted to the expected type.

    Args:
        path: the file.
        kind: see `check_shape`.
        remedy: what to do if the file is damaged.

    Raises:
        FileNotFoundError: the file does not exist.
        UserError: the file has other content.
    """
    message = f"; {remedy}" if remedy else ""
    try:
        content = safe_io.read_json(path, LIMIT)
    except UserError as error:
        raise UserError(f"{error}{message}") from error
    try:
        return check_shape(content, kind)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: damaged: {error}{message}") from error


def read_result(path: Path) -> Result:
    """Returns a result of `flame-mdm evaluate`.

    Raises:
        UserError: the file is damaged.
    """
    return read_json(path, Result, "delete it, then run `flame-mdm evaluate` or `flame-mdm tables` again")
