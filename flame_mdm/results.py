"""What the files of runs, results and tables hold, and how they are read: what is damaged is named, key by key."""

# No `from __future__ import annotations`: TypedDict looks for NotRequired in annotations that are no strings.

import difflib
import json
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, NotRequired, TypedDict, get_args, get_origin, get_type_hints, is_typeddict

from flame_mdm.config import UserError


class Value(TypedDict):
    """A metric over the replications: mean, half the width of its 95 % interval, motions; None where not computable."""

    mean: float | None
    ci: float | None
    replications: int | None
    n: int | None


class Protocol(TypedDict):
    """By which protocol was measured."""

    name: str
    version: int


class Data(TypedDict):
    """What was measured, or trained on."""

    dataset: str
    fingerprint: str
    frames: NotRequired[tuple[int, int]]


class Extractor(TypedDict):
    """What made features of motions."""

    sha256: str


class Checkpoint(TypedDict):
    """What made the motions."""

    path: str
    sha256: str
    sampler: str
    num_inference_steps: int
    guidance_scale: float
    experiment: NotRequired[str | None]
    selected_by: NotRequired[str]
    averaged_weights: NotRequired[bool]
    parameters: NotRequired[int]
    edit: NotRequired[dict[str, Any]]


class Cost(TypedDict):
    """What a motion costs."""

    nfe: NotRequired[float | None]
    seconds_per_sample: NotRequired[float | None]


class Result(TypedDict):
    """A result of `make evaluate`, as far as tables and pages read it."""

    quick: bool
    protocol: Protocol
    split: str
    data: Data
    seed: int
    extractor: Extractor | None
    checkpoint: Checkpoint | None
    device: str
    values: dict[str, Value | None] | None
    ground_truth: dict[str, Value | None] | None
    not_computed: dict[str, str]
    invalid_because: list[str]
    published_split: NotRequired[bool]
    samples_sha256: NotRequired[str | None]
    baseline: NotRequired[str | None]
    changed: NotRequired[dict[str, Any]]
    warnings: NotRequired[list[str]]
    cost: NotRequired[Cost | None]


NAMES = {
    str: "a text",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    NoneType: "null",
    dict: "a mapping",
    list: "a list",
    tuple: "a list",
}


def check_shape(content: Any, kind: Any, where: str = "", closed: bool = False) -> None:
    """Checks what was read from a file against a type.

    Args:
        content: mappings, lists, texts, numbers.
        kind: the type: a TypedDict, whose other keys are let through, dict[str, X], list[X], tuple[X, Y], a union, str,
            bool, int, float (finite) or Any.
        where: the keys that lead to `content`, with dots between them.
        closed: whether TypedDicts have no other keys, but for those with a dot in them.

    Raises:
        ValueError: saying which key holds what, and what it should be.
    """
    origin = get_origin(kind) or kind
    if kind is Any:
        return
    if origin is UnionType:
        first, *others = get_args(kind)
        if not any(_fits(content, other, closed) for other in others):
            check_shape(content, first, where, closed)
        return
    plain = dict if is_typeddict(kind) else origin
    if not _is(content, plain):
        shown = json.dumps(content, default=str)
        shown = shown if len(shown) < 40 else f"{shown[:36]} ..."
        raise ValueError(f"{where or 'the file'} is {shown}, not {NAMES[plain]}")
    inside = f"{where}." if where else ""
    if is_typeddict(kind):
        kinds = get_type_hints(kind)
        for name in sorted(kind.__required_keys__ - content.keys()):
            raise ValueError(f"{where or 'the file'} has no {name}")
        for name, value in content.items():
            if name in kinds:
                check_shape(value, kinds[name], f"{inside}{name}", closed)
            elif closed and "." not in str(name):
                near = difflib.get_close_matches(str(name), kinds, 1)
                raise ValueError(f"{inside}{name} is not known{f'; did you mean {near[0]}?' if near else ''}")
    elif origin is dict:
        for name, value in content.items():
            if not isinstance(name, str):
                raise ValueError(f"{inside}{name} is named by no text; put the name in quotes")
            check_shape(value, get_args(kind)[1], f"{inside}{name}", closed)
    elif origin in (list, tuple):
        kinds = get_args(kind) if origin is tuple else get_args(kind) * len(content)
        if len(kinds) != len(content):
            raise ValueError(f"{where} holds {len(content)} values, not {len(kinds)}")
        for number, (value, part) in enumerate(zip(content, kinds, strict=True)):
            check_shape(value, part, f"{inside}{number}", closed)


def _is(content: Any, kind: type) -> bool:
    if kind in (int, float):
        return (
            isinstance(content, int if kind is int else int | float)
            and not isinstance(content, bool)
            and (
                abs(content) < (2**63 if kind is int else 1e300)  # no NaN, nothing that overflows when it is drawn
            )
        )
    return isinstance(content, list if kind is tuple else kind)


def _fits(content: Any, kind: Any, closed: bool) -> bool:
    try:
        check_shape(content, kind, closed=closed)
    except ValueError:
        return False
    return True


def read_text(path: Path) -> str:
    """A file of text.

    Raises:
        UserError: no such file, or one in another encoding than UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not a text in UTF-8: {error}") from error


def read_json(path: Path, kind: Any = dict[str, Any], remedy: str = "") -> Any:
    """A JSON file that holds what `kind` says, see `check_shape`.

    Args:
        path: of the file.
        kind: what it has to hold.
        remedy: what to do where it is damaged.

    Raises:
        UserError: it is no such file, or holds anything else.
    """

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is no number of JSON")

    text = read_text(path)
    told = f"; {remedy}" if remedy else ""
    try:
        content = json.loads(text, parse_constant=refuse)
        json.dumps(content, ensure_ascii=False).encode()  # half a character cannot be written again
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not a JSON file: {error}{told}") from error
    try:
        check_shape(content, kind)
    except ValueError as error:
        raise UserError(f"{path}: damaged: {error}{told}") from error
    return content


def read_result(path: Path) -> dict[str, Any]:
    """A result of `make evaluate`.

    Raises:
        UserError: it is damaged.
    """
    return read_json(path, Result, "delete it, and make evaluate or make tables makes it again")
