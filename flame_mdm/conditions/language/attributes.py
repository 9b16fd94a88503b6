"""Attributes stated by the words around an action: side, count, direction, speed, and turn."""

from collections.abc import Collection, Sequence

from flame_mdm.conditions.language.morphology import base_forms
from flame_mdm.conditions.language.tables import ActionEntry, Value, phrases, word_values, words_of
from flame_mdm.conditions.language.tokens import Token

LEFT_OR_RIGHT = ("left", "right")
MEASURES = (
    "degree",
    "meter",
    "metre",
    "m",
    "second",
    "s",
    "foot",
    "mile",
    "step",
    "percent",
    "minute",
    "hour",
    "way",
)


class Reader:
    """Reads the attributes of one action from its clause.

    Args:
        entry: the action.
        tokens: words and punctuation marks of the sentence.
        numbers: indices of the tokens that belong to the action.
        verb: indices of the tokens in the phrase that names the action.
    """

    def __init__(
        self,
        entry: ActionEntry,
        tokens: Sequence[Token],
        numbers: Sequence[int],
        verb: Collection[int],
    ):
        self.entry, self.tokens, self.numbers, self.verb = entry, tokens, numbers, set(verb)
        self.used: set[int] = set()
        self.dropped: set[int] = set()
        self.attributes: dict[str, Value] = {}

    def read(self) -> dict[str, Value]:
        """Returns the attributes that the clause states and that the action can have.

        Afterward, `used` contains the tokens for these attributes, and `dropped` contains the
        tokens for attributes that the action cannot have.
        """
        for position, number in enumerate(self.numbers):
            word = self.tokens[number].word
            if word in (*LEFT_OR_RIGHT, "both") or word in ("hands", "arms", "fists"):
                self._read_side(position, number)
            if number not in self.verb:
                self._read_direction(number)
                self._read_speed(number)
            self._read_count(position, number)
        self._read_turn()
        return {name: value for name, value in self.attributes.items() if name in self.entry.takes}

    def _word(self, position: int) -> str:
        """Returns the word at a position in the clause, or "" if there is no such position."""
        return self.tokens[self.numbers[position]].word if 0 <= position < len(self.numbers) else ""

    def _state(self, name: str, value: Value, *numbers: int) -> None:
        self.attributes[name] = value
        if name in self.entry.takes:
            self.used |= set(numbers)
        elif name != "direction":
            self.dropped |= set(numbers)

    def _read_side(self, position: int, number: int) -> None:
        word, after = self.tokens[number].word, self._word(position + 1)
        if after in words_of("determiners"):
            after = self._word(position + 2)
        names_body = any(base in words_of("sides_of") for base in base_forms(after))
        if word == "both":
            if names_body or "hand" in self._word(position + 1):
                self._state("side", "both", number)
            return
        if word in ("hands", "arms", "fists"):
            if "side" not in self.attributes:
                self._state("side", "both")
            return
        is_handed = after == "handed" or (names_body and after not in ("hip", "hips", "side"))
        is_of_shoulder = "side" not in self.entry.takes and is_handed
        if is_of_shoulder and "direction" in self.entry.takes:
            if self._word(position + 1) in ("shoulder", "side"):
                self._state("direction", word, number)
            return
        before = self._word(position - 1)
        if before in words_of("determiners"):
            before = self._word(position - 2)
        if (
            is_handed
            or before in ("with", "using")
            or ("direction" not in self.entry.takes and before not in ("to", "turn"))
        ):
            self._state("side", word, number)

    def _read_direction(self, number: int) -> None:
        word = self.tokens[number].word
        value = word_values("direction").get(word)
        if value is None or number in self.used:
            return
        position = self.numbers.index(number)
        before, after = self._word(position - 1), self._word(position + 1)
        if value in ("up", "down") and "vertical" not in self.entry.takes:
            return
        if word == "back" and before in words_of("determiners"):
            return
        if value in LEFT_OR_RIGHT:
            after = self._word(position + 2) if after in words_of("determiners") else after
            if any(base in words_of("sides_of") - {"side"} for base in base_forms(after)):
                return
            if "side" in self.attributes and before in ("with", "using"):
                return
        self._state("direction", self._around(value), number)

    def _around(self, value: str) -> str:
        """Returns a direction, combined with the direction that the clause states earlier.

        In a circle, left is counterclockwise and right is clockwise.
        """
        earlier = str(self.attributes.get("direction", ""))
        turns = {"left": "counterclockwise", "right": "clockwise"}
        if earlier == "circle":
            return turns.get(value, value if value.endswith("clockwise") else "circle")
        if value == "circle":
            return turns.get(earlier, earlier if earlier.endswith("clockwise") else "circle")
        if earlier.endswith("clockwise") and value in ("forward", *LEFT_OR_RIGHT):
            return earlier
        return value

    def _read_speed(self, number: int) -> None:
        value = word_values("speed").get(self.tokens[number].word)
        if value is not None:
            self._state("speed", value, number)

    def _read_count(self, position: int, number: int) -> None:
        word = self.tokens[number].word
        tables = phrases()
        if word in tables["times"]:
            if not self._is_connector(position):
                self._state("count", tables["times"][word], number)
            return
        if word == "x" and self._word(position + 1).isdecimal():
            self._state("count", int(self._word(position + 1)), number, self.numbers[position + 1])
            return
        count = int(word) if word.isdecimal() and len(word) < 4 else tables["numbers"].get(word)
        if word in ("a", "an", "the") or (word == "couple" and self._word(position + 1) == "of"):
            count = 2 if word == "couple" else None
        if count is None:
            return
        following = [self._word(position + ahead) for ahead in (1, 2, 3, 4)]
        following = [after for after in following if after not in ("of", "more")]
        if following and following[0] in ("time", "times", "x", "repetitions", "reps"):
            self._state("count", count, number)
            return
        if following and any(base in MEASURES for base in base_forms(following[0])):
            if "step" in base_forms(following[0]):
                self._state("count", count, number)
            return
        if any(
            base in words_of("sides_of") for after in following[:2] for base in base_forms(after)
        ):
            return
        if self._names_action(position):
            self._state("count", count, number)

    def _is_connector(self, position: int) -> bool:
        """Returns whether "once" begins a clause, as in "once they have looked around"."""
        subjects = words_of("people") | words_of("determiners")
        return self._word(position) == "once" and self._word(position + 1) in subjects

    def _names_action(self, position: int) -> bool:
        """Returns whether the action is a noun after a number, as in "five quick push-ups"."""
        ahead = [
            self.numbers[position + step]
            for step in (1, 2, 3)
            if position + step < len(self.numbers)
        ]
        return any(number in self.verb for number in ahead)

    def _read_turn(self) -> None:
        if "amount" not in self.entry.takes:
            return
        words = [self.tokens[number].word for number in self.numbers]
        if "180" in words or "half" in words or ("around" in words and "look" not in words):
            self.attributes["amount"] = "half"
        elif "quarter" in words or "90" in words:
            self.attributes["amount"] = "quarter"
