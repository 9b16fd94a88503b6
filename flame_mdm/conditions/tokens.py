"""Small text encoder that is trained with the model and needs no download."""

import zlib

import torch
from torch import Tensor, nn

from flame_mdm.conditions import ConditionEncoder, vocabulary
from flame_mdm.motion import Condition, MotionBatch

START = "<start>"
"""Inserted before every caption, so that the empty caption also has a token; no caption contains this word."""


class LearnedTokens(ConditionEncoder):
    """Hashed words, learned positions and one transformer layer; the null is one learned vector.

    A word is the sum of two rows of the table, selected by two parts of its hash (Svenstrup et al. 2017, "Hash
    embeddings"): no vocabulary is stored, and two words are confused only if both parts collide. The hash (CRC-32) is
    the same on every machine. Captions are lowercased, punctuation separates words, and words after `max_words` are
    dropped.

    The pooled vector is the mean of the tokens, and the null token is the null vector, so that all parameters receive
    gradients whether a denoiser reads the pooled vector or the tokens.
    """

    def __init__(
        self, features: int = 256, buckets: int = 4096, max_words: int = 32, heads: int = 4, dropout: float = 0.1
    ):
        """Builds the encoder.

        Args:
            features: C, the width of the tokens and of the pooled vector.
            buckets: rows of the word table.
            max_words: maximum number of words per caption.
            heads: attention heads; divides `features`.
            dropout: dropout rate of the transformer layer.
        """
        super().__init__()
        self.features, self.buckets, self.max_words = features, buckets, max_words
        self.words = nn.Embedding(buckets, features)
        self.positions = nn.Parameter(0.02 * torch.randn(max_words + 1, features))
        self.layer = nn.TransformerEncoderLayer(
            features, heads, 2 * features, dropout, "gelu", batch_first=True, norm_first=True
        )
        self.norm = nn.LayerNorm(features)
        self.null = nn.Parameter(0.02 * torch.randn(features))

    def rows(self, caption: str) -> list[tuple[int, int]]:
        """Returns the two rows of the table for the start token and each word of a caption."""
        words = [START, *vocabulary.words(caption)[: self.max_words]]
        # Not two hashes of the word with different prefixes: CRC is linear, so both would collide together.
        hashes = [zlib.crc32(word.encode()) for word in words]
        return [(h % self.buckets, h // self.buckets % self.buckets) for h in hashes]

    def forward(self, batch: MotionBatch) -> Condition:
        if batch.text is None:
            raise ValueError("condition=learned needs captions, and this batch has none: choose data with captions")
        device = self.null.device
        rows = [torch.tensor(self.rows(caption)) for caption in batch.text]
        lengths = torch.tensor([len(r) for r in rows])
        padded = nn.utils.rnn.pad_sequence(rows, batch_first=True).to(device)
        token_mask = (torch.arange(padded.shape[1]) < lengths[:, None]).to(device)
        x = self.words(padded).sum(2) + self.positions[: padded.shape[1]]
        tokens = self.norm(self.layer(x, src_key_padding_mask=~token_mask)) * token_mask[..., None]
        return Condition(tokens.sum(1) / token_mask.sum(1, keepdim=True), tokens, token_mask, self._null())

    def _null(self) -> Condition:
        token_mask: Tensor = torch.ones(1, 1, dtype=torch.bool, device=self.null.device)
        return Condition(self.null[None], self.null[None, None], token_mask)
