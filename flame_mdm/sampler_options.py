"""Sampler options, shared by the Python API, the command line, the demo, evaluation and tables."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

from flame_mdm.config.options import option
from flame_mdm.errors import UserError

# Maximum number of diffusion or sampling steps
MAX_STEPS = 100_000
# Spacings of the sampling steps of diffusion; see `flame_mdm.processes.schedules.timesteps`
SPACINGS = (
    "linspace",
    "stride",
)


@dataclass(frozen=True, kw_only=True)
class SamplerOptions:
    """Options for sampling motions.

    Options that are None default to the recipe's values or, if the recipe has none, to the
    sampler's defaults. Each sampler in `flame_mdm.processes.samplers` declares its options, and
    `flame_mdm.processes.Process` rejects all others.

    Raises:
        UserError: If a value is invalid for all models.

    Example:
        >>> recipe = SamplerOptions(sampler="ddim", num_inference_steps=50)
        >>> SamplerOptions(num_inference_steps=10).over(recipe).chosen()
        {'sampler': 'ddim', 'num_inference_steps': 10}
    """

    guidance_scale: float | None = option(
        None, "scale of classifier-free guidance; 1 = off. Default: the recipe's"
    )
    sampler: str | None = option(
        None,
        "name of the sampler. For diffusion: ancestral, ddim, dpm_solver_pp_2m; for flow "
        "matching: euler, midpoint, heun, rk4, dopri5; for distilled models: consistency. "
        "Default: the recipe's",
    )
    num_inference_steps: int | Sequence[int] | None = option(
        None,
        "number of sampling steps or, for diffusion, a list of steps, such as [0,2,5,9]. "
        "Default: the recipe's",
    )
    eta: float | None = option(None, "randomness of the sampler ddim, from 0 (default) to 1")
    spacing: str | None = option(
        None, "how diffusion spaces the sampling steps: linspace (default) or stride"
    )

    def __post_init__(self) -> None:
        for name in ("guidance_scale", "eta"):
            value = getattr(self, name)
            if value is not None and not (isinstance(value, int | float) and math.isfinite(value)):
                raise UserError(f"{name}={value} is not a finite number")
        if self.eta is not None and not 0 <= self.eta <= 1:
            raise UserError(f"eta={self.eta:g}: expected a number from 0 to 1")
        if self.sampler is not None and not isinstance(self.sampler, str):
            raise UserError(f"sampler={self.sampler!r}: expected the name of a sampler")
        if self.spacing is not None and self.spacing not in SPACINGS:
            raise UserError(f"spacing={self.spacing} is unknown. Choose from {', '.join(SPACINGS)}")
        steps = self.num_inference_steps
        listed, least = (steps, 0) if isinstance(steps, list | tuple) else ([steps], 1)
        if steps is not None and not all(
            type(step) is int and least <= step <= MAX_STEPS for step in listed
        ):
            raise UserError(
                f"num_inference_steps={steps}: expected a number of steps, or a list of steps, up to {MAX_STEPS:,}"
            )
        object.__setattr__(
            self, "num_inference_steps", tuple(steps) if isinstance(steps, list) else steps
        )

    def chosen(self) -> dict[str, Any]:
        """Returns the options that are not None, as plain values."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(SamplerOptions)}
        return {
            k: list(v) if isinstance(v, tuple) else v for k, v in values.items() if v is not None
        }

    def over(self, defaults: Self) -> Self:
        """Returns these options, with each None replaced by the value in `defaults`."""
        return replace(defaults, **self.chosen())
