"""Analytic denoisers of the diffusion and flow fixtures, comparisons with these, and rotations of Euler angles."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from flame_mdm.batch import Condition, Denoise, Edit, Noise
from flame_mdm.processes import Process
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.processes.schedules import timesteps
from flame_mdm.sampler_options import SamplerOptions
from support.fixtures import Arrays, meta

NO_CONDITION = Condition(torch.zeros(1, 1), torch.zeros(1, 0, 1), None)


def motions(array: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
    """(B, joints, features, frames) or (B, D, frames) -> (B, F, D)."""
    return torch.from_numpy(array).to(dtype).flatten(1, -2).transpose(1, 2).contiguous()


def sample(
    process: Process,
    denoise: Denoise,
    noise: Noise,
    mask: Tensor | None = None,
    cond: Condition = NO_CONDITION,
    *,
    edit: Edit | None = None,
    trajectory: list[Tensor] | None = None,
    **options: Any,
) -> Tensor:
    """`Process.sample` with the sampler's options as keywords; without a mask, all frames are real."""
    mask = real(noise(0)) if mask is None else mask
    return process.sample(
        denoise, noise, mask, cond, SamplerOptions(**options), edit=edit, trajectory=trajectory
    )


def real(x: Tensor) -> Tensor:
    """The mask of motions without padding."""
    return torch.ones(x.shape[:2], dtype=torch.bool, device=x.device)


def recorded(first: Tensor, rest: Sequence[Tensor] | Tensor = ()) -> Noise:
    """Noise from recorded draws; asking for more of them is an error."""
    return lambda draw: first if draw == 0 else rest[draw - 1]


def drawn(shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> Noise:
    """Noise that depends on the number of the draw alone."""
    return lambda draw: torch.randn(
        shape, generator=torch.Generator().manual_seed(draw), dtype=dtype
    )


def oracle(process: Process, x: Tensor, start: Tensor | None = None) -> Denoise:
    """The denoiser that knows the data, from which the noise in x_t follows; a learned variance is the smallest.

    Of a flow that rounds its times, it also knows the noise of the start.
    """

    def denoise(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        time = t / 1000 if isinstance(process, FlowMatching) else t
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        noise = (x_t - process.corrupt(x, zero, time)) / process.corrupt(zero, one, time)
        if start is not None and isinstance(process, FlowMatching):
            noise = start
        output = process.target(x, noise, time)
        return torch.cat([output, torch.zeros_like(output)], -1)[
            ..., : process.out_features(x.shape[-1])
        ]

    return denoise


class CountedDenoise:
    """A denoiser that counts its calls; guidance around it makes one call with the doubled batch."""

    def __init__(self, denoise: Denoise):
        self.denoise, self.calls = denoise, 0

    def __call__(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        self.calls += 1
        return self.denoise(x_t, t, mask, cond)


def linear_denoiser(A: np.ndarray, b: np.ndarray, g: float) -> Denoise:
    """Each group of channels (one a column of b) mixed by A (outputs, inputs), plus b and g t / 1000."""

    def denoise(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        weight, bias = torch.from_numpy(A).to(x_t), torch.from_numpy(b).to(x_t)
        output = (
            torch.einsum("jk,blkf->bljf", weight, x_t.unflatten(-1, (A.shape[1], b.shape[1])))
            + bias
        )
        return (output + g * t.to(x_t)[:, None, None, None] / 1000).flatten(-2)

    return denoise


def assert_golden(arrays: Arrays, key: str, value: Tensor, within: float = 10.0) -> None:
    """Against the float64 run in float64; else within ten times what float32 cost the authors' code."""
    if value.dtype == torch.float64 and f"f64/{key}" in arrays:
        expected = arrays[f"f64/{key}"]
        tolerance = 1e-10 * max(1.0, np.abs(expected).max())
    else:
        expected = arrays[key]
        cost = np.ravel(meta(arrays)["max_abs_diff_f32_vs_f64"].get(key, 0.0))[0]
        tolerance = max(within * cost, 1e-6 * max(1.0, np.abs(expected).max()))
    if expected.ndim > 2:
        value = value.transpose(1, 2).reshape(expected.shape)
    np.testing.assert_allclose(value.numpy(), expected, rtol=0, atol=tolerance, err_msg=key)


def spaced(total: int, spec: str | list[int]) -> list[int]:
    """The fixtures' choices of steps: "ddimN", "N", counts of equal sections "a,b,c" or [a, b, c], GLIDE's "fast27"."""
    if spec == "fast27":
        return sorted({*spaced(total, "10,10,3,2,2"), total - 3} - {total - 1})
    if isinstance(spec, str) and spec.startswith("ddim"):
        return timesteps(total, int(spec.removeprefix("ddim")), "stride")
    counts = [int(count) for count in spec.split(",")] if isinstance(spec, str) else spec
    steps, start = [], 0
    for index, count in enumerate(counts):
        size = total // len(counts) + (index < total % len(counts))
        steps += [start + step for step in timesteps(size, count)]
        start += size
    return steps


def flow_field(arrays: Arrays) -> Denoise:
    """The fixture's velocity field A x + b + c t, with t as the flow has it."""
    return linear_denoiser(arrays["field/A"], arrays["field/b"], float(arrays["field/c"]))


def euler_to_matrix(angles: Tensor, order: str) -> Tensor:
    """(..., 3) angles about the axes of `order` -> (..., 3, 3); "ZXY" is Rz(first) Rx(second) Ry(third), as in BVH."""
    matrices = Rotation.from_euler(order, angles.reshape(-1, 3).double().numpy()).as_matrix()
    return torch.from_numpy(matrices).to(angles.dtype).reshape(*angles.shape, 3)
