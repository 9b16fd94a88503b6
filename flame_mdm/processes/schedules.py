"""Noise schedules for Gaussian diffusion: coefficients and the selection of sampling steps."""

import math

import torch
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.sampler_options import MAX_STEPS


def cosine_betas(num_train_timesteps: int) -> Tensor:
    """Returns the float64 noise variances (T,) of the cosine schedule, clipped at 0.999.

    Source: Nichol and Dhariwal 2021, eq. 17.

    Example:
        >>> betas = cosine_betas(1000)
        >>> betas.shape, f"{betas[0]:.6f}", f"{betas[-1]:.3f}"
        (torch.Size([1000]), '0.000041', '0.999')
    """

    def alpha_bar(t: float) -> float:
        return math.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2

    steps = range(num_train_timesteps)
    ratios = [
        alpha_bar((i + 1) / num_train_timesteps) / alpha_bar(i / num_train_timesteps) for i in steps
    ]
    return torch.tensor(
        [min(1 - ratio, 0.999) for ratio in ratios], dtype=torch.float64, device="cpu"
    )


def linear_betas(num_train_timesteps: int) -> Tensor:
    """Returns the float64 noise variances (T,) of the linear schedule (Ho et al. 2020, section 4).

    For T = 1000, the variances increase from 1e-4 to 0.02. For other values of T, they are
    multiplied by 1000 / T, so that the final noise is the same, as in guided-diffusion. All
    variances are clipped at 0.999.

    Example:
        >>> [round(beta, 5) for beta in linear_betas(1000)[[0, -1]].tolist()]
        [0.0001, 0.02]
    """
    scale = 1000 / num_train_timesteps
    betas = torch.linspace(
        scale * 1e-4, scale * 0.02, num_train_timesteps, dtype=torch.float64, device="cpu"
    )
    return betas.clamp(max=0.999)


def with_more_noise(betas: Tensor, noise_scale: float) -> Tensor:
    """Returns the noise variances (T,) of a schedule with more noise.

    At each step, the noise-to-signal ratio is multiplied by `noise_scale`. This shifts the
    logarithm of the signal-to-noise ratio (Hoogeboom et al. 2023, "simple diffusion", section 2.2).
    The variances are clipped at 0.999.

    Example:
        >>> before, after = (Schedule(b) for b in (cosine_betas(50), with_more_noise(cosine_betas(50), 4)))
        >>> round(before.log_snr(20) - after.log_snr(20), 6) == round(math.log(4), 6)
        True
    """
    alphas_cumprod = (1 - betas).cumprod(0)
    noise_to_signal = noise_scale**2 * (1 - alphas_cumprod) / alphas_cumprod
    shifted = 1 / (1 + noise_to_signal)
    previous = torch.cat([shifted.new_ones(1), shifted[:-1]])
    return (1 - shifted / previous).clamp(max=0.999)


class Schedule:
    """Coefficients of a Gaussian diffusion, indexed by step i, from 0 (least noise) to N - 1.

    The tables are float64 on the CPU and are rounded only once, when they are used. They are not
    buffers, because casting or moving a model (bfloat16, MPS) must not round them. Formulas: Ho et
    al. 2020, eq. 4 and 7.

    Args:
        betas: (N,) float64, the variance of the noise that each step adds.

    Example:
        >>> schedule = Schedule(cosine_betas(1000)).respace([0, 499, 999])
        >>> len(schedule), round(schedule.number("signal", 1) ** 2 + schedule.number("noise", 1) ** 2, 9)
        (3, 1.0)
    """

    def __init__(self, betas: Tensor):
        """Computes the tables."""
        alphas_cumprod = (1 - betas).cumprod(0)
        previous = torch.cat([betas.new_ones(1), alphas_cumprod[:-1]])
        posterior_variance = betas * (1 - previous) / (1 - alphas_cumprod)
        # The posterior of step 0 has variance 0 and therefore an infinite logarithm, which is
        # replaced by the logarithm of step 1 (Nichol and Dhariwal 2021).
        clipped = torch.cat([posterior_variance[:2][-1:], posterior_variance[1:]])
        self.tables = {
            "betas": betas,
            "alphas_cumprod": alphas_cumprod,
            "alphas_cumprod_prev": previous,
            "signal": alphas_cumprod.sqrt(),
            "noise": (1 - alphas_cumprod).sqrt(),
            "posterior_variance": posterior_variance,
            "posterior_log_variance": clipped.log(),
            "posterior_x0": betas * previous.sqrt() / (1 - alphas_cumprod),
            "posterior_x_t": (1 - previous) * (1 - betas).sqrt() / (1 - alphas_cumprod),
            "log_betas": betas.log(),
            "large_log_variance": torch.cat([clipped[:1], betas[1:]]).log(),
        }
        self.numbers: dict[str, list[float]] = {
            name: table.tolist() for name, table in self.tables.items()
        }
        self._moved: dict[tuple[str, torch.device, torch.dtype], Tensor] = {}

    def __len__(self) -> int:
        return len(self.tables["betas"])

    def number(self, name: str, i: int) -> float:
        """Returns a coefficient at step i as one number for the entire batch."""
        return self.numbers[name][i]

    def at(self, name: str, i: Tensor, x: Tensor) -> Tensor:
        """Returns a coefficient's values (B, 1, 1) at steps i (B,), on the device of x.

        The values have the precision of x, but at least float32.
        """
        key = (name, x.device, torch.promote_types(x.dtype, torch.float32))
        if key not in self._moved:
            self._moved[key] = self.tables[name].to(*key[1:])
        return self._moved[key][i.long()][:, None, None]

    def factor(self, name: str, i: int | Tensor, x: Tensor) -> float | Tensor:
        """Returns `number(name, i)` if i is a single step, or `at(name, i, x)` if i contains B steps."""
        return self.number(name, i) if isinstance(i, int) else self.at(name, i, x)

    def respace(self, steps: list[int]) -> "Schedule":
        """Returns the schedule for a subset of the steps, which must be in increasing order.

        Source: Nichol and Dhariwal 2021, section 4.
        """
        alphas_cumprod = self.tables["alphas_cumprod"][steps]
        previous = torch.cat([alphas_cumprod.new_ones(1), alphas_cumprod[:-1]])
        return Schedule(1 - alphas_cumprod / previous)

    def corrupt(self, x: Tensor, noise: Tensor, i: int | Tensor) -> Tensor:
        """Returns x_t (B, F, D) at step i (Ho et al. 2020, eq. 4)."""
        return self.factor("signal", i, x) * x + self.factor("noise", i, x) * noise

    def log_snr(self, i: int) -> float:
        """Returns half the logarithm of the signal-to-noise ratio at step i."""
        return math.log(self.number("signal", i) / self.number("noise", i))

    def posterior_mean(self, x0: Tensor, x_t: Tensor, i: int | Tensor) -> Tensor:
        """Returns the mean (B, F, D) of x_{t-1} given x_0 and x_t (Ho et al. 2020, eq. 7)."""
        return self.factor("posterior_x0", i, x_t) * x0 + self.factor("posterior_x_t", i, x_t) * x_t


def build_schedule(name: str, num_train_timesteps: int, noise_scale: float = 1.0) -> Schedule:
    """Builds a noise schedule.

    Args:
        name: "cosine" or "linear".
        num_train_timesteps: T, from 2 to `MAX_STEPS`.
        noise_scale: see `with_more_noise`; 1 = unchanged.

    Raises:
        UserError: If the number of steps is out of range, or if `noise_scale` is not above 0.

    Example:
        >>> len(build_schedule("linear", 50))
        50
    """
    if not 2 <= num_train_timesteps <= MAX_STEPS:
        raise UserError(
            f"num_train_timesteps={num_train_timesteps}: expected 2 to {MAX_STEPS:,} steps"
        )
    if not 0 < noise_scale < math.inf:
        raise UserError(
            f"noise_scale={noise_scale}: expected a number above 0; 1 leaves the noise of the schedule unchanged"
        )
    betas = {"cosine": cosine_betas, "linear": linear_betas}[name](num_train_timesteps)
    return Schedule(betas if noise_scale == 1 else with_more_noise(betas, noise_scale))


def timesteps(
    num_train_timesteps: int, num_inference_steps: int, spacing: str = "linspace"
) -> list[int]:
    """Selects the diffusion steps to use in sampling.

    Args:
        num_train_timesteps: T.
        num_inference_steps: N, from 1 to T.
        spacing: "linspace" includes both ends and rounds half to even; the code of MDM and FLAME
            calls it "N", following Nichol and Dhariwal 2021. "stride" counts from 0 with the
            smallest integer stride that gives N steps, so the noisiest step may be well below
            T - 1; MDM and FLAME call it "ddimN", following Song et al. 2021.

    Returns:
        N increasing steps in the range 0 ... T - 1.

    Raises:
        UserError: If N is out of range, or if no stride gives N steps.

    Example:
        >>> timesteps(1000, 5), timesteps(1000, 5, "stride")
        ([0, 250, 500, 749, 999], [0, 200, 400, 600, 800])
    """
    total, count = num_train_timesteps, num_inference_steps
    if not 1 <= count <= total:
        raise UserError(f"num_inference_steps={count}: expected 1 to num_train_timesteps = {total}")
    if spacing == "stride":
        for steps in (range(0, total, stride) for stride in range(1, total + 1)):
            if len(steps) == count:
                return list(steps)
        raise UserError(
            f"no stride selects {count} of {total} steps. Choose another number of steps, or set spacing=linspace"
        )
    stride = (total - 1) / (count - 1) if count > 1 else 1.0
    # A running sum is used instead of i * stride, because its rounding decides ties. The released
    # models were sampled at the resulting steps.
    steps, position = [], 0.0
    for _ in range(count):
        steps.append(round(position))
        position += stride
    return steps
