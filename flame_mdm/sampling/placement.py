"""Placement of bodies in the world, used to join the blocks of a motion."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from flame_mdm.representations import Representation
from flame_mdm.representations.rotation import rotate_y


@dataclass(frozen=True)
class Placement:
    """Placement of B bodies: a rotation about the vertical axis and a shift along the floor.

    The rotations (B,) are in radians, and the shifts (B, 3) are in meters, with y = 0. Both are
    float64.
    """

    turn: Tensor
    shift: Tensor

    @classmethod
    def origin(cls, count: int, device: torch.device) -> Placement:
        """Returns the placement that leaves all points unchanged."""
        turn = torch.zeros(count, dtype=torch.float64, device=device)
        return cls(turn, torch.zeros(count, 3, dtype=torch.float64, device=device))

    @classmethod
    def fit(cls, local: Tensor, world: Tensor) -> Placement:
        """Returns the placement that best maps the poses `local` (B, J, 3) to `world` (B, J, 3).

        The placement minimizes the squared error (Kabsch 1976, for a rotation about one axis).
        Heights do not change. If the poses differ only in their placement, the error is 0.
        """
        local, world = local.double(), world.double()
        floor = local.new_tensor([1.0, 0.0, 1.0])
        from_center, to_center = local.mean(1) * floor, world.mean(1) * floor
        a, b = local - from_center[:, None], world - to_center[:, None]
        sine = (a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]).sum(1)
        cosine = (a[..., 0] * b[..., 0] + a[..., 2] * b[..., 2]).sum(1)
        turn = torch.atan2(sine, cosine)
        return cls(turn, to_center - rotate_y(from_center, turn))

    def apply(self, joints: Tensor) -> Tensor:
        """Converts joint positions (B, ..., 3) from body to world coordinates, in float64."""
        ones = (1,) * (joints.ndim - 2)
        turn = self.turn.view(-1, *ones).expand(joints.shape[:-1])
        return rotate_y(joints.double(), turn) + self.shift.view(-1, *ones, 3)

    def undo(self, points: Tensor) -> Tensor:
        """Inverts `apply`: converts points (B, ..., 3) from world to body coordinates."""
        ones = (1,) * (points.ndim - 2)
        turn = self.turn.view(-1, *ones).expand(points.shape[:-1])
        return rotate_y(points.double() - self.shift.view(-1, *ones, 3), -turn)


def step_after(representation: Representation, last: Tensor, world: Tensor) -> Placement:
    """Returns the placement for decoding the frames after `last`.

    The placement does not depend on later frames, because each frame contains the root's turn and
    step to the next frame.

    Args:
        representation: the representation of the features.
        last: (B, D), features of the last frame so far.
        world: (B, J, 3), world joint positions of the last frame.
    """
    joints = representation.decode(torch.stack([last, last], 1))
    here = Placement.fit(joints[:, 0], world)
    return Placement.fit(joints[:, 0], here.apply(joints[:, 1]))
