"""Joint rotations from joint positions: analytic inverse kinematics for SMPL's 22 joints."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.formats.resampling import frame_pairs, resample
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22, forward_kinematics
from flame_mdm.representations.smpl import ADULT

CHILDREN = tuple(
    tuple(joint for joint, parent in enumerate(SMPL22.parents) if parent == j)
    for j in range(len(SMPL22))
)
PELVIS, SPINE3 = 0, 9
ALIKE = ((0,), (1, 2), (3,), (4, 5), (6,), (7, 8), (9,), (12,), (13, 14), (16, 17), (18, 19))
"""Joints with children, from the root outward. Corresponding left and right joints form groups."""
# For each joint between pelvis and chest, the fraction of the rotation from pelvis to chest that it
# takes
SPINE = {
    3: 1 / 3,
    6: 2 / 3,
}
BENDS = {1: -1.0, 2: -1.0, 16: 1.0, 17: 1.0}
"""For hips and shoulders, the z component of the direction in which the knee or elbow bends at rest."""
STRAIGHT = 0.15
"""Sine of a knee's or elbow's bend angle at which two cues for a limb's twist have equal weight.

The cues are the bend and the rotation of the parent. Weights are squared, so that a clear bend
dominates.
"""
# Weight of the foot relative to the shin, for the twist of a thigh. While the leg is straight, the
# shin does not determine the twist.
FOOT = 0.3
# Seconds over which bend directions are averaged, so that an arm does not spin while it is nearly
# straight
SMOOTH = 0.1
# Number of squarings. They result in the 4,096th power, in which only the dominant eigenvector
# remains.
SQUARINGS = 12
# The power is divided by its largest entry after this many squarings. In between, its dominant
# eigenvalue grows from at most 4 to at most 4^16, which float32 can represent.
RESCALED_EVERY = 4


@dataclass(eq=False)
class Poses:
    """A moving body, defined by its rest pose and rotations.

    Lengths are in meters, and y is up. The rest pose is SMPL's rest pose: arms out to the sides,
    facing +z, with the left side at +x.
    """

    # (22, 3) float64, position of each joint of `SMPL22` relative to its parent in the rest pose
    offsets: Tensor
    # (F, 22, 3, 3) float64, rotations relative to the parents. A rotation applies to the bones that
    # begin at its joint.
    rotations: Tensor
    root: Tensor  # (F, 3) float64, position of the pelvis

    def joints(self) -> Tensor:
        """Returns joint positions (F, 22, 3)."""
        return forward_kinematics(SMPL22, self.rotations, self.offsets, self.root)

    def rest(self) -> Tensor:
        """Returns the joints (22, 3) in the rest pose, with the lowest joint on the floor."""
        joints = SMPL22.assemble(self.offsets, self.offsets.new_zeros(3))
        return joints - joints.new_tensor([0, 1, 0]) * joints[:, 1].min()

    def resampled(self, rate: float, fps: float) -> "Poses":
        """Returns the motion, resampled from `rate` to `fps` frames per second.

        Rotations are interpolated on the sphere, and the path of the pelvis is interpolated with
        cubic splines.
        """
        if math.isclose(rate, fps):
            return self
        before, after, share = frame_pairs(len(self.root), rate, fps, len(SMPL22))
        turns = rotation.matrix_to_quaternion(self.rotations)
        between = torch.from_numpy(share)[:, None, None]
        turns = rotation.slerp(turns[before], turns[after], between)
        root = torch.from_numpy(resample(self.root.numpy(), rate, fps, cubic=True))
        return Poses(self.offsets, rotation.quaternion_to_matrix(turns), root)


@dataclass(frozen=True, eq=False)
class BoneRotations:
    """Rotations of SMPL's joints, taken from the bones in a file.

    Attributes:
        poses: the rotations, for a body with the bone lengths in the file. None if the file
            contains no usable rotations.
        reason: why the rotations in the file cannot be used, or "" if they are usable or the file
            contains no rotations.
    """

    poses: Poses | None = None
    reason: str = ""


def solve(joints: Tensor, fps: float) -> Poses:
    """Computes a body and the joint rotations that reproduce the given joint positions.

    Each bone has its mean length over the clip. The pelvis and the chest, which have three bones
    each, are given the rotation that best fits all three bones (Kabsch 1976). Every other joint is
    rotated so that its bone points at the next joint.

    Positions do not determine the twist of a bone about its own axis. Thighs and upper arms are
    twisted so that knees and elbows bend like hinges. The twist of the spine is distributed evenly
    from pelvis to chest. All other joints, including the head, hands and toes, follow their parent.

    Args:
        joints: (F, 22, 3), joint positions in the order of `SMPL22`, in meters, with y up.
        fps: frames per second.

    Raises:
        UserError: If the joints have the wrong shape, or if a bone has no length.
    """
    if joints.ndim != 3 or not len(joints) or joints.shape[1:] != (len(SMPL22), 3):
        raise UserError(
            "joint rotations can be computed only for SMPL's 22 joints (frames, 22, 3), but these "
            f"joints have shape {tuple(joints.shape)}. Save them as .json or .npy"
        )
    joints = joints.double()
    lengths = torch.linalg.vector_norm(SMPL22.bones(joints), dim=-1).mean(0)
    if (lengths[1:] < 1e-4).any():
        name = SMPL22.joints[int(lengths[1:].argmin()) + 1]
        raise UserError(
            f"the bone that ends at {name} has no length, so its direction is undefined"
        )
    offsets, quaternions = solve_checked(joints, fps)
    return Poses(offsets, rotation.quaternion_to_matrix(quaternions), joints[:, 0])


def solve_checked(joints: Tensor, fps: float) -> tuple[Tensor, Tensor]:
    """Returns offsets (22, 3) and quaternions (F, 22, 4), like `solve` but without checks.

    Both results have the same precision as the joints. The function has no data-dependent branches,
    and it processes similar joints in a single batch so that its ONNX graph is small.
    """
    bones = SMPL22.bones(joints)
    lengths = torch.linalg.vector_norm(bones, dim=-1).mean(0)
    adult = joints.new_tensor(ADULT[: len(SMPL22)])
    offsets = lengths[:, None] * F.normalize(adult, dim=-1)
    for joint in (PELVIS, SPINE3):
        children = list(CHILDREN[joint])
        fitted = rotation.quaternion_to_matrix(_fit(offsets[children], bones[:, children]))
        shape = (fitted.mT[:, None] @ bones[:, children, :, None]).mean(0)[..., 0]
        offsets[children] = lengths[children, None] * F.normalize(shape, dim=-1)
    chest = _fit(offsets[list(CHILDREN[SPINE3])], bones[:, list(CHILDREN[SPINE3])])

    turned: dict[int, Tensor] = {}  # world rotation (F, 4) of each joint
    positions = {PELVIS: joints[:, 0]}
    for group in ALIKE:
        children = [CHILDREN[joint][0] for joint in group]
        start = (
            torch.stack([turned[max(SMPL22.parents[joint], 0)] for joint in group], 1)
            if turned
            else chest
        )
        if len(CHILDREN[group[0]]) > 1:
            children = list(CHILDREN[group[0]])
            swung = _fit(offsets[children], joints[:, children] - positions[group[0]][:, None])[
                :, None
            ]
        else:
            if group[0] in SPINE:
                start = rotation.slerp(turned[PELVIS], chest, SPINE[group[0]])[:, None]
            aims = joints[:, children] - torch.stack([positions[joint] for joint in group], 1)
            swung = rotation.multiply(
                rotation.between(rotation.rotate(start, offsets[children]), aims), start
            )
            if group[0] in BENDS:
                swung = rotation.multiply(
                    _twist(group, swung, offsets[children], bones, fps), swung
                )
        for number, joint in enumerate(group):
            turned[joint] = swung[:, number]
        turned |= {
            child: turned[SMPL22.parents[child]] for child in children if not CHILDREN[child]
        }
        reached = rotation.rotate(swung, offsets[children])
        for number, child in enumerate(children):
            positions[child] = positions[SMPL22.parents[child]] + reached[:, number]
    world = torch.stack([turned[joint] for joint in range(len(SMPL22))], 1)
    above = rotation.inverse(world[:, list(SMPL22.parents[1:])])
    return offsets, rotation.standardize(
        torch.cat([world[:, :1], rotation.multiply(above, world[:, 1:])], 1)
    )


def _fit(offsets: Tensor, bones: Tensor) -> Tensor:
    """Returns the quaternions (F, 4) that best align K offsets (K, 3) with K bones (F, K, 3).

    The quaternions are dominant eigenvectors (Horn 1987, "Closed-form solution of absolute
    orientation using unit quaternions"), computed by repeated squaring. If the bones have no
    length, the result is the identity.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in (offsets.mT @ bones).unbind(-2))
    # The rotation is the eigenvector of this symmetric matrix with the largest eigenvalue. ONNX has
    # no operator for eigenvectors. The columns of high powers of a matrix approach this
    # eigenvector, and repeated squaring needs few operations.
    rows = (
        torch.stack((a + e + i, f - h, g - c, b - d), -1),
        torch.stack((f - h, a - e - i, b + d, g + c), -1),
        torch.stack((g - c, b + d, e - a - i, f + h), -1),
        torch.stack((b - d, g + c, f + h, i - a - e), -1),
    )
    power = torch.stack(rows, -2)
    size = torch.linalg.vector_norm(power, dim=(1, 2), keepdim=True)
    power = power / size.clamp_min(torch.finfo(bones.dtype).tiny) + torch.eye(4, dtype=bones.dtype)
    for squaring in range(1, SQUARINGS + 1):
        power = power @ power
        if squaring % RESCALED_EVERY == 0:
            power = power / power.amax((1, 2), keepdim=True)
    largest = power.diagonal(dim1=1, dim2=2).argmax(-1)
    return F.normalize(power.gather(1, largest[:, None, None].expand(-1, 1, 4))[:, 0], dim=-1)


def _twist(
    group: Sequence[int], swung: Tensor, offsets: Tensor, bones: Tensor, fps: float
) -> Tensor:
    """Returns quaternions (F, G, 4) that twist limbs about their axes.

    After the twist, knees and elbows bend like hinges.

    Args:
        group: the G joints at which the limbs begin.
        swung: (F, G, 4), rotations of the limbs before the twist.
        offsets: (G, 3), offset of each limb's second joint from its first in the rest pose.
        bones: (F, 22, 3), vectors along all bones.
        fps: frames per second.
    """
    middle = [CHILDREN[joint][0] for joint in group]
    end = [CHILDREN[joint][0] for joint in middle]
    axis = F.normalize(rotation.rotate(swung, offsets), dim=-1)
    forward = offsets.new_tensor([0.0, 0.0, BENDS[group[0]]]).expand_as(offsets)
    hinge = rotation.rotate(swung, F.normalize(torch.linalg.cross(offsets, forward), dim=-1))
    limb, beyond = F.normalize(bones[:, middle], dim=-1), F.normalize(bones[:, end], dim=-1)
    bend = torch.linalg.cross(limb, beyond)
    if group[0] == SMPL22.joints.index("left_hip"):
        bend = bend + FOOT * torch.linalg.cross(
            F.normalize(bones[:, [CHILDREN[j][0] for j in end]], dim=-1), limb
        )
    across = torch.linalg.cross(axis, hinge)
    shown = torch.stack([(bend * hinge).sum(-1), (bend * across).sum(-1)], -1)
    shown = _smooth(shown.flatten(1), SMOOTH * fps).unflatten(1, (-1, 2))
    shown = torch.linalg.vector_norm(shown, dim=-1, keepdim=True) * shown + shown.new_tensor(
        [STRAIGHT**2, 0.0]
    )
    return rotation.axis_angle_to_quaternion(
        axis * torch.atan2(shown[..., 1], shown[..., 0])[..., None]
    )


def _smooth(x: Tensor, frames: float) -> Tensor:
    """Smooths values (F, N) over time with a Gaussian of standard deviation `frames`."""
    reach = int(4 * frames + 0.5)
    weights = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / frames) ** 2).to(x)
    padded = torch.cat([x[:1].expand(reach, -1), x, x[-1:].expand(reach, -1)])
    return F.conv1d(padded.T[:, None], weights[None, None] / weights.sum())[:, 0].T
