"""A small text encoder that is trained with the model and requires no download."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from flame_mdm.batch import Condition, MotionBatch, length_mask, sent
from flame_mdm.conditions import ConditionEncoder, vocabulary
from flame_mdm.errors import UserError
from flame_mdm.progress import ProgressBar
from flame_mdm.seeds import key, seed_generator

# Number of clips per step of contrastive training, and the temperature of its softmax
PAIRS, TEMPERATURE = 64, 0.1

START = "<start>"
"""Token before every caption, so that the empty caption also has a token.

No caption contains this token.
"""


class LearnedTokens(ConditionEncoder):
    """Text encoder with hashed words, learned positions and one transformer layer.

    The null condition is one learned vector.

    A word's vector is the sum of two table rows, which are selected by the word's hash; see
    `vocabulary.hashed`. Since a word that does not occur in the training captions would have a
    random vector, it is replaced by another form that does occur (such as "walks" for "walked"), or
    dropped. Each caption is encoded only once, so samples with the same caption share the same
    dropout mask. Linear layers skip the padding.

    The pooled vector is the mean of the tokens, and the null token is the null vector. Therefore,
    all parameters receive gradients, regardless of whether a denoiser reads the pooled vector or
    the tokens.

    Args:
        features: C, the width of the tokens and of the pooled vector.
        buckets: number of rows in the word table.
        max_words: maximum number of words per caption. Any further words are dropped.
        heads: number of attention heads, a divisor of `features`.
        dropout: probability of dropout in the transformer layer.
        pretrain_steps: number of training steps in `pretrain`.

    Raises:
        UserError: If a size is below 1.

    Example:
        >>> encoder = LearnedTokens(features=8, buckets=64, heads=2).eval()
        >>> x = torch.zeros(2, 5, 3)
        >>> captions = ["a person walks", "a person waves slowly"]
        >>> cond = encoder(MotionBatch(x, x[..., 0] == 0, ["a", "b"], text=captions))
        >>> cond.pooled.shape, cond.token_mask.sum(1).tolist()  # a start token and the words
        (torch.Size([2, 8]), [4, 5])
    """

    def __init__(
        self,
        features: int = 256,
        buckets: int = 4096,
        max_words: int = 32,
        heads: int = 4,
        dropout: float = 0.1,
        pretrain_steps: int = 0,
    ):
        for name, value in (
            ("features", features),
            ("buckets", buckets),
            ("max_words", max_words),
            ("heads", heads),
        ):
            if value < 1:
                raise UserError(f"condition.{name}={value}: must be at least 1")
        super().__init__()
        self.features, self.buckets, self.max_words, self.pretrain_steps = (
            features,
            buckets,
            max_words,
            pretrain_steps,
        )
        self.attend: Callable[..., Tensor] = functional.scaled_dot_product_attention
        self.words = nn.Embedding(buckets, features)
        self.positions = nn.Parameter(
            nn.init.normal_(torch.empty(max_words + 1, features), std=0.02)
        )
        self.layer = nn.TransformerEncoderLayer(
            features, heads, 2 * features, dropout, "gelu", batch_first=True, norm_first=True
        )
        self.norm = nn.LayerNorm(features)
        self.null = nn.Parameter(nn.init.normal_(torch.empty(features), std=0.02))
        self._rows: dict[str, np.ndarray] = {}  # rows (T, 2) of the captions encoded so far

    def rows(self, caption: str) -> list[tuple[int, int]]:
        """Returns the indices of the two table rows for the start token and for each word."""
        words = vocabulary.words(caption)
        if self.seen:
            words = [form for word in words if (form := vocabulary.known_form(word, self.seen))]
        return [vocabulary.hashed(word, self.buckets) for word in [START, *words[: self.max_words]]]

    def pretrain(self, groups: Sequence[Sequence[str]], seed: int) -> None:
        """Trains the encoder with a contrastive loss (Gao et al. 2021, "SimCSE", equation 1).

        Pooled vectors are pulled together if their captions belong to the same clip, and pushed
        apart if the captions belong to different clips. Each training step compares two captions
        from each of `PAIRS` clips. Without this training, a small model learns many words slowly,
        because it learns them only from the motion loss. Clips that have only one caption are not
        used.
        """
        groups, device = (
            [captions for captions in groups if len(set(captions)) > 1],
            self.null.device,
        )
        optimizer = torch.optim.AdamW(self.parameters(), lr=1e-3)
        seed_generator(key("pretrain", seed), device)
        steps = self.pretrain_steps if len(groups) > 1 else 0
        for step in ProgressBar(
            range(steps), desc="training the text encoder on captions", disable=not steps or None
        ):
            draw = np.random.default_rng((seed, step))
            clips = draw.choice(len(groups), min(PAIRS, len(groups)), replace=False)
            pairs = [
                draw.choice(sorted(set(groups[clip])), 2, replace=False).tolist() for clip in clips
            ]
            texts = [text for side in zip(*pairs, strict=True) for text in side]
            x = torch.zeros(len(texts), 1, 1, device=device)
            pooled = self(MotionBatch(x=x, mask=x[..., 0] == 0, ids=texts, text=texts)).pooled
            first, second = functional.normalize(pooled, dim=-1).chunk(2)
            loss = functional.cross_entropy(
                first @ second.T / TEMPERATURE, torch.arange(len(first), device=device)
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

    def forward(self, batch: MotionBatch) -> Condition:
        """Returns the encoded captions.

        Raises:
            UserError: If the batch contains no captions.
        """
        if batch.text is None:
            raise UserError(
                "condition=learned: this batch has no captions. Add captions, or choose another condition"
            )
        device = self.null.device
        numbers = {caption: number for number, caption in enumerate(dict.fromkeys(batch.text))}
        for caption in numbers.keys() - self._rows.keys():
            self._rows[caption] = np.array(self.rows(caption), np.int64)
        rows = [self._rows[caption] for caption in numbers]
        lengths = np.array([len(words) for words in rows])
        # Everything that depends on values is computed on the host, which would otherwise have to
        # wait for the device.
        is_real = np.arange(lengths.max()) < lengths[:, None]
        of_caption = np.array([numbers[caption] for caption in batch.text])
        words, index, token_mask, of_sample = (
            sent(torch.from_numpy(values), device)
            for values in (np.concatenate(rows), np.flatnonzero(is_real), is_real, of_caption)
        )
        tokens = self._encode(words, index, token_mask)
        pooled = tokens.sum(1) / token_mask.sum(1, keepdim=True)
        return Condition(pooled[of_sample], tokens[of_sample], token_mask[of_sample], self._null())

    def encode(self, words: Tensor, counts: Tensor) -> Condition:
        """Like `forward`, but takes captions as padded `rows` (B, S, 2) with lengths (B,).

        This method has no branches, so it can be exported as a graph.
        """
        token_mask = length_mask(counts, words.shape[1])
        index = torch.arange(token_mask.numel(), device=words.device)
        tokens = self._encode(words.flatten(0, 1), index, token_mask) * token_mask[..., None]
        return Condition(tokens.sum(1) / counts[:, None], tokens, token_mask, self._null())

    def _encode(self, rows: Tensor, index: Tensor, token_mask: Tensor) -> Tensor:
        """Encodes captions as tokens (N, S, C), with zeros in the padding.

        Only attention processes the padding.

        Args:
            rows: (T, 2), indices of the two table rows for each real token.
            index: (T,), positions of the tokens in the flattened `token_mask`.
            token_mask: (N, S) bool, True for real tokens.
        """

        def pad(y: Tensor) -> Tensor:
            padded = y.new_zeros(token_mask.numel(), y.shape[1])
            return padded.index_copy(0, index, y).unflatten(0, token_mask.shape)

        layer, attention = self.layer, self.layer.self_attn
        positions = torch.arange(token_mask.shape[1], device=index.device).repeat(
            token_mask.shape[0]
        )[index]
        x = self.words(rows).sum(1) + functional.embedding(positions, self.positions)
        qkv = pad(
            functional.linear(layer.norm1(x), attention.in_proj_weight, attention.in_proj_bias)
        )
        query, key, value = qkv.unflatten(2, (3, attention.num_heads, -1)).permute(2, 0, 3, 1, 4)
        dropout = attention.dropout if self.training else 0.0
        y = self.attend(query, key, value, attn_mask=token_mask[:, None, None], dropout_p=dropout)
        y = y.transpose(1, 2).flatten(2).flatten(0, 1).index_select(0, index)
        # On a CPU, adding tensors of different precision takes longer than converting one.
        x = x + layer.dropout1(attention.out_proj(y)).to(x.dtype)
        y = layer.dropout(functional.gelu(layer.linear1(layer.norm2(x))))
        x = x + layer.dropout2(layer.linear2(y)).to(x.dtype)
        return pad(self.norm(x))

    def _null(self) -> Condition:
        token_mask: Tensor = torch.ones(1, 1, dtype=torch.bool, device=self.null.device)
        return Condition(self.null[None], self.null[None, None], token_mask)
