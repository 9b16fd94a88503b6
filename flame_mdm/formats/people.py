"""Loads bodies by name: the mannequin, a body from a file, or an Anny body of any shape.

Anny's shapes are specified by numbers (`body="anny age=0.9"`). Source: Brégier et al., "Human Mesh
Modeling for Anny Body", 2026, https://arxiv.org/abs/2511.03589, (c) 2025 NAVER Corp., Apache-2.0.
Anny's shapes and weights come from MakeHuman and MPFB2 (CC0). Anny can also download topologies of
SMPL and SMPL-X, which are not free for commercial use. This project never uses these topologies.
"""

import os
from importlib import import_module
from pathlib import Path

import numpy as np

from flame_mdm.errors import UserError
from flame_mdm.formats.posture import orthonormal, shortest_turns
from flame_mdm.representations.skeleton import JOINT, SMPL22
from flame_mdm.representations.smpl import ADULT
from flame_mdm.safe_io import atomic_write
from flame_mdm.visualize.body import (
    HAIR,
    HELPERS,
    SHIRT,
    SHOES,
    SKIN,
    TROUSERS,
    Mesh,
    largest_weights,
    mannequin,
    read_body,
)

SHAPE = {"gender": 0.5, "age": 2 / 3, "height": 0.45, "weight": 0.4}
"""Anny's shape parameters and their defaults.

Values range from 0 to 1: from male to female, from baby to old (2/3 is a young adult), from small
to tall, and from light to heavy.
"""
PARTS = {
    "spine1": "spine04 spine03",
    "spine2": "spine02",
    "spine3": "spine01",
    "neck": "neck01 neck02 neck03",
    "head": "head eye",
    "collar": "clavicle shoulder01",
    "shoulder": "upperarm01 upperarm02",
    "elbow": "lowerarm01 lowerarm02",
    "wrist": "wrist finger metacarpal",
    "hip": "upperleg01 upperleg02",
    "knee": "lowerleg01 lowerleg02",
    "ankle": "foot",
    "foot": "toe",
}
"""For each SMPL joint, prefixes of the names of Anny's bones that follow it.

All other bones follow the pelvis.
"""
HEADS = {
    "hip": "upperleg01",
    "knee": "lowerleg01",
    "ankle": "foot",
    "foot": "toe2-1",
    "shoulder": "upperarm01",
} | {**{"elbow": "lowerarm01", "wrist": "wrist", "head": "head"}}
"""For each SMPL joint, Anny's bone that begins there."""
CLOTHES = {
    "neck": SKIN,
    "head": SKIN,
    "wrist": SKIN,
    "ankle": SHOES,
    "foot": SHOES,
} | dict.fromkeys(("pelvis", "hip", "knee"), TROUSERS)


def load_body(name: str) -> Mesh:
    """Returns the body with the given name.

    The name is "mannequin", the path of a body file, or "anny" followed by shape parameters, such
    as "anny gender=1 age=0.9". Creating the first Anny body takes about 90 seconds. Each Anny body
    is saved in the user's cache folder.

    Raises:
        UserError: If the file is damaged, a shape parameter is invalid, or Anny is not installed.
    """
    kind, *words = name.split() or [""]
    if kind != "anny":
        return read_body(name)
    shape = shape_of(words)
    path = _cache() / f"anny1-{'-'.join(f'{key}{value:.3g}' for key, value in shape.items())}.npz"
    if not path.exists():
        figure = bake(shape)
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **figure)
    return read_body(str(path))


def _cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "flame-mdm"


def shape_of(words: list[str]) -> dict[str, float]:
    """Parses shape parameters from words such as age=0.9."""
    shape = dict(SHAPE)
    for word in words:
        key, _, value = word.partition("=")
        try:
            shape[key] = float(value) if key in SHAPE else np.nan
        except ValueError:
            shape[key] = np.nan
        if not 0 <= shape[key] <= 1:
            raise UserError(
                f"body=anny: {word} is invalid. Use NAME=NUMBER, with a name from {', '.join(SHAPE)} and a "
                "number from 0 to 1"
            )
    return shape


def bake(shape: dict[str, float]) -> dict[str, np.ndarray]:
    """Returns the arrays that make up an Anny body's file; see `packed`.

    The first call takes about 90 seconds.
    """
    try:
        package = import_module("anny")
    except ImportError:
        raise UserError(
            'body=anny requires the anny package. Run pip install "flame-mdm[body]"'
        ) from None
    model = package.Anny(rig="anny", topology="notoes_collapse10pc", skinning_method="lbs")
    output = model(phenotype_kwargs={**shape, "muscle": 0.5, "proportions": 0.5})
    axes = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # Anny's body has z up and faces -y
    points, heads = (
        output[key][0].detach().numpy() @ axes.T for key in ("rest_vertices", "rest_bone_heads")
    )
    bones = model.bone_labels
    joints = _joints(dict(zip(bones, heads, strict=True)))
    weights = np.zeros((len(points), len(SMPL22)))
    owner = np.array([_owner(bone) for bone in bones])[model.vertex_bone_indices.numpy()]
    for joint, weight in zip(owner.T, model.vertex_bone_weights.detach().numpy().T, strict=True):
        weights[np.arange(len(points)), joint] += weight
    triangles = model.faces.numpy().astype(int)
    sides = points[triangles[:, 1:]] - points[triangles[:, :1]]
    normals = np.zeros_like(points)
    np.add.at(normals, triangles.ravel(), np.repeat(np.cross(sides[:, 0], sides[:, 1]), 3, axis=0))
    colors = _clothes(points - joints[0], weights)
    helped = with_helpers(points, weights, joints)
    return packed(
        points - joints[0], normals, helped, colors, triangles, joints - joints[0], _turns(joints)
    )


def _owner(bone: str) -> int:
    name, _, side = bone.partition(".")
    for part, beginnings in PARTS.items():
        if name.startswith(tuple(beginnings.split())):
            return (
                JOINT[part]
                if part in JOINT
                else JOINT[f"{'left' if side == 'L' else 'right'}_{part}"]
            )
    return JOINT["pelvis"]


def _joints(heads: dict[str, np.ndarray]) -> np.ndarray:
    """Returns SMPL's joints (22, 3) in Anny's rest pose, given the start points of Anny's bones."""
    joints = np.zeros((len(SMPL22), 3))
    for joint, bone in HEADS.items():
        for side in ("left", "right") if joint not in JOINT else ("",):
            joints[JOINT[f"{side}_{joint}" if side else joint]] = heads[
                f"{bone}.{side[0].upper()}" if side else bone
            ]
    joints[JOINT["neck"]] = heads["neck01"] + [0, 0.02, 0]
    hips = joints[JOINT["left_hip"], 1]
    spine = np.array([heads[f"spine0{k}"] for k in (5, 4, 3, 2, 1)] + [heads["neck01"]])
    for joint, share in (
        ("pelvis", 0.137),
        ("spine1", 0.339),
        ("spine2", 0.565),
        ("spine3", 0.653),
    ):
        height = hips + share * (joints[JOINT["neck"], 1] - hips)
        joints[JOINT[joint]] = [0, height, np.interp(height, spine[:, 1], spine[:, 2])]
    for side in ("left", "right"):
        letter = side[0].upper()
        joints[JOINT[f"{side}_collar"]] = (
            heads[f"clavicle.{letter}"] + heads[f"shoulder01.{letter}"]
        ) / 2
    return joints


def _turns(joints: np.ndarray) -> np.ndarray:
    """Returns the world rotations (22, 3, 3) that turn SMPL's rest pose into Anny's rest pose.

    `joints` (22, 3) are in Anny's rest pose. The pelvis, chest and head keep their orientations,
    and the feet stay level. The arms are twisted so that the elbows bend like SMPL's.
    """
    turns = np.tile(np.eye(3), (len(SMPL22), 1, 1))
    usual = np.array(ADULT)
    for parent, joint in SMPL22.edges:
        name = SMPL22.joints[parent]
        along, level = joints[joint] - joints[parent], [1, 0, 1] if name.endswith("ankle") else 1
        if name not in ("pelvis", "spine3"):
            turns[parent] = shortest_turns(usual[joint] * level, along * level)
    for side in ("left", "right"):
        shoulder, elbow, wrist = (
            JOINT[f"{side}_{name}"] for name in ("shoulder", "elbow", "wrist")
        )
        upper, lower = joints[elbow] - joints[shoulder], joints[wrist] - joints[elbow]
        hinge, rest = np.cross(upper, lower), np.cross(usual[elbow], [0, 0, 1])
        turns[shoulder] = orthonormal(upper, hinge).T @ orthonormal(usual[elbow], rest)
        turns[elbow] = turns[wrist] = orthonormal(lower, hinge).T @ orthonormal(usual[wrist], rest)
        turns[JOINT[f"{side}_foot"]] = turns[JOINT[f"{side}_ankle"]]
    return turns


def _clothes(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Returns vertex colors (V, 3), from 0 to 255, based on the joints that the vertices follow.

    The hair is shaped like the mannequin's hair.
    """
    table = np.array([CLOTHES.get(name.split("_")[-1], SHIRT) for name in SMPL22.joints], float)
    colors = weights @ table
    figure, head = mannequin(), weights[:, JOINT["head"]] > 0.5
    usual = figure.points[figure.weights[:, JOINT["head"]] > 0.5]
    skull = points[head]
    alike = usual.min(0) + (skull - skull.min(0)) / np.ptp(skull, 0) * np.ptp(usual, 0)
    colors[head] += smooth(-0.006, 0.006, hairline(alike))[:, None] * (
        np.array(HAIR) - colors[head]
    )
    return colors


def hairline(points: np.ndarray) -> np.ndarray:
    """Returns how far points on the head lie inside the hair region.

    This region is above the forehead and behind the ears.
    """
    above = (points - [0, 0.757, 0.086]) @ np.array([0, 0.84, -0.54])
    behind = np.minimum(
        (points - [0, 0.70, 0.016]) @ np.array([0, 0.10, -0.99]), points[..., 1] - 0.652
    )
    return np.maximum(above, behind)


def smooth(low: float, high: float, value: np.ndarray) -> np.ndarray:
    """Returns 0 below `low`, 1 above `high`, and a smooth transition in between."""
    share = np.clip((value - low) / (high - low), 0, 1)
    return share * share * (3 - 2 * share)


def with_helpers(points: np.ndarray, weights: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Adds helper bones to skinning weights, and returns the new weights (V, 28).

    The upper part of a limb follows a helper bone that takes on only part of the twist about the
    limb's axis. The lower part of a forearm follows a helper bone that takes on part of the wrist's
    twist. `joints` (22, 3) are the joint positions of the mesh.
    """
    columns = []
    for joint, _ in HELPERS:
        bone = joints[SMPL22.parents.index(joint)] - joints[joint]
        part = smooth(0.2, 0.75, (points - joints[joint]) @ bone / (bone @ bone))
        helper = weights[:, joint] * (part if SMPL22.joints[joint].endswith("elbow") else 1 - part)
        weights[:, joint] -= helper
        columns.append(helper)
    return np.concatenate([weights, np.stack(columns, 1)], 1)


def packed(
    points: np.ndarray,
    normals: np.ndarray,
    weights: np.ndarray,
    colors: np.ndarray,
    triangles: np.ndarray,
    joints: np.ndarray,
    turns: np.ndarray,
) -> dict[str, np.ndarray]:
    """Returns the arrays that make up a body file. `Mesh` reads such files.

    Points are stored in units of 1/20 mm, with the pelvis at 0. Normals are stored in units of
    1/127.
    """
    bones, shares = largest_weights(weights)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return {
        "points": np.rint(points * 20000).astype("<i2"),
        "normals": np.rint(normals * 127).astype("i1"),
        "bones": bones,
        "weights": shares,
        "colors": np.rint(colors).astype("u1"),
        "triangles": triangles.astype("<u2"),
        "joints": joints,
        "turns": turns,
    }
