"""Skeletons of other programs and characters in motion. Blender's extension contains it, so it needs numpy alone."""

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
"""Joints whose bone takes the direction of the motion's bone -> the joint at the end of this bone."""
SPINE = ("spine1", "spine2", "spine3")
TILT = 45  # maximum angle in degrees between the trunk of a rest pose and the vertical
SNAP = 8  # a facing direction within this angle of an axis, in degrees, is taken for the axis
# Minimum sine of the bend of an elbow or knee in the rest pose. The twist of a straighter limb
# cannot be read: the limbs of people also bend sideways, by 7 degrees at the knees and 5 degrees at
# the elbows of SMPL's body, so that a small bend is far from the axis of the joint.
BEND = 0.25
GROUND = 0.1  # maximum height in meters of the lowest joint of a clip that stands on the floor
# Distance of the knee from the line of the leg, in lengths of the thigh, at which bend and thigh weigh the same
STRAIGHT = 0.05
REACH = 0.999  # maximum distance from hip to ankle relative to the length of the straight leg


@dataclass(frozen=True, eq=False)
class Rig:
    """A skeleton with J joints in its rest pose, in meters, y up, facing +z."""

    joints: tuple[str, ...]  # names; parents precede their children
    parents: tuple[int, ...]  # index of each joint's parent, -1 for a root
    positions: np.ndarray  # (J, 3) of the joints
    turns: np.ndarray  # (J, 3, 3), rotations of the joints in the world
    # For each joint, the index of the joint of SMPL whose rotation it takes, or -1
    sources: tuple[int, ...]
    # (J, 3, 3), rotations of these joints in the world while SMPL is in its rest pose
    neutral: np.ndarray
    orders: tuple[str, ...]  # order of the Euler angles of each joint in BVH files
    unit: float = CENTIMETER  # meters per unit of length in BVH files
    # (3, 3), rotation from the world of the file
    frame: np.ndarray = field(default_factory=lambda: np.eye(3))
    # (J,), world units per unit of a joint; none = 1
    scales: np.ndarray = field(default_factory=lambda: np.ones(0))

    @property
    def hips(self) -> int:
        """The joint of the pelvis."""
        return self.sources.index(0)

    def offsets(self) -> np.ndarray:
        """Returns the position (J, 3) of each joint in the frame of its parent, or in the world of the file."""
        return np.stack(
            [self.within(self.positions[joint], joint) for joint in range(len(self.joints))]
        )

    def within(self, positions: np.ndarray, joint: int) -> np.ndarray:
        """Converts positions (..., 3) in the world to the frame of a joint's parent in the rest pose."""
        parent = self.parents[joint]
        if parent < 0:
            return positions @ self.frame
        scale = self.scales[parent] if len(self.scales) else 1
        return (positions - self.positions[parent]) @ self.turns[parent] / scale

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
        """Returns rotations (F, J, 3, 3) in the world that follow SMPL's, `body` (F, 22, 3, 3), or the parent's."""
        rest, turned = self.rest(), np.tile(self.turns, (len(body), 1, 1, 1))
        for joint, (parent, source) in enumerate(zip(self.parents, self.sources, strict=True)):
            if source >= 0:
                turned[:, joint] = body[:, source] @ self.neutral[joint]
            elif parent >= 0:
                turned[:, joint] = turned[:, parent] @ rest[joint]
        return turned

    def assembled(self, world: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
        """Returns positions (F, J, 3) of joints with world rotations (F, J, 3, 3), with the pelvis at (F, 3)."""
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
    """Returns the numbers of the joints that the most similar skeleton names: joint of SMPL -> numbers.

    `skeletons` are spellings of joints -> joints of SMPL, as in
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
    """Returns numbers of a character's joints by SMPL's, each at most once, and the required ones that it lacks."""
    if double := next((joint for joint, numbers in candidates.items() if len(numbers) > 1), None):
        same = ", ".join(names[number] for number in candidates[double])
        raise UserError(
            f"{source}: {len(candidates[double])} joints for {double}: {same}. Rename all but one"
        )
    required = [
        "pelvis",
        *(f"{side}_{name}" for side in SIDES for limb in LIMBS.items() for name in limb),
    ]
    missing = [joint for joint in JOINT if joint in required and joint not in candidates]
    return {joint: number for joint, (number,) in candidates.items()}, missing


@dataclass(frozen=True, eq=False)
class RestPose:
    """A character's skeleton in its rest pose, y up, facing +z, in its own unit."""

    rig: Rig  # the skeleton; `fitted` replaces its neutral rotations by ones that depend on the motion
    map: Mapping[str, int]  # SMPL's joint -> index of the character's
    floor: float  # height of the lowest point in the rest pose

    def position(self, joint: str) -> np.ndarray:
        """Returns the position (3,) of SMPL's joint in the rest pose."""
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
    """Returns a rest pose, turned to y up and +z ahead; `source` names the character in messages.

    Positions (J, 3), rotations `turned` (J, 3, 3) and points that include the `lowest` one are in
    a world of any unit and direction, in which `vertical` (3,) is up. `joints` maps SMPL's joints
    to indices of the character's.
    """
    at = {joint: positions[number] for joint, number in joints.items()}

    def middle(name: str) -> np.ndarray:
        return (at[f"left_{name}"] + at[f"right_{name}"]) / 2

    # First, the pose must be one that rotations can start from: limbs with a length, an upright
    # trunk and upright legs, left and right apart.
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
            f"{source}: the rest pose is not upright, it leans by {tilt:.0f} degrees. Use a T- or an A-pose"
        )

    # The frame is: x to the left, from hips and shoulders, y up, z ahead. A direction that is
    # nearly an axis of the file becomes this axis, so that small asymmetries of a mesh do not
    # turn the character.
    left = at["left_hip"] + at["left_shoulder"] - at["right_hip"] - at["right_shoulder"]
    left = left - up * (up @ left)
    if np.linalg.norm(left) <= shortest:
        raise UserError(f"{source}: left and right joints of the rest pose are at the same points")
    left = left / np.linalg.norm(left)
    nearest = np.eye(3)[np.abs(left).argmax()] * np.sign(left[np.abs(left).argmax()])
    left = nearest if nearest @ left > np.cos(np.radians(SNAP)) else left
    frame = np.stack([left, up, np.cross(left, up)])
    feet = [at[f"{side}_foot"] - at[f"{side}_ankle"] for side in SIDES if f"{side}_foot" in at]
    if feet and frame[2] @ np.sum(feet, 0) < 0:
        raise UserError(
            f"{source}: the toes point backward. Are left and right exchanged, or mirrored?"
        )
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
    return RestPose(rig, joints, float((lowest @ frame[1]).min()))


def fitted(character: RestPose, offsets: np.ndarray) -> Rig:
    """Returns the skeleton with neutral rotations in which its limbs point like the limbs of
    SMPL's rest pose.

    `offsets` (22, 3) are the offsets of SMPL's joints from their parents at rest.
    """
    # Each limb bone is turned from the character's rest pose to SMPL's: its direction first, then
    # the twist, such that knees and elbows bend about the same axis. A limb that is clearly bent
    # at rest shows this axis. For a straight limb, knees are taken to bend backward and elbows
    # forward.
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
    """Moves a character as a body moves; returns rotations (F, J, 3, 3), positions (F, J, 3) and the skeleton for it.

    The body has joints (F, 22, 3) in meters, with `offsets` (22, 3) from their parents in the
    rest pose; its parts have rotations `neutral` (22, 3, 3) in the rest pose and `world`
    (F, 22, 3, 3) in the world.
    """
    # All joints get the rotations of the body, relative to the rest poses. The hips follow the
    # scaled path. Legs of other proportions would then hover or sink, so that each leg is bent
    # until its toes or its ankle are at the scaled position, at the character's own height above
    # the floor.
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
    # heights of the ankles above the floor while the feet are flat
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
    """Returns where a knee (F, 3) is if the ankle is at `target`, or as near as the leg reaches; it bends as before."""
    # Thigh and shin are two sides of a triangle over the line to the target, as in
    # `cleanup.bend`.
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
    # A straight leg does not show where its knee points, so that a little of the thigh's front is
    # added.
    out = out + STRAIGHT * thigh[:, None] * forward
    out = out - line * (out * line).sum(1, keepdims=True)
    out = out / np.linalg.norm(out, axis=1, keepdims=True)
    return hip + along[:, None] * line + np.sqrt(np.maximum(thigh**2 - along**2, 0))[:, None] * out
