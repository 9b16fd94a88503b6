"""Samplers from noise to motion, one function each.

Diffusion samplers descend the steps of a `Schedule`; they call the denoiser as `estimate(x_t, i)`, which returns the
clean motion and the log-variance at step i. ODE solvers call a velocity field. Coefficients and times are Python
numbers, so that no loop waits for the device.
"""

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from flame_mdm.batch import Condition, Denoise, Edit, Noise
from flame_mdm.processes.schedules import Schedule

with torch.device("cpu"):  # it holds tensors, and a network may be built on "meta" while this module is imported
    from torchdiffeq import odeint

Estimate = Callable[[Tensor, int], tuple[Tensor, Tensor | float]]
"""(x_t (B, F, D), step i) -> clean estimate (B, F, D) and log-variance of x_{t-1}, a number or (B, F, D)."""

Velocity = Callable[[Tensor, float | Tensor], Tensor]
"""(x (B, F, D), time t) -> dx/dt (B, F, D)."""


class CountedDenoise:
    """A denoiser that counts its calls (NFE). Outside of guidance, a call with the doubled batch counts once."""

    def __init__(self, denoise: Denoise):
        self.denoise = denoise
        self.calls = 0

    def __call__(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        self.calls += 1
        return self.denoise(x_t, t, mask, cond)


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


def ancestral(estimate: Estimate, schedule: Schedule, noise: Noise, edit: Edit | None = None) -> Tensor:
    """Draws every x_{t-1} from the learned reverse process (Ho et al. 2020, algorithm 2); the last one is its mean."""

    def step(x_t: Tensor, i: int, draw: Callable[[], Tensor]) -> Tensor:
        x0_hat, log_variance = estimate(x_t, i)
        return ancestral_step(x_t, x0_hat, log_variance, schedule, i, draw() if i else None)

    return _descend(step, schedule, noise, edit)


def ddim(estimate: Estimate, schedule: Schedule, noise: Noise, edit: Edit | None = None, *, eta: float = 0.0) -> Tensor:
    """Non-Markovian sampling (Song et al. 2021): deterministic at eta = 0, as random as `ancestral` at eta = 1."""

    def step(x_t: Tensor, i: int, draw: Callable[[], Tensor]) -> Tensor:
        x0_hat, _ = estimate(x_t, i)
        return ddim_step(x_t, x0_hat, schedule, i, draw() if eta and i else None, eta)

    return _descend(step, schedule, noise, edit)


def dpm_solver_pp_2m(estimate: Estimate, schedule: Schedule, noise: Noise, edit: Edit | None = None) -> Tensor:
    """DPM-Solver++ (2M), a deterministic multistep solver (Lu et al. 2022b, algorithm 2).

    The first step is of first order, since there is no history; the last one returns the clean estimate.
    """
    signal, deviation = schedule.tables["signal"].tolist(), schedule.tables["noise"].tolist()
    log_snr = [math.log(a / s) for a, s in zip(signal, deviation, strict=True)]
    last: Tensor | None = None

    def step(x_t: Tensor, i: int, draw: Callable[[], Tensor]) -> Tensor:
        nonlocal last
        x0_hat, _ = estimate(x_t, i)
        if i == 0:
            return x0_hat
        size = log_snr[i - 1] - log_snr[i]
        data = x0_hat
        if last is not None:
            data = x0_hat + size / (2 * (log_snr[i] - log_snr[i + 1])) * (x0_hat - last)
        last = x0_hat
        return deviation[i - 1] / deviation[i] * x_t - signal[i - 1] * math.expm1(-size) * data

    return _descend(step, schedule, noise, edit)


def _descend(
    step: Callable[[Tensor, int, Callable[[], Tensor]], Tensor], schedule: Schedule, noise: Noise, edit: Edit | None
) -> Tensor:
    """Descends all steps from noise(0) and applies an edit of mode "x_t".

    Draws are numbered in order of use: blending before a step, the step, blending after it, resampling.
    """
    draws = itertools.count()

    def draw() -> Tensor:
        return noise(next(draws))

    x = draw()
    top = (len(schedule) if edit is None else edit.steps(len(schedule))) - 1
    if edit is not None and edit.strength is not None:
        x = schedule.corrupt(edit.known, x, top)
    elif edit is not None and edit.mode == "x_t" and edit.blend == "after":
        x = torch.where(edit.keep, schedule.corrupt(edit.known, x, top), x)
    if edit is None or edit.mode != "x_t":
        for i in range(top, -1, -1):
            x = step(x, i, draw)
        return x
    for i in range(top, -1, -1):
        for repeats_left in range(edit.resample - 1 if i else 0, -1, -1):
            if edit.blend == "before":
                x = torch.where(edit.keep, schedule.corrupt(edit.known, draw(), i), x)
            x = step(x, i, draw)
            if edit.blend == "after":
                kept = schedule.corrupt(edit.known, draw(), i - 1) if i else edit.known
                x = torch.where(edit.keep, kept, x)
            if repeats_left:
                beta = schedule.at("betas", i, x)
                x = (1 - beta) ** 0.5 * x + beta**0.5 * draw()
    return x


def euler(velocity: Velocity, x: Tensor, t: float, dt: float) -> Tensor:
    """One step of order 1, one call."""
    return x + dt * velocity(x, t)


def midpoint(velocity: Velocity, x: Tensor, t: float, dt: float) -> Tensor:
    """One step of order 2, two calls."""
    return x + dt * velocity(x + dt / 2 * velocity(x, t), t + dt / 2)


def heun(velocity: Velocity, x: Tensor, t: float, dt: float) -> Tensor:
    """One step of order 2, two calls: the trapezoid with an Euler predictor."""
    first = velocity(x, t)
    return x + dt / 2 * (first + velocity(x + dt * first, t + dt))


def rk4(velocity: Velocity, x: Tensor, t: float, dt: float) -> Tensor:
    """One step of order 4, four calls: Kutta's 3/8 rule, also called rk4 in torchdiffeq."""
    k1 = velocity(x, t)
    k2 = velocity(x + dt / 3 * k1, t + dt / 3)
    k3 = velocity(x + dt * (k2 - k1 / 3), t + dt * 2 / 3)
    k4 = velocity(x + dt * (k1 - k2 + k3), t + dt)
    return x + dt / 8 * (k1 + 3 * (k2 + k3) + k4)


def dopri5(velocity: Velocity, x: Tensor) -> Tensor:
    """Integrates from t = 0 to 1 with adaptive steps of order 5 (Dormand and Prince 1980), rtol = atol = 1e-5, as MFM.

    The error is measured over the entire batch, so a motion depends on the rest of its batch, up to the tolerance. The
    last step may go beyond t = 1; the solver then interpolates back.
    """
    ends = torch.tensor([0.0, 1.0], dtype=x.dtype, device=x.device)
    path = odeint(lambda t, y: velocity(y, t), x, ends, rtol=1e-5, atol=1e-5, method="dopri5")
    assert isinstance(path, Tensor)
    return path[-1]
