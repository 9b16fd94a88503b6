"""Joint rotations from joint positions, by analytic inverse kinematics of SMPL's first 22 joints."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22, forward_kinematics
from flame_mdm.representations.smpl import ADULT

CHILDREN = tuple(tuple(joint for joint, parent in enumerate(SMPL22.parents) if parent == j) for j in range(len(SMPL22)))
PELVIS, SPINE3 = 0, 9
SPINE = {3: 1 / 3, 6: 2 / 3}
"""Joints between pelvis and chest -> fraction of the rotation from pelvis to chest."""
FORWARD = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
BENDS = {1: -FORWARD, 2: -FORWARD, 16: FORWARD, 17: FORWARD}
"""Hips and shoulders -> direction in which the knee or elbow bends the limb in the rest pose."""
STRAIGHT = 0.15
"""Sine of the bend of a knee or elbow at which the bend and the parent's rotation have the same weight for the twist of
the limb. Weights are squared, so that a clear bend dominates."""
FOOT = 0.3
"""Weight of the foot relative to the shin in the twist of a thigh: it determines the twist of a straight leg."""
SMOOTH = 0.1
"""Seconds over which the bend is averaged before it determines the twist, so that an arm does not spin when it passes
through the straight position. Joint positions do not depend on the twist."""


@dataclass(eq=False)
class Poses:
    """A body in motion, in meters, y up; the rest pose is SMPL's: arms out to the sides, facing +z, left at +x.

    Attributes:
        offsets: (22, 3) float64, position of each joint of `SMPL22` relative to its parent in the rest pose.
        rotations: (F, 22, 3, 3) float64, of the root in the world and of each other joint relative to its parent. A
            joint's rotation applies to the bones that leave it.
        root: (F, 3) float64, position of the pelvis.
    """

    offsets: Tensor
    rotations: Tensor
    root: Tensor

    def joints(self) -> Tensor:
        """Returns joint positions (F, 22, 3)."""
        return forward_kinematics(SMPL22, self.rotations, self.offsets, self.root)

    def rest(self) -> Tensor:
        """Returns joint positions (22, 3) of the rest pose, with the lowest joint on the floor."""
        identity = torch.eye(3, dtype=self.offsets.dtype).expand(1, len(SMPL22), 3, 3)
        joints = forward_kinematics(SMPL22, identity, self.offsets, self.offsets.new_zeros(1, 3))[0]
        return joints - joints.new_tensor([0, 1, 0]) * joints[:, 1].min()


def solve(joints: Tensor, fps: float) -> Poses:
    """Computes a body and rotations that reproduce its joint positions in every frame.

    Bones get their mean length over the clip. Pelvis and chest, which have three bones each, are rotated for the best
    fit of all three (Kabsch 1976); every other joint aims its bone at the next joint. The positions are reproduced
    exactly if bones keep their length and the three bones of pelvis and chest their angles, as in recorded motion.
    Positions do not determine the twist of a bone about its own axis: thighs and upper arms are twisted so that knees
    and elbows bend like hinges, the spine twists evenly from pelvis to chest, and all other joints follow their parent.
    The rotations of head, hands and toes are not observable.

    Args:
        joints: (F, 22, 3) positions in meters, y up, in the order of `SMPL22`.
        fps: frames per second.

    Raises:
        UserError: If the joints are of another skeleton, or a bone has no length.
    """
    if joints.ndim != 3 or not len(joints) or joints.shape[1:] != (len(SMPL22), 3):
        raise UserError(
            f"joint rotations are computed only for the {len(SMPL22)} joints of SMPL, (frames, {len(SMPL22)}, 3); "
            f"these joints have shape {tuple(joints.shape)}: write them as .json or .npy"
        )
    joints = joints.double()
    bones = SMPL22.bones(joints)
    lengths = torch.linalg.vector_norm(bones, dim=-1).mean(0)
    if (lengths[1:] < 1e-4).any():
        name = SMPL22.joints[int(lengths[1:].argmin()) + 1]
        raise UserError(f"the bone that ends in {name} has no length, so its direction is undefined")
    adult = torch.tensor(ADULT[: len(SMPL22)], dtype=torch.float64)
    offsets = lengths[:, None] * F.normalize(adult, dim=-1)
    for joint in (PELVIS, SPINE3):
        children = list(CHILDREN[joint])
        fitted = _fit(offsets[children], bones[:, children])
        shape = (fitted.mT[:, None] @ bones[:, children, :, None]).mean(0)[..., 0]
        offsets[children] = lengths[children, None] * F.normalize(shape, dim=-1)
    chest = rotation.matrix_to_quaternion(_fit(offsets[list(CHILDREN[SPINE3])], bones[:, list(CHILDREN[SPINE3])]))

    turned: list[Tensor] = []  # world rotation of each joint
    positions = [joints[:, 0]] + [joints[:, 0]] * (len(SMPL22) - 1)
    for joint, children in enumerate(CHILDREN):
        aims = joints[:, list(children)] - positions[joint][:, None]
        if len(children) > 1:
            turned.append(_fit(offsets[list(children)], aims))
        elif not children:
            turned.append(turned[SMPL22.parents[joint]])
        else:
            start = rotation.matrix_to_quaternion(turned[SMPL22.parents[joint]])
            if joint in SPINE:
                start = rotation.slerp(rotation.matrix_to_quaternion(turned[PELVIS]), chest, SPINE[joint])
            swung = rotation.multiply(rotation.between(rotation.rotate(start, offsets[children[0]]), aims[:, 0]), start)
            if joint in BENDS:
                swung = rotation.multiply(_twist(joint, swung, offsets[children[0]], bones, fps), swung)
            turned.append(rotation.quaternion_to_matrix(swung))
        for child in children:
            positions[child] = positions[joint] + turned[joint] @ offsets[child]
    world = torch.stack(turned, 1)
    above = world[:, [max(parent, 0) for parent in SMPL22.parents]]
    local = above.mT @ world
    local[:, 0] = world[:, 0]
    return Poses(offsets, local, joints[:, 0])


def _fit(offsets: Tensor, bones: Tensor) -> Tensor:
    """Returns rotations (F, 3, 3) that best align K offsets (K, 3) with K bones (F, K, 3)."""
    u, _, vt = torch.linalg.svd(bones.mT @ offsets)
    sign = torch.ones_like(bones[:, 0])
    sign[:, 2] = torch.linalg.det(u @ vt)
    return (u * sign[:, None]) @ vt


def _twist(joint: int, swung: Tensor, offset: Tensor, bones: Tensor, fps: float) -> Tensor:
    """Returns quaternions (F, 4) that rotate a limb about its axis so that the hinge at its end matches the bend."""
    middle = CHILDREN[joint][0]
    end = CHILDREN[middle][0]
    axis = F.normalize(rotation.rotate(swung, offset), dim=-1)
    hinge = rotation.rotate(swung, F.normalize(torch.linalg.cross(offset, BENDS[joint]), dim=-1))
    limb, beyond = F.normalize(bones[:, middle], dim=-1), F.normalize(bones[:, end], dim=-1)
    bend = torch.linalg.cross(limb, beyond)
    if joint in (1, 2):
        bend = bend + FOOT * torch.linalg.cross(F.normalize(bones[:, CHILDREN[end][0]], dim=-1), limb)
    across = torch.linalg.cross(axis, hinge)
    shown = torch.stack([(bend * hinge).sum(-1), (bend * across).sum(-1)], -1)
    shown = _smooth(shown, SMOOTH * fps)
    shown = torch.linalg.vector_norm(shown, dim=-1, keepdim=True) * shown + shown.new_tensor([STRAIGHT**2, 0.0])
    return rotation.axis_angle_to_quaternion(axis * torch.atan2(shown[:, 1], shown[:, 0])[:, None])


def _smooth(x: Tensor, frames: float) -> Tensor:
    """Smooths (F, N) over time with a Gaussian whose standard deviation is `frames`."""
    from scipy.ndimage import gaussian_filter1d

    return torch.from_numpy(gaussian_filter1d(x.numpy(), frames, axis=0, mode="nearest"))
