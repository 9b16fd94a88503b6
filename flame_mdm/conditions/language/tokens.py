"""Splits sentences into words, corrects typos, and detects other languages."""

import re
import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache

from flame_mdm.conditions.language.meaning import SIMILAR, nearest_actions
from flame_mdm.conditions.language.morphology import base_forms, inflections
from flame_mdm.conditions.language.spelling import action_words, corrections, distance
from flame_mdm.conditions.language.tables import phrases, word_values, words_of
from flame_mdm.conditions.language.vectors import word_table

TOKEN = re.compile(r"(?:anti|counter)[- ]?clockwise|\d+|[^\W\d_]+|[.,;:!?|\n]", re.IGNORECASE)
HYPHEN = re.compile("[- ]")
# In a sentence without an action, a real word may be a typo of an action if its frequency rank is
# at least this number.
RARE = 12_000


@dataclass(frozen=True)
class Token:
    """A word or a punctuation mark.

    Attributes:
        typed: the word as the user typed it.
        word: the word in lower case, with typos corrected.
        start, end: position of the token in the sentence.
    """

    typed: str
    word: str
    start: int
    end: int

    @property
    def is_word(self) -> bool:
        """Whether the token is a word rather than a punctuation mark."""
        return self.typed[0].isalnum()


def tokenize(text: str) -> list[Token]:
    """Splits a sentence into words and punctuation marks."""
    matches = TOKEN.finditer(text)
    return [
        Token(match[0], HYPHEN.sub("", match[0].lower()), match.start(), match.end())
        for match in matches
    ]


def is_known(word: str) -> bool:
    """Returns whether any form of a word is in the tables or is frequent in English."""
    if word.isdecimal() or word in _listed():
        return True
    # Base forms with three or fewer letters do not count, because most of these words are names,
    # such as "tims"
    return any(form == word or len(form) > 3 for form in base_forms(word) if word_table().has(form))


def is_foreign(tokens: Sequence[Token]) -> bool:
    """Returns whether a sentence is not in English.

    A sentence is foreign if most of its letters are not Latin. It is also foreign if fewer than
    half of its words are English and, in addition, one of its words has an accent or is typical of
    another language. `phrases.yaml` lists the words that are typical of other languages. Words that
    also occur in English do not count as typical of another language.
    """
    words = [token.word for token in tokens if token.is_word]
    letters = [char for word in words for char in word if char.isalpha()]
    if sum("LATIN" not in unicodedata.name(char, "") for char in letters) * 2 > len(letters) > 0:
        return True
    if not words:
        return False
    listed = [word in _listed() for word in words]
    typical = max(([word in marks for word in words] for marks in _foreign().values()), key=sum)
    foreign = [
        is_typical and not is_listed for is_typical, is_listed in zip(typical, listed, strict=True)
    ]
    accents = [not word.isascii() for word in words]
    if not any(foreign) and not any(accents):
        return False
    marks = zip(words, foreign, accents, strict=True)
    english = [
        is_english(word) for word, is_marked, is_accented in marks if not (is_marked or is_accented)
    ]
    return sum(english) * 2 < len(words)


def is_english(word: str) -> bool:
    """Returns whether a word is frequent, or is a form or misspelling of a word in the tables."""
    rank = word_table().rank(word)
    is_frequent = rank is not None and rank < RARE
    return (
        is_frequent
        or any(form in _listed() for form in base_forms(word))
        or bool(corrections(word))
    )


def corrected(tokens: Sequence[Token]) -> list[Token]:
    """Returns the tokens with typos corrected.

    An unknown word counts as a typo if it is similar to only a few known words.
    """
    return [
        _corrected(token) if token.is_word and not is_known(token.word) else token
        for token in tokens
    ]


def corrected_to_action(tokens: Sequence[Token], free: Collection[int]) -> list[Token]:
    """Replaces one rare word with a word for an action if the two words differ by one letter.

    This function is used for sentences in which no action is understood, such as "doge to the
    left".

    Args:
        tokens: words and punctuation marks of the sentence.
        free: indices of the words that may be replaced.
    """
    for number in free:
        token = tokens[number]
        rank = word_table().rank(token.word)
        if len(token.word) < 3 or (rank is not None and rank < RARE):
            continue
        meant = nearest_actions(token.word)
        if meant and meant[0][1] >= SIMILAR:
            continue
        near = [
            word
            for word in sorted(action_words())
            if len(word) > 2 and distance(token.word, word, 1) == 1
        ]
        starts = [word for word in near if word[0] == token.word[0]]
        if starts:
            return [*tokens[:number], _read_as(token, starts[0]), *tokens[number + 1 :]]
    return list(tokens)


def _corrected(token: Token) -> Token:
    near = corrections(token.word)
    meanings = {base_forms(word)[-1] if word in action_words() else word for word in near}
    if not near or len(meanings) > 3:
        return token
    return _read_as(token, near[0])


def _read_as(token: Token, word: str) -> Token:
    return Token(token.typed, word, token.start, token.end)


@cache
def _listed() -> frozenset[str]:
    """Returns the words of all tables, with the forms of verbs and nouns."""
    tables = phrases()
    words = (
        set(action_words())
        | set(tables["numbers"])
        | set(tables["times"])
        | set(tables["speed_again"])
    )
    for key in ("direction", "speed"):
        words |= set(word_values(key))
    for key in ("people", "function", "objects", "body"):
        words |= {form for word in words_of(key) for form in inflections(word)[:2]}
    return frozenset(words)


@cache
def _foreign() -> dict[str, frozenset[str]]:
    return {language: words_of("foreign", language) for language in phrases()["foreign"]}
