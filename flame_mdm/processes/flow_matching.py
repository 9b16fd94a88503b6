"""Flow matching on straight paths (Lipman et al. 2023; Motion Flow Matching)."""

from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor

from flame_mdm.batch import Condition, Denoise, Edit, Noise
from flame_mdm.losses import masked_mse
from flame_mdm.processes import Auxiliary, Process, samplers
from flame_mdm.processes.diffusion import check_edit

TimeDistribution = Literal["uniform", "logit_normal"]
STEPS = {"euler": samplers.euler, "midpoint": samplers.midpoint, "heun": samplers.heun, "rk4": samplers.rk4}


class FlowMatching(Process):
    """Straight path from noise at t = 0 to motion at t = 1; the denoiser predicts its velocity and is passed 1000 t."""

    edit_modes = ("trajectory", "x0")
    sampler_names = (*STEPS, "dopri5")

    def __init__(
        self,
        sigma_min: float = 1e-4,
        prediction: Literal["velocity", "x0"] = "velocity",
        time_distribution: TimeDistribution = "uniform",
        quantize_time: bool = False,
        odeint_grid: bool = False,
    ):
        """Builds the process.

        Args:
            sigma_min: standard deviation of the noise left at t = 1 (Lipman et al. 2023, eq. 20-23).
            prediction: output of the denoiser: the velocity of the path (MFM), or the clean motion, from which the
                velocity is computed. A network narrower than the motion cannot represent the noise in the velocity.
            time_distribution: distribution of training times: uniform on [0, 1), or the logistic of a normal variable,
                which favors the middle (Esser et al. 2024, eq. 19).
            quantize_time: pass floor(1000 t), a row of the time table, to the denoiser, as in MFM's code.
            odeint_grid: use float32 multiples of 1 / N as times, like torchdiffeq's Euler steps in MFM's code. For some
                N, a time is one row of the table lower than with N equal steps (never for 10, 20 or 30).

        Raises:
            ValueError: the prediction or time distribution is unknown, or sigma_min is not in [0, 1).
        """
        super().__init__()
        if prediction not in ("velocity", "x0"):
            raise ValueError(f"unknown prediction '{prediction}': choose from velocity, x0")
        if time_distribution not in get_args(TimeDistribution):
            known = ", ".join(get_args(TimeDistribution))
            raise ValueError(f"unknown time_distribution '{time_distribution}': choose from {known}")
        if not 0 <= sigma_min < 1:
            raise ValueError(f"sigma_min is {sigma_min}: choose a number in [0, 1)")
        self.sigma_min = sigma_min
        self.prediction = prediction
        self.time_distribution = time_distribution
        self.quantize_time = quantize_time
        self.odeint_grid = odeint_grid

    def out_features(self, features: int) -> int:
        return features

    def training_times(self, u: Tensor) -> Tensor:
        return u if self.time_distribution == "uniform" else torch.special.ndtri(u).sigmoid()

    def corrupt(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        t = t[:, None, None]
        return t * x + (1 - (1 - self.sigma_min) * t) * noise

    def target(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        return x if self.prediction == "x0" else x - (1 - self.sigma_min) * noise

    def to_x0(self, output: Tensor, x_t: Tensor, t: Tensor) -> Tensor:
        """See `Process.to_x0`. Exact, unlike x_t + (1 - t) u in MFM's code, which leaves sigma_min times the noise."""
        if self.prediction == "x0":
            return output
        return (1 - (1 - self.sigma_min) * t[:, None, None]) * output + (1 - self.sigma_min) * x_t

    def table_time(self, t: Tensor) -> Tensor:
        """Converts flow times to times for the denoiser in [0, 1000]; above 1000 only if a solver evaluates t > 1."""
        # Always in float32: models were trained with this rounding.
        return (t.to(torch.float32) * 1000).floor() if self.quantize_time else t * 1000

    def times(self, num_inference_steps: int) -> list[float]:
        """Returns the N + 1 times from 0 to 1 that bound the steps."""
        count = num_inference_steps
        if self.odeint_grid:
            return [*(torch.arange(count, dtype=torch.float32) * (1 / count)).tolist(), 1.0]
        return [i / count for i in range(count + 1)]

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
        """Returns the terms "mse" of the velocity (Lipman et al. 2023, eq. 23), those of `auxiliary`, and "loss"."""
        if t is None:
            t = self.training_times(torch.rand(len(x), device=x.device))
        if noise is None:
            noise = torch.randn_like(x)
        x_t = self.corrupt(x, noise, t)
        output = denoise(x_t, self.table_time(t), mask, cond).to(x_t.dtype)
        terms = {"mse": masked_mse(output, self.target(x, noise, t), mask)}
        if auxiliary is not None:
            terms |= auxiliary(self.to_x0(output, x_t, t), x, mask)
        return terms | {"loss": torch.stack(list(terms.values())).sum(0)}

    def sample(
        self,
        denoise: Denoise,
        noise: Noise,
        mask: Tensor,
        cond: Condition,
        *,
        sampler: str = "euler",
        num_inference_steps: int | Sequence[int],
        edit: Edit | None = None,
        spacing: str = "linspace",
        eta: float = 0.0,
        trajectory: list[Tensor] | None = None,
    ) -> Tensor:
        """See `Process.sample`; draws only noise number 0.

        Args:
            denoise: the denoiser, with or without guidance; called 1 (euler), 2 (midpoint, heun) or 4 times (rk4) per
                step.
            noise: the start.
            mask: (B, F).
            cond: the condition.
            sampler: "euler", "midpoint", "heun", "rk4" or "dopri5".
            num_inference_steps: N >= 1 equal steps; "dopri5" chooses its own.
            edit: mode "trajectory" (MFM, algorithm 1) overwrites the kept part before each step at a time <= `until`
                with the straight path from its noise to the known motion; after that, the model moves it freely. Mode
                "x0" overwrites the clean estimate of every call, which reproduces the kept part exactly. Not supported
                by "dopri5".
            spacing, eta: of diffusion; other values than these are refused.
            trajectory: list to which the clean estimate (B, F, D) of each call is appended.

        Raises:
            ValueError: the sampler, number of steps or edit is not supported.
        """
        if sampler not in self.sampler_names:
            raise ValueError(f"unknown sampler '{sampler}': FlowMatching has {', '.join(self.sampler_names)}")
        if spacing != "linspace" or eta:
            raise ValueError(f"spacing={spacing}, eta={eta}: a flow takes equal steps without noise; leave them out")
        if not isinstance(num_inference_steps, int):
            raise ValueError(f"num_inference_steps={num_inference_steps}: a flow takes a number of equal steps")
        if num_inference_steps < 1:
            raise ValueError(f"num_inference_steps is {num_inference_steps}: flow matching needs at least 1")
        if edit is not None:
            check_edit(edit, mask, self.edit_modes, "FlowMatching")
            if sampler == "dopri5":
                raise ValueError(f"dopri5 chooses its own steps and cannot edit: choose from {', '.join(STEPS)}")
        start = noise(0)

        def velocity(x: Tensor, t: float | Tensor) -> Tensor:
            # Filling a tensor on the device with a number needs no copy and no synchronization.
            precision = torch.promote_types(x.dtype, torch.float32)
            time = t.expand(len(x)) if isinstance(t, Tensor) else x.new_full((len(x),), t, dtype=precision)
            output = x

            def clean(x: Tensor) -> Tensor:
                nonlocal output
                output = denoise(x, self.table_time(time), mask, cond).to(x.dtype)
                return self.to_x0(output, x, time)

            imposed = edit if edit is not None and edit.mode == "x0" else None
            x0_hat = clean(x) if imposed is None else imposed.impose(clean, x)
            if self.prediction == "velocity" and trajectory is None and imposed is None:
                return output
            straight = (x0_hat - (1 - self.sigma_min) * x) / (1 - (1 - self.sigma_min) * time[:, None, None])
            if self.prediction == "x0":
                output = straight
            elif imposed is not None:
                output = straight if imposed.guide else torch.where(imposed.keep, straight, output)
            if trajectory is not None:
                trajectory.append(x0_hat * mask[..., None])
            return output

        if sampler == "dopri5":
            return samplers.dopri5(velocity, start) * mask[..., None]
        step, times, count = STEPS[sampler], self.times(num_inference_steps), num_inference_steps
        first = 0 if edit is None else count - edit.steps(count)
        x = start
        if edit is not None and edit.strength is not None:
            x = self.corrupt(edit.known, start, start.new_full((len(start),), times[first]))
        for i in range(first, count):
            if edit is not None and edit.mode == "trajectory" and i / count <= edit.until:
                x = torch.where(edit.keep, (start * (count - i) + edit.known * i) / count, x)
            x = step(velocity, x, times[i], times[i + 1] - times[i])
        if edit is not None and edit.mode == "x0":
            x = torch.where(edit.keep, edit.known, x)
        return x * mask[..., None]
