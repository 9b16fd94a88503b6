"""Small text encoder that is trained with the model and needs no download."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from flame_mdm.batch import Condition, MotionBatch, length_mask, sent
from flame_mdm.conditions import ConditionEncoder, vocabulary
from flame_mdm.errors import UserError

START = "<start>"
"""Inserted before every caption, so that the empty caption also has a token; no caption contains this word."""


class LearnedTokens(ConditionEncoder):
    """Hashed words, learned positions and one transformer layer; the null is one learned vector.

    A word is the sum of two rows of the table, selected by its hash, see `vocabulary.hashed`. Captions are lowercased,
    punctuation separates words, and words after `max_words` are dropped.

    Each distinct caption of a batch is encoded once, so that samples with the same caption share its dropout. Linear
    layers skip the padding.

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
        self._rows: dict[str, Tensor] = {}  # rows (T, 2) of the captions met so far

    def rows(self, caption: str) -> list[tuple[int, int]]:
        """Returns the two rows of the table for the start token and each word of a caption."""
        words = [START, *vocabulary.words(caption)[: self.max_words]]
        return [vocabulary.hashed(word, self.buckets) for word in words]

    def forward(self, batch: MotionBatch) -> Condition:
        if batch.text is None:
            raise UserError(
                "condition=learned needs captions, and this batch has none: add captions, or choose another condition"
            )
        device = self.null.device
        numbers = {caption: number for number, caption in enumerate(dict.fromkeys(batch.text))}
        for caption in numbers.keys() - self._rows.keys():
            self._rows[caption] = torch.tensor(self.rows(caption))
        rows = [self._rows[caption] for caption in numbers]
        token_mask = length_mask(torch.tensor([len(words) for words in rows]))
        index = sent(token_mask.flatten().nonzero()[:, 0], device)
        token_mask = sent(token_mask, device)
        tokens = self._encode(sent(torch.cat(rows), device), index, token_mask)
        pooled = tokens.sum(1) / token_mask.sum(1, keepdim=True)
        of_sample = sent(torch.tensor([numbers[caption] for caption in batch.text]), device)
        return Condition(pooled[of_sample], tokens[of_sample], token_mask[of_sample], self._null())

    def _encode(self, rows: Tensor, index: Tensor, token_mask: Tensor) -> Tensor:
        """Encodes captions; padding takes part only in attention.

        Args:
            rows: (T, 2), rows of the table of all real tokens.
            index: (T,), their positions among the N * S of the padded captions.
            token_mask: (N, S) bool, True = real token.

        Returns:
            (N, S, C), 0 past the end of each caption.
        """

        def pad(y: Tensor) -> Tensor:
            padded = y.new_zeros(token_mask.numel(), y.shape[1])
            return padded.index_copy(0, index, y).unflatten(0, token_mask.shape)

        layer, attention = self.layer, self.layer.self_attn
        x = self.words(rows).sum(1) + functional.embedding(index % token_mask.shape[1], self.positions)
        qkv = pad(functional.linear(layer.norm1(x), attention.in_proj_weight, attention.in_proj_bias))
        query, key, value = qkv.unflatten(2, (3, attention.num_heads, -1)).permute(2, 0, 3, 1, 4)
        dropout = attention.dropout if self.training else 0.0
        y = functional.scaled_dot_product_attention(query, key, value, token_mask[:, None, None], dropout)
        x = x + layer.dropout1(attention.out_proj(y.transpose(1, 2).flatten(2).flatten(0, 1).index_select(0, index)))
        x = x + layer.dropout2(layer.linear2(layer.dropout(functional.gelu(layer.linear1(layer.norm2(x))))))
        return pad(self.norm(x))

    def _null(self) -> Condition:
        token_mask: Tensor = torch.ones(1, 1, dtype=torch.bool, device=self.null.device)
        return Condition(self.null[None], self.null[None, None], token_mask)
