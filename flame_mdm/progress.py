"""Progress bars that are readable in a terminal and in a log file."""

import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import IO, Any

from tqdm import tqdm

from flame_mdm.signals import raise_received


class ProgressBar(tqdm):
    """Shows tqdm's bar in a terminal and plain lines elsewhere.

    A plain line is printed at the beginning, about every 30 seconds, and at the end.
    """

    SECONDS = 30.0
    # tqdm would swallow an exception raised by a signal while its monitor thread starts
    monitor_interval = 0

    def __init__(self, *args: Any, **options: Any):
        rare = {} if sys.stderr.isatty() else {"mininterval": self.SECONDS}
        super().__init__(*args, miniters=1, **rare, **options)

    def __iter__(self) -> Iterator[Any]:
        for item in super().__iter__():
            raise_received()
            yield item

    def update(self, n: float | None = 1) -> bool | None:
        """Advances the bar by `n`. If a signal was received, raises its exception instead."""
        raise_received()
        return super().update(n)

    @staticmethod
    def status_printer(file: IO[str]) -> Callable[[str], None]:
        """Returns a function that writes the bar to a file. tqdm itself adds the final newline."""
        if file.isatty():
            return tqdm.status_printer(file)
        end = ""

        def write(text: str) -> None:
            nonlocal end
            if text:
                # The program that reads the output, such as `head`, may have exited
                with suppress(BrokenPipeError):
                    file.write(end + text.rstrip())
                    file.flush()
                end = "\n"

        return write
