"""Phrases in a sentence that name actions."""

from collections.abc import Sequence
from dataclasses import dataclass

from flame_mdm.conditions.language.morphology import base_forms
from flame_mdm.conditions.language.tables import GAP, Phrase, phrases_by_first_word, words_of
from flame_mdm.conditions.language.tokens import Token

# Maximum number of words in the gap of a phrase
LONGEST_GAP = 4
WEAK_PHRASES = (("stand", "still"), ("take", "step"), ("stand", "around"), ("stand", "there"))
"""Phrases of several words that count as actions only if the sentence has no other action."""


@dataclass(frozen=True)
class Match:
    """A phrase in a sentence that names an action.

    Attributes:
        phrase: the phrase.
        used: indices of the tokens that form the phrase, in increasing order.
        is_weak: whether the phrase, such as "go", counts as an action only if the sentence contains
            no other action.
    """

    phrase: Phrase
    used: tuple[int, ...]
    is_weak: bool

    @property
    def first(self) -> int:
        """Index of the first token."""
        return self.used[0]

    @property
    def last(self) -> int:
        """Index of the last token."""
        return self.used[-1]


def find_phrases(tokens: Sequence[Token]) -> list[Match]:
    """Finds the phrases in a sentence that name actions.

    If several phrases begin at a word, the longest one is used. Phrases do not overlap.
    """
    matches: list[Match] = []
    number = 0
    while number < len(tokens):
        used, phrase = _longest_at(tokens, number)
        if phrase is None or _is_connective(tokens, number):
            number += 1
            continue
        if not _is_negated(tokens, number):
            matches.append(Match(phrase, used, _is_weak(tokens, used, phrase)))
        number = used[-1] + 1
    return matches


def _longest_at(tokens: Sequence[Token], start: int) -> tuple[tuple[int, ...], Phrase | None]:
    listed = [
        phrase
        for base in base_forms(tokens[start].word)
        for phrase in phrases_by_first_word().get(base, ())
    ]
    listed.sort(key=lambda phrase: -phrase.size)
    for phrase in listed:
        used = _match(tokens, start, phrase.words)
        if used is not None:
            return used, phrase
    return (), None


def _match(tokens: Sequence[Token], start: int, words: Sequence[str]) -> tuple[int, ...] | None:
    """Returns the indices of the tokens that match a phrase at `start`, or None if none do."""
    if not words:
        return ()
    if words[0] == GAP:
        for skipped in range(LONGEST_GAP + 1):
            if any(not token.is_word for token in tokens[start : start + skipped]):
                return None
            used = _match(tokens, start + skipped, words[1:])
            if used is not None:
                return used
        return None
    if start >= len(tokens) or not tokens[start].is_word:
        return None
    if words[0] in base_forms(tokens[start].word):
        rest = _match(tokens, start + 1, words[1:])
        return None if rest is None else (start, *rest)
    if tokens[start].word in words_of("determiners"):
        return _match(tokens, start + 1, words)
    return None


def _is_connective(tokens: Sequence[Token], number: int) -> bool:
    """Returns whether a word begins "followed by", which states an order and not an action."""
    return [token.word for token in tokens[number : number + 2]] == ["followed", "by"]


def _is_negated(tokens: Sequence[Token], number: int) -> bool:
    return (
        number > 0
        and tokens[number - 1].word in words_of("negation")
        and tokens[number].word != "not"
    )


def _is_weak(tokens: Sequence[Token], used: Sequence[int], phrase: Phrase) -> bool:
    """Returns whether a match is weak.

    A weak match is a general verb, such as "go", or a noun after an article, such as "the guard".
    """
    if phrase.size > 1:
        return phrase.words in WEAK_PHRASES
    before = tokens[used[0] - 1].word if used[0] else ""
    return phrase.words[0] in words_of("weak") or before in words_of("determiners")
