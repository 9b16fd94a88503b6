"""Samplers: one plain function each, which takes one step from noise towards motion, and what each of them supports.

Diffusion samplers descend numbers i of steps of a `Schedule`; they get the clean motion and the log-variance at step i
from `estimate`. ODE solvers follow a velocity field. Coefficients and times are Python numbers, so that no step waits
for the device.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from flame_mdm.batch import Edit
from flame_mdm.processes.schedules import Schedule
from flame_mdm.sampler_options import SamplerOptions

Estimate = Callable[[Tensor, int], tuple[Tensor, Tensor | float]]
"""(x_t (B, F, D), step i) -> clean estimate (B, F, D) and log-variance of x_{t-1}, a number or (B, F, D)."""

Velocity = Callable[[Tensor, float | Tensor], Tensor]  # (x (B, F, D), time t) -> dx/dt (B, F, D)


@dataclass(frozen=True)
class Sampler:
    """A sampler and what it can do."""

    # of a diffusion: (x_t, `Descent`, step i) -> x_{t-1}. Of a flow: (x, `Flow`, time, next time) -> x at the next time
    step: Callable[..., Tensor]
    # fields of `SamplerOptions` that it has besides guidance_scale, sampler and num_inference_steps
    options: tuple[str, ...] = ()
    # edits that it cannot make: modes of `Edit`, or "resample"
    unsupported: tuple[str, ...] = ()
    # whether it chooses its own steps, so that one call goes from noise to motion
    adaptive: bool = False


@dataclass
class Descent:
    """A run of a diffusion sampler."""

    estimate: Estimate  # calls the denoiser
    schedule: Schedule  # of the sampling steps
    draws: Iterator[Tensor]  # noise, in order of use
    options: SamplerOptions  # of the sampler
    last: Tensor | None = None  # clean estimate of the step before, for samplers that use it


@dataclass
class Flow:
    """A run of a flow sampler."""

    velocity: Velocity  # calls the denoiser
    draws: Iterator[Tensor]  # noise, in order of use
    sigma_min: float  # standard deviation of the noise left at the end


def ancestral(x: Tensor, run: Descent, i: int) -> Tensor:
    """Draws x_{t-1} from the learned reverse process (Ho et al. 2020, algorithm 2); the last one is its mean."""
    x0_hat, log_variance = run.estimate(x, i)
    mean = run.schedule.posterior_mean(x0_hat, x, i)
    if i == 0:
        return mean
    deviation = (
        (log_variance / 2).exp() if isinstance(log_variance, Tensor) else math.exp(log_variance / 2)
    )
    return mean + deviation * next(run.draws)


def ddim(x: Tensor, run: Descent, i: int) -> Tensor:
    """Non-Markovian sampling (Song et al. 2021, eq. 12 and 16): at eta = 0 deterministic, at 1 as `ancestral`."""
    schedule, eta = run.schedule, run.options.eta or 0.0
    x0_hat, _ = run.estimate(x, i)
    epsilon = (x - schedule.number("signal", i) * x0_hat) / schedule.number("noise", i)
    # eq. 16: eta = 1 has the variance of the ancestral step.
    variance = eta**2 * schedule.number("posterior_variance", i)
    previous = schedule.number("alphas_cumprod_prev", i)
    x = previous**0.5 * x0_hat + (1 - previous - variance) ** 0.5 * epsilon
    return x + variance**0.5 * next(run.draws) if eta and i else x


def dpm_solver_pp_2m(x: Tensor, run: Descent, i: int) -> Tensor:
    """DPM-Solver++ (2M), a deterministic multistep solver (Lu et al. 2022b, algorithm 2).

    The first step is of first order, since there is no history; the last one returns the clean estimate.
    """
    schedule, last = run.schedule, run.last
    x0_hat, _ = run.estimate(x, i)
    run.last = x0_hat
    if i == 0:
        return x0_hat
    size = schedule.log_snr(i - 1) - schedule.log_snr(i)
    data = x0_hat
    if last is not None:
        data = x0_hat + size / (2 * (schedule.log_snr(i) - schedule.log_snr(i + 1))) * (
            x0_hat - last
        )
    shrink = schedule.number("noise", i - 1) / schedule.number("noise", i)
    return shrink * x - schedule.number("signal", i - 1) * math.expm1(-size) * data


def consistency(x: Tensor, run: Descent, i: int) -> Tensor:
    """Estimates the clean motion, and adds new noise of the next step (Song et al. 2023, algorithm 1)."""
    x0_hat, _ = run.estimate(x, i)
    return run.schedule.corrupt(x0_hat, next(run.draws), i - 1) if i else x0_hat


def blended(
    sampler: Sampler, x: Tensor, run: Descent, steps: Sequence[int], edit: Edit, start: Tensor
) -> Tensor:
    """Takes `steps` and replaces the kept part of each noisy motion by the known motion, as noisy as the rest.

    With the blend "after", the kept part of the first x_t has the noise of the `start`, as if blended after a step
    before. RePaint (Lugmayr et al. 2022, algorithm 1) repeats each step after adding its noise again.
    """
    schedule, draws = run.schedule, run.draws
    if edit.blend == "after":
        x = torch.where(edit.keep, schedule.corrupt(edit.known, start, steps[0]), x)
    for i in steps:
        for repeats_left in reversed(range(edit.resample if i else 1)):
            if edit.blend == "before":
                x = torch.where(edit.keep, schedule.corrupt(edit.known, next(draws), i), x)
            x = sampler.step(x, run, i)
            if edit.blend == "after":
                kept = schedule.corrupt(edit.known, next(draws), i - 1) if i else edit.known
                x = torch.where(edit.keep, kept, x)
            if repeats_left:
                beta = schedule.number("betas", i)
                x = (1 - beta) ** 0.5 * x + beta**0.5 * next(draws)
    return x


DIFFUSION_SAMPLERS = {
    "ancestral": Sampler(ancestral, ("spacing",)),
    "ddim": Sampler(ddim, ("spacing", "eta")),
    "dpm_solver_pp_2m": Sampler(dpm_solver_pp_2m, ("spacing",), unsupported=("resample",)),
    "consistency": Sampler(consistency),
}


def euler(x: Tensor, run: Flow, t: float, end: float) -> Tensor:
    """Order 1, one call per step."""
    return x + (end - t) * run.velocity(x, t)


def midpoint(x: Tensor, run: Flow, t: float, end: float) -> Tensor:
    """Order 2, two calls per step."""
    dt = end - t
    return x + dt * run.velocity(x + dt / 2 * run.velocity(x, t), t + dt / 2)


def heun(x: Tensor, run: Flow, t: float, end: float) -> Tensor:
    """Order 2, two calls per step: the trapezoid with an Euler predictor."""
    dt = end - t
    first = run.velocity(x, t)
    return x + dt / 2 * (first + run.velocity(x + dt * first, t + dt))


def rk4(x: Tensor, run: Flow, t: float, end: float) -> Tensor:
    """Order 4, four calls per step: Kutta's 3/8 rule, also called rk4 in torchdiffeq."""
    dt = end - t
    k1 = run.velocity(x, t)
    k2 = run.velocity(x + dt / 3 * k1, t + dt / 3)
    k3 = run.velocity(x + dt * (k2 - k1 / 3), t + dt * 2 / 3)
    k4 = run.velocity(x + dt * (k1 - k2 + k3), t + dt)
    return x + dt / 8 * (k1 + 3 * (k2 + k3) + k4)


def dopri5(x: Tensor, run: Flow, t: float, end: float) -> Tensor:
    """Adaptive steps of order 5 (Dormand and Prince 1980), rtol = atol = 1e-5, as MFM.

    The error is measured over the entire batch, so a motion depends on the rest of its batch, up to the tolerance. The
    last step may go beyond the last time; the solver then interpolates back.
    """
    ends = torch.tensor([t, end], dtype=x.dtype, device=x.device)
    from torchdiffeq import odeint  # here, because it imports much of scipy

    path = odeint(lambda t, y: run.velocity(y, t), x, ends, rtol=1e-5, atol=1e-5, method="dopri5")
    assert isinstance(path, Tensor)
    return path[-1]


def consistency_flow(x: Tensor, run: Flow, t: float, end: float) -> Tensor:
    """As `consistency`: goes straight to the data, and adds new noise of the next time."""
    shrink = 1 - run.sigma_min
    x0_hat = (1 - shrink * t) * run.velocity(x, t) + shrink * x
    return end * x0_hat + (1 - shrink * end) * next(run.draws) if end < 1 else x0_hat


FLOW_SAMPLERS = {
    "euler": Sampler(euler),
    "midpoint": Sampler(midpoint),
    "heun": Sampler(heun),
    "rk4": Sampler(rk4),
    "dopri5": Sampler(dopri5, unsupported=("trajectory", "x0"), adaptive=True),
    "consistency": Sampler(consistency_flow, unsupported=("trajectory",)),
}
