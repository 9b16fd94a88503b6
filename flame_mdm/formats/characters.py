"""Motions for a user's character: a skinned .glb file or the skeleton of a .bvh file.

A character may differ from SMPL's body in proportions, units, axes, names and rest pose. The rest
pose must be upright with flat feet.

The arms and legs point in the directions of the motion's bones. The rotations of the trunk, the
head, the hands and the feet relative to the rest pose are the same as in the motion. The path of
the hips is scaled in proportion to the leg length. The toe positions of the motion are also scaled,
and adjusted to the height of the character's toes. Then the legs are bent so that the character's
toes reach these positions.
"""

import copy
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats import bvh, glb
from flame_mdm.formats.body import PosedFigure, fit_body, local_rotations
from flame_mdm.formats.layouts import LAYOUTS, opposite
from flame_mdm.formats.names import spelled
from flame_mdm.formats.posture import world_rotations
from flame_mdm.formats.retarget import continuous_euler
from flame_mdm.formats.rig import RestPose, Rig, follow, matched, recognized, rest_pose
from flame_mdm.representations.skeleton import JOINT, SMPL22
from flame_mdm.safe_io import read_yaml


@dataclass(frozen=True, eq=False)
class Character(RestPose):
    """A character with a skin, read from a .glb file."""

    file: glb.Glb


@dataclass(frozen=True, eq=False)
class BvhCharacter(RestPose):
    """A character without meshes, read from a .bvh file."""

    file: bvh.Bvh


def read(path: str | Path) -> Character | BvhCharacter:
    """Reads a character.

    The joint names must match a known skeleton, or be listed in a `.yaml` file that has the same
    name as the character's file.

    Raises:
        UserError: If the file is damaged, if a .glb file contains no skin, or if the file contains
            no usable rest pose.
        UnknownJoints: If joints cannot be identified.
    """
    path = Path(path)
    return _read_bvh(path) if path.suffix.lower() == ".bvh" else read_skinned(path)


def _read_bvh(path: Path) -> BvhCharacter:
    """Reads the skeleton of a BVH file.

    The rest pose is the pose without rotations or, if this pose is not usable, the first frame.
    """
    file = bvh.read(path)
    joints = identify(
        path, {number: file.joints[number] for number, names in enumerate(file.channels) if names}
    )
    for joint, number in joints.items():
        if len(turning := _order(file.channels[number])) < 3:
            name = f"{file.joints[number]} ({joint})"
            raise UserError(f"{path}: {name} has {len(turning)} rotation channels instead of three")
    if not any(_moves(names) for names in _above(file, joints["pelvis"]).values()):
        name = file.joints[joints["pelvis"]]
        raise UserError(
            f"{path}: {name} and the joints above it have no position channels. Add position "
            "channels to the root"
        )

    still = np.tile(np.eye(3), (1, len(file.joints), 1, 1))
    first = replace(file, frames=file.frames[:1])
    poses = ((still, file.offsets[None]), (first.rotations(), first.translations()))
    problem: UserError | None = None
    for rotations, translations in poses:
        (positions,), (turned,) = bvh.forward_kinematics(file.parents, rotations, translations)
        up = _vertical(positions, joints)
        try:
            pose = rest_pose(
                path, file.joints, file.parents, positions, turned, joints, positions, up
            )
            return BvhCharacter(pose.rig, pose.map, pose.floor, file)
        except UserError as error:  # in many files, only the first frame is upright
            problem = problem or error
    raise problem or AssertionError


def _order(channels: Sequence[str]) -> str:
    """Returns the axes of a joint's rotation channels, such as ZXY."""
    return "".join(name[0] for name in channels if name.endswith("rotation"))


def _moves(channels: Sequence[str]) -> bool:
    return sum(name.endswith("position") for name in channels) == 3


def _above(file: bvh.Bvh, joint: int) -> dict[int, Sequence[str]]:
    """Returns the channels of a joint and its ancestors, from the joint to the root."""
    channels: dict[int, Sequence[str]] = {}
    while joint >= 0:
        channels[joint] = file.channels[joint]
        joint = file.parents[joint]
    return channels


def _vertical(positions: np.ndarray, joints: Mapping[str, int]) -> tuple[int, int, int]:
    """Returns the direction, along y or z, in which the trunk points in a pose (J, 3)."""
    shoulders = positions[[joints["left_shoulder"], joints["right_shoulder"]]].mean(0)
    hips = positions[[joints["left_hip"], joints["right_hip"]]].mean(0)
    axes = ((0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
    return max(axes, key=lambda axis: float((shoulders - hips) @ np.array(axis)))


def read_skinned(path: Path) -> Character:
    """Reads a character in a .glb file. Raises the same errors as `read`."""
    file = glb.read(path)
    skeletons: list[set[int]] = []
    for skin in file.skins:
        shared = [skeleton for skeleton in skeletons if skeleton & set(skin.joints)]
        skeletons = [skeleton for skeleton in skeletons if skeleton not in shared] + [
            set(skin.joints).union(*shared)
        ]
    if len(skeletons) != 1:
        raise UserError(
            f"{path}: expected one skeleton with a skin, but found {len(skeletons)}. Export "
            f"one mesh with its armature"
        )
    joints = identify(path, {joint: file.names[joint] for joint in sorted(skeletons[0])})
    worlds, corners = _rest(file, joints["pelvis"])
    if not (np.abs(worlds) <= glb.LARGEST).all() or not (np.abs(corners) <= glb.LARGEST).all():
        raise UserError(
            f"{path}: the rest pose contains numbers that are not finite or too large. Export the character again"
        )
    scales = np.cbrt(np.linalg.det(worlds[:, :3, :3]))
    for joint, number in joints.items():
        sizes = np.linalg.svd(worlds[number, :3, :3], compute_uv=False)
        if scales[number] <= 0 or sizes[0] > 1.01 * sizes[2]:
            name = f"{file.names[number]} ({joint})"
            raise UserError(
                f"{path}: {name} is mirrored or scaled unevenly. Apply the scale of the armature"
            )
    turned = worlds[:, :3, :3] / np.where(scales == 0, 1, scales)[:, None, None]
    pose = rest_pose(
        path, file.names, file.parents, worlds[:, :3, 3], turned, joints, corners, (0, 1, 0)
    )
    return Character(replace(pose.rig, scales=scales), pose.map, pose.floor, file)


def _rest(file: glb.Glb, pelvis: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the bind pose of the skin and the corners of a box around the meshes.

    The pose consists of one matrix per node, with shape (N, 4, 4). If the nodes are stored in a
    different pose, the orientation of the skin's coordinates is derived from the pelvis, which is
    nearly upright.
    """
    # If the file is stored in the bind pose, the product of joint matrix and inverse bind matrix is
    # the same for all joints. Otherwise, this product for the pelvis, with its rotation rounded to
    # quarter turns, is used as the frame of the skin. The bind matrices then determine the pose of
    # all joints.
    worlds, corners = file.worlds.copy(), []
    rest: dict[int, np.ndarray] = {}
    for skin in sorted(file.skins, key=lambda skin: (pelvis in skin.joints, len(skin.joints))):
        if not len(skin.binds):
            corners.append(worlds[skin.joints, :3, 3])
            continue
        moves = worlds[skin.joints] @ skin.binds
        move = moves[skin.joints.index(pelvis) if pelvis in skin.joints else 0].copy()
        if not np.allclose(moves, move, atol=1e-3 * np.abs(move).max()):
            scale = np.cbrt(np.linalg.det(move[:3, :3]))
            turn = np.round(move[:3, :3] / scale) if scale else np.zeros((3, 3))
            if np.isclose(np.linalg.det(turn), 1):
                move[:3, :3] = scale * turn
            rest |= dict(zip(skin.joints, move @ np.linalg.inv(skin.binds), strict=True))
        corners.append(skin.corners @ move[:3, :3].T + move[:3, 3])
    if rest:
        for joint, parent in enumerate(file.parents):
            above = worlds[parent] @ file.locals[joint] if parent >= 0 else worlds[joint]
            worlds[joint] = rest.get(joint, above)
    points = np.concatenate(corners)
    return worlds, points if len(points) else worlds[:, :3, 3]


def moved(character: RestPose, motion: PosedFigure) -> tuple[np.ndarray, np.ndarray, Rig]:
    """Applies a motion to a character; see `follow`."""
    body = fit_body(motion)
    joints = motion.joints[:, : len(SMPL22)]
    world = world_rotations(local_rotations(body)) @ body.neutral
    return follow(character, joints, motion.posed().offsets.numpy(), body.neutral, world)


class UnknownJoints(UserError):
    """Error raised when joints cannot be identified.

    `template` contains the lines of a file with joint names, which the user can complete.
    """

    def __init__(self, message: str, template: list[str]):
        super().__init__(message)
        self.template = template


def identify(path: Path, names: Mapping[int, str]) -> dict[str, int]:
    """Returns the index of the character's joint for each SMPL joint.

    `names` maps the indices of the character's joints to their names.

    Raises:
        UnknownJoints: If a joint cannot be identified.
    """
    listed = path.with_suffix(".yaml")
    chosen = read_yaml(listed) if listed.exists() else None
    candidates = (
        _listed(path, listed, chosen, names) if chosen else recognized(names, known_skeletons())
    )
    numbers, missing = matched(path, names, candidates)
    if twice := next(
        (joint for joint, number in numbers.items() if list(numbers.values()).count(number) > 1),
        None,
    ):
        raise UserError(
            f"{listed}: {names[numbers[twice]]} is listed for {twice} and for another joint. Remove one"
        )
    if missing:
        listed_names = {joint: f" {json.dumps(names[number])}" for joint, number in numbers.items()}
        template = [f"# Joints of {path.name}: {', '.join(names.values())}"]
        template += [f"{joint}:{listed_names.get(joint, '')}" for joint in JOINT]
        raise UnknownJoints(
            f"{path}: no joint found for {', '.join(missing)}. Add the joint names to {listed}, as in the "
            "lines above; only spine, neck, head, collars and feet may remain empty",
            template,
        )
    return numbers


def _listed(
    path: Path, listed: Path, chosen: object, names: Mapping[int, str]
) -> dict[str, list[int]]:
    if not isinstance(chosen, dict):
        raise UserError(
            f"{listed}: this is not a list of names. Write one name per line, such as `left_knee: "
            "Calf L`"
        )
    candidates = {}
    for joint, name in chosen.items():
        if joint not in JOINT:
            raise UserError(
                f"{listed}: {joint} is not an SMPL joint.{did_you_mean(str(joint), JOINT)}"
            )
        if name is not None:
            candidates[joint] = [number for number, label in names.items() if label == name]
            if not candidates[joint]:
                similar = did_you_mean(str(name), names.values())
                raise UserError(f"{listed}: {joint}: {path} has no joint {name}.{similar}")
    return candidates


@cache
def known_skeletons() -> list[dict[str, str]]:
    """Returns a mapping from bone names to SMPL joints for each supported skeleton."""
    skeletons = []
    for layout in LAYOUTS.values():
        joints = {name: joint for joint, name in layout.bones.items()}
        others = {name: layout.bones[opposite(joint)] for name, joint in joints.items()}
        skeletons.append({spelling: joints[name] for spelling, name in spelled(others).items()})
    return skeletons


def write(path: Path, character: Character, motion: PosedFigure, name: str) -> str:
    """Writes the motion to a copy of the character's file and returns a summary line.

    The motion becomes the first animation in the file.
    """
    if path.suffix.lower() != ".glb":
        raise UserError(
            f"{path}: a .glb character can only be saved as a .glb, .fbx, .usda, .usdc or .usdz "
            "file"
        )
    file, (world, positions, rig) = character.file, moved(character, motion)
    document, hips = copy.deepcopy(file.document), rig.hips
    binary = glb.Binary(file.data, document["bufferViews"], document["accessors"])
    local, offsets, rest = rig.local(world), rig.offsets(), rig.rest()
    skinned = {joint for skin in file.skins for joint in skin.joints}
    curves = []
    for joint, source in enumerate(rig.sources):
        if source >= 0 or joint in skinned:
            turns = glb.quaternions(np.concatenate([rest[None, joint], local[:, joint]]))
            # An animated node must have a translation, rotation and scale instead of a matrix. The
            # node takes the rest pose, even if the file was stored in a different pose.
            size = float(
                rig.scales[joint]
                / (rig.scales[rig.parents[joint]] if rig.parents[joint] >= 0 else 1)
            )
            node = document["nodes"][file.nodes[joint]]
            node.pop("matrix", None)
            node |= {
                "translation": offsets[joint].tolist(),
                "rotation": turns[0].tolist(),
                "scale": [size] * 3,
            }
            if source >= 0:
                curves.append(("rotation", file.nodes[joint], turns[1:]))
    curves.append(
        ("translation", file.nodes[hips], rig.within(positions[:, hips], hips).astype("f4"))
    )
    # Programs show the first animation.
    document["animations"] = [
        binary.animation(name, motion.fps, curves),
        *document.get("animations", []),
    ]
    binary.save(path, document)
    return _following(rig, len(rig.joints))


def write_bvh(path: Path, character: BvhCharacter, motion: PosedFigure) -> str:
    """Writes the motion to a copy of the character's file and returns a summary line."""
    if path.suffix.lower() != ".bvh":
        raise UserError(
            f"{path}: a .bvh character has no meshes, so it can only be saved as a .bvh file"
        )
    file, (world, positions, rig) = character.file, moved(character, motion)
    local, offsets, hips = rig.local(world), rig.offsets(), rig.hips
    # The joint that moves the body is the hips joint, or a root above it.
    mover = next(joint for joint, names in _above(file, hips).items() if _moves(names))
    carried = rig.within(rig.positions[mover] + positions[:, hips] - rig.positions[hips], mover)

    frames = np.zeros((len(world), file.frames.shape[1]))
    for joint, (names, columns) in enumerate(zip(file.channels, file.columns(), strict=True)):
        position = carried if joint == mover else np.tile(offsets[joint], (len(world), 1))
        values = {f"{axis}position": position[:, number] for number, axis in enumerate("XYZ")}
        if len(order := _order(names)) == 3:
            angles = continuous_euler(torch.from_numpy(local[:, [joint]]), (order,))[:, 0].numpy()
            values |= {
                f"{axis}rotation": np.degrees(angles[:, number])
                for number, axis in enumerate(order)
            }
        for number, name in enumerate(names):
            if name in values:
                frames[:, columns.start + number] = np.round(values[name], 6)
    bvh.write(replace(file, frames=frames, fps=motion.fps), path)
    return _following(rig, sum(map(bool, file.channels)))


def _following(rig: Rig, joints: int) -> str:
    """Describes how many of a character's `joints` follow the motion."""
    follow = sum(source >= 0 for source in rig.sources)
    return f"{follow} of {joints} joints follow the motion, {joints - follow} keep their angle"
