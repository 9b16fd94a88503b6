"""Commands on input that they must refuse: one line, exit code 1, nothing left behind."""

import io
import os
import re
import resource
import signal
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flame_mdm.__main__ import main
from flame_mdm.errors import UserError

WAITING = 12


class Refused:
    """Runs commands on input that they must refuse, and collects the cases where they do not refuse it well.

    Attributes:
        every: of the cases, every so many are run; FLAME_MDM_FUZZ=all runs all.
        seconds: most processor time that a command may take; it may wait, or be kept waiting, `WAITING` times as long.
        memory: bytes of address space that a command may add; None = any.
    """

    every: int
    seconds: int
    memory: int | None

    def __init__(self, folder: Path, capture: pytest.CaptureFixture[str], watched: Sequence[Path]):
        self.folder, self.capture, self.watched = folder, capture, [folder, *watched]
        self.count, self.every, self.faults = 0, 1, list[str]()
        self.seconds, self.memory = 30, None

    def __call__(self, command: str, *words: str, says: str = "") -> None:
        """Runs one command, whose error line must contain `says`."""
        self.count += 1
        if self.count % self.every and os.environ.get("FLAME_MDM_FUZZ") != "all":
            return
        before = self._tree()
        self.capture.readouterr()
        late = False

        def alarm(*_: object) -> None:
            nonlocal late
            late = True
            raise TimeoutError

        handlers = {
            signum: signal.signal(signum, alarm) for signum in (signal.SIGALRM, signal.SIGPROF)
        }
        # The timer counts the time of this process only.
        signal.setitimer(signal.ITIMER_PROF, self.seconds)
        signal.alarm(WAITING * self.seconds)
        limits = resource.getrlimit(resource.RLIMIT_AS)
        if self.memory is not None:
            resource.setrlimit(resource.RLIMIT_AS, (address_space() + self.memory, limits[1]))
        try:
            code: object = main([command, *words])
        except BaseException as error:
            code = (
                f"{type(error).__name__}: {error} ({traceback.extract_tb(error.__traceback__)[-1]})"
            )
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.alarm(0)
            resource.setrlimit(resource.RLIMIT_AS, limits)
            for signum, handler in handlers.items():
                signal.signal(signum, handler)
        out, err = self.capture.readouterr()
        changed = self._tree() ^ before
        faults = [
            f"no end after {self.seconds} s"
            if late
            else "",  # which code that catches every exception hides
            f"it ended with {code}" if code not in (1, 2) else "",
            f"it left {sorted(map(str, changed))}" if changed else "",
            "a traceback" if "Traceback" in out + err else "",
            f"it said {err!r}" if not one_line(err) or says not in err else "",
            "it ran out of memory" if "out of memory" in err else "",
        ]
        if any(faults):
            self.faults.append(f"{command} {str(words)[-200:]}: {'; '.join(filter(None, faults))}")

    def _tree(self) -> set[Path]:
        return {path for folder in self.watched for path in folder.rglob("*")}


@contextmanager
def bounded(seconds: float = 10, memory: int = 2**30) -> Iterator[None]:
    """Limits the address space that this process may add, and the processor time it may take."""
    limits, start = resource.getrlimit(resource.RLIMIT_AS), time.process_time()
    resource.setrlimit(resource.RLIMIT_AS, (address_space() + memory, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert time.process_time() - start < seconds


def address_space() -> int:
    """Bytes of address space of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


def npz(**arrays: Any) -> bytes:
    """The bytes of an .npz file."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


@contextmanager
def one_line_error(match: str) -> Iterator[None]:
    """The block raises an error of one line, about the user's input or a missing file."""
    with pytest.raises((UserError, FileNotFoundError), match=match) as error:
        yield
    assert "\n" not in str(error.value), match


def error_of(capture: pytest.CaptureFixture[str], *words: object) -> str:
    """The only line that a failing command prints as an error."""
    assert main([str(word) for word in words]) == 1
    (line,) = [line for line in capture.readouterr().err.splitlines() if line.startswith("error: ")]
    return line


def one_line(err: str) -> bool:
    """Whether a refusal is one clear line.

    What goes before an error in the middle of work are its progress bars, on lines of their own.
    """
    lines = [
        line
        for line in err.splitlines()
        if line and not re.match(r"\r?(generating|preparing \w+): ", line)
    ]
    return len(lines) == 1 and lines[0].startswith("error: ") and len(lines[0]) > len("error: ") + 8


def one_error(capture: pytest.CaptureFixture[str]) -> str:
    """The error line that was printed, and nothing else with it."""
    (line,) = capture.readouterr().err.splitlines()
    assert line.startswith("error: ")
    return line


def carry_out(task: tuple) -> object:
    """Calls the first of these with the others; for processes of their own, which import no more than this module."""
    function, *arguments = task
    return function(*arguments)
