"""The content of a sentence: actions in order, with their attributes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from flame_mdm.conditions.language.tables import Value


@dataclass(frozen=True)
class Mention:
    """An action in a sentence.

    Attributes:
        action: name of the action in `actions.yaml`.
        attributes: side, count, direction, speed and amount, if the sentence states them.
        text: the words of the sentence that describe the action.
        start, end: position of the verb in the sentence.
        typed: the word that was read as this action because of its meaning, or "" if the sentence
            names the action.
    """

    action: str
    attributes: Mapping[str, Value] = field(default_factory=dict)
    text: str = ""
    start: int = 0
    end: int = 0
    typed: str = ""

    def stating(self, **attributes: Value) -> "Mention":
        """Returns the mention with additional attributes."""
        return replace(self, attributes={**self.attributes, **attributes})


Step = Sequence[Mention]
"""Simultaneous actions."""


@dataclass(frozen=True)
class Understanding:
    """The content of a sentence, as far as it is understood.

    Attributes:
        text: the sentence as the user typed it.
        steps: actions in order.
        objects: words for things, which have no effect.
        unknown: words that are not understood, as the user typed them.
        corrected: maps each corrected word, as typed, to its correction.
        is_foreign: whether the sentence is not in English.
        nearest: if no action is understood, the three actions that are closest in meaning.
    """

    text: str
    steps: tuple[Step, ...] = ()
    objects: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    corrected: Mapping[str, str] = field(default_factory=dict)
    is_foreign: bool = False
    nearest: tuple[str, ...] = ()

    @property
    def mentions(self) -> list[Mention]:
        """All actions in order."""
        return [mention for step in self.steps for mention in step]
