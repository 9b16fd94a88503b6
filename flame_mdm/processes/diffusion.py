"""Gaussian diffusion with a fixed or a learned variance.

Sources: Ho et al. 2020; Nichol and Dhariwal 2021.
"""

import itertools
import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from flame_mdm.batch import Condition, Denoise, Edit, Noise
from flame_mdm.errors import UserError
from flame_mdm.losses import masked_mean, masked_mse
from flame_mdm.processes import Process, samplers
from flame_mdm.processes.schedules import Schedule, build_schedule, timesteps
from flame_mdm.sampler_options import SamplerOptions


class GaussianDiffusion(Process):
    """Gaussian diffusion over T steps (Ho et al. 2020), as in MDM and FLAME.

    The time t is the step, a float from 0 to T - 1, and is passed to the denoiser unchanged. The
    noisy motion is x_t = sqrt(ab) x + sqrt(1 - ab) noise, where the schedule determines ab ("alpha
    bar").

    Args:
        num_train_timesteps: T, the number of diffusion steps.
        schedule: name of the noise schedule, "cosine" or "linear".
        prediction: content of the first D channels of the denoiser's output: the clean motion, the
            noise, or the velocity sqrt(ab) noise - sqrt(1 - ab) x (Salimans and Ho 2022).
        variance: variance of the reverse process. "fixed_small" is the variance of the posterior.
            "fixed_large" is beta. "learned_range" lies between the two and is learned from D
            additional channels (Nichol and Dhariwal 2021, eq. 15).
        vlb_weight: lambda in L_simple + lambda L_vlb (FLAME, eq. 4 and 15). It is used only if the
            variance is learned. L_vlb is a sum over T steps, so it is computed as T times the term
            for a single step. The value 0.001 for T = 1000 (Nichol and Dhariwal) corresponds to 1
            in FLAME's code.
        average_padding: whether to average losses over the padded length, with zero noise in the
            padding, as in FLAME's code. In this case, short motions have less weight. The denoiser
            must return 0 in the padding.
        clip_x0: whether to clamp the clean estimate to [-1, 1] during sampling, as in FLAME's code.
        timestep_sampling: distribution of the diffusion steps drawn for training (FLAME, tables 6
            and 7).
        skip: whether to add a skip connection around the network. This requires the prediction
            "epsilon". The predicted noise is sqrt(1 - ab) x_t + sqrt(ab) times the output (Karras
            et al. 2022, eq. 7, for data of variance 1). With this connection, the output is a
            velocity, but the loss is the error of the noise. The network does not need to copy its
            input to its output, and the clean estimate is computed without division by the signal.
        min_snr: maximum weight of a step. The squared error is weighted as if the clean motion were
            predicted with weight min(SNR, min_snr) (Hang et al. 2023, eq. 4; they use 5). If None,
            every step has weight 1, regardless of the prediction.
        noise_scale: factor by which the noise-to-signal ratio of each step is multiplied. For
            motions with 263 interdependent features, the text is informative only at high noise
            levels. A factor above 1 assigns more steps to these levels (Hoogeboom et al. 2023,
            section 2.2).

    Raises:
        UserError: If T or `noise_scale` is out of range, if `skip` is combined with a prediction
            other than "epsilon", or if `min_snr` is not above 0.

    Example:
        >>> import torch
        >>> from flame_mdm.batch import Condition
        >>> from flame_mdm.sampler_options import SamplerOptions
        >>> process = GaussianDiffusion(num_train_timesteps=50)
        >>> x, mask = torch.ones(1, 4, 2), torch.ones(1, 4, dtype=torch.bool)
        >>> cond = Condition(x[:, 0], x[:, :0], None)
        >>> def oracle(x_t, t, mask, cond):  # a denoiser that knows the motion
        ...     return x
        >>> noise = lambda draw: torch.randn(1, 4, 2)
        >>> options = SamplerOptions(sampler="ddim", num_inference_steps=5)
        >>> process.sample(oracle, noise, mask, cond, options)[0, 0].tolist()
        [1.0, 1.0]
    """

    edit_modes = ("x0", "x_t")
    samplers = samplers.DIFFUSION_SAMPLERS

    def __init__(
        self,
        num_train_timesteps: int = 1000,
        schedule: Literal["cosine", "linear"] = "cosine",
        prediction: Literal["x0", "epsilon", "velocity"] = "x0",
        variance: Literal["fixed_small", "fixed_large", "learned_range"] = "fixed_small",
        vlb_weight: float = 0.001,
        average_padding: bool = False,
        clip_x0: bool = False,
        timestep_sampling: Literal["uniform"] = "uniform",
        skip: bool = False,
        min_snr: float | None = None,
        noise_scale: float = 1.0,
    ):
        super().__init__()
        if prediction != "epsilon" and skip:
            raise UserError("skip=true requires prediction=epsilon")
        if min_snr is not None and not 0 < min_snr < math.inf:
            raise UserError(f"min_snr={min_snr}: expected a number above 0, such as 5, or null")
        self.schedule = build_schedule(schedule, num_train_timesteps, noise_scale)
        self.prediction, self.skip, self.min_snr = prediction, skip, min_snr
        self.variance, self.vlb_weight = variance, vlb_weight
        self.average_padding, self.clip_x0 = average_padding, clip_x0

    def out_features(self, features: int) -> int:
        """Returns D, or 2D if the variance is learned."""
        return 2 * features if self.variance == "learned_range" else features

    def training_times(self, u: Tensor) -> Tensor:
        """Maps uniform random numbers (B,) in (0, 1) to uniform steps (B,) from 0 to T - 1."""
        return (u * len(self.schedule)).floor().clamp(max=len(self.schedule) - 1)

    def corrupt(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Returns x_t (B, F, D) at steps t (B,) (Ho et al. 2020, eq. 4)."""
        return self.schedule.corrupt(x, noise, t)

    def target(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Returns the target (B, F, D): the clean motion, the noise or the velocity."""
        if self.prediction == "x0":
            return x
        if self.prediction == "epsilon" and not self.skip:
            return noise
        return self.schedule.at("signal", t, x) * noise - self.schedule.at("noise", t, x) * x

    def to_x0(self, output: Tensor, x_t: Tensor, t: Tensor | int) -> Tensor:
        """See `Process.to_x0`.

        `output` may also contain the channels of a learned variance, and t may be a single step for
        the entire batch.
        """
        output = output[..., : x_t.shape[-1]]
        if self.prediction == "x0":
            return output
        signal, noise = (self.schedule.factor(name, t, x_t) for name in ("signal", "noise"))
        if self.prediction == "epsilon" and not self.skip:
            return (x_t - noise * output) / signal
        return signal * x_t - noise * output

    def grid(self, count: int) -> list[float]:
        """Returns `count` (at most T) steps, from T - 1 to one interval before the data."""
        total = len(self.schedule)
        count = min(count, total)
        return [float(round(total * k / count) - 1) for k in range(count, 0, -1)]

    def log_variance(
        self, output: Tensor, x_t: Tensor, i: Tensor | int, schedule: Schedule
    ) -> Tensor | float:
        """Returns the log-variance of x_{t-1} at step i of `schedule`.

        If the variance is fixed, the result is a number or has the shape (B, 1, 1). If the variance
        is learned, the shape is (B, F, D).
        """
        # The logarithm of a learned variance is interpolated between its two bounds.
        small = schedule.factor("posterior_log_variance", i, x_t)
        if self.variance == "fixed_small":
            return small
        if self.variance == "fixed_large":
            return schedule.factor("large_log_variance", i, x_t)
        share = (output[..., x_t.shape[-1] :] + 1) / 2
        return share * schedule.factor("log_betas", i, x_t) + (1 - share) * small

    def terms(
        self, output: Tensor, x: Tensor, noise: Tensor, x_t: Tensor, t: Tensor, mask: Tensor
    ) -> dict[str, Tensor]:
        """Returns the losses "mse" (FLAME, eq. 3) and, if the variance is learned, "vlb"."""
        prediction, target = output[..., : x.shape[-1]], self.target(x, noise, t)
        if self.skip:
            # An error in the output is the error in the noise divided by the signal.
            signal = self.schedule.at("signal", t, x)
            prediction, target = signal * prediction, signal * target
        terms = {"mse": self._snr_weight(t) * masked_mse(prediction, target, mask)}
        if self.variance == "learned_range" and self.vlb_weight:
            terms["vlb"] = (
                self.vlb_weight
                * len(self.schedule)
                * masked_mean(self.vlb(output, x, x_t, t), mask)
            )
        return terms

    def _snr_weight(self, t: Tensor) -> Tensor | float:
        """Returns the weights (B,) of the squared prediction errors at steps t (B,)."""
        if self.min_snr is None:
            return 1.0
        snr = (
            (self.schedule.at("signal", t, t) / self.schedule.at("noise", t, t)).square().flatten()
        )
        # A squared error of 1 in the clean motion corresponds to a squared error of SNR in the
        # noise and of SNR + 1 in the velocity.
        return (
            snr.clamp(max=self.min_snr)
            / {"x0": 1.0, "epsilon": snr, "velocity": snr + 1}[self.prediction]
        )

    def vlb(self, output: Tensor, x: Tensor, x_t: Tensor, t: Tensor) -> Tensor:
        """Returns the terms (B, F, D) of the variational bound at steps t (B,), in nats.

        Source: Ho et al. 2020, eq. 5. Only the variance receives a gradient (Nichol and Dhariwal
        2021, section 3.1). As in FLAME's code, the term for step 0 is the KL divergence computed
        with the clipped posterior variance.
        """
        real = self.schedule.posterior_mean(x, x_t, t)
        mean = self.schedule.posterior_mean(self.to_x0(output, x_t, t).detach(), x_t, t)
        log_variance = torch.as_tensor(self.log_variance(output, x_t, t, self.schedule))
        # KL divergence between two normal distributions
        difference = self.schedule.at("posterior_log_variance", t, x_t) - log_variance
        return 0.5 * (
            difference.exp() - 1 - difference + (real - mean).square() * (-log_variance).exp()
        )

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
        """See `Process.sample`. The denoiser is called once per step.

        Noise draws are numbered in the order in which they are used. `options.num_inference_steps`
        is either the number of steps, from 2 to T, or a list of steps in increasing order. If it is
        a number, `options.spacing` determines which steps are used. The sampler "consistency" takes
        1 to T steps, selected by `grid`. An edit with mode "x0" reproduces the kept part exactly.
        """
        sampler, steps = self.find_sampler(options), self._steps(options)
        if edit is not None:
            self.check_edit(edit, mask, options)
        schedule = self.schedule.respace(steps)

        def clean(x_t: Tensor, i: int) -> tuple[Tensor, Tensor]:
            t = torch.full((len(x_t),), float(steps[i]), device=x_t.device)
            output = denoise(x_t, t, mask, cond).to(x_t.dtype)
            x0_hat = self.to_x0(output, x_t, steps[i])
            return x0_hat.clamp(-1, 1) if self.clip_x0 else x0_hat, output

        def estimate(x_t: Tensor, i: int) -> tuple[Tensor, Tensor | float]:
            if edit is not None and edit.guide is not None:
                x_t = edit.guide.steer(lambda x: clean(x, i)[0], x_t)
            x0_hat, output = clean(x_t, i)
            if edit is not None and edit.mode == "x0":
                x0_hat = edit.impose(x0_hat)
            if trajectory is not None:
                trajectory.append(x0_hat * mask[..., None])
            return x0_hat, self.log_variance(output, x_t, i, schedule)

        draws, total = map(noise, itertools.count()), len(steps)
        x = start = next(draws)
        descent = range(total if edit is None else edit.steps(total))[::-1]
        run = samplers.Descent(estimate, schedule, draws, options)
        if edit is not None and edit.strength is not None:
            x = schedule.corrupt(edit.known, start, descent[0])
        if edit is not None and edit.mode == "x_t":
            return samplers.blended(sampler, x, run, descent, edit, start) * mask[..., None]
        for i in descent:
            x = sampler.step(x, run, i)
        return x * mask[..., None]

    def _steps(self, options: SamplerOptions) -> list[int]:
        chosen, total = options.num_inference_steps, len(self.schedule)
        if isinstance(chosen, Sequence):
            steps = list(chosen)
            if len(steps) < 2 or steps != sorted(set(steps)) or steps[-1] >= total:
                raise UserError(
                    f"num_inference_steps={steps}: expected 2 or more increasing steps from 0 to {total - 1}"
                )
            return steps
        least = 1 if options.sampler == "consistency" else 2
        if chosen is None or not least <= chosen <= total:
            raise UserError(
                f"num_inference_steps={chosen}: diffusion takes {least} to {total} steps"
            )
        if options.sampler == "consistency":
            return [int(step) for step in reversed(self.grid(chosen))]
        return timesteps(total, chosen, options.spacing or "linspace")
