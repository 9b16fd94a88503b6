"""Converts sentences to captions that a model knows, and lists the ignored words."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import Any

from flame_mdm.conditions.language.abilities import Abilities
from flame_mdm.conditions.language.parsing import understand
from flame_mdm.conditions.language.tables import Value, actions
from flame_mdm.conditions.language.understanding import Mention, Step, Understanding
from flame_mdm.conditions.language.wording import attribute_words, caption, predicate
from flame_mdm.errors import UserError, shortened

ATTRIBUTES = ("direction", "amount", "speed", "count", "side")
# Maximum number of repetitions that are sampled as several parts
LONGEST_COUNT = 12
# Seconds that a motion takes for its start and end together, and for each stated repetition
START_AND_END, REPETITION = 0.8, 0.7


@dataclass(frozen=True)
class Reading:
    """A sentence as a model reads it.

    Attributes:
        understanding: the content of the sentence, as far as it is understood.
        steps: the actions to sample, in order. The model knows all of them.
        captions: the caption that the model reads for each step.
        texts: the words of the sentence that describe each step.
        changes: one line per difference between the sentence and the sampled motion.
        ignored: words and descriptions of attributes that have no effect on the motion.
    """

    understanding: Understanding
    steps: tuple[Step, ...]
    captions: tuple[str, ...]
    texts: tuple[str, ...]
    changes: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()

    def summary(self) -> str:
        """Returns a summary of the actions, such as "walks forward, then waves twice"."""
        if not self.steps:
            return self.texts[0]
        return ", then ".join(
            " + ".join(predicate(mention) for mention in step) for step in self.steps
        )

    def seconds(self) -> tuple[float | None, ...]:
        """Returns a duration in seconds for each step, or None for steps without a stated count."""
        counts = [
            step[0].attributes.get("count") if len(step) == 1 else None for step in self.steps
        ]
        return tuple(
            None if count is None else START_AND_END + REPETITION * int(count) for count in counts
        )

    def warnings(self) -> list[str]:
        """Returns lines that describe how the sampled motion differs from the sentence."""
        ignored = [f"not understood: {', '.join(self.ignored)}"] if self.ignored else []
        return [*self.changes, *ignored]


class Reader:
    """Reads sentences for a model.

    Each of the model's captions must name one action from a list.

    Args:
        facts: the model's "actions", "vocabulary" and, if known, "captions".
    """

    def __init__(self, facts: Mapping[str, Any]):
        self.abilities = Abilities(facts)

    @staticmethod
    def fits(facts: Mapping[str, Any]) -> bool:
        """Returns whether a model's facts show that its captions describe single actions."""
        return (
            bool(facts.get("verbs"))
            and bool(facts.get("actions"))
            and bool(facts.get("vocabulary"))
        )

    def read(self, text: str) -> Reading:
        """Returns a sentence as the model reads it.

        A training caption is passed to the model unchanged if it names an action outside the
        model's list. The same applies to a sentence in which no action is understood, provided that
        the model's vocabulary contains all unknown words of the sentence.

        Raises:
            UserError: If the sentence is not English, or names an action that the model does not
                know.
        """
        sentence, style = _without_style(text)
        understood = understand(sentence)
        if understood.is_foreign:
            raise UserError(
                f"{_shown(text)}: only English prompts are supported. Write the prompt in English"
            )
        as_typed = Reading(understood, (), (text,), (text,))
        if not understood.steps:
            if understood.unknown and self.abilities.has_words(" ".join(understood.unknown)):
                return as_typed
            raise NotUnderstood(
                f"{_shown(text)}: no word says what happens",
                self.abilities.nearest(understood),
            )

        try:
            return self._read_steps(understood, text, style)
        except NotUnderstood:
            if sentence not in self.abilities.captions:
                raise
            return as_typed

    def _read_steps(self, understood: Understanding, text: str, style: str) -> Reading:
        """Returns the actions of a sentence as captions.

        Raises:
            NotUnderstood: If there is an action that the model does not know.
        """
        notes = _Notes(
            [f"'{typed}' is read as '{word}'" for typed, word in understood.corrected.items()]
        )
        notes.ignored += understood.unknown
        steps: list[Step] = []
        texts: list[str] = []
        for step in _joined(understood.steps, self.abilities.actions):
            read = tuple(self._mention(mention, text, notes) for mention in step)
            parts = [
                part for one in self._possible(read, notes) for part in self._repeated(one, notes)
            ]
            steps += parts
            texts += (
                [read[0].text]
                if len(parts) == len(step) == 1
                else [caption(part) for part in parts]
            )

        special = {word.lower() for word in understood.unknown} & self.abilities.vocabulary
        captions = [
            f"{_caption(step, words, special)}{style}"
            for step, words in zip(steps, texts, strict=True)
        ]
        ignored = tuple(
            word for word in dict.fromkeys(notes.ignored) if word.lower() not in special
        )
        changes = tuple(dict.fromkeys(notes.changes))
        return Reading(understood, tuple(steps), tuple(captions), tuple(texts), changes, ignored)

    def _mention(self, mention: Mention, text: str, notes: "_Notes") -> Mention:
        """Reduces a mention to an action and attributes that the model knows."""
        action, attributes = self._known_action(mention)
        if action is None:
            nearest = [
                caption((Mention(name),)) for name in self.abilities.ranked(mention.action)[:3]
            ]
            raise NotUnderstood(
                f"{_shown(text)}: the model does not know '{predicate(Mention(mention.action))}'",
                nearest,
            )

        if mention.typed:
            notes.changes.append(f"'{mention.typed}' is read as '{predicate(Mention(action))}'")
        elif action != mention.action:
            instead = predicate(Mention(action, attributes))
            notes.changes.append(
                f"the model does not know '{predicate(Mention(mention.action))}': the person "
                f"{instead} instead"
            )
        stated = dict(attributes)
        for name in ATTRIBUTES:
            if name not in mention.attributes:
                continue
            value = mention.attributes[name]
            takes = actions()[action].takes
            # `_repeated` splits counts that the model does not know.
            is_repetition = name == "count" and name in takes and "steps" not in takes
            if is_repetition or (name in takes and self.abilities.supports(action, name, value)):
                stated[name] = value
            elif name not in attributes and (name, value) != ("speed", "normal"):
                unit = " steps" if name == "count" and "steps" in takes else ""
                notes.ignored.append(f"{value}{unit}" if unit else attribute_words(name, value))
        return replace(mention, action=action, attributes=stated)

    def _known_action(self, mention: Mention) -> tuple[str | None, dict[str, Value]]:
        """Returns a known action and the attributes that it requires.

        If the model does not know the action itself, a nearly equivalent action is returned, or
        None if there is no such action.
        """
        if mention.action in self.abilities.actions:
            return mention.action, {}
        for like in actions()[mention.action].like:
            if like.action in self.abilities.actions:
                return like.action, dict(like.attributes)
        return None, {}

    def _possible(self, step: Step, notes: "_Notes") -> list[Step]:
        """Returns steps that the model can sample in place of the given step.

        If none of the model's captions describes simultaneous actions, the actions are sampled one
        after the other.
        """
        distinct = tuple({mention.action: mention for mention in step}.values())
        if len(distinct) == 1 or self.abilities.is_simultaneous:
            return [distinct]
        both = " and ".join(f"'{predicate(mention)}'" for mention in distinct)
        notes.changes.append(
            f"the model cannot do {both} at the same time: they are sampled one after the other"
        )
        return [(mention,) for mention in distinct]

    def _repeated(self, step: Step, notes: "_Notes") -> list[Step]:
        """Returns steps whose counts add up to the count of the given step.

        For example, "kicks four times" becomes two steps of "kicks twice".
        """
        mention, *others = step
        count = mention.attributes.get("count")
        if count is None or others or self.abilities.supports(mention.action, "count", count):
            return [step]
        counts = [n for n in (3, 2, 1) if self.abilities.supports(mention.action, "count", n)]
        if not counts or int(count) > LONGEST_COUNT:
            notes.ignored.append(attribute_words("count", count))
            rest = {name: value for name, value in mention.attributes.items() if name != "count"}
            return [(replace(mention, attributes=rest),)]
        repeats: list[int] = []
        while (missing := int(count) - sum(repeats)) > 0:
            repeats.append(next(n for n in [*counts, missing] if n <= missing))
        notes.changes.append(
            f"{attribute_words('count', count)} is sampled as {' + '.join(map(str, repeats))}"
        )
        return [(mention.stating(count=n),) for n in repeats]


class NotUnderstood(UserError):
    """Error for a sentence without an action that the model knows.

    `nearest` contains captions for the known actions that are closest in meaning.
    """

    def __init__(self, message: str, nearest: Sequence[str]):
        suggested = " or ".join(f"'{text}'" for text in nearest)
        super().__init__(
            f"{message}. Nearest in meaning: {suggested}"
            if nearest
            else f"{message}. Name an action"
        )
        self.message = message
        self.nearest = tuple(nearest)


@dataclass
class _Notes:
    """Changes to a sentence, and words without effect. Both are collected during reading."""

    changes: list[str]
    ignored: list[str] = field(default_factory=list)


def _joined(steps: Sequence[Step], names: Sequence[str]) -> list[Step]:
    """Merges pairs of successive steps that the model knows as a single action.

    For example, "stretches both arms and leans to the left" becomes one step.
    """
    pairs = {
        entry.joins: entry.name
        for entry in actions().values()
        if entry.joins and entry.name in names
    }
    joined: list[Step] = []
    for step in steps:
        before = joined[-1] if joined else ()
        pair = tuple(mention.action for mention in (*before, *step))
        if pair in pairs and len(before) == 1:
            text = f"{before[0].text} and {step[0].text}"
            attributes = {**before[0].attributes, **step[0].attributes}
            taken = {
                name: value
                for name, value in attributes.items()
                if name in actions()[pairs[pair]].takes
            }
            joined[-1] = (replace(step[0], action=pairs[pair], attributes=taken, text=text),)
        else:
            joined.append(step)
    return joined


def _shown(text: str) -> str:
    return f"'{shortened(text, 60)}'"


def _caption(step: Step, words: str, special: Set[str]) -> str:
    """Returns the caption for a step.

    If one of the step's words is in the model's vocabulary but not in the tables, the caption
    consists of the step's own words.
    """
    return words if special & set(words.lower().split()) else caption(step)


def _without_style(text: str) -> tuple[str, str]:
    """Returns a sentence without its style, and the style, such as "in limp style".

    Adapters teach such styles. If the sentence states no style, the second result is "".
    """
    before, separator, style = text.rstrip(" .").rpartition(" in ")
    if separator and style.endswith(" style") and style.count(" ") == 1:
        return before, f" in {style}"
    return text, ""
