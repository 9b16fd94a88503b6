"""Writes a motion as a VRM animation (.vrma), which can be applied to any VRM avatar.

Source: VRM consortium, "VRMC_vrm_animation 1.0", https://github.com/vrm-c/vrm-specification. A
.vrma file is a .glb file that contains no mesh, but declares which nodes are the bones of a
humanoid. The rest pose is VRM's T-pose: limbs along the axes, feet pointing straight ahead, soles
on the floor. Programs apply the rotations relative to this pose, and scale the path of the hips by
the ratio of the avatar's hip height to the hip height in the file.
"""

from pathlib import Path
from typing import Any

import numpy as np

from flame_mdm.formats.glb import Binary, quaternions
from flame_mdm.formats.glb_animation import HUMANOID
from flame_mdm.formats.poses import Poses
from flame_mdm.formats.posture import shortest_turns
from flame_mdm.formats.rig import Rig
from flame_mdm.formats.rigged import RiggedClip
from flame_mdm.representations.skeleton import JOINT, SMPL22

EXTENSION = "VRMC_vrm_animation"
LIMBS = {"shoulder": (1, 0, 0), "elbow": (1, 0, 0), "hip": (0, -1, 0), "knee": (0, -1, 0)}
"""For each joint on the left side, the direction of the bone that begins there in VRM's T-pose."""


def rest_rig(poses: Poses) -> Rig:
    """Returns VRM's humanoid in its T-pose, with the bone lengths of a body.

    The axes of its joints are the world axes.
    """
    names = {joint: bone for bone, joint in HUMANOID.items()}
    offsets = poses.offsets.numpy().copy()
    neutral = np.tile(np.eye(3), (len(SMPL22), 1, 1))
    for side, sign in (("left", 1), ("right", -1)):
        for name, direction in LIMBS.items():
            joint = JOINT[f"{side}_{name}"]
            child = SMPL22.parents.index(joint)
            toward = np.array(direction, float) * [sign, 1, 1]
            neutral[joint] = shortest_turns(toward[None], offsets[child][None])[0]
            offsets[child] = toward * np.linalg.norm(offsets[child])
        # The foot turns about the vertical axis, so that its sole stays flat.
        ankle, toes = JOINT[f"{side}_ankle"], JOINT[f"{side}_foot"]
        sideways, down, ahead = offsets[toes]
        angle = np.arctan2(sideways, ahead)
        cosine, sine = np.cos(angle), np.sin(angle)
        neutral[ankle] = neutral[toes] = [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]
        offsets[toes] = [0, down, np.hypot(sideways, ahead)]
        neutral[JOINT[f"{side}_wrist"]] = neutral[JOINT[f"{side}_elbow"]]

    positions = np.zeros((len(SMPL22), 3))
    for parent, joint in SMPL22.edges:
        positions[joint] = positions[parent] + offsets[joint]
    positions[:, 1] -= positions[:, 1].min()
    return Rig(
        joints=tuple(names[joint] for joint in SMPL22.joints),
        parents=SMPL22.parents,
        positions=positions,
        turns=np.tile(np.eye(3), (len(SMPL22), 1, 1)),
        sources=tuple(range(len(SMPL22))),
        neutral=neutral,
        orders=("XYZ",) * len(SMPL22),
    )


def write(path: Path, clip: RiggedClip) -> None:
    """Writes a clip whose skeleton was created by `rest_rig`."""
    binary = Binary()
    turns = quaternions(np.concatenate([clip.rest[None], clip.turns]))[1:]
    curves = [("rotation", node, turns[:, node]) for node in range(len(clip.joints))]
    lifted = clip.moves[0] + [0, clip.lift, 0]
    curves.append(("translation", 0, lifted.astype("f4")))
    offsets = clip.offsets.copy()
    offsets[0, 1] += clip.lift
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": offset.tolist()}
        for name, offset in zip(clip.joints, offsets, strict=True)
    ]
    for joint, parent in enumerate(clip.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(joint)
    bones = {name: {"node": node} for node, name in enumerate(clip.joints)}
    document = {
        "asset": {"version": "2.0", "generator": "flame_mdm", "extras": {"fps": clip.fps}},
        "extensionsUsed": [EXTENSION],
        "extensions": {EXTENSION: {"specVersion": "1.0", "humanoid": {"humanBones": bones}}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "animations": [binary.animation(clip.name, clip.fps, curves)],
    }
    binary.save(path, document)
