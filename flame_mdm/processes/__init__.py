"""Generative processes: corruption of motions, denoiser targets, losses and sampling."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor, nn

from flame_mdm.batch import Condition, Denoise, Edit, Noise
from flame_mdm.errors import UserError
from flame_mdm.losses import masked_mse
from flame_mdm.processes.samplers import Sampler
from flame_mdm.sampler_options import SamplerOptions

Auxiliary = Callable[[Tensor, Tensor, Tensor], dict[str, Tensor]]
"""Signature of additional losses: (x0_hat (B, F, D), x (B, F, D), mask (B, F)) -> losses by name.

Each loss (B,) is already weighted and has one value per sample.
"""


class Process(nn.Module, ABC):
    """Base class for generative processes: paths between noise and data.

    The subclasses implement Gaussian diffusion and flow matching. A process corrupts training
    motions, defines what the denoiser predicts, and samples motions from noise. Only the process
    interprets the time t; the denoiser merely embeds it. B is the batch size, F the number of
    frames, and D the number of features.

    Example:
        >>> import torch
        >>> from flame_mdm.processes.flow_matching import FlowMatching
        >>> process = FlowMatching()
        >>> x, noise, t = torch.ones(1, 4, 2), torch.zeros(1, 4, 2), torch.tensor([0.25])
        >>> x_t = process.corrupt(x, noise, t)
        >>> x_t[0, 0].tolist()
        [0.25, 0.25]
        >>> torch.allclose(process.to_x0(process.target(x, noise, t), x_t, t), x)
        True
    """

    #: What the denoiser returns: "x0" (the clean motion), "epsilon" (the noise) or "velocity".
    prediction: str

    #: Modes of `Edit` that sampling supports. The first one is the mode that the authors use.
    edit_modes: Sequence[str] = ()

    #: Samplers, keyed by name.
    samplers: Mapping[str, Sampler] = {}

    #: Whether losses are averaged over the padded length, with zero noise in the padding.
    average_padding: bool = False

    @abstractmethod
    def out_features(self, features: int) -> int:
        """Returns how many output channels the denoiser needs for D = `features` input channels.

        This number is D, or 2D if the variance is learned.
        """

    @abstractmethod
    def training_times(self, u: Tensor) -> Tensor:
        """Maps uniform random numbers (B,) in (0, 1) to the times t (B,) of training samples."""

    @abstractmethod
    def corrupt(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Computes the noisy motion x_t (B, F, D) at times t (B,) from a clean motion and noise.

        The clean motion `x` and `noise` have shape (B, F, D).
        """

    @abstractmethod
    def target(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Returns the training target (B, F, D) of the denoiser at times t (B,)."""

    @abstractmethod
    def to_x0(self, output: Tensor, x_t: Tensor, t: Tensor) -> Tensor:
        """Converts the denoiser's output for the noisy motion x_t to the clean estimate (B, F, D).

        If the output is target(x, noise, t) and the noisy motion is corrupt(x, noise, t), the
        clean estimate is x.
        """

    def table_time(self, t: Tensor) -> Tensor:
        """Converts times (B,) of this process to the denoiser's times, in [0, 1000)."""
        return t

    def clean(
        self, denoise: Denoise, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition
    ) -> Tensor:
        """Calls a denoiser at times t (B,) and returns its clean estimate (B, F, D)."""
        return self.to_x0(denoise(x_t, self.table_time(t), mask, cond).to(x_t.dtype), x_t, t)

    @abstractmethod
    def grid(self, count: int) -> list[float]:
        """Returns `count` evenly spaced times from pure noise to one interval before the data.

        If the process has fewer time steps than `count`, all of them are returned.
        """

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
        """Computes the training losses of a batch.

        Args:
            denoise: the denoiser.
            x: (B, F, D) normalized clean motion.
            mask: (B, F) bool, True for real frames.
            cond: conditions of the batch.
            t: (B,) times. Default: drawn from torch's default generator.
            noise: (B, F, D). Default: drawn from torch's default generator.
            auxiliary: additional losses on the clean estimate, such as
                `flame_mdm.losses.MotionLosses`.

        Returns:
            Per-sample losses (B,), keyed by name: the losses returned by `terms` and `auxiliary`,
            and their sum, "loss".
        """
        t, noise = self.drawn(x, t, noise)
        averaged = mask
        if self.average_padding:
            noise, averaged = noise * mask[..., None], torch.ones_like(mask)
        x_t = self.corrupt(x, noise, t)
        output = denoise(x_t, self.table_time(t), mask, cond).to(x_t.dtype)
        terms = self.terms(output, x, noise, x_t, t, averaged)
        if auxiliary is not None:
            terms |= auxiliary(self.to_x0(output, x_t, t), x, mask)
        return terms | {"loss": torch.stack(list(terms.values())).sum(0)}

    def drawn(
        self, x: Tensor, t: Tensor | None = None, noise: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Returns times (B,) and noise like x (B, F, D), and draws them if they are missing."""
        if t is None:
            t = self.training_times(torch.rand(len(x), device=x.device))
        if noise is None:
            noise = torch.randn_like(x)
        return t, noise

    def terms(
        self, output: Tensor, x: Tensor, noise: Tensor, x_t: Tensor, t: Tensor, mask: Tensor
    ) -> dict[str, Tensor]:
        """Returns per-sample losses (B,) of the denoiser's output, averaged over the real frames.

        The loss "mse" is the mean squared difference between the output and the target.
        """
        return {"mse": masked_mse(output, self.target(x, noise, t), mask)}

    @abstractmethod
    def sample(
        self,
        denoise: Denoise,
        noise: Noise,
        mask: Tensor,
        cond: Condition,
        options: SamplerOptions,
        *,
        edit: Edit | None = None,
        trajectory: list[Tensor] | None = None,
    ) -> Tensor:
        """Samples normalized motion from noise.

        Args:
            denoise: the denoiser, with or without guidance; `options.guidance_scale` is ignored.
            noise: function that maps the draw index (0, 1, 2, ...) to noise (B, F, D). Sampling
                starts from draw 0.
            mask: (B, F) bool, True for real frames.
            cond: conditions of the batch.
            options: the sampler, its number of steps and its options.
            edit: the part of a motion that sampling keeps. Default: nothing is kept.
            trajectory: list to which the clean estimate (B, F, D) of each denoiser call is
                appended.

        Returns:
            Normalized motion (B, F, D). Frames past the end of a motion are 0.

        Raises:
            UserError: If the process does not support the sampler, the number of steps or the edit,
                or if the sampler does not support one of the options.
        """

    def find_sampler(self, options: SamplerOptions) -> Sampler:
        """Returns the requested sampler.

        Raises:
            UserError: If there is no such sampler, or if it does not support one of the options.
        """
        name = options.sampler
        if name is None or name not in self.samplers:
            raise UserError(
                f"unknown sampler '{name}'. Available for {type(self).__name__}: {', '.join(self.samplers)}"
            )
        names = ["guidance_scale", "sampler", "num_inference_steps", *self.samplers[name].options]
        for option, value in options.chosen().items():
            if option not in names:
                has = ", ".join(names)
                raise UserError(
                    f"{option}={value}: the sampler {name} does not support this option. "
                    f"It supports {has}"
                )
        return self.samplers[name]

    def check_edit(self, edit: Edit, mask: Tensor, options: SamplerOptions) -> None:
        """Raises `UserError` if this process or the sampler does not support an edit.

        The same error is raised if the edit and the motions have different shapes.
        """
        if edit.mode not in self.edit_modes:
            modes = ", ".join(self.edit_modes)
            raise UserError(
                f"edit mode '{edit.mode}' is not supported: {type(self).__name__} supports {modes}"
            )
        kinds = {edit.mode, "resample"} if edit.resample > 1 else {edit.mode}
        able = [
            name for name, sampler in self.samplers.items() if not kinds & set(sampler.unsupported)
        ]
        if options.sampler not in able:
            edits = " and ".join(sorted(kinds))
            raise UserError(
                f"the sampler {options.sampler} does not support edits with {edits}. "
                f"Use one of these samplers: {', '.join(able)}"
            )
        shapes = [tuple(x.shape) for x in (edit.known, edit.keep, mask)]
        if shapes[0] != shapes[1] or shapes[0][:2] != shapes[2]:
            raise UserError(
                "the shape of the edit does not match the motions: known, keep and mask have shapes "
                f"{shapes}"
            )
