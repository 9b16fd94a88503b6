"""Networks that see a noisy motion and predict what the process asks for."""

from abc import ABC, abstractmethod

from torch import Tensor, nn

from flame_mdm.motion import Condition


class Denoiser(nn.Module, ABC):
    """A network (x_t, t, mask, cond) -> prediction.

    Subclasses take `in_features` (D), `out_features` (D, or 2D with a learned variance) and `cond_features` (C; 0 =
    unconditioned) first, which `task.build` passes, then their own named sizes, which the YAML gives.
    """

    @abstractmethod
    def forward(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        """Predicts from a noisy motion. Pure: draws nothing (but dropout in training), reads and writes nothing.

        Args:
            x_t: (B, F, D) noisy motion.
            t: (B,) float in [0, 1000), the time as a row of the sinusoidal table.
            mask: (B, F) bool, True = real frame. What stands in other frames does not change the result in real ones.
            cond: the condition, with nulls already in place of dropped samples.

        Returns:
            (B, F, out_features).
        """
