"""Gaussian diffusion (Ho et al. 2020) with a fixed or a learned variance (Nichol and Dhariwal 2021)."""

import math
from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from flame_mdm.batch import Condition, Denoise, Edit, Noise
from flame_mdm.losses import masked_mean, masked_mse
from flame_mdm.processes import Auxiliary, Process, samplers
from flame_mdm.processes.schedules import Schedule, ScheduleName, build_schedule, timesteps

Prediction = Literal["x0", "epsilon", "velocity"]
Variance = Literal["fixed_small", "fixed_large", "learned_range"]
TimestepSampling = Literal["uniform", "loss_aware"]
Sampler = Literal["ancestral", "ddim", "dpm_solver_pp_2m"]


class LossAwareTimesteps(nn.Module):
    """Draws training steps in proportion to sqrt(E[L_t^2]) (Nichol and Dhariwal 2021, eq. 18).

    E[L_t^2] is the mean over the last 10 losses of a step; until every step has 10, steps are drawn uniformly. The
    history is stored in buffers: it is saved with the model, and with DDP that of rank 0 is broadcast to all ranks.
    """

    history: Tensor
    counts: Tensor

    def __init__(self, num_train_timesteps: int, kept: int = 10, uniform_share: float = 0.001):
        """`uniform_share` is the probability of drawing uniformly, so that every step can be drawn."""
        super().__init__()
        self.uniform_share = uniform_share
        self.register_buffer("history", torch.zeros(num_train_timesteps, kept))
        self.register_buffer("counts", torch.zeros(num_train_timesteps, dtype=torch.int64))

    def probabilities(self) -> Tensor:
        """Returns the probability (T,) of each step."""
        total, kept = self.history.shape
        weights = self.history.square().mean(1).sqrt()
        share = weights / weights.sum().clamp(min=torch.finfo(weights.dtype).tiny)
        share = (1 - self.uniform_share) * share + self.uniform_share / total
        return torch.where((self.counts >= kept).all(), share, torch.full_like(share, 1 / total))

    def draw(self, batch: int) -> tuple[Tensor, Tensor]:
        """Returns steps (B,) int64 and weights (B,) that make the expected losses those of uniform drawing."""
        p = self.probabilities()
        t = torch.multinomial(p, batch, replacement=True)
        return t, 1 / (len(p) * p[t])

    def update(self, t: Tensor, losses: Tensor) -> None:
        """Adds unweighted losses (B,) at steps t (B,) int64, which may repeat, to the history."""
        kept = self.history.shape[1]
        order = torch.argsort(t, stable=True)
        t, losses = t[order], losses.detach()[order].to(self.history)
        index = torch.arange(len(t), device=t.device)
        before = index - torch.searchsorted(t, t)
        behind = torch.searchsorted(t, t, right=True) - 1 - index
        slot = (self.counts[t] + before) % kept
        newest = behind < kept
        self.history[t[newest], slot[newest]] = losses[newest]
        self.counts.index_add_(0, t, torch.ones_like(t))


class GaussianDiffusion(Process):
    """Gaussian diffusion over T steps. t is the step 0 ... T - 1 as a float, passed unchanged to the denoiser."""

    edit_modes = ("x0", "x_t")
    sampler_names = get_args(Sampler)

    def __init__(
        self,
        num_train_timesteps: int = 1000,
        schedule: ScheduleName = "cosine",
        prediction: Prediction = "x0",
        variance: Variance = "fixed_small",
        vlb_weight: float = 0.001,
        vlb_units: Literal["nats", "bits"] = "nats",
        vlb_decoder: Literal["kl", "discretized"] = "kl",
        average_padding: bool = False,
        clip_x0: bool = False,
        timestep_sampling: TimestepSampling = "uniform",
    ):
        """Builds the process.

        Args:
            num_train_timesteps: T.
            schedule: name of the noise schedule.
            prediction: meaning of the first D channels of the denoiser's output: the clean motion, the noise, or the
                velocity sqrt(ab) noise - sqrt(1 - ab) x (Salimans and Ho 2022).
            variance: variance of the reverse process: that of the posterior, beta, or learned between the two, from a
                second set of D channels (Nichol and Dhariwal 2021, eq. 15).
            vlb_weight: lambda in L_simple + lambda L_vlb (FLAME, eq. 4 and 15), if the variance is learned. L_vlb is
                the sum over T steps, estimated by T times the term of one step. So 0.001 at T = 1000, the value of
                Nichol and Dhariwal, corresponds to 1 in FLAME's code.
            vlb_units: "bits" divides by ln 2, as in guided-diffusion.
            vlb_decoder: term of step 0: "kl" is the divergence with the clipped posterior variance (FLAME's code),
                "discretized" the likelihood of the data in 255 bins of [-1, 1] (guided-diffusion), intended for pixels.
            average_padding: average losses over the padded length with noise 0 in the padding, as in FLAME's code, so
                that short motions have less weight. The denoiser must return 0 there.
            clip_x0: clamp the clean estimate to [-1, 1] in sampling, as in FLAME's code.
            timestep_sampling: how training steps are drawn.

        Raises:
            ValueError: an option has an unknown value.
        """
        super().__init__()
        for name, value, known in (
            ("prediction", prediction, get_args(Prediction)),
            ("variance", variance, get_args(Variance)),
            ("vlb_units", vlb_units, ("nats", "bits")),
            ("vlb_decoder", vlb_decoder, ("kl", "discretized")),
            ("timestep_sampling", timestep_sampling, get_args(TimestepSampling)),
        ):
            if value not in known:
                raise ValueError(f"unknown {name} '{value}': choose from {', '.join(known)}")
        self.schedule = build_schedule(schedule, num_train_timesteps)
        self.prediction = prediction
        self.variance = variance
        self.vlb_weight = vlb_weight
        self.vlb_units = vlb_units
        self.vlb_decoder = vlb_decoder
        self.average_padding = average_padding
        self.clip_x0 = clip_x0
        self.timesteps = LossAwareTimesteps(num_train_timesteps) if timestep_sampling == "loss_aware" else None

    def out_features(self, features: int) -> int:
        return 2 * features if self.variance == "learned_range" else features

    def training_times(self, u: Tensor) -> Tensor:
        return (u * len(self.schedule)).floor().clamp(max=len(self.schedule) - 1)

    def corrupt(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        return self.schedule.corrupt(x, noise, t)

    def target(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        if self.prediction == "x0":
            return x
        if self.prediction == "epsilon":
            return noise
        return self.schedule.at("signal", t, x) * noise - self.schedule.at("noise", t, x) * x

    def to_x0(self, output: Tensor, x_t: Tensor, t: Tensor) -> Tensor:
        """See `Process.to_x0`; `output` may contain the channels of a learned variance."""
        return self._to_x0(output, x_t, t)

    def _to_x0(self, output: Tensor, x_t: Tensor, i: Tensor | int) -> Tensor:
        output = output[..., : x_t.shape[-1]]
        if self.prediction == "x0":
            return output
        signal, noise = self.schedule.at("signal", i, x_t), self.schedule.at("noise", i, x_t)
        if self.prediction == "epsilon":
            return (x_t - noise * output) / signal
        return signal * x_t - noise * output

    def log_variance(self, output: Tensor, x_t: Tensor, i: Tensor | int, schedule: Schedule) -> Tensor | float:
        """Returns the log-variance of x_{t-1} at step i of `schedule`: a number, (B, 1, 1), or (B, F, D) if learned."""
        small = schedule.at("posterior_log_variance", i, x_t)
        if self.variance == "fixed_small":
            return small
        if self.variance == "fixed_large":
            return schedule.at("large_log_variance", i, x_t)
        share = (output[..., x_t.shape[-1] :] + 1) / 2
        return share * schedule.at("log_betas", i, x_t) + (1 - share) * small

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
        """Returns the terms "mse" (FLAME, eq. 3), "vlb" if the variance is learned, those of `auxiliary`, and "loss".

        Loss-aware steps are drawn, and their history updated, only in training mode and if t is not given. All terms
        are then weighted so that they are unbiased.
        """
        weights = None
        if t is None and self.timesteps is not None and self.training:
            t, weights = self.timesteps.draw(len(x))
            t = t.to(torch.float32)
        elif t is None:
            t = self.training_times(torch.rand(len(x), device=x.device))
        if noise is None:
            noise = torch.randn_like(x)
        averaged = mask
        if self.average_padding:
            noise, averaged = noise * mask[..., None], torch.ones_like(mask)
        x_t = self.corrupt(x, noise, t)
        output = denoise(x_t, t, mask, cond).to(x_t.dtype)
        terms = {"mse": masked_mse(output[..., : x.shape[-1]], self.target(x, noise, t), averaged)}
        if self.variance == "learned_range" and self.vlb_weight:
            scale = self.vlb_weight * len(self.schedule)
            terms["vlb"] = scale * masked_mean(self.vlb(output, x, x_t, t), averaged)
        if auxiliary is not None:
            terms |= auxiliary(self.to_x0(output, x_t, t), x, mask)
        loss = torch.stack(list(terms.values())).sum(0)
        if weights is not None and self.timesteps is not None:
            self.timesteps.update(t.long(), loss)
            terms = {name: weights * term for name, term in terms.items()}
            loss = weights * loss
        return terms | {"loss": loss}

    def vlb(self, output: Tensor, x: Tensor, x_t: Tensor, t: Tensor) -> Tensor:
        """Returns terms of the variational bound (B, F, D) at steps t (B,), in `vlb_units` (Ho et al. 2020, eq. 5).

        Only the variance receives a gradient (Nichol and Dhariwal 2021, section 3.1).
        """
        real = self.schedule.posterior_mean(x, x_t, t)
        real_log_variance = self.schedule.at("posterior_log_variance", t, x_t)
        mean = self.schedule.posterior_mean(self.to_x0(output, x_t, t).detach(), x_t, t)
        log_variance = torch.as_tensor(self.log_variance(output, x_t, t, self.schedule))
        terms = _normal_kl(real, torch.as_tensor(real_log_variance), mean, log_variance)
        if self.vlb_decoder == "discretized":
            terms = torch.where((t == 0)[:, None, None], -_binned_log_likelihood(x, mean, log_variance), terms)
        return terms / math.log(2) if self.vlb_units == "bits" else terms

    def prior(self, x: Tensor, mask: Tensor) -> Tensor:
        """Returns the divergence (B,) of the noisiest x_t from the prior, the term L_T, in `vlb_units` per entry."""
        last = len(self.schedule) - 1
        mean = self.schedule.at("signal", last, x) * x
        log_variance = x.new_tensor(2 * math.log(self.schedule.at("noise", last, x)))
        terms = masked_mean(_normal_kl(mean, log_variance, torch.zeros_like(x), torch.zeros_like(log_variance)), mask)
        return terms / math.log(2) if self.vlb_units == "bits" else terms

    def sample(
        self,
        denoise: Denoise,
        noise: Noise,
        mask: Tensor,
        cond: Condition,
        *,
        sampler: str = "ancestral",
        num_inference_steps: int | Sequence[int],
        edit: Edit | None = None,
        spacing: str = "linspace",
        eta: float = 0.0,
        trajectory: list[Tensor] | None = None,
    ) -> Tensor:
        """See `Process.sample`.

        Args:
            denoise: the denoiser, with or without guidance; called once per step.
            noise: draws in order of use: the start, then those of each step. The last step draws none.
            mask: (B, F).
            cond: the condition.
            sampler: "ancestral", "ddim" or "dpm_solver_pp_2m".
            num_inference_steps: 2 to T steps placed by `spacing`, or the steps themselves in increasing order.
            edit: mode "x0" (reproduces the kept part exactly) or "x_t".
            spacing: see `schedules.timesteps`.
            eta: randomness of "ddim", 0 to 1.
            trajectory: list to which the clean estimate (B, F, D) of each call is appended.

        Raises:
            ValueError: the sampler, number of steps, edit or eta is not supported.
        """
        if sampler not in self.sampler_names:
            raise ValueError(f"unknown sampler '{sampler}': GaussianDiffusion has {', '.join(self.sampler_names)}")
        if eta and (sampler != "ddim" or not 0 <= eta <= 1):
            raise ValueError(f"eta={eta} with sampler {sampler}: eta is an option of ddim, from 0 to 1")
        if edit is not None:
            check_edit(edit, mask, self.edit_modes, "GaussianDiffusion")
            if edit.resample > 1 and sampler == "dpm_solver_pp_2m":
                raise ValueError("resample needs a sampler without history: choose ancestral or ddim")
        steps = self._steps(num_inference_steps, spacing)
        schedule = self.schedule.respace(steps)

        def estimate(x_t: Tensor, i: int) -> tuple[Tensor, Tensor | float]:
            t = torch.full((len(x_t),), float(steps[i]), device=x_t.device)
            output = x_t

            def clean(x_t: Tensor) -> Tensor:
                nonlocal output
                output = denoise(x_t, t, mask, cond).to(x_t.dtype)
                x0_hat = self._to_x0(output, x_t, steps[i])
                return x0_hat.clamp(-1, 1) if self.clip_x0 else x0_hat

            x0_hat = edit.impose(clean, x_t) if edit is not None and edit.mode == "x0" else clean(x_t)
            if trajectory is not None:
                trajectory.append(x0_hat * mask[..., None])
            return x0_hat, self.log_variance(output, x_t, i, schedule)

        if sampler == "ddim":
            x = samplers.ddim(estimate, schedule, noise, edit, eta=eta)
        elif sampler == "ancestral":
            x = samplers.ancestral(estimate, schedule, noise, edit)
        else:
            x = samplers.dpm_solver_pp_2m(estimate, schedule, noise, edit)
        return x * mask[..., None]

    def _steps(self, chosen: int | Sequence[int], spacing: str) -> list[int]:
        total = len(self.schedule)
        if isinstance(chosen, int):
            if chosen < 2:
                raise ValueError(f"num_inference_steps is {chosen}: diffusion takes 2 to {total} steps")
            return timesteps(total, chosen, spacing)
        steps = list(chosen)
        whole = all(type(step) is int for step in steps)
        if not whole or len(steps) < 2 or steps != sorted(set(steps)) or steps[0] < 0 or steps[-1] >= total:
            raise ValueError(
                f"sampling steps must be at least 2 distinct steps from 0 to {total - 1}, increasing: got {steps}"
            )
        return steps


def check_edit(edit: Edit, mask: Tensor, modes: Sequence[str], process: str) -> None:
    """Checks an edit before a long run.

    Raises:
        ValueError: the process does not support its mode, or its shape does not match the motions.
    """
    if edit.mode not in modes:
        raise ValueError(f"edit mode '{edit.mode}' is not supported: {process} has {', '.join(modes)}")
    if edit.blend not in ("after", "before") or edit.resample < 1:
        raise ValueError(
            f"edit has blend={edit.blend}, resample={edit.resample}: blend is after or before, resample at least 1"
        )
    if edit.strength is not None and not 0 < edit.strength <= 1:
        raise ValueError(f"strength={edit.strength}: choose a number above 0, up to 1")
    if edit.known.shape != edit.keep.shape or edit.known.shape[:2] != mask.shape:
        shapes = f"known {tuple(edit.known.shape)}, keep {tuple(edit.keep.shape)}"
        raise ValueError(f"edit does not match the shape of the motions: {shapes}, mask {tuple(mask.shape)}")


def _normal_kl(mean: Tensor, log_variance: Tensor, other_mean: Tensor, other_log_variance: Tensor) -> Tensor:
    """Returns the elementwise KL divergence of one normal distribution from another, in nats."""
    difference = log_variance - other_log_variance
    return 0.5 * (difference.exp() - 1 - difference + (mean - other_mean).square() * (-other_log_variance).exp())


def _binned_log_likelihood(x: Tensor, mean: Tensor, log_variance: Tensor) -> Tensor:
    """Returns the log-probability in nats of x's bin: 255 bins in [-1, 1], outer ones open (Ho et al. 2020, eq. 13).

    The normal distribution function is approximated by a tanh, as in guided-diffusion.
    """

    def cdf(z: Tensor) -> Tensor:
        return 0.5 * (1 + torch.tanh(math.sqrt(2 / math.pi) * (z + 0.044715 * z**3)))

    scale = (-0.5 * log_variance).exp()
    upper, lower = cdf(scale * (x - mean + 1 / 255)), cdf(scale * (x - mean - 1 / 255))
    upper, lower = torch.where(x > 0.999, 1.0, upper), torch.where(x < -0.999, 0.0, lower)
    return (upper - lower).clamp(min=1e-12).log()
