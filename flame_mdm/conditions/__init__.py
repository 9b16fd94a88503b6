"""Condition encoders for text, for action labels, and for unconditional models."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal

import torch
from torch import nn

from flame_mdm.batch import Condition, MotionBatch


class ConditionEncoder(nn.Module, ABC):
    """Base class for encoders of text or action labels.

    For each batch, an encoder returns a `Condition`, which includes the null condition.

    Example:
        >>> class WordCount(ConditionEncoder):  # an encoder that counts the words of a caption
        ...     features = 1
        ...     def forward(self, batch):
        ...         pooled = torch.tensor([[float(len(text.split()))] for text in batch.text])
        ...         null = Condition(torch.zeros(1, 1), torch.zeros(1, 0, 1), None)
        ...         return Condition(pooled, pooled[:, None][:, :0], None, null)
        >>> x = torch.zeros(1, 5, 3)
        >>> batch = MotionBatch(x, x[..., 0] == 0, ["clip"], text=["a person walks"])
        >>> WordCount()(batch).pooled.tolist()
        [[3.0]]
    """

    #: C, the width of the condition; 0 = unconditioned.
    features: int
    #: Input of the encoder: captions ("text") or action labels ("action").
    reads: Literal["text", "action"] = "text"
    #: Maximum number of words per caption, or None for no limit.
    max_words: int | None = None
    #: Words of the training captions, or None before they are known.
    seen: Collection[str] | None = None

    @abstractmethod
    def forward(self, batch: MotionBatch) -> Condition:
        """Encodes the conditions of a batch.

        Args:
            batch: captions in `batch.text`, or labels in `batch.action`.

        Returns:
            The condition and its null condition, both on the device of `batch.x`.

        Raises:
            UserError: If the batch contains no captions or labels.
        """

    def pretrain(self, groups: Sequence[Sequence[str]], seed: int) -> None:
        """Trains the encoder on captions alone, before the first training step.

        By default, the method does nothing.

        Args:
            groups: one list of captions per clip.
            seed: seed for all random draws.
        """

    def precompute(self, captions: Sequence[str], folder: Path) -> None:
        """Encodes the given captions and writes the results to a cache on disk.

        Only one process calls this method. By default, it does nothing.
        """

    def load_cache(self, captions: Sequence[str], folder: Path) -> int:
        """Opens the cache that `precompute` wrote, and returns its size in bytes.

        Every process calls this method. The size is 0 if there is no cache.

        Raises:
            UserError: If the cache is damaged.
        """
        return 0

    def move_cache(self, device: torch.device) -> None:
        """Moves the opened cache to a device."""


class Unconditional(ConditionEncoder):
    """Encoder that returns empty conditions, whose vectors and tokens have width 0.

    Example:
        >>> x = torch.zeros(2, 5, 3)
        >>> Unconditional()(MotionBatch(x, x[..., 0] == 0, ["a", "b"])).pooled.shape
        torch.Size([2, 0])
    """

    features = 0

    def forward(self, batch: MotionBatch) -> Condition:
        """Returns an empty condition for each motion."""
        x, mask = batch.x, batch.mask
        null = Condition(x.new_zeros(1, 0), x.new_zeros(1, 0, 0), mask.new_zeros(1, 0))
        return Condition(x[:, 0, :0], x[:, :0, :0], mask[:, :0], null)
