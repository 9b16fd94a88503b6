"""Condition encoders: text, action labels, or unconditional."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal

import torch
from torch import nn

from flame_mdm.batch import Condition, MotionBatch


class ConditionEncoder(nn.Module, ABC):
    """Encodes the text or action of a batch as a `Condition`, including the null condition."""

    features: int
    """C, the width of the condition; 0 = unconditioned."""
    reads: Literal["text", "action"] = "text"
    """What it encodes."""
    max_words: int | None = None
    """Maximum number of words per caption, where the encoder counts words."""
    seen: Collection[str] | None = None
    """Words of the training captions, once they are known."""

    @abstractmethod
    def forward(self, batch: MotionBatch) -> Condition:
        """Encodes the conditions of a batch, on the device of `batch.x`; raises `ValueError` if it has none."""

    def pretrain(self, groups: Sequence[Sequence[str]], seed: int) -> None:
        """Trains the encoder on captions alone, if it can, before the first step; `groups` are captions of a clip."""

    def precompute(self, captions: Sequence[str], folder: Path) -> None:
        """Fills the encoder's cache on disk, if it has one, for these captions. Called in one process only."""

    def load_cache(self, captions: Sequence[str], folder: Path) -> int:
        """Opens the cache of `precompute`, in every process; returns its bytes, or raises `UserError` if damaged."""
        return 0

    def move_cache(self, device: torch.device) -> None:
        """Moves the opened cache to a device."""


class Unconditional(ConditionEncoder):
    """No condition: vectors and tokens of width 0, which are also the null."""

    features = 0

    def forward(self, batch: MotionBatch) -> Condition:
        x, mask = batch.x, batch.mask
        null = Condition(x.new_zeros(1, 0), x.new_zeros(1, 0, 0), mask.new_zeros(1, 0))
        return Condition(x[:, 0, :0], x[:, :0, :0], mask[:, :0], null)
