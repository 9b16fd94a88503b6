"""Word meanings: a table of vectors for frequent English words and for words about motion.

`tools/word_vectors.py` distills the table from MiniLM (all-MiniLM-L6-v2, Apache License 2.0).
`word_vectors.md` documents the source and the license.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from flame_mdm.conditions.language.morphology import base_forms
from flame_mdm.safe_io import read_npz

FILE = Path(__file__).with_name("word_vectors.npz")
SMOOTHING = 1e-4  # words that are more frequent than this have little weight in a mean


class WordTable:
    """Vectors (N, D) of norm 1 for N words, with the most frequent words first."""

    def __init__(self, words: Sequence[str], vectors: np.ndarray):
        self.words = list(words)
        self.vectors = vectors
        self._rows = {word: row for row, word in enumerate(self.words)}

    def has(self, word: str) -> bool:
        """Returns whether the table contains exactly this word."""
        return word in self._rows

    def rank(self, word: str) -> int | None:
        """Returns the frequency rank of a word or its base form, or None if neither is listed."""
        return next((self._rows[form] for form in base_forms(word) if form in self._rows), None)

    def vector(self, word: str) -> np.ndarray | None:
        """Returns the vector (D,) of a word or its base form, or None if neither is listed."""
        row = self.rank(word)
        return None if row is None else self.vectors[row]

    def mean(self, words: Sequence[str]) -> np.ndarray | None:
        """Returns the mean vector (D,) of words, scaled to norm 1, or None if no word is listed.

        Frequent words are given less weight, as in smooth inverse frequency (Arora et al. 2017).
        Word frequencies are estimated with Zipf's law.
        """
        rows = [row for word in words if (row := self.rank(word)) is not None]
        if not rows:
            return None
        frequencies = 1 / (np.array(rows) + 2) / np.sum(1 / (np.arange(len(self.words)) + 2))
        weights = SMOOTHING / (SMOOTHING + frequencies)
        mean = weights @ self.vectors[rows]
        return mean / max(float(np.linalg.norm(mean)), 1e-9)


@cache
def word_table() -> WordTable:
    """Returns the table of word vectors that is included in the package."""
    arrays = read_npz(FILE)
    words = arrays["words"].tobytes().decode().split("\n")
    # The table has 8 bits per number. The lengths of the vectors are not stored, because all of
    # them are 1.
    vectors = arrays["vectors"].astype(np.float32)
    return WordTable(words, vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
