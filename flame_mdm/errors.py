"""Errors that users can fix, suggestions for misspelled names, renamed names, and safe output."""

import difflib
import html
import os
import re
import sys
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TextIO

MAX_LINE = 2_000
"""Maximum length of an error line.

The middle of longer lines is omitted. All messages of the project are shorter.
"""
# Unicode's bidirectional control characters
DIRECTIONS = re.compile("[\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")


class UserError(ValueError):
    """An error that the user can fix.

    Commands print the message on one line and exit with code 1.
    """


def first_line(error: BaseException) -> str:
    """Returns the first line of an error's message.

    If the first line ends with a colon, the second line is appended.
    """
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if len(lines) > 1 and lines[0].endswith(":"):
        return f"{lines[0]} {lines[1]}"
    return lines[0] if lines else type(error).__name__


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Returns " Did you mean a, b?", where a and b are the names most similar to `name`.

    Suggests at most three of `names`, and returns "" if none of them is similar.
    """
    near = difflib.get_close_matches(name, list(names), 3, 0.5)
    return f" Did you mean {', '.join(near)}?" if near else ""


def shortened(text: str, most: int = MAX_LINE) -> str:
    """Shortens text to at most `most` characters and escapes direction characters.

    Shortened text ends with an ellipsis.
    """
    text = DIRECTIONS.sub(lambda match: _escaped(match[0]), text[: most + 1])
    return text if len(text) <= most else f"{text[: most - 1]}…"


def printable(text: str) -> str:
    r"""Returns the text with control and direction characters escaped (`\x1b`).

    The returned text cannot control a terminal.
    """
    return "".join(
        char
        if char == "\t" or unicodedata.category(char) not in ("Cc", "Cf", "Cs", "Zl", "Zp")
        else _escaped(char)
        for char in text
    )


def one_line(text: str) -> str:
    """Returns text (for example, from an untrusted file) as one `printable` line."""
    return printable(re.sub(r"[\t\n\v\f\r\x1c-\x1e\x85\u2028\u2029]+", " ", text))


def markdown_text(text: str) -> str:
    """Escapes text so that Markdown shows it as one line without any formatting."""
    return html.escape(re.sub(r"([|*_`~#\[\]\\])", r"\\\1", one_line(text)), quote=False)


_shown: dict[str, str] = {}


def show_as(path: str, name: str) -> None:
    """Makes all later messages show a name instead of a path.

    If a command works on a temporary copy of a file, it calls this function, so that its messages
    contain the name that the user typed.
    """
    _shown[path] = name


def say(*lines: object, error: bool = False) -> None:
    """Prints each argument as one `printable` line, because it may come from an untrusted file.

    If the output is piped to a program that has ended, such as `head`, all later lines are dropped,
    but the command still finishes its work.
    """
    stream = sys.stderr if error else sys.stdout
    for line in lines:
        text = str(line)
        for path, name in _shown.items():
            text = text.replace(path, name)
        if error and len(text) > MAX_LINE:
            text = f"{text[: MAX_LINE // 2]} … {text[-MAX_LINE // 2 :]}"
        try:
            print(printable(text), file=stream, flush=True)
        except BrokenPipeError:
            drop(stream)


def drop(stream: TextIO) -> None:
    """Redirects a standard stream to the null device and discards its buffered text."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


def _escaped(char: str) -> str:
    return char.encode("unicode_escape").decode("ascii")


def renamed_names(module: str, names: Mapping[str, str], since: str) -> Callable[[str], Any]:
    """Returns a `__getattr__` for a module in which names were renamed.

    Old names keep working for one minor version, with a warning.

    Args:
        module: `__name__` of the module.
        names: mapping from old to new names.
        since: version in which the names were changed.
    """

    def get(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        message = f"{module}.{name} was renamed to {names[name]} in version {since}"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return getattr(sys.modules[module], names[name])

    return get
