"""Action recognition accuracy of generated motions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric


class ActionAccuracy(Metric):
    """Fraction of motions whose largest logit is that of their label (Guo et al. 2020), in [0, 1]."""

    higher_is_better = True
    full_state_update = False
    right: Tensor
    total: Tensor

    def __init__(self, **kwargs: Any):
        super().__init__(**kwargs)
        self.add_state("right", torch.tensor(0), dist_reduce_fx="sum")
        self.add_state("total", torch.tensor(0), dist_reduce_fx="sum")

    def update(self, logits: Tensor, labels: Tensor) -> None:
        """Adds class scores (B, A) and requested classes (B,).

        Raises:
            ValueError: If scores contain NaN or infinity.
        """
        if not logits.isfinite().all():
            raise ValueError("ActionAccuracy: class scores are not finite. Look for motions that are not finite")
        self.right += (logits.argmax(1) == labels).sum()
        self.total += len(labels)

    def compute(self) -> float | None:
        """Returns the accuracy; None without motions."""
        return int(self.right) / int(self.total) if int(self.total) else None
