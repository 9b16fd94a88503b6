"""Paths between noise and motion: how motion is corrupted, what the denoiser predicts, and the way back."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

from torch import Tensor, nn

from flame_mdm.motion import Condition, Denoise, Edit, Noise

Auxiliary = Callable[[Tensor, Tensor, Tensor], dict[str, Tensor]]
"""(x0_hat (B, F, D), x (B, F, D), mask (B, F)) -> weighted per-sample losses (B,) on the clean estimate, by name."""


MOST_STEPS = 100_000
"""Most steps of a diffusion, or of a sampler."""


class Process(nn.Module, ABC):
    """A path between noise and data. Only the process interprets t; the denoiser merely embeds it."""

    edit_modes: Sequence[str] = ()
    """Modes of `Edit` that sampling can impose, the authors' own first."""

    @abstractmethod
    def out_features(self, features: int) -> int:
        """Channels the denoiser has to return for motions of `features` channels: D, or 2D with learned variance."""

    @abstractmethod
    def training_times(self, u: Tensor) -> Tensor:
        """Times t (B,) of training samples from uniform numbers (B,) in (0, 1)."""

    @abstractmethod
    def corrupt(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Noisy motion x_t (B, F, D) at times t (B,) from clean `x` and `noise` (B, F, D)."""

    @abstractmethod
    def target(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """What the denoiser should return (B, F, D) at times t (B,)."""

    @abstractmethod
    def to_x0(self, output: Tensor, x_t: Tensor, t: Tensor) -> Tensor:
        """Clean estimate (B, F, D): of target(x, noise, t) and corrupt(x, noise, t), it is x."""

    @abstractmethod
    def loss(
        self,
        denoise: Denoise,
        x: Tensor,
        mask: Tensor,
        cond: Condition,
        *,
        t: Tensor | None = None,
        noise: Tensor | None = None,
        auxiliary: Auxiliary | None = None,
    ) -> dict[str, Tensor]:
        """Training losses of each sample, (B,) each; key "loss" is their sum.

        Times t (B,) and noise (B, F, D) are drawn from torch's default generator where not given.
        """

    @abstractmethod
    def sample(
        self,
        denoise: Denoise,
        noise: Noise,
        mask: Tensor,
        cond: Condition,
        *,
        sampler: str,
        num_inference_steps: int,
        edit: Edit | None = None,
    ) -> Tensor:
        """Normalised motion (B, F, D) from noise; frames past the end of a motion are 0.

        Raises:
            ValueError: an unknown sampler, a number of steps this process cannot take, or an edit mode it lacks.
        """
