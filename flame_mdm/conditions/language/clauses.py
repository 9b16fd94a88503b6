"""The clauses of a sentence, and their order in time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from flame_mdm.conditions.language.matching import Match
from flame_mdm.conditions.language.tables import words_of
from flame_mdm.conditions.language.tokens import Token

THEN, WHILE, BEFORE, AFTER = "then", "while", "before", "after"
CONNECTORS = {
    ("at", "the", "same", "time"): WHILE,
    ("in", "the", "meantime"): WHILE,
    ("after", "that"): THEN,
    ("followed", "by"): THEN,
    ("then",): THEN,
    ("afterwards",): THEN,
    ("afterward",): THEN,
    ("next",): THEN,
    ("finally",): THEN,
    ("lastly",): THEN,
    ("later",): THEN,
    ("until",): THEN,
    ("till",): THEN,
    ("before",): BEFORE,
    ("after",): AFTER,
    ("once",): AFTER,
    ("when",): AFTER,
    ("while",): WHILE,
    ("whilst",): WHILE,
    ("as",): WHILE,
    ("simultaneously",): WHILE,
    ("meanwhile",): WHILE,
}
"""Words that state the order of two clauses. Longer connectors come first."""
AT_THE_END = {
    (word,)
    for word in ("simultaneously", "meanwhile", "at", "in", "afterwards", "afterward", "later")
}
"""First words of connectors that may also be at the end of their clause."""
NEED_SUBJECT = ("once", "as")
"""Connectors that only occur before a subject: "once they have", but not "jumps once"."""
NEED_CLAUSE = ("next", "later")
"""Connectors that only occur at the beginning of a clause, unlike in "next to the table"."""


@dataclass
class Clause:
    """Consecutive words of a sentence.

    Attributes:
        numbers: indices of the tokens in the clause.
        link: when the action happens relative to the previous clause, or "" if the sentence does
            not say.
        is_first: whether the clause is the first one in its sentence.
        after_comma: whether a comma precedes the clause.
        matches: phrases in the clause that name actions.
    """

    numbers: list[int]
    link: str = ""
    is_first: bool = False
    after_comma: bool = False
    matches: list[Match] = field(default_factory=list)


def split(tokens: Sequence[Token], matches: Sequence[Match]) -> list[Clause]:
    """Returns the clauses of a sentence.

    Clauses end at punctuation, at "and" and at connectors, but never inside a phrase.
    """
    clauses = list(_clauses(tokens, matches))
    for clause in clauses:
        numbers = set(clause.numbers)
        clause.matches = [match for match in matches if match.first in numbers]
    return clauses


def _clauses(tokens: Sequence[Token], matches: Sequence[Match]) -> Iterator[Clause]:
    inside = {number for match in matches for number in range(match.first, match.last + 1)}
    clause = Clause([], is_first=True)
    number = 0
    while number < len(tokens):
        token = tokens[number]
        words = () if number in inside else _connector(tokens, number)
        if number in inside or not (
            words or not token.is_word or token.word in ("and", "or", "but")
        ):
            clause.numbers.append(number)
            number += 1
            continue

        link = CONNECTORS.get(words, "")
        number += max(1, len(words))
        if link and words[:1] in AT_THE_END and clause.numbers:
            clause.link = link
            continue
        if clause.numbers:
            yield clause
            clause = Clause([])
        clause.link = link or clause.link
        if not token.is_word:
            clause.after_comma = token.word == ","
            clause.is_first = clause.is_first or token.word != ","
    if clause.numbers:
        yield clause


def _connector(tokens: Sequence[Token], number: int) -> tuple[str, ...]:
    """Returns the words of the connector that begins at a token, or () if there is none."""
    for words in CONNECTORS:
        if tuple(token.word for token in tokens[number : number + len(words)]) != words:
            continue
        after = tokens[number + len(words)].word if number + len(words) < len(tokens) else ""
        if words[0] in NEED_SUBJECT and after not in words_of("people") | words_of("determiners"):
            continue
        if words[0] in NEED_CLAUSE and after in ("to", "the"):
            continue
        return words
    return ()


def joined(clauses: Sequence[Clause]) -> list[Clause]:
    """Merges clauses so that each one contains an action.

    A clause without an action is merged with the previous clause or, if it is the first clause,
    with the next one. A clause such as "then faster" is not merged, because it repeats the previous
    action.
    """
    merged: list[Clause] = []
    waiting: list[int] = []
    first: Clause | None = None
    for clause in clauses:
        if clause.matches:
            if waiting and first is not None:
                clause.numbers = waiting + clause.numbers
                clause.link, clause.is_first = first.link or clause.link, True
                waiting = []
            merged.append(clause)
        elif merged and clause.link != THEN:
            merged[-1].numbers += clause.numbers
            if clause.link == WHILE and len(merged) > 1:
                merged[-1].link = merged[-1].link or WHILE
        elif merged:
            merged.append(clause)
        else:
            first = first or clause
            waiting += clause.numbers
    return merged
