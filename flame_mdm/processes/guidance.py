"""Guidance: wrappers with the same interface as the denoiser."""

import torch
from torch import Tensor

from flame_mdm.motion import Condition, Denoise


def classifier_free_guidance(denoise: Denoise, scale: float | Tensor, features: int) -> Denoise:
    """Returns a denoiser guided by its unconditional prediction: null + scale * (cond - null), with batch size 2B.

    Ho and Salimans 2021 in the form of MDM and FLAME (eq. 5), where 1 means no guidance; w in Ho and Salimans is
    scale - 1.

    Args:
        denoise: the denoiser.
        scale: guidance scale, one number or one per sample (B,). For the number 1, `denoise` itself is returned.
        features: D. Channels from D on (a learned variance) are not guided: those of the conditional half are returned.

    Raises:
        ValueError: in the first call, if the condition has no null.
    """
    if not isinstance(scale, Tensor) and scale == 1:
        return denoise
    strength = scale[:, None, None] if isinstance(scale, Tensor) else scale
    # One doubled condition per sampling run, so that a denoiser can cache what it computes from it.
    doubled: tuple[Condition, Condition] | None = None

    def guided(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        nonlocal doubled
        if doubled is None or doubled[0] is not cond:
            doubled = (cond, cond.with_null())
        output = denoise(torch.cat([x_t, x_t]), torch.cat([t, t]), torch.cat([mask, mask]), doubled[1])
        with_cond, null = output.chunk(2)
        mean = null[..., :features] + strength * (with_cond[..., :features] - null[..., :features])
        return torch.cat([mean, with_cond[..., features:]], -1)

    return guided
