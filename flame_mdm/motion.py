"""The vocabulary: batches of motion, conditions, edits and masks.

B batch, F frames, D features, S condition tokens, C condition width. Masks: True = real, everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor


@dataclass
class MotionBatch:
    """Motions of mixed lengths, padded to the longest.

    Attributes:
        x: (B, F, D) float32, normalised features, 0 past the end of each motion.
        mask: (B, F) bool, True = real frame.
        ids: B names, unique in the data set; they seed the noise of each sample and join tables.
        text: one caption a motion, or None where the data has none.
        action: (B,) int64 class labels, or None.
    """

    x: Tensor
    mask: Tensor
    ids: list[str]
    text: list[str] | None = None
    action: Tensor | None = None

    @property
    def lengths(self) -> Tensor:
        """(B,) int64, real frames of each motion."""
        return self.mask.sum(1)

    def __len__(self) -> int:
        return len(self.ids)


@dataclass
class Condition:
    """What the motion is conditioned on, encoded once a batch.

    Attributes:
        pooled: (B, C), one vector a sample.
        tokens: (B, S, C), one vector a word piece; (B, 0, C) where the encoder has none.
        token_mask: (B, S) bool, True = real token. On a null, None means: keep the mask of the sample it replaces.
        null: the condition that stands for "no condition", with batch size 1; None where there is none to drop to.
    """

    pooled: Tensor
    tokens: Tensor
    token_mask: Tensor | None
    null: Condition | None = None

    def drop(self, drop: Tensor) -> Condition:
        """Replaces the samples where `drop` (B,) bool is True by the null condition.

        Raises:
            ValueError: there is no null condition.
        """
        if self.null is None:
            raise ValueError("this condition has no null to drop to")
        null = self.null
        pooled = torch.where(drop[:, None], null.pooled.to(self.pooled), self.pooled)
        if self.token_mask is None:
            return Condition(pooled, self.tokens, None, null)
        if null.token_mask is None:
            tokens = torch.where(drop[:, None, None], null.tokens.to(self.tokens), self.tokens)
            return Condition(pooled, tokens, self.token_mask, null)
        size = max(self.tokens.shape[1], null.tokens.shape[1])
        tokens = torch.where(drop[:, None, None], pad_to(null.tokens.to(self.tokens), size), pad_to(self.tokens, size))
        token_mask = torch.where(drop[:, None], pad_to(null.token_mask, size), pad_to(self.token_mask, size))
        return Condition(pooled, tokens, token_mask, null)

    def with_null(self) -> Condition:
        """The batch followed by its null conditions, 2B samples: one forward serves classifier-free guidance."""
        batch = len(self.pooled)
        twice = Condition(
            torch.cat([self.pooled, self.pooled]),
            torch.cat([self.tokens, self.tokens]),
            None if self.token_mask is None else torch.cat([self.token_mask, self.token_mask]),
            self.null,
        )
        return twice.drop(torch.arange(2 * batch, device=self.pooled.device) >= batch)


@dataclass
class Edit:
    """A motion of which parts are kept: in-betweening, prediction, interpolation and body parts are data.

    Attributes:
        known: (B, F, D) normalised features of the motion to keep parts of.
        keep: (B, F, D) bool, True = keep this feature of this frame.
        mode: how the process imposes it. "x0" overwrites the clean estimate (MDM); "x_t" replaces the noisy sample
            by the equally noisy known part (FLAME, RePaint); "trajectory" rewrites the flow's path early on (MFM).
        until: for "trajectory", the flow time up to which (included) the path is rewritten.
        blend: for "x_t", replace the kept part "after" each step (FLAME, eq. 6), which ends in the known motion itself,
            or "before" each call of the denoiser (FLAME's code), which ends in the model's version of it.
        resample: for "x_t", how often each step is taken, going back by fresh noise in between (RePaint, algorithm 1).
    """

    known: Tensor
    keep: Tensor
    mode: Literal["x0", "x_t", "trajectory"] = "x0"
    until: float = 0.2
    blend: Literal["after", "before"] = "after"
    resample: int = 1


Denoise = Callable[[Tensor, Tensor, Tensor, Condition], Tensor]
"""(x_t (B, F, D), t (B,) float in [0, 1000), mask (B, F), cond) -> (B, F, out_features): a denoiser, guided or not."""

Noise = Callable[[int], Tensor]
"""Noise number 0, 1, 2, ... of a sampling run, each (B, F, D); number 0 is where sampling starts."""


def pad_to(x: Tensor, size: int) -> Tensor:
    """Pads dimension 1 of (B, N, ...) with zeros (False) up to `size`."""
    missing = size - x.shape[1]
    return x if missing == 0 else torch.cat([x, x.new_zeros(x.shape[0], missing, *x.shape[2:])], 1)


def length_mask(lengths: Tensor, frames: int | None = None) -> Tensor:
    """(B,) lengths -> (B, F) bool mask, F = `frames` or the longest length."""
    frames = int(lengths.max()) if frames is None else frames
    return torch.arange(frames, device=lengths.device) < lengths[:, None]


def collate(samples: Sequence[tuple[str, Tensor, str | None, int | None]]) -> MotionBatch:
    """Joins (id, x (F, D), caption, action) samples into a batch padded with zeros to the longest."""
    ids, motions, texts, actions = zip(*samples, strict=True)
    lengths = torch.tensor([len(x) for x in motions])
    return MotionBatch(
        x=torch.nn.utils.rnn.pad_sequence(list(motions), batch_first=True),
        mask=length_mask(lengths),
        ids=list(ids),
        text=None if any(t is None for t in texts) else list(texts),
        action=None if any(a is None for a in actions) else torch.tensor(actions),
    )
