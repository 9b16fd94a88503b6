"""What all command lines have in common: variables of make, signals, errors and exit codes."""

from __future__ import annotations

import os
import re
import signal
import traceback
from collections.abc import Callable, Sequence

from flame_mdm.errors import UserError, first_line, say
from flame_mdm.signals import stoppable

STOP = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a command after it has cleaned up."""

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

    For an error that the user can fix, it prints one line and returns 1; FLAME_MDM_TRACEBACK=1 adds the traceback.
    """
    try:
        with stoppable(signums):
            action()
    except (UserError, ValueError, OSError, MemoryError, RecursionError, RuntimeError, ImportError) as error:
        memory = isinstance(error, MemoryError)
        memory |= not isinstance(error, UserError) and NO_MEMORY.search(str(error)) is not None
        if isinstance(error, RuntimeError | ImportError) and not (memory or isinstance(error, RecursionError)):
            raise
        if os.environ.get("FLAME_MDM_TRACEBACK") == "1":
            traceback.print_exc()
        message = (
            f"out of memory ({first_line(error)}). Free memory, or reduce the size" if memory else first_line(error)
        )
        say(f"error: {message}", error=True)
        return 1
    except SystemExit as stop:
        return int(stop.code or 0)
    except KeyboardInterrupt:
        say("interrupted", error=True)
        return 130
    return 0
