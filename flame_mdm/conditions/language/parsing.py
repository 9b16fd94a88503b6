"""Parses sentences into the requested actions, their order and their attributes."""

from collections.abc import Sequence
from functools import lru_cache

from flame_mdm.conditions.language import clauses as parts
from flame_mdm.conditions.language.attributes import Reader
from flame_mdm.conditions.language.clauses import AFTER, BEFORE, WHILE, Clause
from flame_mdm.conditions.language.matching import Match, find_phrases
from flame_mdm.conditions.language.meaning import SIMILAR, is_thing, nearest_actions, nearest_to
from flame_mdm.conditions.language.morphology import base_forms
from flame_mdm.conditions.language.tables import Phrase, actions, phrases, word_values, words_of
from flame_mdm.conditions.language.tokens import (
    Token,
    corrected,
    corrected_to_action,
    is_foreign,
    tokenize,
)
from flame_mdm.conditions.language.understanding import Mention, Step, Understanding

# Number of actions to suggest if no action is understood
NEAREST = 3


@lru_cache(4096)
def understand(text: str) -> Understanding:
    """Returns the actions that a sentence requests, and the words that are not understood."""
    typed = tokenize(text)
    if is_foreign(typed):
        return Understanding(text, is_foreign=True)

    tokens = corrected(typed)
    matches = find_phrases(tokens)
    if not matches:
        free = [
            number
            for number, token in enumerate(tokens)
            if token.is_word and not is_explained(token.word)
        ]
        tokens = corrected_to_action(tokens, free)
        matches = find_phrases(tokens)

    sentence = _Sentence(text, tokens, matches)
    steps = sentence.steps()
    objects, unknown = sentence.rest()
    changed = {token.typed: token.word for token in tokens if token.typed.lower() != token.word}
    nearest = () if steps else _nearest(tokens)
    return Understanding(text, tuple(steps), objects, unknown, changed, nearest=nearest)


def is_explained(word: str) -> bool:
    """Returns whether a word is in a table of words that are not actions."""
    if (
        word.isdecimal()
        or word in phrases()["numbers"]
        or word in phrases()["times"]
        or word == "x"
    ):
        return True
    if word in word_values("direction") or word in word_values("speed"):
        return True
    listed = words_of("people") | words_of("function") | words_of("body") | words_of("objects")
    return any(base in listed for base in base_forms(word))


def _nearest(tokens: Sequence[Token]) -> tuple[str, ...]:
    """Returns the actions that are closest in meaning to the unknown words of a sentence.

    If there are no unknown words, all words are used.
    """
    words = [token.word for token in tokens if token.is_word]
    free = [word for word in words if not is_explained(word)] or words
    return tuple(action for action, _ in nearest_to(free)[:NEAREST])


class _Sentence:
    """Finds the actions in a sentence from its tokens and from the phrases that name actions."""

    def __init__(self, text: str, tokens: Sequence[Token], matches: Sequence[Match]):
        self.text, self.tokens = text, tokens
        self.used: set[int] = set()
        self.dropped: set[int] = set()
        self.verbs: set[int] = set()
        self.typed: dict[int, str] = {}
        self.clauses = parts.split(tokens, matches)
        for clause in self.clauses:
            self._choose(clause)
        self.clauses = parts.joined(self.clauses)

    def steps(self) -> list[Step]:
        """Returns the actions in the order in which they happen."""
        steps: list[Step] = []
        # Actions of "While walking,", which are added to the following clause
        during: list[Step] = []
        # Actions of "Before sitting down,", which happen after the following clause
        later: list[Step] = []
        for clause in self.clauses:
            added = self._actions(clause, steps)
            if not added:
                continue
            if clause.link == WHILE and clause.is_first:
                during = added
                continue
            if clause.link == BEFORE and clause.is_first:
                later = added
                continue

            if during:
                added, during = [*during[:-1], (*during[-1], *added[0]), *added[1:]], []
            if steps and (clause.link == WHILE or self._is_manner(clause, steps)):
                steps[-1:] = [(*steps[-1], *added[0]), *added[1:]]
            elif steps and clause.link == AFTER and not clause.is_first:
                steps[-1:-1] = added
            elif steps and not clause.link and _is_same(steps[-1], added[0]):
                (before,), (again,) = steps[-1], added[0]
                steps[-1:] = [(before.stating(**again.attributes),), *added[1:]]
            else:
                steps += added
            steps, later = steps + later, []
        return [_without_idle(step) for step in steps + during + later]

    def rest(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Returns the words for things, and the words that are not understood.

        Words that are not understood are returned as the user typed them.
        """
        objects, unknown = [], []
        for number, token in enumerate(self.tokens):
            if not token.is_word or number in self.verbs:
                continue
            if number in self.dropped:
                unknown.append(token.typed)
            elif any(base in words_of("objects") for base in base_forms(token.word)):
                objects.append(token.word)
            elif number in self.used:
                continue
            elif not is_explained(token.word):
                listed = objects if self._is_noun(number) and is_thing(token.word) else unknown
                listed.append(token.word if listed is objects else token.typed)
        return tuple(dict.fromkeys(objects)), tuple(dict.fromkeys(unknown))

    def _choose(self, clause: Clause) -> None:
        """Reduces the matches of a clause to the phrases that name its actions.

        If there are no such phrases, a word that is similar in meaning to an action is used.
        """
        strong = [match for match in clause.matches if not match.is_weak]
        if strong:
            clause.matches = strong
            return
        if all(self._is_noun(match.first) for match in clause.matches):
            meant = self._by_meaning(clause)
            clause.matches = [meant] if meant else clause.matches
        verbs = [match for match in clause.matches if not self._is_noun(match.first)]
        clause.matches = (verbs or clause.matches)[-1:]

    def _by_meaning(self, clause: Clause) -> Match | None:
        candidates = []
        for number in clause.numbers:
            word = self.tokens[number].word
            if self._is_noun(number) or is_explained(word) or is_thing(word) or word.endswith("ly"):
                continue
            nearest = nearest_actions(word)
            if nearest and nearest[0][1] >= SIMILAR:
                candidates.append((nearest[0][1], number, nearest[0][0]))
        if not candidates:
            return None
        _, number, action = max(candidates)
        self.typed[number] = self.tokens[number].word
        return Match(Phrase((self.tokens[number].word,), action), (number,), False)

    def _is_noun(self, number: int) -> bool:
        """Returns whether an article or a preposition precedes a word."""
        before = self.tokens[number - 1].word if number else ""
        return before in words_of("determiners") | words_of("prepositions")

    def _actions(self, clause: Clause, steps: Sequence[Step]) -> list[Step]:
        """Returns the actions of a clause, and records the words that state them."""
        if not clause.matches:
            return self._again(clause, steps)
        added: list[Step] = []
        starts = [match.first for match in clause.matches[1:]]
        for position, match in enumerate(clause.matches):
            begin = 0 if position == 0 else match.first
            end = starts[position] if position < len(starts) else len(self.tokens)
            numbers = [number for number in clause.numbers if begin <= number < end]
            mention = self._mention(match, numbers)
            if added and _is_same(added[-1], (mention,)):
                added[-1] = (added[-1][0].stating(**mention.attributes),)
            elif added and self.tokens[match.first].word.endswith("ing"):
                added[-1] = (*added[-1], mention)
            else:
                added.append((mention,))
        return added

    def _mention(self, match: Match, numbers: Sequence[int]) -> Mention:
        reader = Reader(actions()[match.phrase.action], self.tokens, numbers, match.used)
        stated = {**match.phrase.attributes, **reader.read()}
        self.used |= reader.used | set(match.used)
        self.dropped |= reader.dropped
        self.verbs.add(match.first)
        first, last = self.tokens[match.first], self.tokens[match.last]
        return Mention(
            match.phrase.action,
            stated,
            self._words(numbers),
            first.start,
            last.end,
            self.typed.get(match.first, ""),
        )

    def _again(self, clause: Clause, steps: Sequence[Step]) -> list[Step]:
        """Returns the previous action with the attributes of a clause such as "then faster"."""
        if not steps or len(steps[-1]) > 1:
            return []
        before = steps[-1][0]
        reader = Reader(actions()[before.action], self.tokens, clause.numbers, ())
        stated = reader.read()
        self.used |= reader.used
        if not stated:
            return []
        verb = self.text[before.start : before.end]
        words = f"{verb} {self._words(clause.numbers)}"
        return [
            (
                Mention(
                    before.action, {**before.attributes, **stated}, words, before.start, before.end
                ),
            )
        ]

    def _is_manner(self, clause: Clause, steps: Sequence[Step]) -> bool:
        """Returns whether a clause adds to the previous action, as in "stands still, waving"."""
        if clause.link or not clause.after_comma or not clause.matches:
            return False
        before = steps[-1][0]
        verb = self.tokens[clause.matches[0].first]
        preceded = [number for number in clause.numbers if number < clause.matches[0].first]
        if preceded or not verb.word.endswith("ing"):
            return False
        return before.action == "idle" or not self.text[before.start : before.end].lower().endswith(
            "ing"
        )

    def _words(self, numbers: Sequence[int]) -> str:
        """Returns the words of a clause as the user typed them."""
        words: list[str] = []
        for number in numbers:
            token = self.tokens[number]
            if words and self.tokens[number - 1].end == token.start:
                words[-1] += token.typed
            else:
                words.append(token.typed)
        return " ".join(words)


def _is_same(step: Step, other: Step) -> bool:
    """Returns whether two steps name the same action with compatible attributes."""
    if len(step) > 1 or len(other) > 1 or step[0].action != other[0].action:
        return False
    first, second = step[0].attributes, other[0].attributes
    return all(first[name] == second[name] for name in first.keys() & second.keys())


def _without_idle(step: Step) -> Step:
    """Removes duplicate actions.

    If the step contains another action, "stands still" is also removed.
    """
    moving = [mention for mention in step if mention.action != "idle"] or step[:1]
    return tuple({mention.action: mention for mention in moving}.values())
