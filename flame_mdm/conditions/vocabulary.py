"""Vocabulary of the training captions: words that a model has never seen, and captions near a text."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

WORD = re.compile(r"[^\W_]+")
MAX_CAPTIONS = 1000
"""Maximum number of training captions that a checkpoint keeps."""


def words(text: str) -> list[str]:
    """Returns the words of a text, lowercased, without punctuation."""
    return WORD.findall(text.lower())


def hashed(word: str, buckets: int) -> tuple[int, int]:
    """Returns the two rows of a table of `buckets` word vectors whose sum is the vector of a word.

    They are two parts of its hash (Svenstrup et al. 2017, "Hash embeddings"): no vocabulary is stored, and two words
    are confused only if both parts collide. The hash (CRC-32) is the same on every machine.
    """
    # Not two hashes of the word with different prefixes: CRC is linear, so both would collide together.
    number = zlib.crc32(word.encode())
    return number % buckets, number // buckets % buckets


def vocabulary(captions: Iterable[str], *, share: bool) -> dict[str, list[str]]:
    """Returns what a checkpoint keeps of the training captions.

    Args:
        captions: of all training clips.
        share: whether the license of the data allows to redistribute captions.

    Returns:
        "vocabulary": all words, sorted; with `share` also "captions": up to `MAX_CAPTIONS` of them, evenly spaced.
    """
    distinct = sorted(set(captions))
    kept = {"vocabulary": sorted({word for caption in distinct for word in words(caption)})}
    if share:
        count = min(len(distinct), MAX_CAPTIONS)
        kept["captions"] = [distinct[number * len(distinct) // count] for number in range(count)]
    return kept


def advice(text: str, facts: Mapping[str, Any], max_words: int | None = None) -> list[str]:
    """Returns lines about words that a model has never seen in training or does not read.

    Args:
        text: the prompt.
        facts: of the checkpoint; imported models have no vocabulary, and their words are not checked.
        max_words: maximum number of words that the text encoder reads; None = no such limit.
    """
    lines, prompt = [], words(text)
    seen = set(facts.get("vocabulary", prompt))
    if unseen := [word for word in dict.fromkeys(prompt) if word not in seen]:
        line = f"never seen in training: {', '.join(unseen)}. The model guesses from the other words"
        near = ", ".join(f"'{caption}'" for caption in nearest(text, facts.get("captions", ())))
        lines.append(line + f". The nearest training captions: {near}" * bool(near))
    if max_words is not None and len(prompt) > max_words:
        lines.append(f"only the first {max_words} words are read, not '{' '.join(prompt[max_words:])}'")
    return lines


def nearest(text: str, captions: Sequence[str], count: int = 3) -> list[str]:
    """Returns the captions that share the largest part of their words with a text, best first; none if none does."""
    prompt = set(words(text))

    def similarity(caption: str) -> float:
        others = set(words(caption))
        return len(prompt & others) / (len(prompt | others) or 1)

    return sorted((c for c in captions if similarity(c)), key=similarity, reverse=True)[:count]
