"""Motions on a user's own character: the skeleton of a .bvh file, or of the skin of a .glb file.

The character may have other proportions, units, axes, names and another rest pose than SMPL's body. Bones of arms and
legs take the directions of those of the motion. Trunk, head, hands and feet are turned as in the motion, starting from
the character's rest pose, which must be upright with flat feet. The path of the hips is scaled by the length of the
legs. Then both legs are bent: the toes reach the scaled positions of the motion's toes, at the height above the floor
that they have in the rest pose.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from flame_mdm.errors import UserError
from flame_mdm.formats import bvh, glb
from flame_mdm.formats.joint_names import identify
from flame_mdm.formats.retarget import JOINT, Rig, continuous_euler
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.visualize.body import fit_body, orthonormal, world_rotations
from flame_mdm.visualize.scene import Shown

SIDES = ("left", "right")
LEGS = (("hip", "knee"), ("knee", "ankle"))
LIMBS = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}
"""Joints whose bone takes the direction of the motion's bone -> the joint at the end of this bone."""
SPINE = ("spine1", "spine2", "spine3")
TILT = 45
"""Degrees between trunk and vertical at which a rest pose is refused."""
SNAP = 8
"""Largest angle in degrees between the facing direction and an axis at which the character is assumed to face along
the axis."""
BEND = 0.15
"""Minimum sine of the bend of an elbow or knee in the rest pose from which the twist of the limb is read."""
GROUND = 0.1
"""Largest height in meters at which the lowest joint of a clip counts as on the floor: in recordings it is often a
little above."""
STRAIGHT = 0.05
"""Distance of the knee from the straight line of the leg, relative to the thigh, at which the bend and the front of the
thigh have the same weight for where the knee points."""
REACH = 0.999
"""Maximum distance from hip to ankle relative to the length of the straight leg."""


@dataclass(frozen=True, eq=False)
class Character:
    """A skeleton in its rest pose, y up, facing +z, in the unit of its file, and the file.

    Attributes:
        rig: the skeleton; its neutral rotations are those of `fitted`, which depend on the motion.
        map: SMPL's joint -> index of the character's.
        floor: height of the lowest point in the rest pose.
        file: the BVH or GLB file.
    """

    rig: Rig
    map: Mapping[str, int]
    floor: float
    file: bvh.Bvh | glb.Glb

    def position(self, joint: str) -> np.ndarray:
        """Returns the position (3,) of SMPL's joint in the rest pose."""
        return self.rig.positions[self.map[joint]]


def read(path: str | Path) -> Character:
    """Reads a character. Names of joints are those of a known skeleton, or are in a `.yaml` file of the same name.

    Raises:
        FileNotFoundError: If the file does not exist.
        UserError: If the file is damaged or has no skin, its joints are not known (`UnknownJoints`), or its rest pose
            cannot be used.
    """
    path = Path(path)
    if path.suffix.lower() == ".glb":
        return _read_glb(path)
    if path.suffix.lower() != ".bvh":
        raise UserError(f"character={path}: not a character. Use a .bvh or .glb file")
    file = bvh.read(path)
    joints = identify(path, dict(enumerate(file.joints)))
    identity = np.tile(np.eye(3), (1, len(file.joints), 1, 1))
    problem = None
    for turns, offsets in ((identity, file.offsets[None]), (file.rotations()[:1], file.translations()[:1])):
        positions, turned = (values[0] for values in bvh.forward_kinematics(file.parents, turns, offsets))
        ends = [positions[p] + turned[p] @ end for p, end in zip(file.end_parents, file.end_offsets, strict=True)]
        try:
            return _character(path, file, file.joints, file.parents, positions, turned, joints, [*positions, *ends])
        except UserError as error:  # many files have no rest pose, but begin with one
            problem = problem or error
    raise problem or AssertionError


def _read_glb(path: Path) -> Character:
    file = glb.read(path)
    skeletons: list[set[int]] = []
    for skin in file.skins:
        shared = [skeleton for skeleton in skeletons if skeleton & set(skin.joints)]
        skeletons = [skeleton for skeleton in skeletons if skeleton not in shared] + [set(skin.joints).union(*shared)]
    if len(skeletons) != 1:
        raise UserError(
            f"{path}: {len(skeletons)} skeletons with a skin. A character has one: export one mesh with its armature"
        )
    joints = identify(path, {joint: file.names[joint] for joint in sorted(skeletons[0])})
    worlds, corners = _rest(file, joints["pelvis"])
    if not (np.abs(worlds) <= glb.LARGEST).all() or not (np.abs(corners) <= glb.LARGEST).all():
        raise UserError(f"{path}: the rest pose is not finite, or too large. Export the character again")
    scales = np.cbrt(np.linalg.det(worlds[:, :3, :3]))
    for joint, number in joints.items():
        sizes = np.linalg.svd(worlds[number, :3, :3], compute_uv=False)
        if scales[number] <= 0 or sizes[0] > 1.01 * sizes[2]:
            raise UserError(
                f"{path}: {file.names[number]} ({joint}) is mirrored or scaled unevenly in the rest pose. Apply the "
                "scale of the armature and export it again"
            )
    turned = worlds[:, :3, :3] / np.where(scales == 0, 1, scales)[:, None, None]
    character = _character(path, file, file.names, file.parents, worlds[:, :3, 3], turned, joints, corners)
    return replace(character, rig=replace(character.rig, scales=scales))


def _rest(file: glb.Glb, pelvis: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the matrices (N, 4, 4) of nodes in the pose in which the skin was bound, and corners around its meshes.

    Nodes may be stored in another pose. Then the skin's own frame is turned into the world by the multiple of 90
    degrees that the pelvis, which is nearly upright, shows.
    """
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


def _character(
    path: Path,
    file: bvh.Bvh | glb.Glb,
    names: Sequence[str],
    parents: Sequence[int],
    positions: np.ndarray,
    turned: np.ndarray,
    joints: dict[str, int],
    lowest: Sequence[np.ndarray] | np.ndarray,
) -> Character:
    """Returns a character, turned to y up and +z ahead, of the rest pose in the world of its file.

    Raises:
        UserError: If the rest pose is not upright, a limb has no length, or left and right are exchanged.
    """
    at = {joint: positions[number] for joint, number in joints.items()}

    def middle(name: str) -> np.ndarray:
        return (at[f"left_{name}"] + at[f"right_{name}"]) / 2

    trunk, legs = middle("shoulder") - middle("hip"), middle("hip") - middle("ankle")
    _, y, z = np.eye(3)
    up = y if isinstance(file, glb.Glb) else max((y, -y, z, -z), key=lambda axis: trunk @ axis)
    shortest = max(1e-4 * float(np.linalg.norm(legs)), 1e-9)
    for side in SIDES:
        for start, end in LIMBS.items():
            if np.linalg.norm(at[f"{side}_{start}"] - at[f"{side}_{end}"]) <= shortest:
                raise UserError(f"{path}: the bone from {side}_{start} to {side}_{end} has no length")
    tilt = max(np.degrees(np.arccos(np.clip(v @ up / max(np.linalg.norm(v), 1e-9), -1, 1))) for v in (trunk, legs))
    if not tilt <= TILT:
        raise UserError(
            f"{path}: the rest pose is not upright, it leans by {tilt:.0f} degrees. Export the character in a T-pose "
            "or A-pose" + (", or begin the file with one" if isinstance(file, bvh.Bvh) else "")
        )
    left = at["left_hip"] + at["left_shoulder"] - at["right_hip"] - at["right_shoulder"]
    left = left - up * (up @ left)
    if np.linalg.norm(left) <= shortest:
        raise UserError(f"{path}: left and right joints of the rest pose are at the same points")
    left = left / np.linalg.norm(left)
    nearest = np.eye(3)[np.abs(left).argmax()] * np.sign(left[np.abs(left).argmax()])
    left = nearest if nearest @ left > np.cos(np.radians(SNAP)) else left
    frame = np.stack([left, up, np.cross(left, up)])
    feet = [at[f"{side}_foot"] - at[f"{side}_ankle"] for side in SIDES if f"{side}_foot" in at]
    if feet and frame[2] @ np.sum(feet, 0) < 0:
        raise UserError(f"{path}: the toes point backward. Are left and right exchanged, or is the character mirrored?")
    sources = dict(joints)
    spine = [joint for joint in SPINE if joint in sources]
    if spine:  # the arms start at the last joint of the spine, which moves as the chest
        sources["spine3"] = sources.pop(spine[-1])
    of = {number: JOINT[joint] for joint, number in sources.items()}
    rig = Rig(
        joints=tuple(names),
        parents=tuple(parents),
        positions=positions @ frame.T,
        turns=frame @ turned,
        sources=tuple(of.get(number, -1) for number in range(len(names))),
        neutral=np.tile(np.eye(3), (len(names), 1, 1)),
        orders=("",) * len(names),
        frame=frame,
    )
    return Character(rig, joints, float(np.min(np.asarray(lowest) @ frame[1])), file)


# Moving a character ---------------------------------------------------------------------------------------------------


def fitted(character: Character, offsets: np.ndarray) -> Rig:
    """Returns the skeleton with its neutral rotations: limbs have the directions of a body's in its rest pose.

    Args:
        character: the character.
        offsets: (22, 3), position of each joint of the body relative to its parent in the rest pose.
    """
    rig, turns = character.rig, np.tile(np.eye(3), (len(SMPL22), 1, 1))
    for side in SIDES:
        for (start, middle, end), bend in ((("hip", "knee", "ankle"), -1), (("shoulder", "elbow", "wrist"), 1)):
            first, second, third = (character.position(f"{side}_{name}") for name in (start, middle, end))
            ours = [offsets[JOINT[f"{side}_{name}"]] for name in (middle, end)]
            theirs = [second - first, third - second]
            hinge, usual = np.cross(ours[0], [0, 0, bend]), np.cross(theirs[0], [0, 0, bend])
            shown = np.cross(theirs[0], theirs[1]) / (np.linalg.norm(theirs[0]) * np.linalg.norm(theirs[1]))
            clear = np.linalg.norm(shown) > BEND and shown @ usual > 0
            for name, bone, their_bone in zip((start, middle), ours, theirs, strict=True):
                turn = orthonormal(bone, hinge).T @ orthonormal(their_bone, shown if clear else usual)
                turns[JOINT[f"{side}_{name}"]] = turn
        turns[JOINT[f"{side}_wrist"]] = turns[JOINT[f"{side}_elbow"]]
    neutral = np.stack([turns[max(source, 0)] @ turn for source, turn in zip(rig.sources, rig.turns, strict=True)])
    return replace(rig, neutral=neutral)


def moved(character: Character, motion: Shown) -> tuple[np.ndarray, np.ndarray, Rig]:
    """Moves a character as in a motion.

    Returns:
        Rotations (F, J, 3, 3) and positions (F, J, 3) of its joints in the world, and its skeleton for this motion.

    Raises:
        UserError: If the skeleton of the motion is not SMPL's, or a limb is much longer or shorter than people's.
    """
    poses, body = motion.posed(), fit_body(motion)
    offsets = poses.offsets.numpy()
    rig = fitted(character, offsets)
    neutral = body.neutral.copy()
    neutral[JOINT["neck"]] = neutral[JOINT["head"]]
    turned = world_rotations(body.local()) @ neutral
    joints = motion.joints[:, : len(SMPL22)].astype(float)
    lowest = joints[..., 1].min()
    joints[..., 1] -= lowest if abs(lowest) <= GROUND else 0
    size = _leg([offsets[JOINT[f"{s}_{name}"]] for s in SIDES for name in ("knee", "ankle")])
    own = [character.position(f"{s}_{b}") - character.position(f"{s}_{a}") for s in SIDES for a, b in LEGS]
    scale = _leg(own) / size
    # heights of the ankles above the floor while the feet are flat
    flat = {s: (neutral[JOINT[f"{s}_ankle"]].T @ offsets[JOINT[f"{s}_foot"]])[1] for s in SIDES}
    higher = {s: character.position(f"{s}_ankle")[1] - character.floor + scale * flat[s] for s in SIDES}

    hips = scale * joints[:, [JOINT["left_hip"], JOINT["right_hip"]]].mean(1)
    hips[:, 1] += np.mean(list(higher.values()))
    world = rig.turned(turned)
    positions = rig.assembled(world, np.zeros_like(hips))
    pelvis = hips - positions[:, [character.map[f"{s}_hip"] for s in SIDES]].mean(1)
    positions = rig.assembled(world, pelvis)
    for side in SIDES:
        hip, knee, ankle = (character.map[f"{side}_{name}"] for name in ("hip", "knee", "ankle"))
        target = scale * joints[:, JOINT[f"{side}_ankle"]] + [0, higher[side], 0]
        if f"{side}_foot" in character.map:
            toe = character.map[f"{side}_foot"]
            target = scale * joints[:, JOINT[f"{side}_foot"]] - (positions[:, toe] - positions[:, ankle])
            target[:, 1] += rig.positions[toe, 1] - character.floor
        forward = turned[:, JOINT[f"{side}_hip"], :, 2]
        bent = _bent(positions[:, hip], positions[:, knee], positions[:, ankle], target, forward)
        for name, bone, start, end in (
            ("hip", bent - positions[:, hip], hip, knee),
            ("knee", target - bent, knee, ankle),
        ):
            number = JOINT[f"{side}_{name}"]
            turned[:, number] = _turns(positions[:, end] - positions[:, start], bone) @ turned[:, number]
    world = rig.turned(turned)
    return world, rig.assembled(world, pelvis), rig


def _leg(bones: Sequence[np.ndarray]) -> float:
    return float(np.sum([np.linalg.norm(bone) for bone in bones])) / 2


def _bent(hip: np.ndarray, knee: np.ndarray, ankle: np.ndarray, target: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Returns where a knee (F, 3) is if the ankle is at `target`, or as near as the leg reaches; it bends as before."""
    thigh, shin = np.linalg.norm(knee - hip, axis=1), np.linalg.norm(ankle - knee, axis=1)
    line = target - hip
    length = np.maximum(np.linalg.norm(line, axis=1), 1e-9)
    line = line / length[:, None]
    length = np.clip(length, np.abs(thigh - shin) / REACH, REACH * (thigh + shin))
    along = (thigh**2 - shin**2 + length**2) / (2 * length)
    before = ankle - hip
    out = (knee - hip) - before * ((knee - hip) * before).sum(1, keepdims=True) / (before**2).sum(1, keepdims=True)
    # a straight leg does not show where its knee points
    out = out + STRAIGHT * thigh[:, None] * forward
    out = out - line * (out * line).sum(1, keepdims=True)
    out = out / np.linalg.norm(out, axis=1, keepdims=True)
    return hip + along[:, None] * line + np.sqrt(np.maximum(thigh**2 - along**2, 0))[:, None] * out


def _turns(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Returns the shortest rotations (F, 3, 3) between directions (F, 3)."""
    turns = rotation.between(torch.from_numpy(start), torch.from_numpy(end))
    return rotation.quaternion_to_matrix(turns).numpy()


# Writing --------------------------------------------------------------------------------------------------------------


def write(path: Path, character: Character, motion: Shown, name: str) -> str:
    """Writes the character's file with a motion, and returns a line that describes it.

    A .glb file keeps its content and gets a further animation, the first one; a .bvh file gets other frames.

    Raises:
        UserError: If the file cannot be written, a joint of a .bvh file cannot turn, or `moved` raises it.
    """
    ending = ".bvh" if isinstance(character.file, bvh.Bvh) else ".glb"
    if path.suffix.lower() != ending:
        raise UserError(f"{path}: this character is a {ending} file, so name a {ending} file for the result")
    world, positions, rig = moved(character, motion)
    if isinstance(character.file, bvh.Bvh):
        _write_bvh(path, character.file, rig, world, positions, motion.fps)
    else:
        _write_glb(path, character.file, rig, world, positions, motion.fps, name)
    follow = sum(source >= 0 for source in rig.sources)
    return f"{follow} of {len(rig.joints)} joints follow the motion, {len(rig.joints) - follow} keep their angle"


def _write_bvh(path: Path, file: bvh.Bvh, rig: Rig, world: np.ndarray, positions: np.ndarray, fps: float) -> None:
    local, offsets, frames = rig.local(world), rig.offsets(), np.zeros((len(world), file.frames.shape[1]))
    mover = hips = rig.hips
    while rig.parents[mover] >= 0 and not any(name.endswith("position") for name in file.channels[mover]):
        mover = rig.parents[mover]
    moves = positions[:, hips] - rig.positions[hips]
    for joint, (names, column) in enumerate(zip(file.channels, file.columns(), strict=True)):
        order = "".join(name[0] for name in names if name.endswith("rotation"))
        if len(order) < 3 and rig.sources[joint] >= 0:
            raise UserError(
                f"{path}: {rig.joints[joint]} has {len(order)} rotation channels in the character's file, not 3"
            )
        position = np.tile(offsets[joint], (len(world), 1))
        if joint == mover:
            position = rig.within(rig.positions[joint] + moves, joint)
        values = {f"{axis}position": position[:, k] for k, axis in enumerate("XYZ")}
        if len(order) == 3:
            angles = continuous_euler(torch.from_numpy(local[:, [joint]]), (order,))[:, 0].numpy()
            values |= {f"{axis}rotation": np.degrees(angles[:, k]) for k, axis in enumerate(order)}
        for k, name in enumerate(names):
            frames[:, column.start + k] = np.round(values.get(name, np.zeros(len(world))), 6)
    bvh.write(replace(file, frames=frames, fps=fps), path)


def _write_glb(
    path: Path, file: glb.Glb, rig: Rig, world: np.ndarray, positions: np.ndarray, fps: float, name: str
) -> None:
    document, hips = copy.deepcopy(file.document), rig.hips
    binary = glb.Binary(file.data, document["bufferViews"], document["accessors"])
    local, offsets, rest = rig.local(world), rig.offsets(), rig.rest()
    skinned = {joint for skin in file.skins for joint in skin.joints}
    curves = []
    for joint, source in enumerate(rig.sources):
        if source >= 0 or joint in skinned:
            turns = glb.quaternions(np.concatenate([rest[None, joint], local[:, joint]]))
            # the rest pose, also where the file has another pose, and in the form that animations need
            size = float(rig.scales[joint] / (rig.scales[rig.parents[joint]] if rig.parents[joint] >= 0 else 1))
            node = document["nodes"][file.nodes[joint]]
            node.pop("matrix", None)
            node |= {"translation": offsets[joint].tolist(), "rotation": turns[0].tolist(), "scale": [size] * 3}
            if source >= 0:
                curves.append(("rotation", file.nodes[joint], turns[1:]))
    curves.append(("translation", file.nodes[hips], rig.within(positions[:, hips], hips).astype("f4")))
    # programs show the first animation
    document["animations"] = [binary.animation(name, fps, curves), *document.get("animations", [])]
    binary.save(path, document)
