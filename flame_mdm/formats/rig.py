"""Skeletons of other programs, and moving characters.

The Blender extension also contains this file. Therefore, the file requires only numpy.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flame_mdm.errors import UserError
from flame_mdm.formats.names import best_match
from flame_mdm.formats.posture import orthonormal, shortest_turns
from flame_mdm.representations.skeleton import JOINT, SMPL22

CENTIMETER = 0.01
SIDES = ("left", "right")
LEGS = (("hip", "knee"), ("knee", "ankle"))
LIMBS = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}
"""Joints whose bones take the directions of the motion's bones, and the joints at their ends."""
SPINE = ("spine1", "spine2", "spine3")
# Maximum angle in degrees between the trunk in a rest pose and the vertical
TILT = 45
# A facing direction within this angle of an axis, in degrees, is snapped to the axis
SNAP = 8
# Minimum sine of the bend angle of an elbow or knee in the rest pose. The twist of a straighter
# limb cannot be determined. The limbs of people also bend sideways; in SMPL's body, the knees do so
# by 7 degrees and the elbows by 5 degrees. The axis of a small bend is therefore far from the axis
# of the joint.
BEND = 0.25
# Maximum height in meters of the lowest joint of a clip that stands on the floor
GROUND = 0.1
# Distance of the knee from the line of the leg, in thigh lengths, at which the bend of the knee
# and the front of the thigh have the same weight
STRAIGHT = 0.05
REACH = 0.999  # maximum distance from hip to ankle, as a fraction of the straight leg's length


@dataclass(frozen=True, eq=False)
class Rig:
    """A skeleton with J joints in its rest pose, facing +z.

    Lengths are in meters, and y is up.
    """

    # Names of the joints; parents precede their children
    joints: tuple[str, ...]
    # Index of each joint's parent, or -1 for a root
    parents: tuple[int, ...]
    # (J, 3), positions of the joints
    positions: np.ndarray
    # (J, 3, 3), world rotations of the joints
    turns: np.ndarray
    # For each joint, the index of the SMPL joint whose rotation it takes, or -1
    sources: tuple[int, ...]
    # (J, 3, 3), world rotations of these joints while SMPL is in its rest pose
    neutral: np.ndarray
    # Order of each joint's Euler angles in BVH files
    orders: tuple[str, ...]
    # Meters per unit of length in BVH files
    unit: float = CENTIMETER
    # (3, 3), rotation from the world coordinates of the file to y up, facing +z
    frame: np.ndarray = field(default_factory=lambda: np.eye(3))
    # (J,), scale of each joint: world units per unit of the joint. Empty = all scales are 1.
    scales: np.ndarray = field(default_factory=lambda: np.ones(0))

    @property
    def hips(self) -> int:
        """Index of the pelvis."""
        return self.sources.index(0)

    def offsets(self) -> np.ndarray:
        """Returns the joint positions relative to the parents, with shape (J, 3).

        A root's position is in the world coordinates of the file.
        """
        return np.stack(
            [self.within(self.positions[joint], joint) for joint in range(len(self.joints))]
        )

    def within(self, positions: np.ndarray, joint: int) -> np.ndarray:
        """Converts world positions (..., 3) to the rest-pose coordinates of a joint's parent."""
        parent = self.parents[joint]
        if parent < 0:
            return positions @ self.frame
        scale = self.scales[parent] if len(self.scales) else 1
        return (positions - self.positions[parent]) @ self.turns[parent] / scale

    def rest(self) -> np.ndarray:
        """Returns the joint rotations relative to the parents, with shape (J, 3, 3).

        A root's rotation is relative to the world coordinates of the file.
        """
        return self.local(self.turns)

    def local(self, turned: np.ndarray) -> np.ndarray:
        """Converts world rotations (..., J, 3, 3) to rotations relative to the parents.

        The resulting rotation of a root is relative to the world coordinates of the file.
        """
        local = turned.copy()
        for joint, parent in enumerate(self.parents):
            above = turned[..., parent, :, :] if parent >= 0 else self.frame
            local[..., joint, :, :] = np.swapaxes(above, -1, -2) @ turned[..., joint, :, :]
        return local

    def turned(self, body: np.ndarray) -> np.ndarray:
        """Returns world rotations (F, J, 3, 3) that follow SMPL's world rotations `body` (F, 22, 3, 3).

        Joints without a counterpart in SMPL follow their parent.
        """
        rest, turned = self.rest(), np.tile(self.turns, (len(body), 1, 1, 1))
        for joint, (parent, source) in enumerate(zip(self.parents, self.sources, strict=True)):
            if source >= 0:
                turned[:, joint] = body[:, source] @ self.neutral[joint]
            elif parent >= 0:
                turned[:, joint] = turned[:, parent] @ rest[joint]
        return turned

    def assembled(self, world: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
        """Returns the joint positions (F, J, 3) for the world rotations `world` (F, J, 3, 3).

        `pelvis` (F, 3) is the position of the pelvis.
        """
        positions, hips = np.tile(self.positions, (len(world), 1, 1)), self.hips
        for joint, parent in enumerate(self.parents):
            if joint == hips:
                positions[:, joint] = pelvis
            elif parent >= 0:
                offset = self.turns[parent].T @ (self.positions[joint] - self.positions[parent])
                positions[:, joint] = positions[:, parent] + world[:, parent] @ offset
        return positions


def recognized(
    names: Mapping[int, str], skeletons: Sequence[Mapping[str, str]]
) -> dict[str, list[int]]:
    """Returns the indices of the joints that may correspond to each SMPL joint.

    The correspondence is taken from the most similar known skeleton.

    Args:
        names: joint names, keyed by joint index.
        skeletons: for each skeleton, a mapping from joint spellings to SMPL joints, as in
            `flame_mdm.formats.names.best_match`.
    """
    numbers = list(names)
    match = best_match(
        list(names.values()), {str(key): skeleton for key, skeleton in enumerate(skeletons)}
    )
    return {
        joint: [numbers[index] for index in indices] for joint, indices in match.numbers.items()
    }


def matched(
    source: object, names: Mapping[int, str], candidates: Mapping[str, Sequence[int]]
) -> tuple[dict[str, int], list[str]]:
    """Returns the index of the character's joint for each SMPL joint, and the missing joints.

    Joints are reported as missing only if they are required. Raises `UserError` if there are
    several candidates for an SMPL joint.
    """
    if double := next((joint for joint, numbers in candidates.items() if len(numbers) > 1), None):
        same = ", ".join(names[number] for number in candidates[double])
        raise UserError(
            f"{source}: found {len(candidates[double])} joints for {double}: {same}. Rename all but one"
        )
    required = [
        "pelvis",
        *(f"{side}_{name}" for side in SIDES for limb in LIMBS.items() for name in limb),
    ]
    missing = [joint for joint in JOINT if joint in required and joint not in candidates]
    return {joint: number for joint, (number,) in candidates.items()}, missing


@dataclass(frozen=True, eq=False)
class RestPose:
    """A character's skeleton in its rest pose, facing +z.

    Lengths are in the character's unit, and y is up.
    """

    # The skeleton, whose neutral rotations `fitted` replaces for a motion
    rig: Rig
    # Index of the character's joint for each SMPL joint
    map: Mapping[str, int]
    # Height of the lowest point in the rest pose
    floor: float

    def position(self, joint: str) -> np.ndarray:
        """Returns an SMPL joint's position (3,) in the rest pose."""
        return self.rig.positions[self.map[joint]]


def rest_pose(
    source: object,
    names: Sequence[str],
    parents: Sequence[int],
    positions: np.ndarray,
    turned: np.ndarray,
    joints: Mapping[str, int],
    lowest: np.ndarray,
    vertical: Sequence[int],
) -> RestPose:
    """Returns a rest pose, turned so that y points up and +z points forward.

    Args:
        source: name of the character in error messages.
        names: names of the J joints.
        parents: index of each joint's parent.
        positions: (J, 3), joint positions in world coordinates with any unit and orientation.
        turned: (J, 3, 3), joint rotations in these coordinates.
        joints: index of the character's joint for each SMPL joint.
        lowest: points in these coordinates, including the lowest point of the character.
        vertical: (3,), the up direction in these coordinates.
    """
    at = {joint: positions[number] for joint, number in joints.items()}

    def middle(name: str) -> np.ndarray:
        return (at[f"left_{name}"] + at[f"right_{name}"]) / 2

    # The pose must be usable: limbs have a length, the trunk and the legs are upright, and left and
    # right joints are at different points.
    trunk, legs = middle("shoulder") - middle("hip"), middle("hip") - middle("ankle")
    up = np.array(vertical)
    shortest = max(1e-4 * float(np.linalg.norm(legs)), 1e-9)
    for side in SIDES:
        for start, end in LIMBS.items():
            if np.linalg.norm(at[f"{side}_{start}"] - at[f"{side}_{end}"]) <= shortest:
                raise UserError(
                    f"{source}: the bone from {side}_{start} to {side}_{end} has no length"
                )
    tilt = max(
        np.degrees(np.arccos(np.clip(v @ up / max(np.linalg.norm(v), 1e-9), -1, 1)))
        for v in (trunk, legs)
    )
    if not tilt <= TILT:
        raise UserError(
            f"{source}: the rest pose is not upright: it leans by {tilt:.0f} degrees. Use a T-pose or an A-pose"
        )

    # The axes of the new coordinates are x to the left (from hips and shoulders), y up, and z
    # ahead. A direction that is nearly an axis of the file is replaced by this axis, so that small
    # asymmetries of a mesh do not turn the character.
    left = at["left_hip"] + at["left_shoulder"] - at["right_hip"] - at["right_shoulder"]
    left = left - up * (up @ left)
    if np.linalg.norm(left) <= shortest:
        raise UserError(f"{source}: left and right joints are at the same points in the rest pose")
    left = left / np.linalg.norm(left)
    nearest = np.eye(3)[np.abs(left).argmax()] * np.sign(left[np.abs(left).argmax()])
    left = nearest if nearest @ left > np.cos(np.radians(SNAP)) else left
    frame = np.stack([left, up, np.cross(left, up)])
    feet = [at[f"{side}_foot"] - at[f"{side}_ankle"] for side in SIDES if f"{side}_foot" in at]
    if feet and frame[2] @ np.sum(feet, 0) < 0:
        raise UserError(
            f"{source}: the toes point backward. Are left and right swapped, or is the character mirrored?"
        )
    sources = dict(joints)
    spine = [joint for joint in SPINE if joint in sources]
    if spine:  # the arms start at the last joint of the spine, which moves like the chest
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
    return RestPose(rig, joints, float((lowest @ frame[1]).min()))


def fitted(character: RestPose, offsets: np.ndarray) -> Rig:
    """Returns the skeleton with neutral rotations that move its limbs to SMPL's rest pose.

    `offsets` (22, 3) are the positions of SMPL's joints relative to their parents in the rest pose.
    """
    # Each bone of a limb is turned from the character's rest pose to SMPL's. First its direction is
    # matched, then its twist, so that knees and elbows bend about the same axis. A limb that is
    # clearly bent at rest shows this axis. If a limb is straight, its knee is assumed to bend
    # backwards, or its elbow to bend forward.
    rig, turns = character.rig, np.tile(np.eye(3), (len(SMPL22), 1, 1))
    for side in SIDES:
        for (start, middle, end), bend in (
            (("hip", "knee", "ankle"), -1),
            (("shoulder", "elbow", "wrist"), 1),
        ):
            first, second, third = (
                character.position(f"{side}_{name}") for name in (start, middle, end)
            )
            ours = [offsets[JOINT[f"{side}_{name}"]] for name in (middle, end)]
            theirs = [second - first, third - second]
            hinge, usual = np.cross(ours[0], [0, 0, bend]), np.cross(theirs[0], [0, 0, bend])
            shown = np.cross(theirs[0], theirs[1]) / (
                np.linalg.norm(theirs[0]) * np.linalg.norm(theirs[1])
            )
            clear = np.linalg.norm(shown) > BEND and shown @ usual > 0
            for name, bone, their_bone in zip((start, middle), ours, theirs, strict=True):
                turn = orthonormal(bone, hinge).T @ orthonormal(
                    their_bone, shown if clear else usual
                )
                turns[JOINT[f"{side}_{name}"]] = turn
        turns[JOINT[f"{side}_wrist"]] = turns[JOINT[f"{side}_elbow"]]
    neutral = np.stack(
        [turns[max(source, 0)] @ turn for source, turn in zip(rig.sources, rig.turns, strict=True)]
    )
    return replace(rig, neutral=neutral)


def follow(
    character: RestPose,
    joints: np.ndarray,
    offsets: np.ndarray,
    neutral: np.ndarray,
    world: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, Rig]:
    """Applies the motion of a body to a character.

    Args:
        character: the character.
        joints: (F, 22, 3), joint positions of the body in meters.
        offsets: (22, 3), offsets of the joints from their parents in the rest pose.
        neutral: (22, 3, 3), rotations of the body parts in the rest pose.
        world: (F, 22, 3, 3), world rotations of the body parts.

    Returns:
        The character's world rotations (F, J, 3, 3) and joint positions (F, J, 3), and its
        skeleton.
    """
    # All joints take the rotations of the body, relative to the rest poses. The hips follow the
    # scaled path. If the legs have different proportions, the feet would then hover or sink.
    # Therefore, each leg is bent until its toes or its ankle reach the scaled position, at the
    # character's own height above the floor.
    rig, neutral = fitted(character, offsets), neutral.copy()
    turned = world @ np.swapaxes(neutral, 1, 2)
    neutral[JOINT["neck"]] = neutral[JOINT["head"]]
    turned = turned @ neutral
    joints = joints.astype(float)
    lowest = joints[..., 1].min()
    joints[..., 1] -= lowest if abs(lowest) <= GROUND else 0
    legs = [offsets[JOINT[f"{s}_{name}"]] for s in SIDES for name in ("knee", "ankle")]
    leg_bones = [
        character.position(f"{s}_{b}") - character.position(f"{s}_{a}")
        for s in SIDES
        for a, b in LEGS
    ]
    scale = float(np.linalg.norm(leg_bones, axis=1).sum() / np.linalg.norm(legs, axis=1).sum())
    # Heights of the ankles above the floor while the feet are flat
    flat = {s: (neutral[JOINT[f"{s}_ankle"]].T @ offsets[JOINT[f"{s}_foot"]])[1] for s in SIDES}
    higher = {
        s: character.position(f"{s}_ankle")[1] - character.floor + scale * flat[s] for s in SIDES
    }

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
            target = scale * joints[:, JOINT[f"{side}_foot"]] - (
                positions[:, toe] - positions[:, ankle]
            )
            target[:, 1] += rig.positions[toe, 1] - character.floor
        forward = turned[:, JOINT[f"{side}_hip"], :, 2]
        bent = _bent(positions[:, hip], positions[:, knee], positions[:, ankle], target, forward)
        bones = (("hip", bent - positions[:, hip], hip, knee), ("knee", target - bent, knee, ankle))
        for name, bone, start, end in bones:
            number = JOINT[f"{side}_{name}"]
            turned[:, number] = (
                shortest_turns(positions[:, end] - positions[:, start], bone) @ turned[:, number]
            )
    world = rig.turned(turned)
    return world, rig.assembled(world, pelvis), rig


def _bent(
    hip: np.ndarray, knee: np.ndarray, ankle: np.ndarray, target: np.ndarray, forward: np.ndarray
) -> np.ndarray:
    """Returns the knee position (F, 3) that moves the ankle as close as possible to `target`.

    The knee bends to the same side as before.
    """
    # Thigh, shin and the line to the target form a triangle, as in `cleanup.bend`.
    thigh, shin = np.linalg.norm(knee - hip, axis=1), np.linalg.norm(ankle - knee, axis=1)
    line = target - hip
    length = np.maximum(np.linalg.norm(line, axis=1), 1e-9)
    line = line / length[:, None]
    length = np.clip(length, np.abs(thigh - shin) / REACH, REACH * (thigh + shin))
    along = (thigh**2 - shin**2 + length**2) / (2 * length)
    before = ankle - hip
    out = (knee - hip) - before * ((knee - hip) * before).sum(1, keepdims=True) / (before**2).sum(
        1, keepdims=True
    )
    # A straight leg does not show in which direction its knee points, so a small fraction of the
    # thigh's front direction is added.
    out = out + STRAIGHT * thigh[:, None] * forward
    out = out - line * (out * line).sum(1, keepdims=True)
    out = out / np.linalg.norm(out, axis=1, keepdims=True)
    return hip + along[:, None] * line + np.sqrt(np.maximum(thigh**2 - along**2, 0))[:, None] * out
