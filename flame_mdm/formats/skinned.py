"""A skinned figure and its motion as a .glb file, for Blender, game engines and web viewers."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from flame_mdm.formats.glb import Binary, quaternions
from flame_mdm.formats.poses import Poses
from flame_mdm.formats.retarget import retarget
from flame_mdm.formats.rig import Rig
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.visualize.body import ANCHORS, FittedBody
from flame_mdm.visualize.render import SIDE_COLORS
from flame_mdm.visualize.scene import radii, sides

VERTICES, INDICES = 34962, 34963  # uses of a buffer view
SIDES = 10  # number of corners of a limb's cross section


def write(path: Path, poses: Poses, rig: Rig, fps: float, text: str, name: str, body: FittedBody | None = None) -> None:
    """Writes a .glb file of the motion in meters, y up; the rest pose faces +z, as the format requires.

    It contains one node per joint, one animation that rotates all nodes and moves the hips, with one key per frame in
    seconds, and one mesh skinned to the joints: a body, stored in an A-pose, or rounded limbs if it is None. The node
    above the joints lifts a body by the thickness of its soles; its toes bend as in pictures. The rig has the bone
    lengths of the motion. The animation is called `text`, or `name` if there is none.
    """
    binary = Binary()
    rest = poses.rest().numpy()
    position, normal, color, joint, weight, index, bind = _limbs(rest) if body is None else _skin(body)
    attributes = {
        "POSITION": binary.add(position, VERTICES, bounds=True),
        "NORMAL": binary.add(normal, VERTICES),
        "COLOR_0": binary.add(color, VERTICES, normalized=True),
        "JOINTS_0": binary.add(joint, VERTICES),
        "WEIGHTS_0": binary.add(weight, VERTICES, normalized=True),
    }
    indices = binary.add(index, INDICES)
    skinned = [rig.sources.index(number) for number in range(len(SMPL22))]
    bind[:, :3] = rig.neutral[skinned].mT @ bind[:, :3]
    others = [joint for joint, source in enumerate(rig.sources) if source < 0]
    resting = np.tile(np.eye(4, dtype="f4"), (len(others), 1, 1))
    resting[:, :3, :3] = rig.turns[others].mT
    resting[:, :3, 3] = -(rig.turns[others].mT @ rig.positions[others, :, None])[..., 0]
    bind = np.concatenate([bind, resting])
    matrices = binary.add(bind.mT.reshape(-1, 16))  # matrices are stored in column-major order
    moved = poses if body is None else Poses(poses.offsets, torch.from_numpy(body.local()), poses.root)
    turns, root = retarget(moved, rig)
    turns = quaternions(np.concatenate([rig.rest()[None], turns]))
    curves = [("rotation", node, turns[1:, node]) for node in range(len(rig.joints))]
    curves.append(("translation", rig.hips, root.astype("f4")))
    animated = binary.animation(text or name or "motion", fps, curves)
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": offset.tolist(), "rotation": turn.tolist()}
        for name, offset, turn in zip(rig.joints, rig.offsets(), turns[0], strict=True)
    ]
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(joint)
    nodes.append({"name": "figure", "mesh": 0, "skin": 0})
    nodes.append({"name": "lifted", "children": [0], "translation": [0, body.lift if body else 0, 0]})
    extras = {"fps": fps, "text": text, "unit": "metre", "up": "y"}
    document = {
        "asset": {"version": "2.0", "generator": "flame_mdm", "extras": extras},
        "scene": 0,
        "scenes": [{"nodes": [len(rig.joints), len(rig.joints) + 1]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}}],
        "skins": [{"joints": skinned + others, "skeleton": 0, "inverseBindMatrices": matrices}],
        "animations": [animated],
    }
    binary.save(path, document)


def _skin(body: FittedBody) -> tuple[np.ndarray, ...]:
    """Returns the body in its stored pose, lifted onto the floor: see `_limbs`. Helper bones join their joints."""
    mesh, floor = body.mesh, np.array([0, body.points[:, 1].min(), 0])
    weights = mesh.weights[:, : len(SMPL22)].copy()
    np.add.at(weights.T, list(ANCHORS[len(SMPL22) :]), mesh.weights[:, len(SMPL22) :].T)
    joint = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    weight = np.rint(255 * np.take_along_axis(weights, joint, 1)).astype(int)
    weight[:, 0] += 255 - weight.sum(1)
    bind = np.tile(np.eye(4), (len(SMPL22), 1, 1))
    bind[:, :3, :3] = body.neutral @ mesh.turns[: len(SMPL22)].mT
    bind[:, :3, 3] = -(bind[:, :3, :3] @ (body.joints - floor)[..., None])[..., 0]
    return (
        (body.points - floor).astype("<f4"),
        mesh.normals.astype("<f4"),
        _linear(mesh.colors),
        np.where(weight > 0, joint, 0).astype("u1"),
        weight.astype("u1"),
        mesh.triangles.astype("<u2").ravel(),
        bind.astype("<f4"),
    )


def _linear(colors: np.ndarray) -> np.ndarray:
    """Returns linear colors (N, 4) uint8 with alpha of colors (N, 3) from 0 to 255 as on screens."""
    linear = np.rint(255 * (np.asarray(colors) / 255) ** 2.2)
    return np.concatenate([linear, np.full((len(linear), 1), 255)], 1).astype("u1")


def _limbs(rest: np.ndarray) -> tuple[np.ndarray, ...]:
    """Returns the limbs of the rest pose: positions, normals, colors, joints, weights, triangles, inverse binds."""
    thickness, side_of, parents = radii(SMPL22), sides(SMPL22), SMPL22.parents
    limbs = []
    for joint, parent in enumerate(parents):
        if parent >= 0:
            side = side_of[joint] if side_of[joint] == side_of[parent] else 0
            thick = min(thickness[parent], 1.35 * thickness[joint])
            limbs.append((parent, side, *_limb(rest[parent], rest[joint], thick, thickness[joint])))
            if SMPL22.joints[joint] == "head":
                up = rest[joint] - rest[parent]
                up /= np.linalg.norm(up)
                limbs.append((joint, 0, *_limb(rest[joint] + 0.05 * up, rest[joint] + 0.11 * up, 0.08, 0.09)))
    counts = [len(position) for _, _, position, _, _ in limbs]
    starts = np.cumsum([0, *counts[:-1]])
    color = np.repeat(np.array([SIDE_COLORS[side] for _, side, *_ in limbs]), counts, axis=0)
    triangles = np.concatenate([start + corners for (*_, corners), start in zip(limbs, starts, strict=True)])
    moved, weight = np.zeros((2, sum(counts), 4), "u1")
    moved[:, 0], weight[:, 0] = np.repeat([joint for joint, *_ in limbs], counts), 255
    bind = np.tile(np.eye(4, dtype="<f4"), (len(rest), 1, 1))
    bind[:, :3, 3] = -rest
    return (
        np.concatenate([position for _, _, position, _, _ in limbs]).astype("<f4"),
        np.concatenate([normal for _, _, _, normal, _ in limbs]).astype("<f4"),
        _linear(color),
        moved,
        weight,
        triangles.astype("<u2").ravel(),
        bind,
    )


def _limb(a: np.ndarray, b: np.ndarray, radius_a: float, radius_b: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns a limb with round ends: positions (N, 3), normals (N, 3), outward-facing triangles (T, 3)."""
    along = (b - a) / np.linalg.norm(b - a)
    side = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    side /= np.linalg.norm(side)
    angles = 2 * np.pi * np.arange(SIDES) / SIDES
    around = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(along, side)
    latitudes = np.radians([-89, -45, 0, 0, 45, 89])
    normals = np.cos(latitudes)[:, None, None] * around + np.sin(latitudes)[:, None, None] * along
    centers, radii = np.array([a, a, a, b, b, b]), np.array([radius_a] * 3 + [radius_b] * 3)
    positions = centers[:, None] + radii[:, None, None] * normals
    ring, corner = np.meshgrid(np.arange(len(latitudes) - 1), np.arange(SIDES), indexing="ij")
    this, next_ = ring * SIDES + corner, ring * SIDES + (corner + 1) % SIDES
    above, above_next = this + SIDES, next_ + SIDES
    triangles = np.stack([this, next_, above_next, this, above_next, above], -1).reshape(-1, 3)
    return positions.reshape(-1, 3), normals.reshape(-1, 3), triangles
