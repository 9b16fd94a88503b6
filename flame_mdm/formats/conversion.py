"""Converts motions to the joint positions or SMPL rotations that representations encode."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.formats.motion import AMASS_AXES, Motion
from flame_mdm.formats.poses import Poses
from flame_mdm.formats.resampling import resample
from flame_mdm.representations import Representation, rotation
from flame_mdm.representations.motion272 import Motion272
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import KIT21, SMPL22
from flame_mdm.representations.smpl import ADULT, SMPL

CAMERA_AXES = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
"""Rotation from the camera coordinates of the action data sets (y down) to y up.

It is its own inverse.
"""
KIT_SOURCES = {"root": "pelvis", "belly": "spine2", "thorax": "spine3"}
KIT_SOURCES |= {f"{side}_toes": f"{side}_foot" for side in ("left", "right")}
"""KIT-ML joints whose names differ from SMPL's, with the SMPL joint at the same location."""
LEGS = tuple(
    SMPL22.joints.index(f"{side}_{name}")
    for side in ("left", "right")
    for name in ("knee", "ankle")
)


@dataclass(frozen=True, eq=False)
class RawMotion:
    """A motion in the form that `Representation.encode` accepts.

    Attributes:
        values: joint positions (F, J, 3) in meters, with y up, or SMPL rotations (F, 75) as in
            `representations.smpl.read_pose`.
        note: a line for the user if a body with different proportions was used, or "" otherwise.
            The line states the error, and whether the rotations come from the file or were fitted
            to the joints.
        error: mean distance in meters between the joints of this body and the joints of the motion.
    """

    values: Tensor
    note: str = ""
    error: float = 0.0


def needs_rotations(representation: Representation) -> bool:
    """Returns whether a representation encodes SMPL rotations instead of joint positions."""
    return isinstance(representation, SMPL | Rot6D | Motion272)


def raw_motion(motion: Motion, representation: Representation) -> RawMotion:
    """Converts a motion to the form and frame rate of a representation.

    Joint positions are resampled with cubic splines, and rotations with spherical interpolation
    (slerp). KIT-ML's 21 joints are computed from SMPL's joints. If SMPL rotations are unknown, they
    are computed from the bones of the file or, without bones, fitted to the joints. Rotations that
    are computed or fitted in this way describe a body with an adult's bones. The path of this body
    is scaled in proportion to the leg length.

    Raises:
        UserError: If the representation cannot encode the skeleton of the motion.
    """
    if needs_rotations(representation):
        axes = CAMERA_AXES if isinstance(representation, Rot6D) else AMASS_AXES
        return _rotations(motion, representation.fps, axes)
    joints, skeleton = motion.joints.astype(float), representation.skeleton
    if skeleton.joints == motion.skeleton.joints[: len(skeleton)]:
        joints = joints[:, : len(skeleton)]  # without the hands
    elif skeleton is KIT21 and motion.skeleton.joints[: len(SMPL22)] == SMPL22.joints:
        joints = kit_joints(joints)
    return RawMotion(torch.from_numpy(resample(joints, motion.fps, representation.fps, cubic=True)))


def kit_joints(joints: np.ndarray) -> np.ndarray:
    """Converts SMPL's joints (F, 22 or more, 3) to KIT-ML's 21 joints (F, 21, 3).

    The result is mirrored, as in KIT-ML. KIT-ML's mid-foot joints are placed halfway between the
    ankle and the toes.
    """
    at = {name: joints[:, number] for number, name in enumerate(SMPL22.joints)}
    feet = {
        f"{side}_foot": (at[f"{side}_ankle"] + at[f"{side}_foot"]) / 2 for side in ("left", "right")
    }
    points = [
        feet[name] if name in feet else at[KIT_SOURCES.get(name, name)] for name in KIT21.joints
    ]
    return np.stack(points, 1) * [-1.0, 1.0, 1.0]


def _rotations(motion: Motion, fps: float, axes: Tensor) -> RawMotion:
    """Returns SMPL rotations in coordinates that `axes` (3, 3) converts to y up."""
    if motion.skeleton.joints[: len(SMPL22)] != SMPL22.joints:
        raise UserError(
            f"the model needs rotations of SMPL's joints, but these cannot be derived "
            f"from {motion.skeleton.name}. Use a motion with SMPL's 22 joints"
        )
    note, error = "", 0.0
    if motion.poses is not None:
        poses = motion.poses.resampled(motion.fps, fps)
    else:
        joints = resample(motion.joints.astype(float), motion.fps, fps, cubic=True)
        if motion.bones.poses is not None:
            source, body = "were read from the file", motion.bones.poses.resampled(motion.fps, fps)
        else:
            because = f" ({motion.bones.reason})" if motion.bones.reason else ""
            source = f"were fitted to joints{because}"
            body = Motion(joints, fps, motion.skeleton).posed()
        poses, apart = _adult(body, joints[:, : len(SMPL22)])
        error = float(apart.mean())
        note = (
            f"rotations {source}, on the body of an adult: mean error {100 * error:.1f} cm, "
            f"max {100 * apart.max():.1f} cm"
        )
    rotations = poses.rotations.clone()
    rotations[:, 0] = axes.T @ rotations[:, 0]
    vectors = rotation.matrix_to_axis_angle(rotations).flatten(1)
    hands = vectors.new_zeros(len(vectors), 6)
    translation = poses.root @ axes - vectors.new_tensor(ADULT[0])
    return RawMotion(torch.cat([translation, vectors, hands], 1), note, error)


def _adult(body: Poses, joints: np.ndarray) -> tuple[Poses, np.ndarray]:
    """Transfers a motion to an adult body and scales the path in proportion to the leg length.

    Args:
        body: the motion of a body with the original bone lengths.
        joints: (F, 22, 3), joint positions of the motion, in meters.

    Returns:
        The poses, and an array (F, 22) with the distance in meters between each joint in these
        poses and the same joint in the scaled `joints`.
    """
    adult = body.offsets.new_tensor(ADULT[: len(SMPL22)])
    legs = list(LEGS)
    scale = float(adult[legs].norm(dim=1).sum() / body.offsets[legs].norm(dim=1).sum())
    poses = Poses(adult, body.rotations, scale * body.root)
    return poses, np.linalg.norm(poses.joints().numpy() - scale * joints, axis=-1)
