"""Flow matching on straight paths (Lipman et al. 2023; Motion Flow Matching)."""

import itertools
from typing import Literal

import torch
from torch import Tensor

from flame_mdm.batch import Condition, Denoise, Edit, Noise
from flame_mdm.errors import UserError
from flame_mdm.processes import Process, samplers
from flame_mdm.sampler_options import SamplerOptions


class FlowMatching(Process):
    """Flow matching on straight paths from noise at t = 0 to motion at t = 1, as in MFM.

    The denoiser receives the time 1000 t and predicts the velocity of the path or the clean motion.
    With s = `sigma_min`, x_t = t x + (1 - (1 - s) t) noise, and the velocity is x - (1 - s) noise.
    Sources: Lipman et al. 2023; Hu et al. 2023.

    Args:
        sigma_min: standard deviation of the noise that remains at t = 1 (Lipman et al. 2023, eq.
            20-23).
        prediction: what the denoiser predicts, either the velocity of the path ("velocity", as in
            MFM) or the clean motion ("x0"), from which the velocity is computed. A network whose
            layers are narrower than the motion features cannot represent the noise in the velocity.
        time_distribution: distribution of training times: "uniform" on [0, 1), or "logit_normal".
            The latter is the logistic function of a normal variable and favors times in the middle
            (Esser et al. 2024, eq. 19).
        quantize_time: whether to pass floor(1000 t) to the denoiser, as a row index into the time
            table, as in MFM's code.
        odeint_grid: whether to use float32 multiples of 1 / N as times, like torchdiffeq's Euler
            steps in MFM's code. For some N, `quantize_time` then rounds some times to a table row
            that is one lower than the row that N equal steps would use. This never happens for N =
            10, 20 or 30.

    Raises:
        UserError: If `sigma_min` is not in [0, 1).

    Example:
        >>> import torch
        >>> from flame_mdm.batch import Condition
        >>> from flame_mdm.sampler_options import SamplerOptions
        >>> process = FlowMatching(prediction="x0")
        >>> x, mask = torch.ones(1, 4, 2), torch.ones(1, 4, dtype=torch.bool)
        >>> cond = Condition(x[:, 0], x[:, :0], None)
        >>> def oracle(x_t, t, mask, cond):  # a denoiser that knows the motion
        ...     return x
        >>> options = SamplerOptions(sampler="euler", num_inference_steps=4)
        >>> motion = process.sample(oracle, lambda draw: torch.randn(1, 4, 2), mask, cond, options)
        >>> torch.allclose(motion, x, atol=1e-3)  # up to sigma_min
        True
    """

    edit_modes = ("trajectory", "x0")
    samplers = samplers.FLOW_SAMPLERS

    def __init__(
        self,
        sigma_min: float = 1e-4,
        prediction: Literal["velocity", "x0"] = "velocity",
        time_distribution: Literal["uniform", "logit_normal"] = "uniform",
        quantize_time: bool = False,
        odeint_grid: bool = False,
    ):
        super().__init__()
        if not 0 <= sigma_min < 1:
            raise UserError(f"sigma_min={sigma_min}: expected a number in [0, 1)")
        self.sigma_min, self.prediction, self.time_distribution = (
            sigma_min,
            prediction,
            time_distribution,
        )
        self.quantize_time, self.odeint_grid = quantize_time, odeint_grid

    def out_features(self, features: int) -> int:
        """Returns D, because no variance is learned."""
        return features

    def training_times(self, u: Tensor) -> Tensor:
        """Maps uniform numbers (B,) to times (B,) in (0, 1), following `time_distribution`."""
        return u if self.time_distribution == "uniform" else torch.special.ndtri(u).sigmoid()

    def corrupt(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Returns x_t (B, F, D) at times t (B,) (Lipman et al. 2023, eq. 22)."""
        t = t[:, None, None]
        return t * x + (1 - (1 - self.sigma_min) * t) * noise

    def target(self, x: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """See `Process.target`.

        The target is the velocity (Lipman et al. 2023, eq. 23) or the clean motion.
        """
        return x if self.prediction == "x0" else x - (1 - self.sigma_min) * noise

    def to_x0(self, output: Tensor, x_t: Tensor, t: Tensor) -> Tensor:
        """See `Process.to_x0`. Unlike in MFM's code, the result is exact.

        MFM's code computes x_t + (1 - t) u, which retains sigma_min times the noise.
        """
        if self.prediction == "x0":
            return output
        return (1 - (1 - self.sigma_min) * t[:, None, None]) * output + (1 - self.sigma_min) * x_t

    def table_time(self, t: Tensor) -> Tensor:
        """Converts flow times in [0, 1] to the denoiser's times in [0, 1000].

        The result exceeds 1000 only if a solver evaluates a time t > 1.
        """
        # Times are always computed in float32, because models were trained with this rounding.
        return (t.to(torch.float32) * 1000).floor() if self.quantize_time else t * 1000

    def times(self, count: int) -> list[float]:
        """Returns the N + 1 times from 0 to 1 that delimit N = `count` steps."""
        if self.odeint_grid:
            return [*(torch.arange(count, dtype=torch.float32) * (1 / count)).tolist(), 1.0]
        return [i / count for i in range(count + 1)]

    def grid(self, count: int) -> list[float]:
        """Returns `count` evenly spaced times, from 0 to one interval before 1."""
        return self.times(count)[:-1]

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
        """See `Process.sample`.

        Flow matching uses N >= 1 steps of equal size, except with "dopri5", which chooses its own
        step sizes.

        Only "consistency" adds noise. An edit with mode "trajectory" is applied before each step at
        a time <= `until`: the kept part is set to its point on the straight path from its noise to
        the known motion (MFM, algorithm 1). After this time, the model may change the kept part
        freely. Mode "x0" overwrites the kept part in the clean estimate of every call and therefore
        reproduces the kept part exactly.
        """
        sampler, count = self.find_sampler(options), options.num_inference_steps
        if not isinstance(count, int):
            raise UserError(
                f"num_inference_steps={count}: flow matching uses steps of equal size. "
                "Specify a single whole number"
            )
        if edit is not None:
            self.check_edit(edit, mask, options)
        imposed = edit if edit is not None and edit.mode == "x0" else None
        guide = None if imposed is None else imposed.guide

        def velocity(x: Tensor, t: float | Tensor) -> Tensor:
            # Filling a tensor on the device needs no copy and no synchronization.
            precision = torch.promote_types(x.dtype, torch.float32)
            time = (
                t.expand(len(x))
                if isinstance(t, Tensor)
                else x.new_full((len(x),), t, dtype=precision)
            )
            seen = x
            if guide is not None:
                seen = guide.steer(lambda x: self.clean(denoise, x, time, mask, cond), x)
            output = denoise(seen, self.table_time(time), mask, cond).to(x.dtype)
            if self.prediction == "velocity" and trajectory is None and imposed is None:
                return output
            x0_hat = self.to_x0(output, seen, time)
            if imposed is not None:
                x0_hat = imposed.impose(x0_hat)
            if trajectory is not None:
                trajectory.append(x0_hat * mask[..., None])
            straight = (x0_hat - (1 - self.sigma_min) * x) / (
                1 - (1 - self.sigma_min) * time[:, None, None]
            )
            if self.prediction == "x0" or guide is not None:
                return straight
            return output if imposed is None else torch.where(imposed.keep, straight, output)

        draws = map(noise, itertools.count())
        x = start = next(draws)
        run = samplers.Flow(velocity, draws, self.sigma_min)
        count = 1 if sampler.adaptive else count
        times, first = self.times(count), 0 if edit is None else count - edit.steps(count)
        if edit is not None and edit.strength is not None:
            x = self.corrupt(edit.known, start, start.new_full((len(start),), times[first]))
        for i in range(first, count):
            if edit is not None and edit.mode == "trajectory" and i / count <= edit.until:
                x = torch.where(edit.keep, (start * (count - i) + edit.known * i) / count, x)
            x = sampler.step(x, run, times[i], times[i + 1])
        x = x if imposed is None else torch.where(imposed.keep, imposed.known, x)
        return x * mask[..., None]
