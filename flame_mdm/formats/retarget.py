"""Motions on the skeletons of other programs and data sets; `rigs.yaml` contains their names, rest poses and axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats.poses import Poses
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.safe_io import read_yaml

JOINT = {name: number for number, name in enumerate(SMPL22.joints)}
DIRECTIONS = {
    **{"up": (0, 1, 0), "down": (0, -1, 0), "forward": (0, 0, 1), "back": (0, 0, -1)},
}
CENTIMETER = 0.01
SMPL_ORDERS = tuple("YXZ" if name.endswith("shoulder") else "YZX" for name in SMPL22.joints)
"""Euler order of each of SMPL's joints, chosen to keep gimbal lock (middle angle at 90 degrees) away from common poses:
bent knees, elbows and hips, a hanging arm, a body that turns or bows."""


@dataclass(frozen=True, eq=False)
class Rig:
    """A skeleton with J joints in its rest pose, in meters, y up, facing +z.

    Attributes:
        joints: names; parents precede their children.
        parents: index of each joint's parent, -1 for a root.
        places: (J, 3), positions of the joints.
        turns: (J, 3, 3), rotations of the joints in the world.
        sources: for each joint, the index of the joint of SMPL whose rotation it takes, or -1.
        neutral: (J, 3, 3), rotations of these joints in the world while SMPL's are those of its rest pose.
        unit: meters per unit of length in BVH files.
        orders: of the Euler angles of each joint in BVH files.
        moving: every joint has channels of its position in BVH files, not only the pelvis and joints above it.
        frame: (3, 3), rotation from the world of the file.
        scales: (J,), units of the world per unit in the frame of each joint; none = 1.
    """

    joints: tuple[str, ...]
    parents: tuple[int, ...]
    places: np.ndarray
    turns: np.ndarray
    sources: tuple[int, ...]
    neutral: np.ndarray
    orders: tuple[str, ...]
    unit: float = CENTIMETER
    moving: bool = False
    frame: np.ndarray = field(default_factory=lambda: np.eye(3))
    scales: np.ndarray = field(default_factory=lambda: np.ones(0))

    @property
    def hips(self) -> int:
        """The joint of the pelvis."""
        return self.sources.index(0)

    def offsets(self) -> np.ndarray:
        """Returns the position (J, 3) of each joint in the frame of its parent, or in the world of the file."""
        return np.stack([self.within(self.places[joint], joint) for joint in range(len(self.joints))])

    def within(self, places: np.ndarray, joint: int) -> np.ndarray:
        """Converts positions (..., 3) in the world to the frame of a joint's parent in the rest pose."""
        parent = self.parents[joint]
        if parent < 0:
            return places @ self.frame
        return (places - self.places[parent]) @ self.turns[parent] / (self.scales[parent] if len(self.scales) else 1)

    def rest(self) -> np.ndarray:
        """Returns the rotation (J, 3, 3) of each joint relative to its parent, or to the world of the file."""
        return self.local(self.turns)

    def local(self, turned: np.ndarray) -> np.ndarray:
        """Converts rotations (..., J, 3, 3) in the world to those relative to parents, or to the world of the file."""
        local = turned.copy()
        for joint, parent in enumerate(self.parents):
            above = turned[..., parent, :, :] if parent >= 0 else self.frame
            local[..., joint, :, :] = np.swapaxes(above, -1, -2) @ turned[..., joint, :, :]
        return local

    def turned(self, body: np.ndarray) -> np.ndarray:
        """Returns rotations (F, J, 3, 3) in the world, while SMPL's joints have the rotations `body` (F, 22, 3, 3).

        Joints with a counterpart follow it; the others keep their angle to their parent.
        """
        rest, turned = self.rest(), np.tile(self.turns, (len(body), 1, 1, 1))
        for joint, (parent, source) in enumerate(zip(self.parents, self.sources, strict=True)):
            if source >= 0:
                turned[:, joint] = body[:, source] @ self.neutral[joint]
            elif parent >= 0:
                turned[:, joint] = turned[:, parent] @ rest[joint]
        return turned


@cache
def presets() -> dict[str, dict[str, Any]]:
    """Returns the skeletons in `rigs.yaml` by name."""
    return read_yaml(Path(__file__).with_name("rigs.yaml"))


def smpl(poses: Poses) -> Rig:
    """Returns a body's own skeleton."""
    same = np.tile(np.eye(3), (len(SMPL22), 1, 1))
    return Rig(SMPL22.joints, SMPL22.parents, poses.rest().numpy(), same, tuple(range(len(SMPL22))), same, SMPL_ORDERS)


def preset(name: str, poses: Poses) -> Rig:
    """Returns a known skeleton with the bone lengths of a body: its joints are where those of the body are.

    Args:
        name: of a skeleton in `rigs.yaml`.
        poses: the body.

    Raises:
        UserError: no skeleton has this name.
    """
    if name not in presets():
        raise UserError(f"rig={name}: unknown.{did_you_mean(name, presets())} Use one of {', '.join(presets())}")
    data = presets()[name]
    offsets, posed = poses.offsets.numpy(), np.tile(np.eye(3), (len(SMPL22), 1, 1))
    for joint, degrees in data.get("pose", {}).items():
        for side, sign in (("left", -1), ("right", 1)):
            posed[JOINT[f"{side}_{joint}"]] = Rotation.from_euler("z", sign * degrees, degrees=True).as_matrix()
    posed = world_rotations(posed)
    rest = np.zeros((len(SMPL22), 3))
    for parent, joint in SMPL22.edges:
        rest[joint] = rest[parent] + posed[parent] @ offsets[joint]
    rest[:, 1] -= rest[:, 1].min()
    # name, parent, counterpart, place, axes in the T-pose, rotation in the rest pose
    joints: list[tuple[str, int, int, np.ndarray, np.ndarray, np.ndarray]] = []
    if "root" in data:
        joints.append((data["root"], -1, -1, np.zeros(3), np.eye(3), np.eye(3)))

    def add(part: str, start: str | None, side: str = "", mark: str = "") -> None:
        parent = next((k for k, each in enumerate(joints) if each[0] == start), len(joints) - 1)
        for name, at in data[part].items():
            if isinstance(at, str):
                number = JOINT[side + at]
                axes = _axes(data.get("axes", {}), part, at, offsets[_end(number)], side == "right_")
                joints.append((name.replace("*", mark), parent, number, rest[number], axes, posed[number] @ axes))
            else:
                following = list(data[part].values())[list(data[part]).index(name) :]
                end = rest[JOINT[side + next(place for place in following if isinstance(place, str))]]
                place = joints[parent][3] + at * (end - joints[parent][3])
                joints.append((name.replace("*", mark), parent, -1, place, *joints[parent][4:]))
            parent = len(joints) - 1

    add("trunk", data.get("root"))
    for side, mark in zip(("left_", "right_"), data["sides"], strict=True):
        add("leg", next(iter(data["trunk"])), side, mark)
        add("arm", data["chest"], side, mark)
    names, parents, sources, places, neutral, turns = zip(*joints, strict=True)
    return Rig(
        *(tuple(data.get("prefix", "") + name for name in names), parents, np.stack(places), np.stack(turns)),
        *(sources, np.stack(neutral), (data["order"],) * len(joints)),
        unit=data.get("unit", CENTIMETER),
        moving=data.get("moving", False),
    )


def _end(joint: int) -> int:
    """Returns the joint at the end of a joint's bone; the last joint of a limb continues the bone before it."""
    return SMPL22.parents.index(joint) if joint in SMPL22.parents else joint


def _axes(axes: dict[str, Any], part: str, joint: str, bone: np.ndarray, right: bool) -> np.ndarray:
    """Returns the local axes (3, 3) in a T-pose of a joint whose bone has the direction `bone`."""
    flip = np.array([-1, 1, 1]) if right else np.ones(3)
    made, columns = np.eye(3), []
    for axis, direction in axes.get(joint, axes.get(part, {})).items():  # two of them, of the left side
        toward = np.array(DIRECTIONS[direction], float) if direction in DIRECTIONS else bone * flip
        for column in columns:
            toward = toward - made[:, column] * (made[:, column] @ toward)
        columns.append("xyz".index(axis[-1]))
        made[:, columns[-1]] = toward / np.linalg.norm(toward) * (-1 if axis.startswith("-") else 1)
    if columns:
        third = 3 - sum(columns)
        made[:, third] = np.cross(made[:, (third + 1) % 3], made[:, (third + 2) % 3])
        if right:
            made = made * flip[:, None] * (-1 if axes.get("opposed") else 1)
            made[:, third] *= 1 if axes.get("opposed") else -1
    return made


def retarget(poses: Poses, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Moves a skeleton with the bone lengths of a body as this body moves.

    Returns:
        Rotations (F, J, 3, 3) relative to parents, or of roots in the world; positions (F, 3) of the hips in the world.
    """
    return rig.local(rig.turned(world_rotations(poses.rotations.numpy()))), poses.root.numpy()


def world_rotations(rotations: np.ndarray) -> np.ndarray:
    """Returns rotations (..., 22, 3, 3) in the world from those relative to parents."""
    world = rotations.copy()
    for parent, joint in SMPL22.edges:
        world[..., joint, :, :] = world[..., parent, :, :] @ rotations[..., joint, :, :]
    return world


def continuous_euler(matrices: Tensor, orders: Sequence[str] = SMPL_ORDERS) -> Tensor:
    """Converts rotations (F, J, 3, 3) to Euler angles (F, J, 3) in the joints' `orders`, radians, without jumps.

    A rotation has two triples of angles, and full turns may be added to each angle. The angles nearest to the previous
    frame are used, so that programs can interpolate; two full turns of the body end at 720 degrees.
    """
    turn = 2 * torch.pi
    first = torch.stack([rotation.matrix_to_euler(matrices[:, j], order) for j, order in enumerate(orders)], 1)
    second = torch.stack([first[..., 0] + torch.pi, torch.pi - first[..., 1], first[..., 2] + torch.pi], -1)
    chosen = [first[0]]
    for pair in torch.stack([first, second], -2)[1:]:
        before = chosen[-1][:, None]
        near = pair - turn * ((pair - before) / turn).round()
        best = (near - before).square().sum(-1).argmin(-1)
        chosen.append(near[torch.arange(len(near)), best])
    return torch.stack(chosen)
