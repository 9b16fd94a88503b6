"""Rotations for SMPL's joints, computed from the bones in a BVH or AMC file.

Joint positions do not show how a forearm or the head turns about its own axis, but the bones in a
file do. The rotation of each SMPL joint is the rotation of its bone relative to the rest pose.
Three rest poses are tried, in this order: the file's pose without rotations, a rest pose that
precedes the motion, and the axes of a known skeleton in a T-pose. If a rest pose is not a T-pose,
its arms and legs are turned by the smallest rotations that point them in SMPL's directions.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike

from flame_mdm.errors import UserError
from flame_mdm.formats.bvh import Bvh, forward_kinematics
from flame_mdm.formats.layouts import UP, Layout
from flame_mdm.formats.poses import BoneRotations, Poses
from flame_mdm.formats.posture import shortest_turns
from flame_mdm.formats.retarget import preset, presets
from flame_mdm.formats.rig import LIMBS, SIDES, rest_pose
from flame_mdm.representations.skeleton import JOINT, SMPL22
from flame_mdm.representations.smpl import ADULT

# Maximum mean distance, in meters, between the joint positions in the file and the positions that
# follow from the rotations
APART = 0.03
# Cosine of the maximum angle between a limb of a known skeleton in its T-pose and SMPL's limb
ALIKE = np.cos(np.radians(30))
VERTICALS = ((0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
"""Possible directions of the trunk in a rest pose.

Some programs export rest poses with a different up axis.
"""


def bone_poses(
    tree: Bvh,
    layout: Layout,
    joints: np.ndarray,
    worlds: np.ndarray,
    in_front: np.ndarray | None = None,
) -> BoneRotations:
    """Returns the rotations of SMPL's joints, taken from the bones in a file.

    The file's rotations cannot be used if the rest pose is unknown or if the rotations do not
    reproduce the joint positions, for example because position channels move each joint.

    Args:
        tree: the tree of joints in the file.
        layout: the skeleton of the file.
        joints: (F, 22, 3), positions of SMPL's joints in meters, with y up.
        worlds: (F, J, 3, 3), world rotations of the J joints in the file.
        in_front: (J, 3, 3), the rest pose that precedes the motion, as rotations relative to the
            parents; None if there is no such pose.
    """
    if layout.mirrored:
        return BoneRotations(reason="the motion in the file is mirrored")
    bones = [tree.joints.index(layout.bone(joint)) for joint in SMPL22.joints]
    up = np.array(UP[layout.up], float)
    turned = up @ worlds[:, bones]
    joints = joints.astype(float)
    steps = np.zeros_like(joints)
    steps[:, 1:] = joints[:, 1:] - joints[:, list(SMPL22.parents[1:])]

    rest = _rest(tree, layout, bones, turned, steps, in_front)
    if rest is None:
        return BoneRotations(reason="the rest pose in the file is unknown")
    turned = turned @ _aligned(rest, turned, steps)
    poses = _assembled(turned, joints[:, 0], steps)
    apart = np.linalg.norm(poses.joints().numpy() - joints, axis=-1).mean()
    if not apart <= APART:
        reason = f"the rotations in the file place joints {100 * apart:.0f} cm from their positions"
        return BoneRotations(reason=reason)
    return BoneRotations(poses)


def _rest(
    tree: Bvh,
    layout: Layout,
    bones: Sequence[int],
    turned: np.ndarray,
    steps: np.ndarray,
    in_front: np.ndarray | None,
) -> np.ndarray | None:
    """Returns the bone rotations (22, 3, 3) in the rest pose, with y up and the body facing +z.

    Returns None if no rest pose is known.
    """
    still = np.tile(np.eye(3), (len(tree.joints), 1, 1))
    for local in (still, in_front):
        if local is not None:
            positions, worlds = forward_kinematics(tree.parents, local[None], tree.offsets[None])
            pose = layout.apply(positions, tree.joints)[0].astype(float)
            up = np.array(UP[layout.up], float)
            if (rest := _upright(pose, up @ worlds[0, bones])) is not None:
                return rest
    if "axes" in presets().get(layout.rig, {}):
        rig = preset(layout.rig, _adult(np.eye(3)[None]))
        rest = np.stack([rig.neutral[rig.sources.index(joint)] for joint in range(len(SMPL22))])
        if all(
            _unit(rest[start] @ _local(turned, steps, start, end)) @ _unit(ADULT[end]) > ALIKE
            for start, end in _limbs()
        ):
            return rest
    return None


def _upright(pose: np.ndarray, turned: np.ndarray) -> np.ndarray | None:
    """Returns the bone rotations (22, 3, 3) in a pose, turned so that y is up and +z is forward.

    Returns None if the body is not upright in the `pose` (22, 3).
    """
    shoulders = pose[[JOINT["left_shoulder"], JOINT["right_shoulder"]]].mean(0)
    trunk = shoulders - pose[[JOINT["left_hip"], JOINT["right_hip"]]].mean(0)
    vertical = max(VERTICALS, key=lambda axis: float(trunk @ np.array(axis)))
    try:
        names, parents = SMPL22.joints, SMPL22.parents
        pose_at_rest = rest_pose("", names, parents, pose, turned, JOINT, pose, vertical)
    except UserError:
        return None
    return pose_at_rest.rig.turns


def _limbs() -> list[tuple[int, int]]:
    """Returns the first and last joints of each bone in the arms and legs."""
    return [
        (JOINT[f"{side}_{start}"], JOINT[f"{side}_{end}"])
        for side in SIDES
        for start, end in LIMBS.items()
    ]


def _aligned(rest: np.ndarray, turned: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Returns the rotations (22, 3, 3) from SMPL's joints at rest to the bones in the file."""
    aligned = np.swapaxes(rest, 1, 2).copy()
    for start, end in _limbs():
        along = rest[start] @ _local(turned, steps, start, end)
        turn = shortest_turns(np.array(ADULT[end]), along)
        aligned[start] = rest[start].T @ turn
        if SMPL22.joints[start].endswith("elbow"):
            aligned[end] = rest[end].T @ turn
    return aligned


def _local(turned: np.ndarray, steps: np.ndarray, start: int, end: int) -> np.ndarray:
    """Returns the mean position of a bone's end in the bone's coordinates, with shape (3,)."""
    return np.einsum("fji,fj->fi", turned[:, start], steps[:, end]).mean(0)


def _unit(vector: ArrayLike) -> np.ndarray:
    vector = np.asarray(vector, float)
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


def _assembled(turned: np.ndarray, root: np.ndarray, steps: np.ndarray) -> Poses:
    """Returns poses whose joints have the given world rotations (F, 22, 3, 3).

    The body has the same bone lengths as the skeleton in the file.
    """
    offsets = np.zeros((len(SMPL22), 3))
    local = turned.copy()
    for parent, joint in SMPL22.edges:
        local[:, joint] = np.swapaxes(turned[:, parent], 1, 2) @ turned[:, joint]
        length = np.linalg.norm(steps[:, joint], axis=1).mean()
        offsets[joint] = length * _unit(_local(turned, steps, parent, joint))
    return Poses(torch.from_numpy(offsets), torch.from_numpy(local), torch.from_numpy(root))


def _adult(turns: np.ndarray) -> Poses:
    offsets = torch.tensor(ADULT[: len(SMPL22)], dtype=torch.float64)
    local = torch.from_numpy(np.tile(turns[:, None], (1, len(SMPL22), 1, 1)))
    return Poses(offsets, local, torch.zeros(len(turns), 3, dtype=torch.float64))
