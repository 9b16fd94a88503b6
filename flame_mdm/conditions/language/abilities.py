"""Actions and attributes that a model knows, derived from the facts in its file."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

from flame_mdm.conditions.language.meaning import nearest_to, similarity
from flame_mdm.conditions.language.morphology import inflections
from flame_mdm.conditions.language.parsing import understand
from flame_mdm.conditions.language.tables import Value, actions
from flame_mdm.conditions.language.understanding import Mention, Understanding
from flame_mdm.conditions.language.wording import caption, predicate

CHOICES: dict[str, tuple[Value, ...]] = {
    "direction": ("forward", "backward", "left", "right", "clockwise", "counterclockwise"),
    "speed": ("slow", "fast"),
    "count": (1, 2, 3, 4, 5),
    "side": ("left", "right", "both"),
}
"""Values of each attribute that a user can choose."""
WORDS_OF_VALUES: dict[Value, tuple[str, ...]] = {
    1: ("once", "one", "single", "a ", "1"),
    2: ("twice", "two", "2"),
    3: ("three", "thrice", "3"),
    4: ("four", "4"),
    5: ("five", "5"),
    "fast": ("fast", "quick", "brisk"),
    "slow": ("slow",),
    "forward": ("forward", "ahead", "straight"),
    "backward": ("back", "reverse"),
    "circle": ("circle",),
}
"""Word parts for each value of an attribute.

A caption that states the value contains one of these parts.
"""


class Abilities:
    """Actions and attributes that a model knows.

    Each of the model's captions must name one action from a list.

    Args:
        facts: the model's "actions", "vocabulary" and, if known, "captions".
    """

    def __init__(self, facts: Mapping[str, Any]):
        self.vocabulary = frozenset(facts["vocabulary"])
        self.captions: Sequence[str] = facts.get("captions", ())
        self.names: Sequence[str] = facts["actions"]
        self._supported: dict[tuple[str, str, Value], bool] = {}

    @cached_property
    def actions(self) -> list[str]:
        """Names of the actions that the model knows, as in `actions.yaml`."""
        listed: dict[str, None] = {}
        for name in self.names:
            plain = name.replace("_", " ").lower()
            named = [entry.name for entry in actions().values() if plain in entry.names]
            named = named or [mention.action for mention in understand(plain).mentions[:1]]
            listed |= dict.fromkeys(named)
        return [
            action for action in listed if self.has_words(actions()[action].say.format(side=""))
        ]

    @cached_property
    def is_simultaneous(self) -> bool:
        """Whether any of the model's captions describes two simultaneous actions."""
        marked = [
            text for text in self.captions if " while " in text or " at the same time" in text
        ]
        return any(len(step) > 1 for text in marked for step in understand(text).steps)

    def has_words(self, text: str) -> bool:
        """Returns whether all words of the text are in the vocabulary."""
        return all(word in self.vocabulary for word in text.replace("-", " ").split())

    def supports(self, action: str, name: str, value: Value) -> bool:
        """Returns whether the model knows the action with the given attribute value.

        A caption must state both the action and the value. If the facts contain no captions, the
        vocabulary must contain all words for the action and the value.
        """
        key = (action, name, value)
        if key not in self._supported:
            self._supported[key] = self._states(action, name, value)
        return self._supported[key]

    def _states(self, action: str, name: str, value: Value) -> bool:
        words = predicate(Mention(action, {name: value}))
        if not self.has_words(words):
            return False
        if not self.captions or name == "amount":
            return True
        if name == "count" and "steps" in actions()[action].takes:
            return False  # in captions, "takes two steps" means the same as "takes a few steps"

        verbs = {
            form for phrase in actions()[action].phrases for form in inflections(phrase.words[0])
        }
        parts = WORDS_OF_VALUES.get(value, (str(value),))
        for text in self.captions:
            if any(part in text for part in parts) and verbs & set(text.lower().split()):
                mentions = understand(text).mentions
                if any(
                    mention.action == action and mention.attributes.get(name) == value
                    for mention in mentions
                ):
                    return True
        return False

    def choices(self, action: str) -> dict[str, list[Value]]:
        """Returns the values that the model knows for each attribute of an action."""
        takes = actions()[action].takes
        listed = {
            name: [value for value in values if self.supports(action, name, value)]
            for name, values in CHOICES.items()
            if name in takes
        }
        return {name: values for name, values in listed.items() if values}

    def ranked(self, action: str) -> list[str]:
        """Returns the known actions, beginning with the one most similar to `action`."""
        return sorted(self.actions, key=lambda other: -similarity(action, other))

    def nearest(self, understood: Understanding) -> list[str]:
        """Returns captions for the three known actions that are closest in meaning to a sentence.

        The list is empty if none of the words has a known meaning.
        """
        names = [action for action in understood.nearest if action in self.actions]
        ranked = nearest_to([word for word in understood.text.lower().split() if word.isalpha()])
        names += [action for action, _ in ranked if action in self.actions and action not in names]
        return [caption((Mention(action),)) for action in names[:3]]
