"""Signal handlers that end a command cleanly, or stop training at the end of a training step."""

import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import active_children
from types import FrameType
from typing import Any, NoReturn

# The exception of the first signal that the running command received
_received: BaseException | None = None


@contextmanager
def stoppable(signums: Sequence[int]) -> Iterator[None]:
    """Turns signals into exceptions, so that partial files are deleted.

    The command exits with code 128 + the signal number.
    """
    global _received

    def exception(number: int) -> BaseException:
        return KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        global _received
        # suppresses messages about objects that are being created or deleted
        sys.unraisablehook = lambda _: None
        _received = _received or exception(number)
        raise exception(number)

    hook = sys.unraisablehook
    before = {
        n: signal.signal(n, stop) for n in signums if signal.getsignal(n) is not signal.SIG_IGN
    }
    try:
        yield
    except Exception:
        # The exception of a signal may be raised anywhere in a library, whose cleanup may then fail
        # with another exception.
        if _received is not None:
            raise _received from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _received, sys.unraisablehook = None, hook


def raise_received() -> None:
    """Re-raises the exception for a received signal, in case a library has swallowed it."""
    if _received is not None:
        raise _received


class StopRequest:
    """Records a signal that requests a stop at the end of a training step.

    `signum` is the signal number; 0 = no signal. A second SIGINT stops immediately. So does a
    second SIGTERM, unless it arrives within one second of the first one: `timeout` sends two at
    once.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)

    def __init__(self) -> None:
        self.signum, self.time = 0, 0.0
        self.handlers: dict[int, Any] = {}

    def install(self) -> None:
        """Registers `note` as the signal handler."""
        self.handlers = {signum: signal.signal(signum, self.note) for signum in self.SIGNALS}

    def restore(self) -> None:
        """Restores the handlers that `install` replaced."""
        for signum, handler in self.handlers.items():
            signal.signal(signum, handler)
        self.handlers = {}

    def note(self, signum: int, frame: FrameType | None) -> None:
        """Records a signal, so that training stops after the current step.

        A second Ctrl-C ends the process at once.
        """
        repeated = self.signum == signum and time.monotonic() > self.time + 1
        if self.signum and (signum == signal.SIGINT or (signum == signal.SIGTERM and repeated)):
            kill_children()
            raise SystemExit(128 + signum)
        self.signum, self.time = signum, time.monotonic()
        # print is not reentrant, and the signal may have interrupted another print.
        with suppress(BrokenPipeError):
            os.write(
                1,
                b"\nstopping at the end of this step; press Ctrl-C or send SIGTERM again to stop immediately\n",
            )


def kill_children() -> None:
    """Kills all child processes. Otherwise, Python would wait forever for suspended workers."""
    # torch's handler would raise an error for each worker that ends.
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    for process in active_children():
        process.kill()


def ignore_interrupts() -> None:
    """Ignores Ctrl-C in a worker process, whose parent process handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
