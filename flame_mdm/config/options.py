"""Fields of settings dataclasses, with help texts and checks for the command line."""

from collections.abc import Callable
from dataclasses import MISSING, field, fields
from typing import Any

Check = Callable[[str, Any], None]
"""Function that checks a value. Its arguments are the key and the value.

It raises `UserError` or `FileNotFoundError` if the value is invalid.
"""


def option(default: Any, help: str, check: Check | None = None) -> Any:
    """Returns a dataclass field with a help text and, optionally, a check for the command line.

    If `default` is a function, it is called to compute the default.
    """
    default = {"default_factory" if callable(default) else "default": default}
    return field(**default, metadata={"help": help, "check": check})


def required(help: str, check: Check | None = None) -> Any:
    """Returns the same dataclass field as `option`, but without a default."""
    return option(MISSING, help, check)


def same_option(kind: type[Any], name: str, check: Check | None = None, **default: Any) -> Any:
    """Returns a field that reuses the help text of a field in another dataclass.

    Unless `default` is given, the field also reuses the default.
    """
    original = next(entry for entry in fields(kind) if entry.name == name)
    return option(default.get("default", original.default), original.metadata["help"], check)
