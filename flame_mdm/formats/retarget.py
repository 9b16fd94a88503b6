"""Transfers motions to the skeletons of other programs and data sets.

`rigs.yaml` contains the names, rest poses and axes of these skeletons.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats.poses import Poses
from flame_mdm.formats.posture import world_rotations
from flame_mdm.formats.rig import CENTIMETER, Rig
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import JOINT, SMPL22
from flame_mdm.safe_io import read_package_yaml

DIRECTIONS = {"up": (0, 1, 0), "down": (0, -1, 0), "forward": (0, 0, 1), "back": (0, 0, -1)}
SMPL_ORDERS = tuple("YXZ" if name.endswith("shoulder") else "YZX" for name in SMPL22.joints)
"""Euler orders for which common poses are far from gimbal lock.

Common poses are bent limbs, a hanging arm, and a body that turns or bows.
"""


@cache
def presets() -> dict[str, dict[str, Any]]:
    """Returns the skeletons in `rigs.yaml`, keyed by name."""
    return read_package_yaml(Path(__file__).with_name("rigs.yaml"))


def joint_names(skeleton: Mapping[str, Any]) -> dict[str, str]:
    """Returns a `rigs.yaml` skeleton's joint names, without their prefix, keyed by SMPL joint."""
    names = {}
    for part, side, mark in _parts(skeleton):
        bones = {joint: name for name, joint in skeleton[part].items() if isinstance(joint, str)}
        names |= {side + joint: name.replace("*", mark) for joint, name in bones.items()}
    return names


def _parts(skeleton: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yields the parts of a skeleton in `rigs.yaml`.

    For each part, yields its key, the prefix of SMPL's joints, and the mark for the side in joint
    names.
    """
    yield "trunk", "", ""
    for side, mark in zip(("left_", "right_"), skeleton["sides"], strict=True):
        yield from (("leg", side, mark), ("arm", side, mark))


def preset(name: str | None, poses: Poses) -> Rig:
    """Returns a skeleton from `rigs.yaml` (None for SMPL's skeleton) with a body's bone lengths."""
    if name is None:
        same, sources = np.tile(np.eye(3), (len(SMPL22), 1, 1)), tuple(range(len(SMPL22)))
        return Rig(
            SMPL22.joints, SMPL22.parents, poses.rest().numpy(), same, sources, same, SMPL_ORDERS
        )
    if name not in presets():
        raise UserError(
            f"rig={name}: unknown.{did_you_mean(name, presets())} Use one of {', '.join(presets())}"
        )
    data = presets()[name]
    offsets, posed = poses.offsets.numpy(), np.tile(np.eye(3), (len(SMPL22), 1, 1))
    for joint, degrees in data.get("pose", {}).items():
        for side, sign in (("left", -1), ("right", 1)):
            posed[JOINT[f"{side}_{joint}"]] = Rotation.from_euler(
                "z", sign * degrees, degrees=True
            ).as_matrix()
    posed = world_rotations(posed)
    rest = np.zeros((len(SMPL22), 3))
    for parent, joint in SMPL22.edges:
        rest[joint] = rest[parent] + posed[parent] @ offsets[joint]
    rest[:, 1] -= rest[:, 1].min()
    joints: list[_RigJoint] = []
    if "root" in data:
        joints.append(_RigJoint(data["root"], -1, -1, np.zeros(3), np.eye(3), np.eye(3)))
    starts = {"trunk": data.get("root"), "leg": next(iter(data["trunk"])), "arm": data["chest"]}
    for part, side, mark in _parts(data):
        start, names = starts[part], list(data[part].items())
        parent = next((k for k, joint in enumerate(joints) if joint.name == start), len(joints) - 1)
        for number, (label, source) in enumerate(names):
            label = label.replace("*", mark)
            if isinstance(source, str):
                joint = JOINT[side + source]
                # A joint without a child continues in the direction of the previous bone.
                end = SMPL22.parents.index(joint) if joint in SMPL22.parents else joint
                local = _axes(data.get("axes", {}), part, source, offsets[end], side == "right_")
                joints.append(
                    _RigJoint(label, parent, joint, rest[joint], posed[joint] @ local, local)
                )
            else:
                # A joint that SMPL lacks lies at a fraction of the distance from its parent to the
                # next SMPL joint, and does not rotate.
                above = joints[parent]
                following = next(ours for _, ours in names[number:] if isinstance(ours, str))
                distance = rest[JOINT[side + following]] - above.position
                position = above.position + source * distance
                joints.append(_RigJoint(label, parent, -1, position, above.turn, above.neutral))
            parent = len(joints) - 1
    names, parents, sources, positions, turns, neutral = zip(*joints, strict=True)
    return Rig(
        joints=tuple(data.get("prefix", "") + name for name in names),
        parents=parents,
        positions=np.stack(positions),
        turns=np.stack(turns),
        sources=sources,
        neutral=np.stack(neutral),
        orders=(data["order"],) * len(joints),
        unit=data.get("unit", CENTIMETER),
    )


class _RigJoint(NamedTuple):
    """A joint of a rig in the rest pose.

    The fields are the joint's name, the index of its parent, the index of the SMPL joint that it
    follows (or -1), its position, its world rotation, and its neutral rotation.
    """

    name: str
    parent: int
    source: int
    position: np.ndarray
    turn: np.ndarray
    neutral: np.ndarray


def _axes(axes: dict[str, Any], part: str, joint: str, bone: np.ndarray, right: bool) -> np.ndarray:
    """Returns a joint's local axes (3, 3) in a T-pose; `bone` is the bone's direction."""
    # Gram-Schmidt: the first direction is kept, its component is removed from the second direction,
    # and the third axis is their cross product. The right side is the mirror image of the left
    # side. In "opposed" skeletons, all three axes are then reversed, which keeps them right-handed.
    flip = np.array([-1, 1, 1]) if right else np.ones(3)
    matrix, columns = np.eye(3), []
    # The file lists the axes for two directions, and only for the left side.
    for axis, direction in axes.get(joint, axes.get(part, {})).items():
        toward = np.array(DIRECTIONS[direction], float) if direction in DIRECTIONS else bone * flip
        for column in columns:
            toward = toward - matrix[:, column] * (matrix[:, column] @ toward)
        columns.append("xyz".index(axis))
        matrix[:, columns[-1]] = toward / np.linalg.norm(toward)
    if columns:
        third = 3 - sum(columns)
        matrix[:, third] = np.cross(matrix[:, (third + 1) % 3], matrix[:, (third + 2) % 3])
        if right:
            matrix = matrix * flip[:, None] * (-1 if axes.get("opposed") else 1)
            matrix[:, third] *= 1 if axes.get("opposed") else -1
    return matrix


def retarget(poses: Poses, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Applies a motion to a skeleton.

    Returns:
        The local rotations (F, J, 3, 3), as in `Rig.local`, and the world positions (F, 3) of the
        hips.
    """
    return rig.local(rig.turned(world_rotations(poses.rotations.numpy()))), poses.root.numpy()


def continuous_euler(matrices: Tensor, orders: Sequence[str] = SMPL_ORDERS) -> Tensor:
    """Converts rotations to Euler angles, in radians, that do not jump between frames.

    Programs can therefore interpolate the angles.

    Args:
        matrices: (F, J, 3, 3), rotation matrices.
        orders: order of the Euler angles of each joint, such as "ZXY".

    Returns:
        The angles (F, J, 3).
    """
    # Each rotation is described by two triples of Euler angles, (a, b, c) and (a + pi, pi - b, c +
    # pi), and full turns may be added to each angle. In each frame, the triple nearest to the
    # previous frame is used.
    turn = 2 * torch.pi
    first = torch.stack(
        [rotation.matrix_to_euler(matrices[:, j], order) for j, order in enumerate(orders)], 1
    )
    second = torch.stack(
        [first[..., 0] + torch.pi, torch.pi - first[..., 1], first[..., 2] + torch.pi], -1
    )
    chosen = [first[0]]
    for pair in torch.stack([first, second], -2)[1:]:
        before = chosen[-1][:, None]
        near = pair - turn * ((pair - before) / turn).round()
        best = (near - before).square().sum(-1).argmin(-1)
        chosen.append(near[torch.arange(len(near)), best])
    return torch.stack(chosen)
