"""Reconstruction error over real frames, and geometric losses on the clean estimate."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """(B,) mean of x (B, F, ...) over the real frames of each sample; 0 where a sample has none.

    Unlike MDM's code, nothing is added to the number of entries: its 1e-8 is below the resolution of float32.
    """
    x = x.flatten(2)
    total = (x * mask[..., None]).sum((1, 2))
    return total / (mask.sum(1).clamp(min=1) * x.shape[2])


def masked_mse(a: Tensor, b: Tensor, mask: Tensor) -> Tensor:
    """(B,) squared error between a and b (B, F, ...), averaged over real frames (mask (B, F)) and all their entries.

    Each sample weighs the same whatever its length (Tevet et al. 2022, eq. 2, as their code averages it).
    """
    return masked_mean((a - b).square(), mask)


def differences(x: Tensor) -> Tensor:
    """(B, F, ...) -> (B, F - 1, ...), change from each frame to the next."""
    return x[:, 1:] - x[:, :-1]


class MotionLosses(nn.Module):
    """Geometric losses of MDM (Tevet et al. 2022, eq. 3-5), each weighted; terms of weight 0 are not computed.

    All are means over real frames and entries, so the paper's norms are divided by the number of entries of a frame,
    as its code does. Velocities are per frame.
    """

    def __init__(
        self,
        to_joints: Callable[[Tensor], Tensor],
        feet: Sequence[int],
        *,
        joints: float = 0.0,
        velocity: float = 0.0,
        joint_velocity: float = 0.0,
        foot_contact: float = 0.0,
        contact_speed: float = 0.01,
        root_relative: bool = False,
        velocity_features: int | None = None,
    ):
        """Weights and options.

        Args:
            to_joints: normalised features (B, F, D) -> joint positions (B, F, J, 3) in metres, differentiable.
            feet: indices of the joints that touch the ground.
            joints: weight of the squared error of the joint positions (eq. 3).
            velocity: weight of the squared error of the features' velocity (eq. 5).
            joint_velocity: weight of the squared error of the joints' velocity; in MDM's code, not in its loss.
            foot_contact: weight of the squared velocity of feet that stand in the data (eq. 4). The mean includes the
                feet that do not stand, whose entries are 0, as the paper's sum over all frames does.
            contact_speed: a foot stands where it moves at most this far per frame in the data, in metres.
            root_relative: legacy of MDM's code: joints are taken relative to the first one, so that no joint-based loss
                sees the root translation.
            velocity_features: legacy of MDM's code: `velocity` sees the first so many features only (144 of 25 x 6,
                262 of 263: the last row of the feature matrix is left out). None = all.
        """
        super().__init__()
        self.to_joints = to_joints
        self.feet = list(feet)
        self.weights = {
            "joints": joints,
            "velocity": velocity,
            "joint_velocity": joint_velocity,
            "foot_contact": foot_contact,
        }
        self.contact_speed = contact_speed
        self.root_relative = root_relative
        self.velocity_features = velocity_features

    def forward(self, x0_hat: Tensor, x: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Weighted losses (B,) by name, from the clean estimate and the data (B, F, D) and mask (B, F)."""
        # The first frame has no velocity; a velocity is real where its second frame is, as motions are padded behind.
        moving = mask[:, 1:]
        losses: dict[str, Tensor] = {}
        if self.weights["velocity"]:
            size = self.velocity_features
            losses["velocity"] = masked_mse(differences(x0_hat[..., :size]), differences(x[..., :size]), moving)
        if self.weights["joints"] or self.weights["joint_velocity"] or self.weights["foot_contact"]:
            predicted, real = self._joints(x0_hat), self._joints(x)
            if self.weights["joints"]:
                losses["joints"] = masked_mse(predicted, real, mask)
            if self.weights["joint_velocity"]:
                losses["joint_velocity"] = masked_mse(differences(predicted), differences(real), moving)
            if self.weights["foot_contact"]:
                stands = differences(real[:, :, self.feet]).norm(dim=-1, keepdim=True) <= self.contact_speed
                slide = torch.where(stands, differences(predicted[:, :, self.feet]), 0.0)
                losses["foot_contact"] = masked_mean(slide.square(), moving)
        return {name: self.weights[name] * loss for name, loss in losses.items()}

    def _joints(self, x: Tensor) -> Tensor:
        joints = self.to_joints(x)
        return joints - joints[:, :, :1] if self.root_relative else joints
