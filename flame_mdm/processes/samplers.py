"""Sampling loops from noise to motion, one plain function each, and the options that each of them has.

Diffusion samplers descend numbers i of steps of a `Schedule`; they get the clean motion and the log-variance at step i
from `estimate`. ODE solvers follow a velocity field. Coefficients and times are Python numbers, so that no loop waits
for the device.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from flame_mdm.batch import Condition, Denoise, Edit
from flame_mdm.processes.schedules import Schedule
from flame_mdm.sampler_options import SamplerOptions

Estimate = Callable[[Tensor, int], tuple[Tensor, Tensor | float]]
"""(x_t (B, F, D), step i) -> clean estimate (B, F, D) and log-variance of x_{t-1}, a number or (B, F, D)."""

Velocity = Callable[[Tensor, float | Tensor], Tensor]  # (x (B, F, D), time t) -> dx/dt (B, F, D)


@dataclass(frozen=True)
class Sampler:
    """A sampling loop and what it can do."""

    # of a diffusion: (x_t, `Descent`) -> x after its last step. Of a flow: (velocity, x, times) -> x at the last time.
    loop: Callable[..., Tensor]
    # fields of `SamplerOptions` that it has besides guidance_scale, sampler and num_inference_steps
    options: tuple[str, ...] = ()
    # whether each step depends on the previous x alone, so that an edit can come between two steps
    single_step: bool = True


class CountedDenoise:
    """A denoiser that counts its calls (NFE). Outside of guidance, a call with the doubled batch counts once."""

    def __init__(self, denoise: Denoise):
        self.denoise = denoise
        self.calls = 0

    def __call__(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        self.calls += 1
        return self.denoise(x_t, t, mask, cond)


class Descent(NamedTuple):
    """Inputs of a diffusion sampler, apart from x_t."""

    estimate: Estimate  # calls the denoiser
    schedule: Schedule  # of the sampling steps
    steps: Sequence[int]  # numbers i of the steps to take, falling
    draws: Iterator[Tensor]  # noise, in order of use
    options: SamplerOptions  # of the sampler


# Diffusion ------------------------------------------------------------------------------------------------------------


def ancestral(x: Tensor, run: Descent) -> Tensor:
    """Draws every x_{t-1} from the learned reverse process (Ho et al. 2020, algorithm 2); the last one is its mean."""
    for i in run.steps:
        x0_hat, log_variance = run.estimate(x, i)
        x = ancestral_step(x, x0_hat, log_variance, run.schedule, i, next(run.draws) if i else None)
    return x


def ddim(x: Tensor, run: Descent) -> Tensor:
    """Non-Markovian sampling (Song et al. 2021): deterministic at eta = 0, as random as `ancestral` at eta = 1."""
    eta = run.options.eta or 0.0
    for i in run.steps:
        x0_hat, _ = run.estimate(x, i)
        x = ddim_step(x, x0_hat, run.schedule, i, next(run.draws) if eta and i else None, eta)
    return x


def dpm_solver_pp_2m(x: Tensor, run: Descent) -> Tensor:
    """DPM-Solver++ (2M), a deterministic multistep solver (Lu et al. 2022b, algorithm 2).

    The first step is of first order, since there is no history; the last one returns the clean estimate.
    """
    signal, deviation = (run.schedule.tables[name].tolist() for name in ("signal", "noise"))
    log_snr = [math.log(a / s) for a, s in zip(signal, deviation, strict=True)]
    last: Tensor | None = None
    for i in run.steps:
        x0_hat, _ = run.estimate(x, i)
        if i == 0:
            return x0_hat
        size = log_snr[i - 1] - log_snr[i]
        data = x0_hat
        if last is not None:
            data = x0_hat + size / (2 * (log_snr[i] - log_snr[i + 1])) * (x0_hat - last)
        last = x0_hat
        x = deviation[i - 1] / deviation[i] * x - signal[i - 1] * math.expm1(-size) * data
    return x


def consistency(x: Tensor, run: Descent) -> Tensor:
    """Estimates the clean motion, adds new noise of the next step, and repeats (Song et al. 2023, algorithm 1)."""
    for i in run.steps:
        x, _ = run.estimate(x, i)
        x = run.schedule.corrupt(x, next(run.draws), i - 1) if i else x
    return x


def ancestral_step(
    x_t: Tensor, x0_hat: Tensor, log_variance: Tensor | float, schedule: Schedule, i: int, noise: Tensor | None
) -> Tensor:
    """Draws x_{t-1} from p(x_{t-1} | x_t) (Ho et al. 2020, algorithm 2); returns its mean if `noise` is None."""
    mean = schedule.posterior_mean(x0_hat, x_t, i)
    if noise is None:
        return mean
    deviation = (log_variance / 2).exp() if isinstance(log_variance, Tensor) else math.exp(log_variance / 2)
    return mean + deviation * noise


def ddim_step(x_t: Tensor, x0_hat: Tensor, schedule: Schedule, i: int, noise: Tensor | None, eta: float) -> Tensor:
    """Returns x_{t-1} of DDIM (Song et al. 2021, eq. 12 and 16); `noise` is needed if eta > 0."""
    epsilon = (x_t - schedule.at("signal", i, x_t) * x0_hat) / schedule.at("noise", i, x_t)
    # eq. 16: eta = 1 has the variance of the ancestral step.
    variance = eta**2 * schedule.at("posterior_variance", i, x_t)
    previous = schedule.at("alphas_cumprod_prev", i, x_t)
    x = previous**0.5 * x0_hat + (1 - previous - variance) ** 0.5 * epsilon
    return x if noise is None else x + variance**0.5 * noise


def blended(run: Descent, edit: Edit, start: Tensor) -> Descent:
    """Returns a run whose `estimate` sees the known motion, as noisy as x_t, in the kept part of x_t.

    This wrapper is exact, since what a sampler makes of the kept part is replaced before the next call. With the blend
    "after", the kept part of the first x_t has the noise of the start, as if it were blended after a step before that.
    """
    first = run.steps[0] if edit.blend == "after" else None

    def estimate(x_t: Tensor, i: int) -> tuple[Tensor, Tensor | float]:
        noise = start if i == first else next(run.draws)
        return run.estimate(torch.where(edit.keep, run.schedule.corrupt(edit.known, noise, i), x_t), i)

    return run._replace(estimate=estimate)


def repaint(sampler: Sampler, x: Tensor, run: Descent, edit: Edit) -> Tensor:
    """RePaint (Lugmayr et al. 2022, algorithm 1): takes each step several times, adding its noise again in between."""
    schedule, draws = run.schedule, run.draws
    if edit.blend == "after" and edit.strength is None:
        x = torch.where(edit.keep, schedule.corrupt(edit.known, x, run.steps[0]), x)
    for i in run.steps:
        for repeats_left in reversed(range(edit.resample if i else 1)):
            if edit.blend == "before":
                x = torch.where(edit.keep, schedule.corrupt(edit.known, next(draws), i), x)
            x = sampler.loop(x, run._replace(steps=[i]))
            if edit.blend == "after":
                kept = schedule.corrupt(edit.known, next(draws), i - 1) if i else edit.known
                x = torch.where(edit.keep, kept, x)
            if repeats_left:
                beta = schedule.at("betas", i, x)
                x = (1 - beta) ** 0.5 * x + beta**0.5 * next(draws)
    return x


DIFFUSION_SAMPLERS = {
    "ancestral": Sampler(ancestral, ("spacing",)),
    "ddim": Sampler(ddim, ("spacing", "eta")),
    "dpm_solver_pp_2m": Sampler(dpm_solver_pp_2m, ("spacing",), single_step=False),
    "consistency": Sampler(consistency),
}

# Flows ----------------------------------------------------------------------------------------------------------------


def euler(velocity: Velocity, x: Tensor, times: Sequence[float]) -> Tensor:
    """Order 1, one call per step."""
    for t, end in pairwise(times):
        x = x + (end - t) * velocity(x, t)
    return x


def midpoint(velocity: Velocity, x: Tensor, times: Sequence[float]) -> Tensor:
    """Order 2, two calls per step."""
    for t, end in pairwise(times):
        dt = end - t
        x = x + dt * velocity(x + dt / 2 * velocity(x, t), t + dt / 2)
    return x


def heun(velocity: Velocity, x: Tensor, times: Sequence[float]) -> Tensor:
    """Order 2, two calls per step: the trapezoid with an Euler predictor."""
    for t, end in pairwise(times):
        dt = end - t
        first = velocity(x, t)
        x = x + dt / 2 * (first + velocity(x + dt * first, t + dt))
    return x


def rk4(velocity: Velocity, x: Tensor, times: Sequence[float]) -> Tensor:
    """Order 4, four calls per step: Kutta's 3/8 rule, also called rk4 in torchdiffeq."""
    for t, end in pairwise(times):
        dt = end - t
        k1 = velocity(x, t)
        k2 = velocity(x + dt / 3 * k1, t + dt / 3)
        k3 = velocity(x + dt * (k2 - k1 / 3), t + dt * 2 / 3)
        k4 = velocity(x + dt * (k1 - k2 + k3), t + dt)
        x = x + dt / 8 * (k1 + 3 * (k2 + k3) + k4)
    return x


def dopri5(velocity: Velocity, x: Tensor, times: Sequence[float]) -> Tensor:
    """Adaptive steps of order 5 from the first to the last time (Dormand and Prince 1980), rtol = atol = 1e-5, as MFM.

    The error is measured over the entire batch, so a motion depends on the rest of its batch, up to the tolerance. The
    last step may go beyond the last time; the solver then interpolates back.
    """
    ends = torch.tensor([times[0], times[-1]], dtype=x.dtype, device=x.device)
    from torchdiffeq import odeint  # here, because it imports much of scipy

    path = odeint(lambda t, y: velocity(y, t), x, ends, rtol=1e-5, atol=1e-5, method="dopri5")
    assert isinstance(path, Tensor)
    return path[-1]


def consistency_flow(
    velocity: Velocity, x: Tensor, times: Sequence[float], draws: Iterator[Tensor], sigma_min: float
) -> Tensor:
    """As `consistency`: goes straight to the data, adds new noise of the next time, and repeats."""
    shrink = 1 - sigma_min
    for t, end in pairwise(times):
        x = (1 - shrink * t) * velocity(x, t) + shrink * x
        x = end * x + (1 - shrink * end) * next(draws) if end < 1 else x
    return x


def rewrite(
    sampler: Sampler, velocity: Velocity, x: Tensor, times: Sequence[float], first: int, start: Tensor, edit: Edit
) -> Tensor:
    """MFM's editing (Hu et al. 2023, algorithm 1): replaces the kept part before each step at a time <= `until`.

    It is replaced by the straight path from its noise in `start` to the known motion; after that, the model moves it.
    Sampling begins with step number `first`.
    """
    count = len(times) - 1
    for i in range(first, count):
        if i / count <= edit.until:
            x = torch.where(edit.keep, (start * (count - i) + edit.known * i) / count, x)
        x = sampler.loop(velocity, x, times[i : i + 2])
    return x


FLOW_SAMPLERS = {
    "euler": Sampler(euler),
    "midpoint": Sampler(midpoint),
    "heun": Sampler(heun),
    "rk4": Sampler(rk4),
    "dopri5": Sampler(dopri5, single_step=False),
    "consistency": Sampler(consistency_flow),
}
