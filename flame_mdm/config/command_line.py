"""Command lines: keys (declared by one dataclass per command), signals, errors and exit codes."""

import os
import re
import shlex
import signal
import textwrap
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields
from inspect import cleandoc, formatannotation
from itertools import takewhile
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from flame_mdm.config.composition import parse
from flame_mdm.config.signatures import check_kind
from flame_mdm.errors import UserError, did_you_mean, first_line, say, shortened
from flame_mdm.safe_io import FULL
from flame_mdm.signals import stoppable

Settings = TypeVar("Settings")
"""Dataclass of a command.

The docstring of the class is the usage message, and the fields created by `option` are the keys.
`OBJECTS` lists the keys to which leading words without a key are assigned; if the last of these
keys is a list, it takes all remaining words. `SWEEPS` is True if the command accepts --multirun and
launch= (see `flame_mdm.config.jobs`). A field `composed` receives the arguments for Hydra: keys
with a dot, such as `data.source.path`, and the keys and options in `COMPOSED`.
"""

STOP = (signal.SIGINT, signal.SIGTERM)  # signals upon which a command cleans up and exits

TEXT = ("str", "str | None")  # annotations of keys that take any text

BUG = 70  # exit code for a bug, as in sysexits.h

NO_MEMORY = re.compile(
    "allocate memory|out of memory|bad_alloc|start new thread|create a primitive|failed to map"
)
"""Messages of errors that a lack of memory causes in torch, in threads and in loading libraries."""


def run(command: Callable[[Settings], None], kind: type[Settings], argv: Sequence[str]) -> int:
    """Runs a command line `[OBJECT [OUT]] key=value ...` and returns its exit code."""
    words = make_variables() if "--from-make" in argv else list(argv)
    if any(word in ("-h", "--help") for word in words):
        say(*_help(kind))
        return 0

    return guarded(lambda: command(checked_settings(kind, words)), STOP)


def checked_settings(kind: type[Settings], words: Sequence[str]) -> Settings:
    """Reads the settings of a command and runs the checks declared by their fields."""
    settings = read_settings(kind, words)
    for entry in fields(kind):  # type: ignore[arg-type]
        value, check = getattr(settings, entry.name), entry.metadata.get("check")
        if check is not None and value is not None:
            check(entry.name, value)
    return settings


def read_settings(kind: type[Settings], words: Sequence[str]) -> Settings:
    """Reads the settings of a command from its command-line arguments.

    Strings are taken literally, lists of strings are split as in a shell, and all other values
    follow Hydra's grammar.
    """
    annotations = _annotations(kind)
    values: dict[str, Any] = {}
    composed: list[str] = []
    takes_composed = "composed" in {entry.name for entry in fields(kind)}  # type: ignore[arg-type]
    for word in with_keys(kind, words):
        key, separator, text = word.partition("=")
        if word.startswith("-") and takes_composed and word in getattr(kind, "COMPOSED", ()):
            composed.append(word)
            continue
        if word.startswith("-"):
            raise UserError(f"unknown option {word}. Available: --help and key=value pairs")
        if not separator:
            raise UserError(f"unexpected word '{word}'. Write key=value, and quote text: key='a b'")
        if not key:
            raise UserError(
                f"'{shortened(word, 60)}' has no key. Write key=value, without spaces around the = sign"
            )
        if key in annotations:
            values[key] = _value(key, text, annotations[key], getattr(kind, "SWEEPS", False))
        elif takes_composed and ("." in key or key in getattr(kind, "COMPOSED", ())):
            composed.append(word)
        else:
            raise UserError(f"unknown config key '{key}'.{did_you_mean(key, annotations)}")
    for entry in fields(kind):  # type: ignore[arg-type]
        if entry.default is entry.default_factory is MISSING and entry.name not in values:
            usage = cleandoc(kind.__doc__ or "").splitlines()[0].removeprefix("usage: ")
            raise UserError(f"{entry.name} is missing. Usage: {usage}")
    return kind(**values, **({"composed": tuple(composed)} if composed else {}))


def _annotations(kind: type[Any]) -> Mapping[str, str]:
    """Returns the annotation of each key, such as "int | None"."""
    hints = get_type_hints(kind)
    return {
        entry.name: formatannotation(hints[entry.name])
        for entry in fields(kind)
        if "help" in entry.metadata
    }


def _value(key: str, text: str, annotation: str, sweeps: bool) -> Any:
    if text == "null" and "None" in annotation:
        return None
    if annotation in TEXT:
        return text
    if annotation.startswith("list[str]"):
        try:
            names = shlex.split(text)
        except ValueError as error:
            raise UserError(
                f"{key}={text}: {error}. Put names that contain spaces in quotes"
            ) from error
        if not names or not all(names):
            raise UserError(
                f"{key}={text}: the list is empty. Set it to one or more names, separated by spaces"
            )
        return names
    override = parse([f"{key}={text}"])[0]
    if override.is_sweep_override() and sweeps:
        raise UserError(
            f"{key}={text}: several values define a sweep with one job per value. Add --multirun, "
            f"or use a single value"
        )
    if override.is_sweep_override():
        raise UserError(
            f"{key}={text}: got several values. Use a single value, or a list: {key}=[{text}]"
        )
    value = override.value()
    check_kind(key, value, annotation)
    return value


def is_text(kind: type[Any], key: str) -> bool:
    """Returns whether a key of a command accepts arbitrary text, which is taken literally."""
    return _annotations(kind).get(key) in TEXT


def with_keys(kind: type[Any], words: Sequence[str]) -> list[str]:
    """Converts the leading words, which specify a command's objects, to the form `key=value`."""
    objects, annotations = getattr(kind, "OBJECTS", ()), _annotations(kind)
    leading = list(takewhile(_is_object, words))
    rest = list(words[len(leading) :])
    if (
        objects
        and annotations[objects[-1]].startswith("list[str]")
        and len(leading) >= len(objects)
    ):
        leading[len(objects) - 1 :] = [shlex.join(leading[len(objects) - 1 :])]
    for key in objects[: len(leading)]:
        if any(word.startswith(f"{key}=") for word in rest):
            raise UserError(
                f"{key} is given twice: once without a key and once as {key}=. Remove one of them"
            )
    # Additional words stay unchanged and are rejected later, because they have no key
    keyed = [f"{key}={word}" for key, word in zip(objects, leading, strict=False)]
    return keyed + leading[len(objects) :] + rest


def _is_object(word: str) -> bool:
    # The path of an existing file is an object, even if it contains "=".
    is_path = "/" in word.partition("=")[0] and len(word) < 1000 and Path(word).exists()
    return not word.startswith("-") and ("=" not in word or is_path)


def _help(kind: type[Any]) -> list[str]:
    """Returns the usage message of a command and its keys, with their defaults and help texts."""
    lines = [*cleandoc(kind.__doc__ or "").splitlines(), "", "Keys, with their defaults:"]
    objects = getattr(kind, "OBJECTS", ())
    annotations = [vars(base).get("__annotations__", {}) for base in kind.__mro__]
    keys = [entry for entry in fields(kind) if "help" in entry.metadata]
    ranks = {
        entry.name: next(rank for rank, names in enumerate(annotations) if entry.name in names)
        for entry in keys
    }
    for entry in sorted(keys, key=lambda entry: (entry.name not in objects[:1], ranks[entry.name])):
        default = entry.default_factory() if callable(entry.default_factory) else entry.default
        if default is MISSING:
            shown = "..."
        elif default is None:
            shown = "null"
        elif isinstance(default, list):
            shown = " ".join(default)
        elif isinstance(default, bool):
            shown = str(default).lower()
        else:
            shown = default
        text = textwrap.wrap(entry.metadata["help"], 84)
        lines += [
            f"  {f'{entry.name}={shown}':30} {text[0]}",
            *(f"{'':33}{line}" for line in text[1:]),
        ]
    return lines


def make_variables() -> list[str]:
    """Returns the variables that were passed to `make`, as command-line arguments.

    `EXP` names the recipe, and other upper-case variables are keys. `make` lists the variables
    in MAKEFLAGS after ` -- `, the latest one first, with escaped spaces and doubled dollar signs.
    """
    variables = (" " + os.environ.get("MAKEFLAGS", "")).partition(" -- ")[2]
    words = [
        re.sub(r"\\(.)", r"\1", w).replace("$$", "$")
        for w in re.findall(r"(?:\\.|[^\\ ])+", variables)
    ]
    pairs = [word.partition("=") for word in reversed(words)]
    names = [value for key, _, value in pairs if key == "EXP"]
    keys = [(key.lower() if key.isupper() else key, value) for key, _, value in pairs]
    return names + [f"{key}={value}" for key, value in keys if key not in ("exp", "python", "venv")]


def guarded(action: Callable[[], None], signums: Sequence[int] = ()) -> int:
    """Runs `action` and returns the exit code.

    If a signal in `signums` arrives, the action cleans up and ends. An error that the user can fix
    is printed on one line, and the exit code is 1; FLAME_MDM_TRACEBACK=1 prints the traceback
    first. Any other exception is a bug: the traceback is printed with a request to report it, and
    the exit code is `BUG`.
    """
    try:
        with stoppable(signums):
            action()
    except SystemExit as stop:
        return int(stop.code or 0)
    except KeyboardInterrupt:
        say("interrupted", error=True)
        return 130
    except Exception as error:
        verbose = os.environ.get("FLAME_MDM_TRACEBACK") == "1"
        if isinstance(error, MemoryError) and not verbose:
            # Free the variables of the stack frames, because printing a line also requires memory
            error.__traceback__ = None
        line = explanation(error)
        if line is None or verbose:
            traceback.print_exc()
        if line is None:
            say(
                "this is a bug in flame_mdm. Please report it with the lines above and your command",
                error=True,
            )
            return BUG
        say(f"error: {line}", error=True)
        return 1
    return 0


def explanation(error: Exception) -> str | None:
    """Returns the line to print for an error that the user can fix, or None for a bug.

    The user can fix the cause of a `UserError`, a file error or an out-of-memory error.
    """
    if isinstance(error, UserError):
        return first_line(error)
    if isinstance(error, MemoryError) or NO_MEMORY.search(str(error)):
        return f"out of memory ({first_line(error)}). Free memory, or reduce the size"
    # An OSError names its file, unless this framework raised it or the disk is full.
    if isinstance(error, FileNotFoundError) or (
        isinstance(error, OSError) and (error.filename or error.errno in FULL)
    ):
        return first_line(error)
    return None
