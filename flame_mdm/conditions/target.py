"""Target conditions: requested positions of joints at the end of a motion.

Source: Tevet et al. 2025, "CLoSD", section 3.1. A target (B, 8, 4) contains a slot for each name in
`SLOTS`. Each slot contains x, y, z, and a flag, which is 1 if the slot is requested and 0 if it is
free. All values of a free slot are 0.

Positions are in meters relative to the first predicted frame, whose root is at x = z = 0 and faces
+z. y is the height above the floor. "traj" is the position of the pelvis projected onto the floor
(y = 0). For "heading", x is the direction that the hips and shoulders face, in radians: 0 = +z,
positive toward +x.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from flame_mdm.batch import Constant
from flame_mdm.errors import UserError, did_you_mean

JOINTS = ("pelvis", "left_foot", "right_foot", "left_wrist", "right_wrist", "head")
SLOTS = (*JOINTS, "traj", "heading")
HEADING = SLOTS.index("heading")
COORDINATES = Constant([[1.0, 1.0, 1.0]] * len(JOINTS) + [[1.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
"""Mask (8, 3) of the coordinates that are lengths. The x of the heading is an angle instead."""

FLOOR = Constant([1.0, 0.0, 1.0])
"""Factors (3,) of x, y and z that project a position onto the floor."""

# Added to the number of requested values, as in the authors' code, so that the error of a target
# that requests nothing is 0
EPSILON = 1e-8


class TargetConditions:
    """Draws targets for training motions and computes the error of predicted motions.

    Args:
        joints: names of the skeleton's joints, in the order of the joint positions.
        facing: joint indices of the right hip, left hip, right shoulder and left shoulder.
        choices: sets of slots. For each training motion, one of the sets is drawn with equal
            probability. An empty set results in a target that requests nothing, which differs from
            having no target.
        drop_prob: probability that a training motion has no target.
        weight: weight of the error in the loss.
        heading_modulo_pi: whether to compute the error of the heading modulo pi, as in MDM's code.
            The heading error of a body that faces backwards is then 0.

    Raises:
        UserError: If the skeleton lacks a required joint, if a choice is unknown, or if the
            probability is not in [0, 1].

    Example:
        >>> from flame_mdm.representations.skeleton import SMPL22
        >>> targets = TargetConditions(SMPL22.joints, SMPL22.facing, choices=[["left_wrist"]])
        >>> motion = torch.randn(1, 5, 22, 3)
        >>> target = targets.draw(motion, torch.tensor([0.5]))
        >>> torch.equal(target[0, SLOTS.index("left_wrist"), :3], motion[0, -1, 20])
        True
        >>> targets.error(motion, target).item()
        0.0
    """

    def __init__(
        self,
        joints: Sequence[str],
        facing: Sequence[int],
        *,
        choices: Sequence[Sequence[str]],
        drop_prob: float = 0.1,
        weight: float = 1.0,
        heading_modulo_pi: bool = False,
    ):
        if lacking := [name for name in JOINTS if name not in joints]:
            raise UserError(
                f"task.targets: the skeleton has no {', '.join(lacking)}. Choose another data set, "
                "or set task.targets=null"
            )
        unknown = [name for choice in choices for name in choice if name not in SLOTS]
        if unknown or not choices:
            advice = did_you_mean(unknown[0], SLOTS) if unknown else ""
            raise UserError(
                f"task.targets.choices={list(choices)}: unknown or missing names.{advice} "
                f"Each choice must be a set of these names: {', '.join(SLOTS)}"
            )
        if not 0 <= drop_prob <= 1:
            raise UserError(
                f"task.targets.drop_prob={drop_prob}: expected a probability from 0 to 1"
            )
        self.columns = Constant([joints.index(name) for name in JOINTS])
        self.facing = Constant(list(facing))
        self.choices = Constant([[slot in choice for slot in SLOTS] for choice in choices])
        self.drop_prob, self.weight, self.heading_modulo_pi = drop_prob, weight, heading_modulo_pi

    def locations(self, joints: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Returns the values (B, 8, 3) of all slots in the last frame of each motion.

        Args:
            joints: (B, F, J, 3), positions in meters.
            lengths: (B,) int64, number of real frames per motion. Default: F.
        """
        last = (
            joints[:, -1]
            if lengths is None
            else joints[torch.arange(len(joints), device=joints.device), lengths - 1]
        )
        pelvis = last[:, :1] * FLOOR.on(last.device).to(last.dtype)
        angle = heading(last[:, self.facing.on(last.device)])
        turned = torch.stack([angle, torch.zeros_like(angle), torch.zeros_like(angle)], -1)
        return torch.cat([last[:, self.columns.on(last.device)], pelvis, turned[:, None]], 1)

    def draw(self, joints: Tensor, u: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Draws targets (B, 8, 4), whose values are taken from the ends of real motions.

        Args:
            joints: (B, F, J, 3), positions in meters.
            u: (B,) uniform numbers in [0, 1), each of which selects one of the choices.
            lengths: (B,) int64, number of real frames per motion. Default: F.
        """
        choices = self.choices.on(joints.device)
        drawn = (u * len(choices)).long()
        return requested(self.locations(joints, lengths), choices[drawn])

    def error(self, joints: Tensor, target: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Returns the weighted error (B,) of predicted motions (B, F, J, 3).

        The error is the mean squared error of the requested coordinates in square meters, plus
        the squared error of the heading in square radians. It is 0 if a target requests nothing.
        """
        predicted, values, valid = self.locations(joints, lengths), target[..., :3], target[..., 3:]
        counted = valid * COORDINATES.on(target.device).to(target.dtype)
        squares = ((predicted - values).square() * counted).sum((1, 2)) / (
            counted.sum((1, 2)) + EPSILON
        )
        difference = predicted[:, HEADING, 0] - values[:, HEADING, 0]
        if self.heading_modulo_pi:
            turn = torch.remainder(difference + math.pi / 2, math.pi) - math.pi / 2
        else:
            turn = torch.remainder(difference + math.pi, 2 * math.pi) - math.pi
        counted = valid[:, HEADING, 0]
        return self.weight * (squares + turn.square() * counted / (counted + EPSILON))


def heading(joints: Tensor) -> Tensor:
    """Returns the direction (B,), in radians, that a body faces.

    `joints` (B, 4, 3) contains the right hip, left hip, right shoulder and left shoulder.
    """
    right_hip, left_hip, right_shoulder, left_shoulder = joints.unbind(1)
    right = right_hip - left_hip + right_shoulder - left_shoulder
    # forward = y cross right
    return torch.atan2(right[:, 2], -right[:, 0])


def requested(locations: Tensor, slots: Tensor) -> Tensor:
    """Returns targets (B, 8, 4) from `locations` (B, 8, 3) and a bool mask `slots` (B, 8)."""
    valid = slots[..., None].to(locations)
    return torch.cat([locations * valid, valid], -1)
