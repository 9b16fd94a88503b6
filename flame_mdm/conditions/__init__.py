"""Encoders of what a motion is asked to be: text, an action label, or nothing."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

from torch import nn

from flame_mdm.motion import Condition, MotionBatch


class ConditionEncoder(nn.Module, ABC):
    """Turns the text or the action of a batch into a `Condition`, the null condition of the recipe included."""

    features: int
    """C, the width of the condition; 0 = unconditioned."""

    @abstractmethod
    def forward(self, batch: MotionBatch) -> Condition:
        """Encodes the conditions of a batch, on the device of `batch.x`."""

    def precompute(self, captions: Sequence[str], folder: Path) -> None:
        """Fills the cache on disk for these captions, where the encoder keeps one. Called on one process only."""

    def load_cache(self, captions: Sequence[str], folder: Path) -> None:
        """Opens the cache that `precompute` filled. Called on every process."""
