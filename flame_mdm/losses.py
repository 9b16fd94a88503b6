"""Reconstruction error over real frames, and geometric losses on the clean estimate."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from flame_mdm.batch import Constant

CONTACT_SPEED = 0.01
"""Maximum displacement, in meters per frame, of a foot that counts as being in contact."""


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Returns the mean (B,) of `x` (B, F, ...) over the real frames of each sample.

    The mean of a sample without real frames is 0. MDM's code adds 1e-8 to the number of entries.
    This function does not, because 1e-8 is below the resolution of float32.

    Example:
        >>> x, mask = torch.tensor([[[1.0], [3.0], [9.0]]]), torch.tensor([[True, True, False]])
        >>> masked_mean(x, mask).tolist()
        [2.0]
    """
    x = x.flatten(2)
    total = (x * mask[..., None]).sum((1, 2))
    return total / (mask.sum(1).clamp(min=1) * x.shape[2])


def masked_mse(a: Tensor, b: Tensor, mask: Tensor) -> Tensor:
    """Returns the squared error (B,) between `a` and `b` (B, F, ...), averaged over real frames.

    `mask` has shape (B, F). All samples have equal weight, regardless of their lengths (Tevet et
    al. 2022, eq. 2, averaged as in their code).

    Example:
        >>> masked_mse(torch.zeros(1, 2, 3), torch.full((1, 2, 3), 2.0), torch.ones(1, 2) > 0).tolist()
        [4.0]
    """
    return _MaskedSquaredError.apply(*torch.broadcast_tensors(a, b), mask)  # type: ignore[return-value]


class _MaskedSquaredError(torch.autograd.Function):
    """Computes `masked_mean((a - b).square(), mask)` with about half as many passes over the data.

    The results are identical, bit for bit.
    """

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor, mask: Tensor) -> Tensor:
        difference = a - b
        squares = difference.square().flatten(2)
        entries = mask.sum(1).clamp(min=1) * squares.shape[2]
        ctx.save_for_backward(difference, mask, entries)
        return squares.mul_(mask[..., None]).sum((1, 2)) / entries

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        difference, mask, entries = ctx.saved_tensors
        factor = (2 * (gradients[0] / entries))[:, None] * mask
        of_a = difference * factor.reshape(*mask.shape, *[1] * (difference.ndim - 2))
        return of_a, -of_a if ctx.needs_input_grad[1] else None, None


def bone_lengths(joints: Tensor, edges: Sequence[tuple[int, int]] | Tensor) -> Tensor:
    """Returns the lengths (..., N) of N bones, given joint positions (..., J, 3).

    `edges` (N, 2) contains the joint indices of each bone's parent and child.
    """
    parents, children = torch.as_tensor(edges).T
    return (joints[..., children, :] - joints[..., parents, :]).norm(dim=-1)


class MotionLosses(nn.Module):
    """MDM's geometric losses and a bone-length loss, each with a weight.

    Sources: Tevet et al. 2022, eq. 3-5, and Liang et al. 2024, InterGen. All losses are means over
    real frames and entries: the norms in MDM's paper are divided by the number of entries per
    frame, as in MDM's code. Velocities are in units per frame. Losses with weight 0 are not
    computed.

    Args:
        to_joints: differentiable map from normalized features (B, F, D) to joint positions (B, F,
            J, 3) in meters.
        feet: indices of the joints that touch the ground.
        edges: joint indices (parent, child) of each bone, used by `bone_length`.
        joints: weight of the squared error of the joint positions (eq. 3).
        velocity: weight of the squared error of the features' velocity (eq. 5).
        foot_contact: weight of the squared velocity of feet that touch the ground in the data (eq.
            4). As in the paper's sum over all frames, feet that are not in contact contribute 0 to
            the mean.
        bone_length: weight of the squared error of the bone lengths, in square meters. This is
            InterGen's bone-length loss (arXiv:2304.05684), but applied at all noise levels.
            InterGen applies it only up to a certain noise level.
        root_relative: whether to subtract the first joint from all joints, as in MDM's code.
        velocity_features: number of leading features that `velocity` uses. MDM's code omits the
            last row of the feature matrix. It therefore uses 144 of the 25 x 6 features, or 262 of
            the 263 features. If None, all features are used.

    Example:
        >>> losses = MotionLosses(lambda x: x.unflatten(-1, (-1, 3)), feet=[1], joints=2.0)
        >>> x, mask = torch.zeros(1, 5, 6), torch.ones(1, 5, dtype=torch.bool)
        >>> losses(x + 1, x, mask)
        {'joints': tensor([2.])}
    """

    def __init__(
        self,
        to_joints: Callable[[Tensor], Tensor],
        feet: Sequence[int],
        edges: Sequence[tuple[int, int]] = (),
        *,
        joints: float = 0.0,
        velocity: float = 0.0,
        foot_contact: float = 0.0,
        bone_length: float = 0.0,
        root_relative: bool = False,
        velocity_features: int | None = None,
    ):
        super().__init__()
        self.to_joints = to_joints
        # Lists would be copied to the GPU in every step, which would make the GPU wait.
        self.feet, self.edges = Constant(list(feet)), Constant(list(edges))
        self.joints, self.velocity, self.foot_contact, self.bone_length = (
            joints,
            velocity,
            foot_contact,
            bone_length,
        )
        self.root_relative, self.velocity_features = root_relative, velocity_features

    def forward(self, x0_hat: Tensor, x: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Returns the weighted losses (B,), keyed by name.

        Args:
            x0_hat: (B, F, D), the clean estimate.
            x: (B, F, D), the data.
            mask: (B, F) bool, True for real frames.
        """
        # The first frame has no velocity. Padding is at the end, so a velocity is real if its
        # second frame is real.
        moving = mask[:, 1:]
        losses: dict[str, Tensor] = {}
        if self.velocity:
            velocity, real_velocity = (
                motion[..., : self.velocity_features].diff(dim=1) for motion in (x0_hat, x)
            )
            losses["velocity"] = self.velocity * masked_mse(velocity, real_velocity, moving)
        if not (self.joints or self.foot_contact or self.bone_length):
            return losses
        predicted, real = self.to_joints(x0_hat), self.to_joints(x)
        if self.root_relative:
            predicted, real = predicted - predicted[:, :, :1], real - real[:, :, :1]
        if self.joints:
            losses["joints"] = self.joints * masked_mse(predicted, real, mask)
        if self.foot_contact:
            feet = self.feet.on(x.device)
            in_contact = real[:, :, feet].diff(dim=1).norm(dim=-1, keepdim=True) <= CONTACT_SPEED
            slide = torch.where(in_contact, predicted[:, :, feet].diff(dim=1), 0.0)
            losses["foot_contact"] = self.foot_contact * masked_mean(slide.square(), moving)
        if self.bone_length:
            edges = self.edges.on(x.device)
            lengths, real_lengths = (bone_lengths(joints, edges) for joints in (predicted, real))
            losses["bone_length"] = self.bone_length * masked_mse(lengths, real_lengths, mask)
        return losses
