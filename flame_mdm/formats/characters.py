"""Motions on a user's own character: the skeleton of a .bvh file, or of the skin of a .glb file.

The character may have other proportions, units, axes, names and another rest pose than SMPL's body. Arms and legs take
the directions of the motion's. Trunk, head, hands and feet take its rotations from their own rest pose, which is
upright with flat feet. The way of the hips is scaled by the length of the legs, and both legs are bent until the toes
are where those of the motion are, scaled, and as high above the floor as in the rest pose.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats import bvh, glb
from flame_mdm.formats.layouts import LAYOUTS
from flame_mdm.formats.retarget import JOINT, Rig, continuous_euler, presets, world_rotations
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.safe_io import read_yaml
from flame_mdm.visualize.body import figure
from flame_mdm.visualize.scene import Shown

SIDES = ("left", "right")
LEGS = (("hip", "knee"), ("knee", "ankle"))
LIMBS = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}
"""Joints whose bone is turned to the direction of the motion's, and the joint at the end of this bone."""
NEEDED = ("pelvis", *(f"{side}_{name}" for side in SIDES for name in ("hip", "knee", "ankle")))
NEEDED += tuple(f"{side}_{name}" for side in SIDES for name in ("shoulder", "elbow", "wrist"))
SPINE = ("spine1", "spine2", "spine3")
TILT = 45
"""Degrees between trunk and vertical at which a rest pose is refused."""
SNAP = 8
"""Degrees from an axis within which a character is taken to face along it."""
BEND = 0.15
"""Sine of the bend of an elbow or knee in the rest pose above which it tells how the limb is twisted."""
GROUND = 0.1
"""Height in meters up to which the lowest joint of a clip is taken to be on the floor: recordings have it a little
above."""
STRAIGHT = 0.05
"""Distance of the knee from the line of a leg, in thighs, at which the bend tells as much as the thigh's front side."""
REACH = 0.999
"""Largest part of its length to which a leg is stretched."""


class UnknownJoints(UserError):
    """No names are known for some joints; `template` has the lines of a file with names, to be completed."""

    def __init__(self, message: str, template: list[str]):
        super().__init__(message)
        self.template = template


@dataclass(frozen=True, eq=False)
class Character:
    """A skeleton in its rest pose, y up, facing +z, in the unit of its file, and the file.

    Attributes:
        rig: the skeleton; its neutral rotations are not known yet.
        map: SMPL's joint -> index of the character's.
        floor: height of the lowest point in the rest pose.
        file: the BVH or GLB file.
    """

    rig: Rig
    map: Mapping[str, int]
    floor: float
    file: bvh.Bvh | glb.Glb

    def place(self, joint: str) -> np.ndarray:
        """Returns the position (3,) of SMPL's joint in the rest pose."""
        return self.rig.places[self.map[joint]]


def read(path: str | Path) -> Character:
    """Reads a character. Names of joints are those of a known skeleton, or are in a `.yaml` file of the same name.

    Raises:
        FileNotFoundError: the file does not exist.
        UserError: the file cannot be read, has no skin, or its rest pose cannot be used.
        UnknownJoints: the names of joints are not known.
        ValueError: the file is damaged.
    """
    path = Path(path)
    if path.suffix.lower() == ".glb":
        return _read_glb(path)
    if path.suffix.lower() != ".bvh":
        raise UserError(f"character={path}: not a character. Use a .bvh or .glb file")
    file = bvh.read(path)
    found = _names(path, dict(enumerate(file.joints)))
    zero = np.tile(np.eye(3), (1, len(file.joints), 1, 1))
    problem = None
    for turns, offsets in ((zero, file.offsets[None]), (file.rotations()[:1], file.translations()[:1])):
        places, turned = (values[0] for values in bvh.forward_kinematics(file.parents, turns, offsets))
        ends = [places[p] + turned[p] @ end for p, end in zip(file.end_parents, file.end_offsets, strict=True)]
        try:
            return _character(path, file, file.joints, file.parents, places, turned, found, [*places, *ends])
        except UserError as error:  # many files have no rest pose, but begin with one
            problem = problem or error
    raise problem or AssertionError


def _read_glb(path: Path) -> Character:
    file = glb.read(path)
    skeletons: list[set[int]] = []
    for joints, *_ in file.skins:
        shared = [skeleton for skeleton in skeletons if skeleton & set(joints)]
        skeletons = [skeleton for skeleton in skeletons if skeleton not in shared] + [set(joints).union(*shared)]
    if len(skeletons) != 1:
        raise UserError(
            f"{path}: {len(skeletons)} skeletons with a skin. A character has one: export one mesh with its armature"
        )
    found = _names(path, {joint: file.names[joint] for joint in sorted(skeletons[0])})
    worlds, corners = _rest(file, found["pelvis"])
    scales = np.cbrt(np.linalg.det(worlds[:, :3, :3]))
    for joint, number in found.items():
        sizes = np.linalg.svd(worlds[number, :3, :3], compute_uv=False)
        if scales[number] <= 0 or sizes[0] > 1.01 * sizes[2]:
            raise UserError(
                f"{path}: {file.names[number]} ({joint}) is mirrored or scaled unevenly in the rest pose. Apply the "
                "scale of the armature and export it again"
            )
    turned = worlds[:, :3, :3] / np.where(scales == 0, 1, scales)[:, None, None]
    made = _character(path, file, file.names, file.parents, worlds[:, :3, 3], turned, found, corners)
    return replace(made, rig=replace(made.rig, scales=scales))


def _rest(file: glb.Glb, pelvis: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the matrices (N, 4, 4) of nodes in the pose in which the skin was bound, and corners around its meshes.

    Nodes may be stored in another pose. Then the skin's own frame is turned into the world by the multiple of 90
    degrees that the pelvis, which is nearly upright, shows.
    """
    worlds, corners = file.worlds.copy(), []
    rest: dict[int, np.ndarray] = {}
    for joints, binds, boxes in sorted(file.skins, key=lambda skin: (pelvis in skin[0], len(skin[0]))):
        if not len(binds):
            corners.append(worlds[joints, :3, 3])
            continue
        moves = worlds[joints] @ binds
        move = moves[joints.index(pelvis) if pelvis in joints else 0].copy()
        if not np.allclose(moves, move, atol=1e-3 * np.abs(move).max()):
            scale = np.cbrt(np.linalg.det(move[:3, :3]))
            turn = np.round(move[:3, :3] / scale)
            if np.isclose(np.linalg.det(turn), 1):
                move[:3, :3] = scale * turn
            rest |= {joint: move @ np.linalg.inv(bind) for joint, bind in zip(joints, binds, strict=True)}
        corners.append(boxes @ move[:3, :3].T + move[:3, 3])
    if rest:
        for joint, parent in enumerate(file.parents):
            above = np.linalg.inv(file.worlds[parent]) @ file.worlds[joint] if parent >= 0 else worlds[joint]
            worlds[joint] = rest.get(joint, worlds[parent] @ above if parent >= 0 else above)
    return worlds, np.concatenate(corners)


def _plain(name: str) -> str:
    """Returns a name without the part before a colon, Mixamo's prefix, signs and capitals."""
    return re.sub(r"[\W_]", "", re.sub(r"^mixamorig\d*[_:]?", "", name.rpartition(":")[2])).lower()


def _layouts() -> dict[str, dict[str, str]]:
    """Returns known skeletons: plain name -> joint of SMPL."""
    known = {}
    for name, data in presets().items():
        parts = [("trunk", "", "")]
        parts += [(p, f"{s}_", m) for s, m in zip(SIDES, data["sides"], strict=True) for p in ("arm", "leg")]
        known[name] = {
            _plain(joint.replace("*", mark)): side + place
            for part, side, mark in parts
            for joint, place in data[part].items()
            if isinstance(place, str)
        }
    for name in ("SMPL", "Bandai-Namco"):
        known[name] = {_plain(place): j for j, place in LAYOUTS[name].map.items() if isinstance(place, str)}
    return known


def _names(path: Path, names: Mapping[int, str]) -> dict[str, int]:
    """Returns the numbers of the joints that correspond to SMPL's, from the file of names or a known skeleton.

    Raises:
        UserError: the file of names is invalid.
        UnknownJoints: needed joints are missing.
    """
    listed = path.with_suffix(".yaml")
    chosen = read_yaml(listed) if listed.exists() else None
    if chosen:
        if not isinstance(chosen, dict) or not all(isinstance(name, str | None) for name in chosen.values()):
            raise UserError(f"{listed}: not a list of names, each on a line such as `left_knee: Calf L`")
        if unknown := next((joint for joint in chosen if joint not in JOINT), None):
            raise UserError(f"{listed}: {unknown} is no joint of SMPL.{did_you_mean(str(unknown), JOINT)}")
        places = {joint: str(name) for joint, name in chosen.items() if name is not None}
        found = {joint: [number for number, each in names.items() if each == name] for joint, name in places.items()}
        if missing := next((joint for joint, numbers in found.items() if not numbers), None):
            raise UserError(
                f"{listed}: {missing}: {path} has no joint {places[missing]}."
                f"{did_you_mean(places[missing], names.values())}"
            )
    else:
        plain: dict[str, list[int]] = {}
        for number, name in names.items():
            plain.setdefault(_plain(name), []).append(number)
        known = max(_layouts().values(), key=lambda layout: len(layout.keys() & plain.keys()))
        found = {joint: plain[name] for name, joint in known.items() if name in plain}
    if double := next((joint for joint, numbers in found.items() if len(numbers) > 1), None):
        same = ", ".join(names[number] for number in found[double])
        raise UserError(f"{path}: {len(found[double])} joints for {double}: {same}. Rename all but one")
    numbers = {joint: number for joint, (number,) in found.items()}
    if twice := next((joint for joint, number in numbers.items() if list(numbers.values()).count(number) > 1), None):
        raise UserError(f"{listed}: {names[numbers[twice]]} is given for {twice} and for another joint. Remove one")
    if missing := [joint for joint in NEEDED if joint not in numbers]:
        have = {joint: names[number] for joint, number in numbers.items()}
        template = [f"# Joints of {path.name}: {', '.join(names.values())}"]
        template += [f"{joint}: {json.dumps(have[joint])}" if joint in have else f"{joint}:" for joint in JOINT]
        raise UnknownJoints(
            f"{path}: no joint found for {', '.join(missing)}. Write the names of the joints into {listed}, as in the "
            "lines above; only spine, neck, head, collars and feet may stay empty",
            template,
        )
    return numbers


def _character(
    path: Path,
    file: bvh.Bvh | glb.Glb,
    names: Sequence[str],
    parents: Sequence[int],
    places: np.ndarray,
    turned: np.ndarray,
    found: dict[str, int],
    lowest: Sequence[np.ndarray] | np.ndarray,
) -> Character:
    """Returns a character, turned to y up and +z ahead, of the rest pose in the world of its file.

    Raises:
        UserError: the rest pose is not upright, a limb has no length, or left and right are exchanged.
    """

    def middle(name: str) -> np.ndarray:
        return places[[found[f"{side}_{name}"] for side in SIDES]].mean(0)

    trunk, legs = middle("shoulder") - middle("hip"), middle("hip") - middle("ankle")
    axes = (1,) if isinstance(file, glb.Glb) else (1, 2)
    ups = [sign * np.eye(3)[axis] for axis in axes for sign in ((1,) if len(axes) == 1 else (1, -1))]
    up = max(ups, key=lambda up: trunk @ up)
    size = np.linalg.norm(legs)
    for side in SIDES:
        for start, end in LIMBS.items():
            if np.linalg.norm(places[found[f"{side}_{start}"]] - places[found[f"{side}_{end}"]]) <= 1e-4 * size:
                raise UserError(f"{path}: the bone from {side}_{start} to {side}_{end} has no length")
    tilt = max(
        np.degrees(np.arccos(np.clip(way @ up / max(np.linalg.norm(way), 1e-9), -1, 1))) for way in (trunk, legs)
    )
    if not tilt <= TILT:
        raise UserError(
            f"{path}: the rest pose is not upright, it leans by {tilt:.0f} degrees. Export the character in a T-pose "
            "or A-pose" + (", or begin the file with one" if isinstance(file, bvh.Bvh) else "")
        )
    left = np.subtract(*(places[found[f"{side}_hip"]] + places[found[f"{side}_shoulder"]] for side in SIDES))
    left = left - up * (up @ left)
    left = left / np.linalg.norm(left)
    nearest = np.eye(3)[np.abs(left).argmax()] * np.sign(left[np.abs(left).argmax()])
    left = nearest if nearest @ left > np.cos(np.radians(SNAP)) else left
    frame = np.stack([left, up, np.cross(left, up)])
    feet = [places[found[f"{side}_foot"]] - places[found[f"{side}_ankle"]] for side in SIDES if f"{side}_foot" in found]
    if feet and frame[2] @ np.sum(feet, 0) < 0:
        raise UserError(f"{path}: the toes point backward. Are left and right exchanged, or is the character mirrored?")
    sources = dict(found)
    spine = [joint for joint in SPINE if joint in sources]
    if spine:  # the arms hang from the last joint of the spine, which moves as the chest
        sources["spine3"] = sources.pop(spine[-1])
    of = {number: JOINT[joint] for joint, number in sources.items()}
    rig = Rig(
        *(tuple(names), tuple(parents), places @ frame.T, frame @ turned),
        *(tuple(of.get(number, -1) for number in range(len(names))), np.tile(np.eye(3), (len(names), 1, 1))),
        ("",) * len(names),
        frame=frame,
    )
    return Character(rig, found, float(np.min(np.asarray(lowest) @ frame[1])), file)


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
            places = [character.place(f"{side}_{name}") for name in (start, middle, end)]
            ours = [offsets[JOINT[f"{side}_{name}"]] for name in (middle, end)]
            theirs = [places[1] - places[0], places[2] - places[1]]
            hinge, usual = np.cross(ours[0], [0, 0, bend]), np.cross(theirs[0], [0, 0, bend])
            shown = np.cross(theirs[0], theirs[1]) / (np.linalg.norm(theirs[0]) * np.linalg.norm(theirs[1]))
            clear = np.linalg.norm(shown) > BEND and shown @ usual > 0
            for name, bone, theirs_bone in zip((start, middle), ours, theirs, strict=True):
                turn = _frame(bone, hinge) @ _frame(theirs_bone, shown if clear else usual).T
                turns[JOINT[f"{side}_{name}"]] = turn
        turns[JOINT[f"{side}_wrist"]] = turns[JOINT[f"{side}_elbow"]]
    neutral = np.stack([turns[max(source, 0)] @ turn for source, turn in zip(rig.sources, rig.turns, strict=True)])
    return replace(rig, neutral=neutral)


def _frame(bone: np.ndarray, hinge: np.ndarray) -> np.ndarray:
    along = bone / np.linalg.norm(bone)
    across = hinge - along * (along @ hinge)
    across = across / np.linalg.norm(across)
    return np.stack([along, across, np.cross(along, across)], 1)


def moved(character: Character, motion: Shown) -> tuple[np.ndarray, np.ndarray, Rig]:
    """Moves a character as in a motion.

    Returns:
        Rotations (F, J, 3, 3) and positions (F, J, 3) of its joints in the world, and its skeleton for this motion.

    Raises:
        ValueError: the skeleton of the motion is not SMPL's, or a limb is much longer or shorter than people's.
    """
    poses, body = motion.posed(), figure(motion)
    offsets = poses.offsets.numpy()
    rig = fitted(character, offsets)
    neutral = body.neutral.copy()
    neutral[JOINT["neck"]] = neutral[JOINT["head"]]
    turned = world_rotations(body.local()) @ neutral
    joints = motion.joints[:, : len(SMPL22)].astype(float)
    lowest = joints[..., 1].min()
    joints[..., 1] -= lowest if abs(lowest) <= GROUND else 0
    size = _leg([offsets[JOINT[f"{s}_{name}"]] for s in SIDES for name in ("knee", "ankle")])
    own = [character.place(f"{s}_{b}") - character.place(f"{s}_{a}") for s in SIDES for a, b in LEGS]
    scale = _leg(own) / size
    # heights of the ankles above the floor while the feet are flat
    flat = {s: (neutral[JOINT[f"{s}_ankle"]].T @ offsets[JOINT[f"{s}_foot"]])[1] for s in SIDES}
    higher = {s: character.place(f"{s}_ankle")[1] - character.floor + scale * flat[s] for s in SIDES}

    hips = scale * joints[:, [JOINT["left_hip"], JOINT["right_hip"]]].mean(1)
    hips[:, 1] += np.mean(list(higher.values()))
    world = rig.turned(turned)
    places = _places(rig, world, np.zeros_like(hips))
    pelvis = hips - places[:, [character.map[f"{s}_hip"] for s in SIDES]].mean(1)
    places = _places(rig, world, pelvis)
    for side in SIDES:
        hip, knee, ankle = (character.map[f"{side}_{name}"] for name in ("hip", "knee", "ankle"))
        target = scale * joints[:, JOINT[f"{side}_ankle"]] + [0, higher[side], 0]
        if f"{side}_foot" in character.map:
            toe = character.map[f"{side}_foot"]
            target = scale * joints[:, JOINT[f"{side}_foot"]] - (places[:, toe] - places[:, ankle])
            target[:, 1] += rig.places[toe, 1] - character.floor
        forward = turned[:, JOINT[f"{side}_hip"], :, 2]
        bent = _bent(places[:, hip], places[:, knee], places[:, ankle], target, forward)
        for name, bone, start in (("hip", bent - places[:, hip], hip), ("knee", target - bent, knee)):
            end = knee if name == "hip" else ankle
            number = JOINT[f"{side}_{name}"]
            turned[:, number] = _turns(places[:, end] - places[:, start], bone) @ turned[:, number]
    world = rig.turned(turned)
    return world, _places(rig, world, pelvis), rig


def _leg(bones: Sequence[np.ndarray]) -> float:
    return float(np.sum([np.linalg.norm(bone) for bone in bones])) / 2


def _places(rig: Rig, world: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
    """Returns positions (F, J, 3) of joints with rotations (F, J, 3, 3), with the pelvis at (F, 3)."""
    places = np.tile(rig.places, (len(world), 1, 1))
    for joint, parent in enumerate(rig.parents):
        if joint == rig.hips:
            places[:, joint] = pelvis
        elif parent >= 0:
            offset = rig.turns[parent].T @ (rig.places[joint] - rig.places[parent])
            places[:, joint] = places[:, parent] + world[:, parent] @ offset
    return places


def _bent(hip: np.ndarray, knee: np.ndarray, ankle: np.ndarray, target: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Returns where a knee (F, 3) is if the ankle is at `target`, or as near as the leg reaches; it bends as before."""
    thigh, shin = np.linalg.norm(knee - hip, axis=1), np.linalg.norm(ankle - knee, axis=1)
    way = target - hip
    length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    way = way / length[:, None]
    length = np.clip(length, np.abs(thigh - shin) / REACH, REACH * (thigh + shin))
    along = (thigh**2 - shin**2 + length**2) / (2 * length)
    before = ankle - hip
    out = (knee - hip) - before * ((knee - hip) * before).sum(1, keepdims=True) / (before**2).sum(1, keepdims=True)
    # a straight leg does not show where its knee points
    out = out + STRAIGHT * thigh[:, None] * forward
    out = out - way * (out * way).sum(1, keepdims=True)
    out = out / np.linalg.norm(out, axis=1, keepdims=True)
    return hip + along[:, None] * way + np.sqrt(np.maximum(thigh**2 - along**2, 0))[:, None] * out


def _turns(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Returns the shortest rotations (F, 3, 3) between directions (F, 3)."""
    turns = rotation.between(torch.from_numpy(start), torch.from_numpy(end))
    return rotation.quaternion_to_matrix(turns).numpy()


# Writing --------------------------------------------------------------------------------------------------------------


def write(path: Path, character: Character, motion: Shown, name: str) -> str:
    """Writes the character's file with a motion, and returns a line that describes it.

    A .glb file keeps its content and gets a further animation, the first one; a .bvh file gets other frames.

    Raises:
        UserError: the file cannot be written, or a joint of a .bvh file cannot turn.
        ValueError: see `moved`.
    """
    world, places, rig = moved(character, motion)
    ending = ".bvh" if isinstance(character.file, bvh.Bvh) else ".glb"
    if path.suffix.lower() != ending:
        raise UserError(f"{path}: this character is a {ending} file, so name a {ending} file for the result")
    if isinstance(character.file, bvh.Bvh):
        _write_bvh(path, character.file, rig, world, places, motion.fps)
    else:
        _write_glb(path, character.file, rig, world, places, motion.fps, name)
    follow = sum(source >= 0 for source in rig.sources)
    return f"{follow} of {len(rig.joints)} joints follow the motion, {len(rig.joints) - follow} keep their angle"


def _write_bvh(path: Path, file: bvh.Bvh, rig: Rig, world: np.ndarray, places: np.ndarray, fps: float) -> None:
    local, frames = rig.local(world), np.zeros((len(world), file.frames.shape[1]))
    mover = rig.hips
    while rig.parents[mover] >= 0 and not any(name.endswith("position") for name in file.channels[mover]):
        mover = rig.parents[mover]
    moves = places[:, rig.hips] - rig.places[rig.hips]
    for joint, (names, column) in enumerate(zip(file.channels, file.columns(), strict=True)):
        order = "".join(name[0] for name in names if name.endswith("rotation"))
        if len(order) < 3 and rig.sources[joint] >= 0:
            raise UserError(
                f"{path}: {rig.joints[joint]} has {len(order)} rotation channels in the character's file, not 3"
            )
        place = np.tile(rig.offsets()[joint], (len(world), 1))
        if joint == mover:
            place = rig.within(rig.places[joint] + moves, joint)
        values = {f"{axis}position": place[:, k] for k, axis in enumerate("XYZ")}
        if len(order) == 3:
            angles = continuous_euler(torch.from_numpy(local[:, [joint]]), (order,))[:, 0].numpy()
            values |= {f"{axis}rotation": np.degrees(angles[:, k]) for k, axis in enumerate(order)}
        for k, name in enumerate(names):
            frames[:, column.start + k] = np.round(values.get(name, np.zeros(len(world))), 6)
    bvh.write(replace(file, frames=frames, fps=fps), path)


def _write_glb(
    path: Path, file: glb.Glb, rig: Rig, world: np.ndarray, places: np.ndarray, fps: float, name: str
) -> None:
    document = json.loads(json.dumps(file.document))
    binary = glb.Binary(file.data, document["bufferViews"], document["accessors"])
    turns = glb.quaternions(np.concatenate([rig.rest()[None], rig.local(world)]))
    offsets = rig.offsets()
    curves = []
    for joint, source in enumerate(rig.sources):
        node = document["nodes"][file.nodes[joint]]
        if source >= 0 or any(joint in joints for joints, *_ in file.skins):
            # the rest pose, also where the file has another pose, and in the form that animations need
            size = float(rig.scales[joint] / (rig.scales[rig.parents[joint]] if rig.parents[joint] >= 0 else 1))
            node.pop("matrix", None)
            node |= {"translation": offsets[joint].tolist(), "rotation": turns[0, joint].tolist(), "scale": [size] * 3}
        if source >= 0:
            curves.append(("rotation", file.nodes[joint], turns[1:, joint]))
    curves.append(("translation", file.nodes[rig.hips], rig.within(places[:, rig.hips], rig.hips).astype("f4")))
    # programs show the first animation
    document["animations"] = [glb.animation(binary, name, fps, curves), *document.get("animations", [])]
    document |= {"accessors": binary.accessors, "bufferViews": binary.views}
    document["buffers"][0]["byteLength"] = len(binary.data)
    glb.save(path, document, binary.data)
