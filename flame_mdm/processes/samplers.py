"""Samplers: functions that take one step from noise toward motion, and the options they support.

Diffusion samplers take the steps i of a `Schedule` in decreasing order. At step i, they obtain the
clean motion and the log-variance from `estimate`. ODE solvers follow a velocity field. Coefficients
and times are Python numbers, so that no step has to wait for the device.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from flame_mdm.batch import Edit
from flame_mdm.processes.schedules import Schedule
from flame_mdm.sampler_options import SamplerOptions

# Relative and absolute tolerance of adaptive samplers, as in MFM
TOLERANCE = 1e-5

Estimate = Callable[[Tensor, int], tuple[Tensor, Tensor | float]]
"""Signature: (x_t (B, F, D), step i) -> clean estimate (B, F, D), log-variance of x_{t-1}.

The log-variance is a number or has the shape (B, F, D).
"""

Velocity = Callable[[Tensor, float | Tensor], Tensor]  # (x (B, F, D), time t) -> dx/dt (B, F, D)


@dataclass(frozen=True)
class Sampler:
    """A sampler: the function that takes one step, and the options and edits that it supports.

    Example:
        >>> DIFFUSION_SAMPLERS["ddim"].options
        ('spacing', 'eta')
    """

    #: Takes one step. Diffusion: (x_t, `Descent`, step i) -> x_{t-1}. Flow: (x, `Flow`, time, next
    #: time) -> x at the next time.
    step: Callable[..., Tensor]
    #: Fields of `SamplerOptions` that the sampler uses, in addition to guidance_scale, sampler and
    #: num_inference_steps.
    options: tuple[str, ...] = ()
    #: Edits that the sampler does not support: modes of `Edit`, or "resample".
    unsupported: tuple[str, ...] = ()
    #: Whether the sampler chooses its own step sizes. One call then goes from noise to motion.
    adaptive: bool = False


@dataclass
class Descent:
    """State of a diffusion sampler while it generates one batch."""

    #: Function that calls the denoiser.
    estimate: Estimate
    #: Schedule of the sampling steps.
    schedule: Schedule
    #: Draws of noise (B, F, D), in order of use.
    draws: Iterator[Tensor]
    #: Options of the sampler.
    options: SamplerOptions
    #: Clean estimate of the previous step, for samplers that use it.
    last: Tensor | None = None


@dataclass
class Flow:
    """State of a flow sampler while it generates one batch."""

    #: Function that calls the denoiser.
    velocity: Velocity
    #: Draws of noise (B, F, D), in order of use.
    draws: Iterator[Tensor]
    #: Standard deviation of the noise that remains at the end.
    sigma_min: float


def ancestral(x: Tensor, run: Descent, i: int) -> Tensor:
    """Draws x_{t-1} from the learned reverse process. The last step returns the mean instead.

    Source: Ho et al. 2020, algorithm 2.

    Args:
        x: (B, F, D) noisy motion at step i.
        run: the sampling run, whose clean estimate and variance define the step.
        i: the step, N - 1 ... 0.

    Returns:
        Noisy motion (B, F, D) at step i - 1.

    Example:
        >>> from flame_mdm.processes.schedules import build_schedule
        >>> draws = iter([torch.zeros(1, 1, 2)])
        >>> run = Descent(lambda x, i: (x, -5.0), build_schedule("cosine", 10), draws, SamplerOptions())
        >>> ancestral(torch.ones(1, 1, 2), run, 5).shape
        torch.Size([1, 1, 2])
    """
    x0_hat, log_variance = run.estimate(x, i)
    mean = run.schedule.posterior_mean(x0_hat, x, i)
    if i == 0:
        return mean
    deviation = (
        (log_variance / 2).exp() if isinstance(log_variance, Tensor) else math.exp(log_variance / 2)
    )
    return mean + deviation * next(run.draws)


def ddim(x: Tensor, run: Descent, i: int) -> Tensor:
    """Takes a DDIM step.

    With eta = 0 (the default), the step is deterministic; with eta = 1, it is as random as a step
    of `ancestral`. Source: Song et al. 2021, eq. 12 and 16 (non-Markovian sampling).

    Args:
        x: (B, F, D) noisy motion at step i.
        run: the sampling run, whose options contain eta, from 0 to 1.
        i: the step, N - 1 ... 0.

    Returns:
        Noisy motion (B, F, D) at step i - 1.

    Example:
        >>> from flame_mdm.processes.schedules import build_schedule
        >>> schedule = build_schedule("cosine", 10)
        >>> run = Descent(lambda x, i: (torch.ones_like(x), 0.0), schedule, iter([]), SamplerOptions())
        >>> ddim(torch.zeros(1, 1, 2), run, 0).tolist()  # the last step ends in the clean estimate
        [[[1.0, 1.0]]]
    """
    # The clean estimate implies the noise in x. The step keeps the part of this noise that the
    # next level needs, and replaces the rest with new noise of the given variance.
    schedule, eta = run.schedule, run.options.eta or 0.0
    x0_hat, _ = run.estimate(x, i)
    epsilon = (x - schedule.number("signal", i) * x0_hat) / schedule.number("noise", i)
    # eq. 16: eta = 1 has the variance of the ancestral step.
    variance = eta**2 * schedule.number("posterior_variance", i)
    previous = schedule.number("alphas_cumprod_prev", i)
    x = previous**0.5 * x0_hat + (1 - previous - variance) ** 0.5 * epsilon
    return x + variance**0.5 * next(run.draws) if eta and i else x


def dpm_solver_pp_2m(x: Tensor, run: Descent, i: int) -> Tensor:
    """Takes a step of DPM-Solver++ (2M), a deterministic multistep solver of order 2.

    The solver calls the denoiser once per step. The first step has only order 1, because it has no
    predecessor. The last step returns the clean estimate. Source: Lu et al. 2022b, algorithm 2.

    Args:
        x: (B, F, D) noisy motion at step i.
        run: the sampling run, which stores the clean estimate for the next step.
        i: the step, N - 1 ... 0.

    Returns:
        Noisy motion (B, F, D) at step i - 1.

    Example:
        >>> from flame_mdm.processes.schedules import build_schedule
        >>> schedule = build_schedule("cosine", 10)
        >>> run = Descent(lambda x, i: (torch.ones_like(x), 0.0), schedule, iter([]), SamplerOptions())
        >>> x = torch.zeros(1, 1, 2)
        >>> for i in reversed(range(10)):
        ...     x = dpm_solver_pp_2m(x, run, i)
        >>> x.tolist()
        [[[1.0, 1.0]]]
    """
    # The time is half the logarithm of the signal-to-noise ratio. With this time, the linear part
    # of the equation is solved exactly. The remaining integral contains the clean estimate, which
    # is extrapolated from this step and the previous step.
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
    """Estimates the clean motion and adds new noise for the next step.

    Distilled models use this sampler. Source: Song et al. 2023, "Consistency Models", algorithm 1.

    Args:
        x: (B, F, D) noisy motion at step i.
        run: the sampling run.
        i: the step, N - 1 ... 0.

    Returns:
        Noisy motion (B, F, D) at step i - 1, or the clean estimate after step 0.

    Example:
        >>> from flame_mdm.processes.schedules import build_schedule
        >>> schedule = build_schedule("cosine", 10)
        >>> run = Descent(lambda x, i: (x / 2, 0.0), schedule, iter([]), SamplerOptions())
        >>> consistency(torch.ones(1, 1, 2), run, 0).tolist()
        [[[0.5, 0.5]]]
    """
    x0_hat, _ = run.estimate(x, i)
    return run.schedule.corrupt(x0_hat, next(run.draws), i - 1) if i else x0_hat


def blended(
    sampler: Sampler, x: Tensor, run: Descent, steps: Sequence[int], edit: Edit, start: Tensor
) -> Tensor:
    """Samples with an edit in mode "x_t".

    At each step, the kept part is replaced by the known motion with the current amount of noise.
    If `edit.blend` is "after", the kept part is also replaced before the first step, by the known
    motion with the initial noise. RePaint (Lugmayr et al. 2022, algorithm 1) adds the noise of each
    step again and repeats the step.

    Args:
        sampler: a diffusion sampler.
        x: (B, F, D) noisy motion at the first step.
        run: the sampling run.
        steps: the steps to take, from noisy to clean.
        edit: the part to keep, how to blend it, and how many times to repeat each step.
        start: (B, F, D) noise from which sampling started.

    Returns:
        Normalized motion (B, F, D).
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
    """Takes a step of Euler's method.

    The method has order 1 and calls the denoiser once.

    Args:
        x: (B, F, D) motion at time t.
        run: the sampling run.
        t: time of x, in [0, 1).
        end: time of the result, in (0, 1].

    Returns:
        Motion (B, F, D) at time `end`.

    Example:
        >>> run = Flow(lambda x, t: torch.full_like(x, 2.0), iter([]), 0.0)
        >>> euler(torch.zeros(1, 1, 2), run, 0.0, 0.5).tolist()
        [[[1.0, 1.0]]]
    """
    return x + (end - t) * run.velocity(x, t)


def midpoint(x: Tensor, run: Flow, t: float, end: float) -> Tensor:
    """Takes a step of the midpoint method.

    The method has order 2 and calls the denoiser twice.

    Args:
        x: (B, F, D) motion at time t.
        run: the sampling run.
        t: time of x, in [0, 1).
        end: time of the result, in (0, 1].

    Returns:
        Motion (B, F, D) at time `end`.

    Example:
        >>> run = Flow(lambda x, t: torch.full_like(x, 2 * t), iter([]), 0.0)
        >>> midpoint(torch.zeros(1, 1, 2), run, 0.0, 1.0).tolist()  # the integral of 2 t
        [[[1.0, 1.0]]]
    """
    dt = end - t
    return x + dt * run.velocity(x + dt / 2 * run.velocity(x, t), t + dt / 2)


def heun(x: Tensor, run: Flow, t: float, end: float) -> Tensor:
    """Takes a step of Heun's method, the trapezoidal rule with an Euler predictor.

    The method has order 2 and calls the denoiser twice.

    Args:
        x: (B, F, D) motion at time t.
        run: the sampling run.
        t: time of x, in [0, 1).
        end: time of the result, in (0, 1].

    Returns:
        Motion (B, F, D) at time `end`.

    Example:
        >>> run = Flow(lambda x, t: torch.full_like(x, 2 * t), iter([]), 0.0)
        >>> heun(torch.zeros(1, 1, 2), run, 0.0, 1.0).tolist()  # the integral of 2 t
        [[[1.0, 1.0]]]
    """
    dt = end - t
    first = run.velocity(x, t)
    return x + dt / 2 * (first + run.velocity(x + dt * first, t + dt))


def rk4(x: Tensor, run: Flow, t: float, end: float) -> Tensor:
    """Takes a step of Kutta's 3/8 rule, which torchdiffeq also calls rk4.

    The method has order 4 and calls the denoiser four times.

    Args:
        x: (B, F, D) motion at time t.
        run: the sampling run.
        t: time of x, in [0, 1).
        end: time of the result, in (0, 1].

    Returns:
        Motion (B, F, D) at time `end`.

    Example:
        >>> run = Flow(lambda x, t: torch.full_like(x, 4 * t**3), iter([]), 0.0)
        >>> [round(value, 5) for value in rk4(torch.zeros(1, 1, 2), run, 0.0, 1.0).flatten().tolist()]
        [1.0, 1.0]
    """
    dt = end - t
    k1 = run.velocity(x, t)
    k2 = run.velocity(x + dt / 3 * k1, t + dt / 3)
    k3 = run.velocity(x + dt * (k2 - k1 / 3), t + dt * 2 / 3)
    k4 = run.velocity(x + dt * (k1 - k2 + k3), t + dt)
    return x + dt / 8 * (k1 + 3 * (k2 + k3) + k4)


def dopri5(x: Tensor, run: Flow, t: float, end: float) -> Tensor:
    """Integrates with adaptive steps of order 5 (Dormand and Prince 1980).

    As in MFM, rtol = atol = 1e-5. Because the error is measured over the entire batch, a motion
    depends on the other motions in its batch, but only within the tolerance. If the last step
    overshoots the final time, the solver interpolates back to it.

    Args:
        x: (B, F, D) motion at time t.
        run: the sampling run.
        t: time of x, in [0, 1).
        end: time of the result, in (0, 1].

    Returns:
        Motion (B, F, D) at time `end`.

    Example:
        >>> run = Flow(lambda x, t: torch.ones_like(x) * 2 * t, iter([]), 0.0)
        >>> [round(value, 4) for value in dopri5(torch.zeros(1, 1, 2), run, 0.0, 1.0).flatten().tolist()]
        [1.0, 1.0]
    """
    ends = torch.tensor([t, end], dtype=x.dtype, device=x.device)
    from torchdiffeq import odeint  # imported here because it imports much of scipy

    path = odeint(
        lambda t, y: run.velocity(y, t), x, ends, rtol=TOLERANCE, atol=TOLERANCE, method="dopri5"
    )
    assert isinstance(path, Tensor)
    return path[-1]


def consistency_flow(x: Tensor, run: Flow, t: float, end: float) -> Tensor:
    """Estimates the clean motion and adds new noise for the next time; see `consistency`.

    Args:
        x: (B, F, D) motion at time t.
        run: the sampling run.
        t: time of x, in [0, 1).
        end: time of the result, in (0, 1].

    Returns:
        Motion (B, F, D) at time `end`.

    Example:
        >>> run = Flow(lambda x, t: torch.full_like(x, 2.0), iter([]), 0.0)
        >>> consistency_flow(torch.zeros(1, 1, 2), run, 0.5, 1.0).tolist()
        [[[1.0, 1.0]]]
    """
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
