"""Printed lines and working folders, for tests with recorded results."""

import io
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from support.recorded import outcome


def printed(action: Callable[..., Any], *arguments: Any, **options: Any) -> list[Any]:
    """The outcome of a call, followed by the lines on standard output and standard error."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        result = outcome(action, *arguments, **options)
    return [result, out.getvalue(), err.getvalue()]


@contextmanager
def workspace() -> Iterator[Path]:
    """Runs the block in an empty folder, so that relative paths lead to it. Yields its full path."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield Path(folder).resolve()
        finally:
            os.chdir(before)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yields the full path of an empty folder, which is deleted after the block."""
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder).resolve()


def without(folder: Path, value: Any) -> Any:
    """A result in which the path of a folder is replaced in all texts."""
    if isinstance(value, str | Path):
        return str(value).replace(str(folder), "FOLDER")
    if isinstance(value, Mapping):
        return {without(folder, key): without(folder, entry) for key, entry in value.items()}
    return [without(folder, entry) for entry in value] if isinstance(value, list | tuple) else value
