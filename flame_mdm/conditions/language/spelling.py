"""Corrects typos of one or two letters in words for motions, attributes and subjects."""

from functools import cache

from flame_mdm.conditions.language.morphology import inflections
from flame_mdm.conditions.language.tables import GAP, actions, phrases, words_of

# Words with this number of letters or fewer are never corrected, because too many words are similar
# to them
NEVER_CORRECTED = 2
FREQUENT = (
    "a",
    "the",
    "with",
    "and",
    "then",
    "to",
    "left",
    "right",
    "person",
    "man",
    "woman",
    "forward",
    "times",
)


def distance(first: str, second: str, most: int) -> int:
    """Returns the number of edits between two words, or `most` + 1 if there are more than `most`.

    An edit inserts, removes or replaces a letter, or swaps two neighboring letters. This is the
    optimal string alignment distance (Damerau 1964; Levenshtein 1966).

    Example:
        >>> distance("wlak", "walk", most=2), distance("dance", "walk", most=2)
        (1, 3)
    """
    # Dynamic programming over prefixes: `row` contains the distances of first[:i] to all prefixes
    # of the second word. Two earlier rows are enough, because a swap looks back by two letters.
    if abs(len(first) - len(second)) > most:
        return most + 1
    before: list[int] = []
    row = list(range(len(second) + 1))
    for i, letter in enumerate(first, start=1):
        earlier, before, row = before, row, [i]
        for j, other in enumerate(second, start=1):
            cost = min(before[j] + 1, row[j - 1] + 1, before[j - 1] + (letter != other))
            if i > 1 and j > 1 and letter == second[j - 2] and first[i - 2] == other:
                cost = min(cost, earlier[j - 2] + 1)
            row.append(cost)
        if min(row) > most:
            return most + 1
    return min(row[-1], most + 1)


@cache
def corrections(word: str) -> tuple[str, ...]:
    """Returns the words that a misspelled word may stand for, taken from the tables.

    The tuple is empty if no word is similar. All returned words are equally likely: they differ
    from the misspelled word by the same number of edits of the same kind. A word of up to five
    letters may have one wrong letter, and a longer word may have two. Numbers are not corrected.
    """
    if len(word) <= NEVER_CORRECTED or any(char.isdecimal() for char in word):
        return ()
    most = 1 if len(word) <= 5 else 2
    near: dict[int, list[str]] = {}
    for other in _correct_words():
        if len(other) > NEVER_CORRECTED and (far := distance(word, other, most)) <= most:
            # A wrong first letter or a replaced letter is rarer than a missing, an additional or a
            # swapped letter.
            begins_otherwise = sorted(other[:2]) != sorted(word[:2]) and other[0] != word[0]
            has_replaced = len(other) == len(word) and sorted(other) != sorted(word)
            near.setdefault(3 * far + begins_otherwise + has_replaced, []).append(other)
    return tuple(near[min(near)]) if near else ()


@cache
def action_words() -> frozenset[str]:
    """Returns all forms of the words in phrases that name actions."""
    bases = {
        word for entry in actions().values() for phrase in entry.phrases for word in phrase.words
    }
    return frozenset(form for base in bases - {GAP} for form in inflections(base))


@cache
def _correct_words() -> tuple[str, ...]:
    """Returns the words that a typo may stand for.

    Frequent words come first, followed by words for actions and then by all other words.
    """
    tables = phrases()
    listed = words_of("body") | words_of("people") | words_of("function") | words_of("objects")
    for key in ("numbers", "times"):
        listed |= frozenset(tables[key])
    for key in ("direction", "speed"):
        listed |= frozenset(word for words in tables[key].values() for word in words.split())
    nouns = {
        form for word in words_of("body") | words_of("objects") for form in inflections(word)[:2]
    }
    return tuple(dict.fromkeys([*FREQUENT, *sorted(action_words()), *sorted(listed | nouns)]))
