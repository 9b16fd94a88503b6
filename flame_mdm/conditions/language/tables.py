"""Tables of words: `actions.yaml` for actions and `phrases.yaml` for all other words."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from flame_mdm.safe_io import read_package_yaml

Value = str | int
GAP = "..."


@dataclass(frozen=True)
class Phrase:
    """Words that name an action.

    Attributes:
        words: base forms of the words; `GAP` stands for up to four arbitrary words.
        action: name of the action.
        attributes: attributes that the phrase states.
    """

    words: tuple[str, ...]
    action: str
    attributes: Mapping[str, Value] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """The number of words, not counting gaps."""
        return len(self.words) - self.words.count(GAP)


@dataclass(frozen=True)
class ActionEntry:
    """An action, with the attributes that it can have and the words that describe it in captions.

    `actions.yaml` describes the fields.
    """

    name: str
    phrases: tuple[Phrase, ...]
    takes: frozenset[str]
    say: str
    part: str = "hand"
    ways: Mapping[str, str] = field(default_factory=dict)
    usual: str = ""
    joins: tuple[str, ...] = ()
    before_side: str = "with"
    names: tuple[str, ...] = ()
    like: tuple[Phrase, ...] = ()


@cache
def phrases() -> dict[str, Any]:
    """Returns the contents of `phrases.yaml`."""
    return read_package_yaml(Path(__file__).with_name("phrases.yaml"))


@cache
def words_of(*keys: str) -> frozenset[str]:
    """Returns the words in a list of `phrases.yaml`.

    Several keys select a nested list: `words_of("speed", "slow")`.
    """
    entry: Any = phrases()
    for key in keys:
        entry = entry[key]
    return frozenset(entry.split())


@cache
def word_values(key: str) -> dict[str, str]:
    """Returns a mapping from each word in a table to the value that the word states.

    For example, `word_values("speed")["slowly"]` is "slow".
    """
    return {word: value for value, listed in phrases()[key].items() for word in listed.split()}


@cache
def actions() -> dict[str, ActionEntry]:
    """Returns the actions, keyed by name."""
    content = read_package_yaml(Path(__file__).with_name("actions.yaml"))
    return {name: _entry(name, values) for name, values in content.items()}


@cache
def phrases_by_first_word() -> dict[str, list[Phrase]]:
    """Returns the phrases that name actions, grouped by first word. Longer phrases come first."""
    listed_at: dict[str, list[Phrase]] = {}
    for entry in actions().values():
        for phrase in entry.phrases:
            listed_at.setdefault(phrase.words[0], []).append(phrase)
    for listed in listed_at.values():
        listed.sort(key=lambda phrase: -phrase.size)
    return listed_at


def _entry(name: str, values: Mapping[str, Any]) -> ActionEntry:
    listed = (phrase.strip() for phrase in values["words"].split(","))
    return ActionEntry(
        name=name,
        phrases=tuple(_phrase(phrase, name) for phrase in listed),
        takes=frozenset(values.get("takes", ())),
        say=values["say"],
        part=values.get("part", "hand"),
        ways=values.get("ways", {}),
        usual=values.get("usual", ""),
        joins=tuple(values.get("joins", ())),
        before_side="on" if values.get("on") else "with",
        names=(name, *values.get("names", ())),
        like=tuple(_like(phrase) for phrase in values.get("like", ())),
    )


def _phrase(text: str, action: str) -> Phrase:
    parts = text.replace("-", " ").replace("'", " ").split()
    stated = dict(part.split("=") for part in parts if "=" in part)
    return Phrase(tuple(part for part in parts if "=" not in part), action, stated)


def _like(text: str) -> Phrase:
    """Parses a similar action and its required attributes, such as "walk speed=slow"."""
    parts = text.split()
    name = " ".join(part for part in parts if "=" not in part)
    return Phrase((name,), name, dict(part.split("=") for part in parts if "=" in part))
