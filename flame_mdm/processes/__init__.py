"""Generative processes: corruption of motion, prediction target of the denoiser, training loss and sampling."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

from torch import Tensor, nn

from flame_mdm.batch import Condition, Denoise, Edit, Noise
from flame_mdm.sampler_options import MAX_STEPS as MAX_STEPS

Auxiliary = Callable[[Tensor, Tensor, Tensor], dict[str, Tensor]]
"""(x0_hat (B, F, D), x (B, F, D), mask (B, F)) -> weighted per-sample losses (B,) of the clean estimate, by name."""


class Process(nn.Module, ABC):
    """A path between noise and data. Only the process interprets t; the denoiser just embeds it."""

    prediction: str
    """What the denoiser returns: x0, epsilon (the noise) or velocity."""

    edit_modes: Sequence[str] = ()
    """Modes of `Edit` that sampling supports; the first is the authors'."""

    sampler_names: Sequence[str] = ()
    """Values of `sampler` in `sample`."""

    @abstractmethod
    def out_features(self, features: int) -> int:
        """Returns the number of output channels of the denoiser for D = `features`: D, or 2D with learned variance."""

    @abstractmethod
    def training_times(self, u: Tensor) -> Tensor:
        """Returns times t (B,) of training samples for uniform numbers (B,) in (0, 1)."""

    @abstractmethod
    def corrupt(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Returns noisy motion x_t (B, F, D) at times t (B,) from clean `x` and `noise` (B, F, D)."""

    @abstractmethod
    def target(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Returns the training target (B, F, D) of the denoiser at times t (B,)."""

    @abstractmethod
    def to_x0(self, output: Tensor, x_t: Tensor, t: Tensor) -> Tensor:
        """Returns the clean estimate (B, F, D); for target(x, noise, t) and corrupt(x, noise, t), it is x."""

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
        """Returns training losses per sample, (B,) each, by name; "loss" is their sum.

        Times t (B,) and noise (B, F, D) are drawn from torch's default generator if not given.
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
        num_inference_steps: int | Sequence[int],
        edit: Edit | None = None,
        spacing: str = "linspace",
        eta: float = 0.0,
        trajectory: list[Tensor] | None = None,
    ) -> Tensor:
        """Samples normalized motion (B, F, D) from noise; frames past the end of a motion are 0.

        Raises:
            ValueError: the process does not support the sampler, the number of steps or the edit mode.
        """
