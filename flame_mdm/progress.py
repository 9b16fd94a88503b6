"""Progress bars that are readable in a terminal and in a log file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import IO, Any

from tqdm import tqdm


class ProgressBar(tqdm):
    """tqdm's bar in a terminal; elsewhere, a plain line at the beginning, about every 30 seconds, and at the end."""

    SECONDS = 30.0

    def __init__(self, *args: Any, **options: Any):
        rare = {} if sys.stderr.isatty() else {"mininterval": self.SECONDS, "maxinterval": self.SECONDS}
        super().__init__(*args, **rare, **options)

    @staticmethod
    def status_printer(file: IO[str]) -> Callable[[str], None]:
        """Returns the function that writes the bar to a file; tqdm itself ends the last line."""
        if file.isatty():
            return tqdm.status_printer(file)
        end = ""

        def write(text: str) -> None:
            nonlocal end
            if text:
                file.write(end + text.rstrip())
                file.flush()
                end = "\n"

        return write
