"""Vocabulary of the training captions: unknown words, suggestions, and parts of sentences."""

import difflib
import re
import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cache
from typing import Any

from flame_mdm.conditions.language.meaning import similar_word
from flame_mdm.conditions.language.tokens import is_known
from flame_mdm.errors import UserError, shortened

WORD = re.compile(r"[^\W_]+")
# Maximum number of training captions in a checkpoint
MAX_CAPTIONS = 1000
FUNCTION_WORDS = frozenset(
    WORD.findall(
        "a an the this that some one and or then of to in on at by with from for as is are was were be been it its s t "
        "he she they you i we his her their your my him them who while person people human figure man woman men women "
        "boy girl guy lady someone somebody will"
    )
)
"""Function words, which do not describe what happens.

Text that consists only of these words describes nothing. Users are not warned if a model does not
know one of them.
"""
NUMBERS = frozenset(
    [
        "zero",
        "one",
        "two",
        "three",
        "four",
        "five",
        "six",
        "seven",
        "eight",
        "nine",
        "ten",
        "eleven",
        "twelve",
    ]
)
SUFFIXES = ("ing", "ed", "es", "s", "d", "")
BREAK = re.compile(
    r"[.!?;]+\s+|[.,;]?\s+(?:and\s+)?(?:then|afterwards|after that)\b,?\s*|\s*\n\s*", re.IGNORECASE
)
BEGINNING = re.compile(
    r"^(?:(?:and|then|first|next|finally|afterwards|after that)\b[\s,]*)+", re.IGNORECASE
)
SUBJECT = (
    r"(?:(?:he|she|they|you|it|(?:a|the|this) \w+|someone|somebody)\s+)?(?:(?:is|are|will)\s+)?"
)


def words(text: str) -> list[str]:
    """Returns the words of the text in lower case, without punctuation."""
    return WORD.findall(text.lower())


def hashed(word: str, buckets: int) -> tuple[int, int]:
    """Returns the indices of a word's two rows in a table of `buckets` vectors.

    The word's vector is the sum of the two rows.

    The indices are two parts of the word's hash (Svenstrup et al. 2017, "Hash embeddings"). The
    model cannot distinguish two words for which both parts are equal. The hash (CRC-32) is the same
    on every machine.
    """
    # Two hashes of the word with different prefixes would not be enough: CRC is linear, so both
    # hashes would collide for the same pairs of words.
    number = zlib.crc32(word.encode())
    return number % buckets, number // buckets % buckets


def vocabulary(
    captions: Iterable[str], shared: Iterable[str] | None = None
) -> dict[str, list[str]]:
    """Returns the words and captions of the training data, for saving in a checkpoint.

    Args:
        captions: all captions of the training clips.
        shared: the captions that may be included in a checkpoint under the license of their data,
            or None for no captions.

    Returns:
        "vocabulary" contains all words in the captions, sorted. Unless `shared` is None, "captions"
        contains up to `MAX_CAPTIONS` captions from `shared`, evenly spaced in sorted order.
    """
    facts = {"vocabulary": sorted({word for caption in set(captions) for word in words(caption)})}
    if shared is not None:
        distinct = sorted(set(shared))
        count = min(len(distinct), MAX_CAPTIONS)
        facts["captions"] = [distinct[number * len(distinct) // count] for number in range(count)]
    return facts


def known_form(word: str, seen: Collection[str]) -> str | None:
    """Returns `word` if it is known, or a known form with another ending ("walks" for "walked").

    Returns None if no form is known.
    """
    if word in seen:
        return word
    if word in NUMBERS:  # "four" is not a form of "fours"
        return None
    stems = [word.removesuffix(suffix) for suffix in SUFFIXES if word.endswith(suffix)]
    # The stem of "waving" is "wave", and the stem of "hopping" is "hop".
    stems += [stem[:-1] for stem in stems if len(stem) > 3 and stem[-1] in f"e{stem[-2]}"]
    forms = (
        stem + ending
        for stem in stems
        if len(stem) > 2
        for ending in ("", "e", "s", "es", "ing", "ed")
    )
    return next((form for form in forms if form in seen), None)


def advice(text: str, facts: Mapping[str, Any], max_words: int | None = None) -> list[str]:
    """Returns warnings about words that a model does not read or has never seen in training.

    Args:
        text: the prompt.
        facts: facts about the model, including its vocabulary. For imported models, whose
            vocabulary is unknown, words are not checked.
        max_words: maximum number of words that the model reads, or None for no limit.
    """
    lines = []
    if unknown := unknown_words(text, facts):
        lines.append(f"never seen in training: {', '.join(unknown)}.{_suggested(text, facts)}")
    if unread := unread_words(text, max_words):
        lines.append(f"only the first {max_words} words are read, not '{' '.join(unread)}'")
    return lines


def check_known(text: str, facts: Mapping[str, Any]) -> None:
    """Checks that a model knows at least one content word of the text.

    Raises:
        UserError: If the model does not know any content word of the text.
    """
    if facts.get("vocabulary") and unknown_words(text, facts) == _content(text):
        instead = _suggested(text, facts) or " Use words of its training captions"
        raise UserError(
            f"'{shortened(text, 60)}': the model knows none of its content words.{instead}"
        )


def _content(text: str) -> list[str]:
    return [word for word in dict.fromkeys(words(text)) if word not in FUNCTION_WORDS]


def unread_words(text: str, max_words: int | None) -> list[str]:
    """Returns the words that follow the first `max_words`, or [] if `max_words` is None."""
    return [] if max_words is None else words(text)[max_words:]


def unknown_words(text: str, facts: Mapping[str, Any]) -> list[str]:
    """Returns the content words of the text that the model does not know in any form."""
    seen = facts.get("vocabulary")
    return (
        [] if seen is None else [word for word in _content(text) if known_form(word, seen) is None]
    )


def _suggested(text: str, facts: Mapping[str, Any]) -> str:
    """Returns the question " Did you mean '...'?" for text with unknown words.

    The question quotes the text with its unknown words replaced by known words. If an unknown word
    cannot be replaced, the question quotes the most similar training caption that contains a
    content word of the text.

    A word that is not English is replaced by a known word with a similar spelling. An English word
    is replaced only by a known word with a similar meaning ("shelf" never becomes "she").
    """
    fixed = text.lower()
    for word in (unknown := unknown_words(text, facts)):
        if (meant := _meant(word, facts["vocabulary"])) is None:
            break
        # a function instead of a string, because the words of a model may contain backslashes
        fixed = re.sub(rf"\b{word}\b", lambda _, replacement=meant: replacement, fixed)
    else:
        if unknown:
            return f" Did you mean '{fixed}'?"
    near = nearest(text, facts.get("captions", ()), 1) if _content(text) else []
    return f" Did you mean '{near[0]}'?" if near else ""


def _meant(word: str, vocabulary: Collection[str]) -> str | None:
    """Returns the known word that an unknown word probably stands for, or None if there is none.

    A word that is not English is treated as a typo of a known word. For an English word, a known
    word with a similar meaning is chosen.
    """
    if not is_known(word):
        similar = [other for other in vocabulary if other[:1] == word[0]]
        return next(iter(difflib.get_close_matches(word, similar, 1, 0.75)), None)
    content = [other for other in vocabulary if other not in FUNCTION_WORDS]
    return similar_word(word, content)


def in_parts(text: str, verbs: Collection[str]) -> list[str]:
    """Splits a sentence with several actions into one part per action.

    For example, "walks, turns left and waves. Then she sits" has four parts.

    Text is split at sentence boundaries and at "then". With `verbs`, each of these pieces is also
    split at each comma that is followed by a verb. A piece that contains such a comma is also split
    at each "and" that is followed by a verb. Otherwise, "and" does not split the text: "raises both
    hands and waves" is one action. A part without a verb is joined with a neighboring part. A style
    at the end, such as "in limp style", is added to all parts. Adapters teach such styles.

    Args:
        text: the sentence.
        verbs: all forms of the known verbs.
    """
    comma, also = _before_verb(tuple(verbs))
    parts: list[str] = []
    for sentence in BREAK.split(text):
        clauses = comma.split(sentence)
        if len(clauses) > 1:
            clauses = [part for clause in clauses for part in also.split(clause)]
        parts += [
            part
            for clause in clauses
            if WORD.search(part := BEGINNING.sub("", clause).strip(" .,;!?"))
        ]
    merged: list[str] = []
    for part in parts:
        if (
            merged
            and verbs
            and not (set(words(part)) & set(verbs) and set(words(merged[-1])) & set(verbs))
        ):
            merged[-1] += f", {part}"
        else:
            merged.append(part)
    if len(merged) < 2:
        return [text]
    (style,) = re.findall(r" in \w+ style$", merged[-1]) or [""]
    return [part.removesuffix(style) + style for part in merged]


@cache
def _before_verb(verbs: tuple[str, ...]) -> tuple[re.Pattern[str], re.Pattern[str]]:
    """Returns two patterns: a comma before a verb, and an "and" before a verb."""
    finite = (
        "|".join(re.escape(verb) for verb in sorted(verbs) if not verb.endswith("ing")) or "(?!)"
    )
    verb = rf"(?={SUBJECT}(?:\w+ly\s+)?(?:{finite})\b)"
    return re.compile(rf",\s*(?:and\s+)?{verb}", re.IGNORECASE), re.compile(
        rf"\s+and\s+{verb}", re.IGNORECASE
    )


def plainest(captions: Iterable[str]) -> list[str]:
    """Returns the captions, sorted from plain to elaborate.

    Captions that begin with "a person" come first, and shorter captions come before longer ones.
    """
    return sorted(
        captions, key=lambda caption: (not caption.startswith("a person "), len(caption), caption)
    )


def nearest(text: str, captions: Sequence[str], count: int = 3) -> list[str]:
    """Returns the captions that share the largest fraction of words with the text, best first.

    The list is empty if no caption shares a word with the text.
    """
    prompt = set(words(text))
    content = prompt - FUNCTION_WORDS or prompt

    def similarity(caption: str) -> float:
        others = set(words(caption))
        return len(content & others) and len(content & others) + len(prompt & others) / len(
            prompt | others
        )

    return sorted((c for c in captions if similarity(c)), key=similarity, reverse=True)[:count]
