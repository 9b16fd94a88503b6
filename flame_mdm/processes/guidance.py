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
    # One doubled mask and condition per sampling run, so that a denoiser can cache what it computes from them.
    seen: tuple[Tensor, Condition] | None = None
    doubled: tuple[Tensor, Condition]

    def guided(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        nonlocal seen, doubled
        if seen is None or seen[0] is not mask or seen[1] is not cond:
            seen, doubled = (mask, cond), (torch.cat([mask, mask]), cond.with_null())
        with_cond, null = denoise(torch.cat([x_t, x_t]), torch.cat([t, t]), *doubled).chunk(2)
        mean = null[..., :features] + strength * (with_cond[..., :features] - null[..., :features])
        variance = with_cond[..., features:]
        return torch.cat([mean, variance], -1) if variance.shape[-1] else mean

    return guided
