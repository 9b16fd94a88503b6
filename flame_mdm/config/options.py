"""Fields of the dataclasses that hold settings: each with the help text that the command line shows, and a check."""

from collections.abc import Callable
from dataclasses import MISSING, field, fields
from typing import Any

Check = Callable[[str, Any], None]
"""Check of the value of a key, by name and value; raises `UserError` or `FileNotFoundError`."""


def option(default: Any, help: str, check: Check | None = None) -> Any:
    """Returns a dataclass field with a help text and a check for the command line; a function `default` computes it."""
    default = {"default_factory" if callable(default) else "default": default}
    return field(**default, metadata={"help": help, "check": check})


def required(help: str, check: Check | None = None) -> Any:
    """Returns a dataclass field as `option` does, but without a default."""
    return option(MISSING, help, check)


def same_option(kind: type[Any], name: str, check: Check | None = None, **default: Any) -> Any:
    """Returns a field with the help text of another dataclass's field and, unless `default` is given, its default."""
    original = next(entry for entry in fields(kind) if entry.name == name)
    return option(default.get("default", original.default), original.metadata["help"], check)
