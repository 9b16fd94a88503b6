"""Typed schemas of files, and readers whose errors name file and key; results of evaluations and audits."""

import functools
import json
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from flame_mdm import safe_io
from flame_mdm.errors import UserError, did_you_mean

MAX_INTEGER = 2**63 - 1  # maximum integer in a file; larger ones overflow when they are plotted or logged
LIMIT = 4 * safe_io.MEBIBYTE
"""Maximum size of a file of results, lengths or provenance. Typical files have 10 to 300 KiB."""
T = TypeVar("T")
Int = Annotated[int, Field(gt=-(2**63), lt=2**63)]
Number = Annotated[float, Field(gt=-1e300, lt=1e300)]  # a finite number that does not overflow when it is plotted
Plain = str | bool | Int | Number | None


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
    """A metric over replications: mean, half-width of its 95 % interval, number of motions; None if not computable."""

    mean: Number | None
    ci: Number | None
    replications: Int | None
    n: Int | None
    per_replication: list[Number | None] = []


class ProtocolVersion(Schema):
    """The protocol of an evaluation or audit, and the hash of its content."""

    name: str
    version: Int
    sha256: str = ""


class Data(Schema):
    """The data set of an evaluation or audit; `frames` are the limits of its clips, `excluded` counts by reason."""

    dataset: str
    fingerprint: str
    frames: Annotated[list[Int], Field(min_length=2, max_length=2)] | None = None
    excluded: dict[str, Int] = {}
    representation: str = ""


class ExtractorRecord(Schema):
    """A feature extractor, and the fingerprint of the data it was trained on, if known."""

    sha256: str
    path: str = ""
    data: str | None = None


class Checkpoint(Schema):
    """The checkpoint that generated the motions, its training, and the sampling options."""

    path: str
    sha256: str
    sampler: str
    num_inference_steps: Int | list[Int]
    eta: Number | None = None
    spacing: str | None = None
    guidance_scale: Number
    edit: dict[str, Plain] = {}
    experiment: str | None = None
    config_sha256: str = ""
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


class UsedSkeleton(Schema):
    """The bones of joints computed from SMPL's rotations: those of SMPL's model file, or of a stand-in."""

    stand_in: bool
    smpl_sha256: str | None = None


class Cost(Schema):
    """Cost per motion; None if no model was used."""

    nfe: Number | None = None
    seconds_per_sample: Number | None = None
    batch_size: Number | None = None


class Measured(Schema):
    """What an evaluation measures: `values` and, of real motions, `ground_truth`, by metric; None = not measured."""

    ground_truth: dict[str, Value | None] | None
    values: dict[str, Value | None] | None
    not_computed: dict[str, str]  # reasons by metric
    invalid_because: list[str]  # [] if the values are valid
    forced: bool = False  # whether motions were generated although real motions do not have the expected values
    warnings: list[str] = []
    cost: Cost | None = None
    seeds: list[Int] = []  # of metrics, by replication


class Result(Measured):
    """A result of `flame-mdm evaluate`: what was evaluated, how and where, and the values."""

    quick: bool  # not for publication
    protocol: ProtocolVersion
    changed: dict[str, Plain] = {}  # options that differ from the protocol
    split: str
    published_split: bool = False  # whether it tests on clips seen in training, or has no validation clips
    data: Data
    seed: Int
    extractor: ExtractorRecord | None
    checkpoint: Checkpoint | None
    samples_sha256: str | None = None  # of motion files from another system
    baseline: str | None = None
    audit: str | None = None  # path of the audit card of the extractor; None = not audited
    skeleton: UsedSkeleton | None = None  # None if the data has joint positions
    device: str
    precision: str = ""
    environment: dict[str, Any] = {}

    @property
    def stand_in_skeleton(self) -> bool:
        return self.skeleton is not None and self.skeleton.stand_in


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


class AuditedExtractor(Schema):
    """The extractor of an audit, by its recipe or file."""

    sha256: str
    name: str


class AuditCard(ClosedSchema):
    """An evaluator audit, as `flame-mdm audit` writes it."""

    format: Int
    extractor: AuditedExtractor | None
    protocol: ProtocolVersion
    data: Data
    split: str
    motions: Int
    seed: Int
    resamples: Int
    packages: dict[str, str]
    metrics: dict[str, bool | None]  # whether higher values are better; None = values near those of real motions
    real: dict[str, Annotated[list[Number | None], Field(min_length=2, max_length=2)]]  # and half widths of intervals
    perturbations: Annotated[list[AuditedPerturbation], Field(min_length=1)]
    not_computed: dict[str, str]
    truth: dict[str, dict[str, Number | None]]  # agreement with exact attributes: `auc` and `correlation`, by metric


EXPECTED = {
    **{"string": "a text", "bool": "true or false", "int": "a whole number", "float": "a number", "finite": "a number"},
    **{"less": "a smaller number", "greater": "a larger number", "none": "null"},
    **{"dict": "a mapping", "model": "a mapping", "list": "a list"},
    **{"string_too_short": "a non-empty text", "too_short": "a longer list or mapping", "too_long": "a shorter list"},
}
"""Expected content, by the type of a pydantic error or its first word."""

_adapter = functools.cache(TypeAdapter)


def check_shape(content: Any, kind: type[T] | Any, strict: bool = True) -> T:
    """Returns content of a file converted to a `Schema` or another type that pydantic supports.

    Raises `ValueError`, with key, found value and expected type. Dataclasses need `strict` = False: "1" is a number.
    """
    if large := _too_large(content):
        raise ValueError(f"{large[:40]} ... is too large for a JSON integer; the maximum is {MAX_INTEGER:,}")
    try:
        return _adapter(kind).validate_python(content, strict=strict)
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
    for key in first["loc"]:  # pydantic also lists the members of unions, which are no keys
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
    """Returns the content of a JSON file of at most `LIMIT` bytes, as `check_shape` does; errors end with `remedy`."""
    message = f"; {remedy}" if remedy else ""
    try:
        return check_shape(safe_io.read_json(path, LIMIT), kind)
    except UserError as error:
        raise UserError(f"{error}{message}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: damaged: {error}{message}") from error


def read_result(path: Path) -> Result:
    return read_json(path, Result, "delete it, then run `flame-mdm evaluate` or `flame-mdm tables` again")
