"""Whether a motion obeys the floor."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

HEIGHT = 0.05
"""Metres above the floor, y = 0, below which a toe joint touches it."""
SPEED = 0.5
"""Metres a second over the ground above which a toe joint on the floor slides."""


class FootSkating(Metric):
    """Foot skating ratio: share of frame steps in which a foot that touches the floor slides.

    A toe joint touches the floor while it is below 5 cm in two adjacent frames, and slides when it moves further than
    2.5 cm between them over the ground (Karunratanakul et al. 2023, "Guided Motion Diffusion"). The 2.5 cm belong to 20
    frames a second; at other rates the same speed, 0.5 m/s, counts. Two deviations from the code released with the
    paper: it asks in addition for the same speed in the mean of five frames, which the paper does not; and it averages
    the ratios of the motions, where here every frame step counts alike.

    Args:
        fps: frames a second of the motions.
        toes: the toe joints; the default are those of the 22 SMPL joints.
    """

    higher_is_better = False
    full_state_update = False
    skating: Tensor
    steps: Tensor

    def __init__(self, fps: float, toes: tuple[int, ...] = (10, 11), **kwargs: Any):
        super().__init__(**kwargs)
        self.fps, self.toes = fps, list(toes)
        self.add_state("skating", torch.tensor(0), dist_reduce_fx="sum")
        self.add_state("steps", torch.tensor(0), dist_reduce_fx="sum")

    def update(self, joints: Tensor, mask: Tensor) -> None:
        """Adds motions: joints (B, F, J, 3) in metres, y up; mask (B, F) bool, True = real frame."""
        toes = joints[:, :, self.toes].double()
        moved = (toes[:, 1:, :, [0, 2]] - toes[:, :-1, :, [0, 2]]).norm(dim=-1)
        low = toes[..., 1] < HEIGHT
        slides = (low[:, 1:] & low[:, :-1] & (moved * self.fps > SPEED)).any(-1)
        real = mask[:, 1:] & mask[:, :-1]
        self.skating += (slides & real).sum()
        self.steps += real.sum()

    def compute(self) -> float | None:
        """The ratio in [0, 1]; None where no motion had two frames."""
        return int(self.skating) / int(self.steps) if int(self.steps) else None
