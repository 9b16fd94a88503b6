"""Classifier-free guidance, and guidance toward world positions of joints."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from flame_mdm.batch import Condition, Denoise
from flame_mdm.losses import bone_lengths

# Number of gradient steps before each step of the sampler
STEERING_STEPS = 2
STEERING_LIMIT = 0.02
"""Maximum length of a gradient step, as an RMS over normalized features.

If the denoiser depends only weakly on x_t, longer steps make x_t unlike the noisy motions in
training. In one experiment, arms became a third longer.
"""
CLOSE, MOST_STEPS = 0.005, 8
"""Limits of the search for a motion that reaches the requested positions.

The search ends when the error is below `CLOSE` meters, or after `MOST_STEPS` steps.
"""
RELAXATION = 1e-3
"""Variance of the remaining error, relative to the variance of the position.

It limits the size of the changes.
"""


def classifier_free_guidance(denoise: Denoise, scale: float | Tensor, features: int) -> Denoise:
    """Returns a denoiser guided by its unconditional prediction: null + scale * (cond - null).

    The original denoiser is called with batches of size 2B. Source: Ho and Salimans 2021, with w =
    scale - 1. In this form, which MDM and FLAME (eq. 5) use, a scale of 1 means no guidance.

    Args:
        denoise: the denoiser. The condition passed to it must contain a null condition.
        scale: guidance scale, either one number or one per sample (B,). If the scale is the number
            1, `denoise` itself is returned.
        features: D, the number of features. Further channels contain a learned variance, which is
            not guided but taken from the conditional prediction.

    Returns:
        A function with the same signature as `denoise`.

    Example:
        >>> null = Condition(torch.zeros(1, 1), torch.zeros(1, 0, 1), None)
        >>> cond = Condition(torch.ones(1, 1), torch.zeros(1, 0, 1), None, null)
        >>> def denoise(x_t, t, mask, cond):
        ...     return cond.pooled[:, None].expand_as(x_t)
        >>> guided = classifier_free_guidance(denoise, 2.5, features=3)
        >>> guided(torch.zeros(1, 1, 3), torch.zeros(1), torch.ones(1, 1) > 0, cond).tolist()
        [[[2.5, 2.5, 2.5]]]
    """
    if not isinstance(scale, Tensor) and scale == 1:
        return denoise
    strength = scale[:, None, None] if isinstance(scale, Tensor) else scale
    # The doubled mask and condition are computed once per sampling run, so that a denoiser can
    # cache what it computes from them.
    seen: tuple[Tensor, Condition] | None = None
    doubled: tuple[Tensor, Condition]

    def guided(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        nonlocal seen, doubled
        if seen is None or seen[0] is not mask or seen[1] is not cond:
            seen, doubled = (mask, cond), (torch.cat([mask, mask]), cond.with_null())
        with_cond, null = denoise(torch.cat([x_t, x_t]), torch.cat([t, t]), *doubled).unflatten(
            0, (2, -1)
        )
        mean = null[..., :features] + strength * (with_cond[..., :features] - null[..., :features])
        variance = with_cond[..., features:]
        return torch.cat([mean, variance], -1) if variance.shape[-1] else mean

    return guided


@dataclass
class Positions:
    """M world coordinates that the joints of a motion should reach.

    Attributes:
        frames: (M,) int64, indices of the frames.
        joints: (M,) int64, indices of the joints.
        axes: (M,) int64, the axes; 0 = x, 1 = y, 2 = z.
        values: (M,), the coordinates in meters.
    """

    frames: Tensor
    joints: Tensor
    axes: Tensor
    values: Tensor

    def of(self, joints: Tensor) -> Tensor:
        """Returns the values (..., M) of these coordinates in a motion (..., F, J, 3)."""
        return joints[..., self.frames, self.joints, self.axes]


def steer(
    clean: Callable[[Tensor], Tensor],
    x_t: Tensor,
    to_joints: Callable[[Tensor], Tensor],
    positions: Positions,
) -> Tensor:
    """Guides noisy motions toward world positions.

    Each step follows the gradient through the denoiser (Chung et al. 2023, "Diffusion posterior
    sampling"), so the entire body moves with the joints in a way that is plausible to the
    denoiser. The step length follows Polyak's rule and is limited by `STEERING_LIMIT`.

    Args:
        clean: function that returns the clean estimate (B, F, D) of a noisy motion.
        x_t: (B, F, D) noisy motions.
        to_joints: function that converts normalized features (B, F, D) to joint positions
            (B, F, J, 3) in meters.
        positions: the positions that the motions should approach.

    Returns:
        Noisy motions (B, F, D) whose clean estimates are closer to the positions.
    """
    # Polyak's step: if the loss were linear, it would be 0 after the distance loss / slope.
    for _ in range(STEERING_STEPS):
        with torch.enable_grad():
            x = x_t.detach().requires_grad_()
            loss = (positions.of(to_joints(clean(x))) - positions.values).square().sum(-1)
            (slope,) = torch.autograd.grad(loss.sum(), x)
        norm = slope.square().sum((1, 2)).clamp(min=1e-9).sqrt()
        length = (loss.detach() / norm).clamp(max=STEERING_LIMIT * slope[0].numel() ** 0.5)
        x_t = x_t - (length / norm)[:, None, None] * slope
    return x_t


def reach(
    x: Tensor,
    to_joints: Callable[[Tensor], Tensor],
    positions: Positions,
    bones: Tensor,
    free: Tensor,
    smoothness: float,
) -> Tensor:
    """Changes motions as little as possible, so that joints reach the requested world positions.

    Each Gauss-Newton step changes the normalized features as little as possible to reach the
    positions. A Gaussian-process prior keeps the change smooth in time. In frames with a requested
    position, bone lengths are also constrained: they must equal their medians over the motion.
    Neighboring frames receive only part of the change. This would shorten turning bones, so the
    bone lengths in these frames are restored afterward.

    Args:
        x: (B, F, D) normalized motions.
        to_joints: function that converts normalized features (F, D) to joint positions (F, J, 3) in
            meters.
        positions: the positions to reach.
        bones: (3, N) int64, the frame, parent and child of each bone. All bones are listed for each
            frame in which the change could affect their lengths.
        free: (B, F, D) bool, True if this feature may change.
        smoothness: standard deviation of the Gaussian process, in frames.

    Returns:
        Normalized motions (B, F, D). The position error is at most `CLOSE` meters unless the search
        ends earlier, after `MOST_STEPS` steps.
    """
    # The prior's covariance K between frames is a Gaussian kernel. With the Jacobian A of the
    # constraints and their error e, the smallest change is K A^T (A K A^T)^-1 e. Below, `smooth`
    # is A K, and `gram` is A K A^T.
    offset = torch.arange(-int(3 * smoothness), int(3 * smoothness) + 1, device=x.device)
    kernel = torch.exp(-0.5 * (offset / smoothness) ** 2)
    frames, edges = bones[0], bones[1:].T

    def values(features: Tensor) -> Tensor:
        joints = to_joints(features)
        lengths = (joints[frames, edges[:, 1]] - joints[frames, edges[:, 0]]).norm(dim=-1)
        return torch.cat([positions.of(joints), lengths])

    around = frames.unique()
    near = torch.exp(
        -0.5 * ((torch.arange(x.shape[1], device=x.device)[:, None] - around) / smoothness) ** 2
    )
    changed = []
    for motion, may in zip(x, free, strict=True):
        joints = to_joints(motion)
        usual = bone_lengths(joints, edges).median(0).values
        for _ in range(MOST_STEPS):
            error = torch.cat([positions.values, usual]) - values(motion)
            if error.abs().max() < CLOSE:
                break
            slope = torch.func.jacrev(values)(motion) * may  # (M + N, F, D)
            rows = slope.movedim(1, 2).flatten(0, 1)[:, None]
            smooth = F.conv1d(rows, kernel[None, None] / kernel.sum(), padding="same")[:, 0]
            smooth = smooth.unflatten(0, (len(error), -1)).movedim(1, 2) * may
            gram = torch.einsum("mfd,nfd->mn", smooth, slope).double()
            gram += torch.diag(RELAXATION * gram.diagonal() + 1e-9)
            motion = motion + torch.einsum(
                "m,mfd->fd", torch.linalg.solve(gram, error.double()).to(x), smooth
            )
        if len(around):
            all_edges = edges[frames == around[0]]
            before, weight = bone_lengths(joints, all_edges), near.amax(1, keepdim=True)
            lengths = weight * before.median(0).values + (1 - weight) * before
            motion = _with_bones(motion, to_joints, all_edges, lengths, may)
        changed.append(motion)
    return torch.stack(changed)


def _with_bones(
    motion: Tensor,
    to_joints: Callable[[Tensor], Tensor],
    edges: Tensor,
    lengths: Tensor,
    free: Tensor,
) -> Tensor:
    """Returns the nearest motion (F, D) in which the bones have the requested lengths.

    `lengths` (F, N) contains, for each frame, the lengths of the bones in `edges` (N, 2).
    """
    # Gauss-Newton steps as in `reach`, but for each frame separately: A^T (A A^T)^-1 e

    def lengths_of(frame: Tensor) -> Tensor:
        return bone_lengths(to_joints(frame[None])[0], edges)

    for _ in range(MOST_STEPS):
        error = lengths - torch.func.vmap(lengths_of)(motion)
        if error.abs().max() < CLOSE:
            break
        slope = torch.func.vmap(torch.func.jacrev(lengths_of))(motion) * free[:, None]  # (F, N, D)
        gram = (slope @ slope.mT).double()
        gram = gram + torch.diag_embed(RELAXATION * gram.diagonal(dim1=1, dim2=2) + 1e-9)
        motion = motion + (
            torch.linalg.solve(gram, error.double()).to(motion)[..., None] * slope
        ).sum(1)
    return motion
