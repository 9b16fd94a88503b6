# pyright: standard
"""Prompt files, which are read without torch, so that invalid files are rejected quickly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from flame_mdm.errors import UserError, first_line
from flame_mdm.safe_io import MEBIBYTE, read_text
from flame_mdm.sampling.motion_request import check_length, read_parts


@dataclass(frozen=True)
class PromptFile:
    """A text file with one prompt per line. If some prompts are refused, the others are sampled.

    Attributes:
        path: name of the file, as the user typed it.
        lines: the prompts, keyed by line number, starting at 1. Blank lines are omitted.
        refused: the errors that state why prompts cannot be sampled, keyed by line number.
    """

    path: str
    lines: dict[int, str]
    refused: dict[int, UserError] = field(default_factory=dict)

    @classmethod
    def read(cls, path: str) -> PromptFile:
        """Reads a file and refuses the prompts that no model can sample.

        Raises:
            UserError: If the file contains no prompts.
        """
        text = read_text(path, MEBIBYTE)
        lines = enumerate(text.removeprefix("\ufeff").splitlines(), start=1)
        prompts = {number: line.strip() for number, line in lines if line.strip()}
        if not prompts or "\0" in text:
            raise UserError(f"{path} contains no prompts. Write one per line")

        file = cls(path, prompts)
        for number, prompt in prompts.items():
            try:
                check_length(prompt)
                read_parts(prompt)
            except UserError as error:
                file.refused[number] = error
        return file

    @property
    def accepted(self) -> dict[int, str]:
        """The prompts that are not refused, keyed by line number."""
        return {
            number: prompt for number, prompt in self.lines.items() if number not in self.refused
        }

    def refuse(self, errors: Mapping[int, UserError]) -> None:
        """Refuses prompts; the keys of `errors` are indices into the accepted prompts."""
        numbers = list(self.accepted)
        self.refused.update({numbers[position]: error for position, error in errors.items()})

    def lengths(self, key: str, lengths: Any) -> Any:
        """Returns the lengths of the accepted prompts.

        A single length, which applies to all prompts, is returned unchanged.
        """
        if not isinstance(lengths, Sequence):
            return lengths
        if len(lengths) != len(self.lines):
            raise UserError(
                f"{key}={list(lengths)}: the number of lengths is {len(lengths)}, but the number of prompts is "
                f"{len(self.lines)}. Use one length, or one per prompt"
            )
        return [
            length
            for number, length in zip(self.lines, lengths, strict=True)
            if number not in self.refused
        ]

    def report(self) -> list[str]:
        """Returns one line per refused prompt, with the reason."""
        return [
            f"{self.path}, line {number}: {first_line(self.refused[number])}"
            for number in sorted(self.refused)
        ]
