"""Typed schemas for files, and readers with error messages that name the file and the key."""

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from flame_mdm import safe_io
from flame_mdm.config import plain
from flame_mdm.errors import UserError, did_you_mean

# Maximum integer in a file. Larger integers overflow when they are plotted or logged.
MAX_INTEGER = 2**63 - 1
LIMIT = 4 * safe_io.MEBIBYTE
"""Maximum size in bytes of a file of results, lengths or provenance.

Typical files have 10 to 300 KiB.
"""
T = TypeVar("T")
Int = Annotated[int, Field(gt=-(2**63), lt=2**63)]
# A finite number that does not overflow when it is plotted
Number = Annotated[float, Field(gt=-1e300, lt=1e300)]
Plain = str | bool | Int | Number | None


class Schema(BaseModel):
    """Schema of a file's content.

    Types are not converted: the string "1" is not accepted as a number. Unknown keys are ignored.
    """

    model_config = ConfigDict(strict=True)


class ClosedSchema(Schema):
    """Schema of a file that is written by hand.

    Unknown keys are errors, except for overrides such as `data.crop.max_frames`.
    """

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, content: Any) -> Any:
        for name in content if isinstance(content, dict) else ():
            if name not in cls.model_fields and "." not in str(name):
                raise ValueError(f"unknown key: {name}.{did_you_mean(str(name), cls.model_fields)}")
        return content


EXPECTED = {
    **{
        "string": "a string",
        "bool": "true or false",
        "int": "a whole number",
        "float": "a number",
        "finite": "a number",
    },
    **{"less": "a smaller number", "greater": "a larger number", "none": "null"},
    **{"dict": "a mapping", "model": "a mapping", "list": "a list"},
    **{
        "string_too_short": "a non-empty string",
        "too_short": "a longer list or mapping",
        "too_long": "a shorter list",
    },
}
"""Descriptions of the expected content, by a pydantic error type or its first word."""

_adapter = functools.cache(TypeAdapter)


def check_shape(content: Any, kind: type[T] | Any, strict: bool = True) -> T:
    """Converts the contents of a file to a `Schema` or another type that pydantic supports.

    Dataclasses require `strict=False`, which also accepts the string "1" as a number.

    Raises:
        ValueError: If the content does not match `kind`. The message contains the key, its value
            and the expected type.
    """
    if large := _too_large(content):
        raise ValueError(
            f"{large[:40]} ... is too large for a JSON integer; the maximum is {MAX_INTEGER:,}"
        )
    try:
        return _adapter(kind).validate_python(content, strict=strict)
    except ValidationError as error:
        raise ValueError(_first_error(error, content)) from error


def check_plain(content: Mapping[str, Any], kind: type[T] | Any, path: Path) -> T:
    """Converts the contents of an untrusted file, which may contain only plain values.

    The content is converted as in `check_shape`. Raises a `UserError` that names `path` if the
    conversion fails, or if the content is nested too deeply or contains itself.
    """
    # checked before the shape: the check of the shape would not end for content that contains
    # itself
    for name, value in content.items():
        plain(value, f"{path}: {name}")
    try:
        return check_shape(content, kind)
    except ValueError as error:
        raise UserError(f"{path} is damaged: {error}") from error


def _too_large(content: Any) -> str:
    """Returns the first integer above `MAX_INTEGER` as text, or "" if there is none."""
    if isinstance(content, dict | list):
        values = content.values() if isinstance(content, dict) else content
        return next(filter(None, map(_too_large, values)), "")
    return hex(content) if isinstance(content, int) and abs(content) > MAX_INTEGER else ""


def _first_error(error: ValidationError, content: Any) -> str:
    first: Any = error.errors(include_url=False)[0]
    keys, kind, context = [], first["type"], first.get("ctx", {})
    for key in first["loc"]:  # pydantic also lists the members of unions, which are not keys
        if (isinstance(content, dict) and key in content) or (
            isinstance(content, list) and isinstance(key, int)
        ):
            content = content[key]
            keys.append(str(key))
    name = ".".join(keys) or "the file"
    if first["loc"] and first["loc"][-1] == "[key]":
        return f"{name}: a key is not a string. Put it in quotes"
    if kind == "missing":
        return f"{name} has no {first['loc'][-1]}"
    if kind == "value_error":
        return ": ".join(filter(None, [".".join(keys), str(context["error"])]))
    shown = json.dumps(content, default=str)
    shown = shown if len(shown) < 40 else f"{shown[:36]} ..."
    expected = (
        context["expected"]
        if kind == "literal_error"
        else EXPECTED.get(kind, EXPECTED.get(kind.split("_")[0]))
    )
    return (
        f"{name} is {shown}, not {expected}" if expected else f"{name} is {shown}: {first['msg']}"
    )


def read_json(path: Path, kind: type[T] | Any, remedy: str = "") -> T:
    """Reads a JSON file of at most `LIMIT` bytes and returns its content; see `check_shape`.

    `remedy` is appended to error messages, as advice to the user.
    """
    message = f"; {remedy}" if remedy else ""
    try:
        return check_shape(safe_io.read_json(path, LIMIT), kind)
    except UserError as error:
        raise UserError(f"{error}{message}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is damaged: {error}{message}") from error
