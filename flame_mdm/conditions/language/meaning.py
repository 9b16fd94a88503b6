"""Finds actions similar to words that are not in the tables, and detects words for things."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from flame_mdm.conditions.language.tables import actions, words_of
from flame_mdm.conditions.language.vectors import word_table

SIMILAR = 0.65
"""Minimum similarity at which a word is read as the action that is closest in meaning.

docs/language.md reports the precision and recall at this threshold.
"""
NEIGHBORS = 5  # number of nearest listed words that decide whether a word names a thing


def nearest_actions(word: str) -> list[tuple[str, float]]:
    """Returns the actions with their similarities to a word, most similar first.

    The result is empty if the vector table does not contain the word.
    """
    vector = word_table().vector(word)
    return [] if vector is None else _ranked(vector)


def nearest_to(words: list[str]) -> list[tuple[str, float]]:
    """Returns the actions with their similarities to the mean of `words`, most similar first."""
    vector = word_table().mean(words)
    return [] if vector is None else _ranked(vector)


def similarity(action: str, other: str) -> float:
    """Returns the cosine similarity between the mean word vectors of two actions."""
    names, _, _ = _action_vectors()
    first, second = names.index(action), names.index(other)
    centers = _centers()
    return float(centers[first] @ centers[second])


def similar_word(word: str, words: Sequence[str]) -> str | None:
    """Returns the word in `words` that is most similar in meaning to `word`.

    Returns None if no word is similar enough.
    """
    vector = word_table().vector(word)
    pairs = [(other, row) for other in words if (row := word_table().vector(other)) is not None]
    if vector is None or not pairs:
        return None
    scores = np.array([row for _, row in pairs]) @ vector
    best = int(scores.argmax())
    return pairs[best][0] if scores[best] >= SIMILAR else None


def is_thing(word: str) -> bool:
    """Returns whether a word names a thing.

    A word counts as a thing if most of the listed words closest to it in meaning are words for
    things.
    """
    vector = word_table().vector(word)
    if vector is None:
        return False
    _, rows, vectors = _action_vectors()
    things = _thing_vectors()
    scores = np.concatenate([vectors @ vector, things @ vector])
    nearest = np.argsort(-scores)[:NEIGHBORS]
    return int((nearest >= len(rows)).sum()) * 2 > NEIGHBORS


def _ranked(vector: np.ndarray) -> list[tuple[str, float]]:
    """Returns the actions with their scores, best first.

    The score is the mean of two similarities: one to the action's closest word, and one to the
    action's center.
    """
    names, rows, vectors = _action_vectors()
    words = vectors @ vector
    nearest = np.full(len(names), -1.0)
    np.maximum.at(nearest, rows, words)
    scores = (nearest + _centers() @ vector) / 2
    order = np.argsort(-scores, kind="stable")
    return [(names[row], float(scores[row])) for row in order]


@cache
def _action_vectors() -> tuple[list[str], np.ndarray, np.ndarray]:
    """Returns the names of the actions, and two arrays for the single words that name actions.

    The first array contains the index of each word's action, and the second contains each word's
    vector.
    """
    table, weak = word_table(), words_of("weak")
    names = list(actions())
    rows, vectors = [], []
    for row, entry in enumerate(actions().values()):
        single = [
            phrase.words[0]
            for phrase in entry.phrases
            if phrase.size == 1 and phrase.words[0] not in weak
        ]
        listed = [vector for word in single if (vector := table.vector(word)) is not None]
        if not listed and (vector := table.mean(list(entry.phrases[0].words))) is not None:
            listed = [vector]
        vectors += listed
        rows += [row] * len(listed)
    return names, np.array(rows), np.array(vectors)


@cache
def _centers() -> np.ndarray:
    """Returns the mean word vectors (N, D) of the actions, each scaled to norm 1."""
    names, rows, vectors = _action_vectors()
    centers = np.array([vectors[rows == row].sum(0) for row in range(len(names))])
    return centers / np.maximum(np.linalg.norm(centers, axis=1, keepdims=True), 1e-9)


@cache
def _thing_vectors() -> np.ndarray:
    table = word_table()
    listed = [table.vector(word) for word in sorted(words_of("objects"))]
    return np.array([vector for vector in listed if vector is not None])
