"""What all command lines have in common: variables of make, signals, errors and exit codes."""

import errno
import os
import re
import signal
import traceback
from collections.abc import Callable, Sequence

from flame_mdm.errors import UserError, first_line, say
from flame_mdm.signals import stoppable

STOP = (signal.SIGINT, signal.SIGTERM)  # signals that end a command after it has cleaned up

BUG = 70  # exit code of a bug, as in sysexits.h
REPORT = "this is a bug in flame_mdm. Please report it with the lines above and the command that you ran"
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)

NO_MEMORY = re.compile("allocate memory|out of memory|bad_alloc|start new thread|create a primitive|failed to map")
"""Messages of errors caused by a lack of memory: from torch, from threads, and from libraries that fail to load."""


def make_variables() -> list[str]:
    """Returns the variables given to make, as words: `EXP` names the recipe, other upper-case names are keys.

    Make passes them in MAKEFLAGS after ` -- `, latest first, with escaped spaces and doubled dollar signs. Read from
    there, they have not been processed by a shell.
    """
    variables = (" " + os.environ.get("MAKEFLAGS", "")).partition(" -- ")[2]
    words = [re.sub(r"\\(.)", r"\1", w).replace("$$", "$") for w in re.findall(r"(?:\\.|[^\\ ])+", variables)]
    pairs = [word.partition("=") for word in reversed(words)]
    names = [value for key, _, value in pairs if key == "EXP"]
    keys = [(key.lower() if key.isupper() else key, value) for key, _, value in pairs]
    return names + [f"{key}={value}" for key, value in keys if key not in ("exp", "python", "venv")]


def guarded(action: Callable[[], None], signums: Sequence[int] = ()) -> int:
    """Runs `action` and returns the exit code; a signal of `signums` ends it after it has cleaned up.

    For an error that the user can fix, it prints one line and returns 1; FLAME_MDM_TRACEBACK=1 adds the traceback. For
    any other exception, a bug, it prints the traceback and how to report it, and returns `BUG`.
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
            error.__traceback__ = None  # frees what the frames hold: printing a line takes memory, too
        line = explanation(error)
        if line is None or verbose:
            traceback.print_exc()
        say(f"error: {line}" if line is not None else REPORT, error=True)
        return BUG if line is None else 1
    return 0


def explanation(error: Exception) -> str | None:
    """Returns the line for an error that the user can fix, or None for a bug.

    The user can fix a `UserError`, a file that cannot be found, read or written, and a lack of memory.
    """
    if isinstance(error, UserError):
        return first_line(error)
    if isinstance(error, MemoryError) or NO_MEMORY.search(str(error)):
        return f"out of memory ({first_line(error)}). Free memory, or reduce the size"
    # Errors of files name the file, unless this framework raised them or a disk is full.
    if isinstance(error, FileNotFoundError) or (isinstance(error, OSError) and (error.filename or error.errno in FULL)):
        return first_line(error)
    return None
