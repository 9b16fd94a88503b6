"""Reconstruction error over real frames, and geometric losses of the clean estimate."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

CONTACT_SPEED = 0.01
"""Maximum displacement per frame, in meters, of a foot in contact in the data."""


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Returns the mean (B,) of x (B, F, ...) over the real frames of each sample; 0 if a sample has none.

    Unlike in MDM's code, 1e-8 is not added to the number of entries: it is below the resolution of float32.
    """
    x = x.flatten(2)
    total = (x * mask[..., None]).sum((1, 2))
    return total / (mask.sum(1).clamp(min=1) * x.shape[2])


def masked_mse(a: Tensor, b: Tensor, mask: Tensor) -> Tensor:
    """Returns the squared error (B,) of a and b (B, F, ...), averaged over the entries of real frames (mask (B, F)).

    All samples have equal weight, regardless of length (Tevet et al. 2022, eq. 2, averaged as in their code).
    """
    return masked_mean((a - b).square(), mask)


def differences(x: Tensor) -> Tensor:
    """Returns the change (B, F - 1, ...) from each frame of x (B, F, ...) to the next."""
    return x[:, 1:] - x[:, :-1]


def bone_lengths(joints: Tensor, edges: Sequence[tuple[int, int]]) -> Tensor:
    """Returns the distances (..., number of edges) of the pairs of joints that a bone connects, from (..., J, 3)."""
    parents, children = zip(*edges, strict=True)
    return (joints[..., children, :] - joints[..., parents, :]).norm(dim=-1)


class MotionLosses(nn.Module):
    """Weighted geometric losses of MDM (Tevet et al. 2022, eq. 3-5), and of bone lengths (Liang et al. 2024, InterGen).

    All are means over real frames and entries: the norms in the paper are divided by the number of entries per frame,
    as in its code. Velocities are per frame. Terms with weight 0 are not computed.
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
        """Stores weights and options.

        Args:
            to_joints: differentiable map from normalized features (B, F, D) to joint positions (B, F, J, 3) in meters.
            feet: indices of the joints that touch the ground.
            edges: (parent, child) of each bone, for `bone_length`.
            joints: weight of the squared error of the joint positions (eq. 3).
            velocity: weight of the squared error of the features' velocity (eq. 5).
            foot_contact: weight of the squared velocity of feet in contact in the data (eq. 4). The mean includes feet
                that are not in contact, whose entries are 0, like the sum over all frames in the paper.
            bone_length: weight of the squared error of the bone lengths, in square meters; the bone length loss of
                InterGen (arXiv:2304.05684), which applies it only up to a noise level, here at all of them.
            root_relative: subtract the first joint from all joints, as in MDM's code, so that joint-based losses do not
                depend on the root translation.
            velocity_features: number of features, from the first, that `velocity` uses, as in MDM's code (144 of
                25 x 6, 262 of 263: the last row of the feature matrix is left out). None = all.
        """
        super().__init__()
        self.to_joints = to_joints
        self.feet, self.edges = list(feet), list(edges)
        self.weights = {
            "joints": joints,
            "velocity": velocity,
            "foot_contact": foot_contact,
            "bone_length": bone_length,
        }
        self.root_relative = root_relative
        self.velocity_features = velocity_features

    def forward(self, x0_hat: Tensor, x: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Returns weighted losses (B,) by name, from clean estimate and data (B, F, D) and mask (B, F)."""
        # The first frame has no velocity. Padding is at the end, so a velocity is real if its second frame is.
        moving = mask[:, 1:]
        losses: dict[str, Tensor] = {}
        if self.weights["velocity"]:
            size = self.velocity_features
            losses["velocity"] = masked_mse(differences(x0_hat[..., :size]), differences(x[..., :size]), moving)
        if any(self.weights[name] for name in ("joints", "foot_contact", "bone_length")):
            predicted, real = self._joints(x0_hat), self._joints(x)
            if self.weights["joints"]:
                losses["joints"] = masked_mse(predicted, real, mask)
            if self.weights["foot_contact"]:
                in_contact = differences(real[:, :, self.feet]).norm(dim=-1, keepdim=True) <= CONTACT_SPEED
                slide = torch.where(in_contact, differences(predicted[:, :, self.feet]), 0.0)
                losses["foot_contact"] = masked_mean(slide.square(), moving)
            if self.weights["bone_length"]:
                lengths, real_lengths = (bone_lengths(joints, self.edges) for joints in (predicted, real))
                losses["bone_length"] = masked_mse(lengths, real_lengths, mask)
        return {name: self.weights[name] * loss for name, loss in losses.items()}

    def _joints(self, x: Tensor) -> Tensor:
        joints = self.to_joints(x)
        return joints - joints[:, :, :1] if self.root_relative else joints
