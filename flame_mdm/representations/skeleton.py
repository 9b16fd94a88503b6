"""Skeleton definitions and forward kinematics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from flame_mdm.errors import UserError, did_you_mean

if TYPE_CHECKING:  # Blender has no torch
    from torch import Tensor

LEG, ARM = (
    ("hip", "knee", "ankle", "foot", "toes"),
    ("collar", "shoulder", "elbow", "wrist", "hand"),
)


@dataclass(frozen=True)
class Skeleton:
    """A tree of joints. Parents precede their children, and joint 0 is the root."""

    # Key in `SKELETONS`
    name: str
    # Names in the order of the data. The prefixes `left_` and `right_` mark the sides.
    joints: tuple[str, ...]
    # Parent of each joint, or -1 for the root
    parents: tuple[int, ...]
    # Kinematic chains of HumanML3D's inverse kinematics
    chains: tuple[tuple[int, ...], ...]
    # (J, 3), unit vector in the rest direction of the bone that ends at each joint, or 0 for the
    # root. The vectors are taken from HumanML3D's `paramUtil.py`.
    raw_offsets: tuple[tuple[int, int, int], ...]
    # Indices of the right hip, left hip, right shoulder and left shoulder, which define the heading
    facing: tuple[int, int, int, int]
    # Joints that touch the ground, in the order of HumanML3D's contact features
    feet: tuple[int, ...]
    leg: tuple[int, int]  # (knee, ankle); the lengths of their bones determine the size of a body

    def __len__(self) -> int:
        return len(self.joints)

    @cached_property
    def edges(self) -> tuple[tuple[int, int], ...]:
        """The parent and the child of each bone."""
        return tuple((parent, joint) for joint, parent in enumerate(self.parents) if parent >= 0)

    @cached_property
    def chain_parents(self) -> tuple[int, ...]:
        """For each joint, the reference joint for its rotation in HumanML3D.

        The reference joint is the parent or, at the start of a chain, the root.
        """
        starts = {chain[1] for chain in self.chains}
        return tuple(0 if joint in starts else parent for joint, parent in enumerate(self.parents))

    @cached_property
    def mirrored(self) -> tuple[int, ...]:
        """For each joint, the index of the joint that replaces it in a left-right mirror image."""
        swap = {"left": "right", "right": "left"}
        sides = [name.split("_") for name in self.joints]
        return tuple(
            self.joints.index("_".join([swap.get(side, side), *rest])) for side, *rest in sides
        )

    def mirror(self, joints: Tensor) -> Tensor:
        """Returns the mirror image of joint positions (..., J, 3).

        The sign of x is flipped, and left and right joints are swapped.
        """
        return joints[..., list(self.mirrored), :] * joints.new_tensor([-1.0, 1.0, 1.0])

    def bones(self, joints: Tensor) -> Tensor:
        """Returns the vectors (..., J, 3) from parents to children. The root's vector is 0."""
        return joints - joints[..., [max(parent, 0) for parent in self.parents], :]

    def assemble(self, bones: Tensor, root: Tensor) -> Tensor:
        """Computes joint positions (..., J, 3) from the vectors `bones` and the root position."""
        paths = [[0.0] * len(self)]
        for joint, parent in enumerate(self.parents[1:], 1):
            paths.append([1.0 if bone == joint else on for bone, on in enumerate(paths[parent])])
        return bones.new_tensor(paths) @ bones + root[..., None, :]


def forward_kinematics(
    skeleton: Skeleton, rotations: Tensor, offsets: Tensor, root: Tensor
) -> Tensor:
    """Computes joint positions (..., J, 3) in the unit of `offsets`.

    The computation is differentiable.

    Args:
        skeleton: the tree of joints.
        rotations: (..., J, 3, 3), relative to the parents. As in SMPL and BVH, the rotation of a
            joint applies to the bones that begin at the joint.
        offsets: (J, 3), positions relative to the parents in the rest pose. The offset of the root
            is ignored.
        root: (..., 3), position of the root.
    """
    turned = global_rotations(rotations, skeleton.parents)
    bones = (
        turned[..., [max(parent, 0) for parent in skeleton.parents], :, :] @ offsets[..., None]
    )[..., 0]
    return skeleton.assemble(bones, root)


def global_rotations(rotations: Tensor, parents: Sequence[int]) -> Tensor:
    """Converts rotations (..., J, 3, 3) relative to the parents to world rotations.

    Each level of the tree requires one matrix product.
    """
    import torch

    level = [0]
    joints, turned = [0], [rotations[..., :1, :, :]]
    while level := [joint for joint, parent in enumerate(parents) if parent in level]:
        above = torch.cat(turned, -3)[..., [joints.index(parents[joint]) for joint in level], :, :]
        turned.append(above @ rotations[..., level, :, :])
        joints += level
    return torch.cat(turned, -3)[..., [joints.index(joint) for joint in range(len(parents))], :, :]


_X, _Y, _Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
_RIGHT, _DOWN = (-1, 0, 0), (0, -1, 0)

SMPL22 = Skeleton(
    name="smpl22",
    joints=(
        *(
            "pelvis",
            "left_hip",
            "right_hip",
            "spine1",
            "left_knee",
            "right_knee",
            "spine2",
            "left_ankle",
        ),
        *(
            "right_ankle",
            "spine3",
            "left_foot",
            "right_foot",
            "neck",
            "left_collar",
            "right_collar",
            "head",
        ),
        *(
            "left_shoulder",
            "right_shoulder",
            "left_elbow",
            "right_elbow",
            "left_wrist",
            "right_wrist",
        ),
    ),
    parents=(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19),
    chains=(
        (0, 2, 5, 8, 11),
        (0, 1, 4, 7, 10),
        (0, 3, 6, 9, 12, 15),
        (9, 14, 17, 19, 21),
        (9, 13, 16, 18, 20),
    ),
    raw_offsets=(
        *(
            (0, 0, 0),
            _X,
            _RIGHT,
            _Y,
            _DOWN,
            _DOWN,
            _Y,
            _DOWN,
            _DOWN,
            _Y,
            _Z,
            _Z,
            _Y,
            _X,
            _RIGHT,
            _Z,
        ),
        *(_DOWN, _DOWN, _DOWN, _DOWN, _DOWN, _DOWN),
    ),
    facing=(2, 1, 17, 16),
    feet=(7, 10, 8, 11),
    leg=(5, 8),
)

JOINT = {name: number for number, name in enumerate(SMPL22.joints)}
"""Index of each joint of `SMPL22`, by name."""

SMPL24 = Skeleton(
    name="smpl24",
    joints=(*SMPL22.joints, "left_hand", "right_hand"),
    parents=(*SMPL22.parents, 20, 21),
    chains=(*SMPL22.chains[:3], (*SMPL22.chains[3], 23), (*SMPL22.chains[4], 22)),
    raw_offsets=(*SMPL22.raw_offsets, _DOWN, _DOWN),
    facing=SMPL22.facing,
    feet=SMPL22.feet,
    leg=SMPL22.leg,
)

# The joints are in MMM's order: root, BP, BT, BLN, BUN, LS, LE, LW, RS, RE, RW, LH, LK, LA, LMrot, LF, RH, RK,
# RA, RMrot, RF. KIT's coordinates are mirrored: the left side of a body that faces +z is at -x.
# Therefore, the published code calls MMM's leg L the right leg. `facing` and `feet` keep the order
# of the published code, whereas the names in this table are MMM's.
KIT21 = Skeleton(
    name="kit21",
    joints=(
        *(
            "root",
            "belly",
            "thorax",
            "neck",
            "head",
            "left_shoulder",
            "left_elbow",
            "left_wrist",
            "right_shoulder",
        ),
        *(
            "right_elbow",
            "right_wrist",
            "left_hip",
            "left_knee",
            "left_ankle",
            "left_foot",
            "left_toes",
        ),
        *("right_hip", "right_knee", "right_ankle", "right_foot", "right_toes"),
    ),
    parents=(-1, 0, 1, 2, 3, 3, 5, 6, 3, 8, 9, 0, 11, 12, 13, 14, 0, 16, 17, 18, 19),
    chains=(
        (0, 11, 12, 13, 14, 15),
        (0, 16, 17, 18, 19, 20),
        (0, 1, 2, 3, 4),
        (3, 5, 6, 7),
        (3, 8, 9, 10),
    ),
    raw_offsets=(
        *((0, 0, 0), _Y, _Y, _Y, _Y, _X, _DOWN, _DOWN, _RIGHT, _DOWN, _DOWN),
        *(_X, _DOWN, _DOWN, _Z, _Z, _RIGHT, _DOWN, _DOWN, _Z, _Z),
    ),
    facing=(11, 16, 5, 8),
    feet=(19, 20, 14, 15),
    leg=(17, 18),
)

SKELETONS: dict[str, Skeleton] = {skeleton.name: skeleton for skeleton in (SMPL22, SMPL24, KIT21)}


def part_names(skeleton: Skeleton) -> dict[str, list[int]]:
    """Returns the indices of the joints in each body part.

    As in MDM, lower_body consists of the root and the legs, and upper_body includes all other
    joints.
    """
    parts: dict[str, list[int]] = {}
    for side in ("left", "right"):
        for limb, words in (("arm", ARM), ("leg", LEG)):
            names = {f"{side}_{word}" for word in words}
            parts[f"{side}_{limb}"] = [
                joint for joint, name in enumerate(skeleton.joints) if name in names
            ]
    parts["arms"] = parts["left_arm"] + parts["right_arm"]
    parts["legs"] = parts["left_leg"] + parts["right_leg"]
    parts["lower_body"] = [0, *parts["legs"]]
    parts["upper_body"] = [
        joint for joint in range(len(skeleton)) if joint not in parts["lower_body"]
    ]
    return parts


def find_joints(skeleton: Skeleton, names: str | Sequence[str]) -> list[int]:
    """Converts the names of joints and body parts to sorted joint indices.

    Raises:
        UserError: If a name is unknown. The message suggests similar names.
    """
    indices = part_names(skeleton) | {name: [index] for index, name in enumerate(skeleton.joints)}
    chosen: list[Any] = list(names) if isinstance(names, list | tuple) else [names]
    for name in chosen:
        if not isinstance(name, str) or name not in indices:
            near = did_you_mean(str(name), indices)
            raise UserError(
                f"skeleton {skeleton.name} has no joint or part '{name}'.{near} Use one "
                f"of {', '.join(indices)}"
            )
    return sorted({index for name in chosen for index in indices[name]})
