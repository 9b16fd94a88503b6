"""glTF 2.0 binary files (.glb): a skinned figure and its motion, for Blender, game engines and web viewers.

Khronos Group, "glTF 2.0 Specification", https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flame_mdm.files import atomic_write
from flame_mdm.formats.poses import Poses
from flame_mdm.formats.retarget import Rig, retarget
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.visualize.body import ANCHORS, Figure
from flame_mdm.visualize.render import SIDE_COLORS
from flame_mdm.visualize.scene import radii, sides

UNSIGNED_BYTE, UNSIGNED_SHORT, FLOAT = 5121, 5123, 5126
VERTICES, INDICES = 34962, 34963
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
SIDES = 10
"""Number of corners of a limb's cross section."""


def write(path: Path, poses: Poses, rig: Rig, fps: float, text: str, name: str, body: Figure | None = None) -> None:
    """Writes a .glb file in meters, y up; the rest pose faces +z, as the format requires.

    It contains one node per joint, one animation that rotates all nodes and moves the hips, with one key per frame in
    seconds, and one mesh skinned to the joints: a body, stored in an A-pose, or rounded limbs. The node above the
    joints lifts a body by the thickness of its soles; its toes bend as in pictures.

    Args:
        path: the file.
        poses: the motion.
        rig: the skeleton, with the bone lengths of the motion.
        fps: frames per second.
        text: the caption.
        name: of the animation, if there is no caption.
        body: the body of this motion; None = rounded limbs.
    """
    binary = _Binary()
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
    resting[:, :3, 3] = -(rig.turns[others].mT @ rig.places[others, :, None])[..., 0]
    bind = np.concatenate([bind, resting])
    matrices = binary.add(bind.mT.reshape(-1, 16))  # matrices are stored in column-major order
    times = binary.add(np.arange(len(poses.root), dtype=np.float32) / np.float32(fps), bounds=True)
    moved = poses if body is None else Poses(poses.offsets, torch.from_numpy(body.local()), poses.root)
    turns, root = retarget(moved, rig)
    turns = quaternions(np.concatenate([rig.rest()[None], turns]))
    curves = [("rotation", node, turns[1:, node]) for node in range(len(rig.joints))]
    curves.append(("translation", rig.hips, root.astype("f4")))
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": offset.tolist(), "rotation": turn.tolist()}
        for name, offset, turn in zip(rig.joints, rig.offsets(), turns[0], strict=True)
    ]
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(joint)
    nodes.append({"name": "figure", "mesh": 0, "skin": 0})
    nodes.append({"name": "lifted", "children": [0], "translation": [0, body.lift if body else 0, 0]})
    document = {
        "asset": {
            "version": "2.0",
            "generator": "flame_mdm",
            "extras": {"fps": fps, "text": text, "unit": "metre", "up": "y"},
        },
        "scene": 0,
        "scenes": [{"nodes": [len(rig.joints), len(rig.joints) + 1]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}}],
        "skins": [{"joints": skinned + others, "skeleton": 0, "inverseBindMatrices": matrices}],
        "animations": [
            {
                "name": text or name or "motion",
                "samplers": [{"input": times, "output": binary.add(values)} for _, _, values in curves],
                "channels": [
                    {"sampler": sampler, "target": {"node": node, "path": kind}}
                    for sampler, (kind, node, _) in enumerate(curves)
                ],
            }
        ],
        "accessors": binary.accessors,
        "bufferViews": binary.views,
        "buffers": [{"byteLength": len(binary.data)}],
    }
    head = json.dumps(document, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    chunks = struct.pack("<I4s", len(head), b"JSON") + head
    chunks += struct.pack("<I4s", len(binary.data), b"BIN\0") + bytes(binary.data)
    with atomic_write(path) as temporary:
        temporary.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """Converts rotations (F, ..., 3, 3) to float32 quaternions x, y, z, w without sign changes between frames."""
    turns = rotation.continuous(rotation.matrix_to_quaternion(torch.from_numpy(matrices)), dim=0)
    return turns[..., [1, 2, 3, 0]].float().numpy()


class _Binary:
    """The binary part of the file: concatenated arrays, with buffer views and accessors that describe them."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: np.ndarray, target: int | None = None, bounds: bool = False, normalized: bool = False) -> int:
        """Appends numbers (N,) or (N, K) and returns the index of their accessor; `normalized`: bytes mean 0 to 1."""
        rows = array.reshape(len(array), -1)
        component = {"u1": UNSIGNED_BYTE, "u2": UNSIGNED_SHORT, "f4": FLOAT}[rows.dtype.str[1:]]
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": rows.nbytes}
        self.views.append(view if target is None else {**view, "target": target})
        accessor: dict[str, Any] = {"bufferView": len(self.views) - 1, "componentType": component}
        accessor |= {"count": len(rows), "type": KINDS[rows.shape[1]]}
        if normalized:
            accessor["normalized"] = True
        if bounds:
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(accessor)
        self.data += rows.tobytes()
        self.data += b"\0" * (-len(self.data) % 4)
        return len(self.accessors) - 1


def _skin(body: Figure) -> tuple[np.ndarray, ...]:
    """Returns the body in its stored pose, lifted onto the floor: see `_limbs`. Helper bones join their joints."""
    figure, floor = body.mesh, np.array([0, body.points[:, 1].min(), 0])
    weights = figure.weights[:, : len(SMPL22)].copy()
    np.add.at(weights.T, list(ANCHORS[len(SMPL22) :]), figure.weights[:, len(SMPL22) :].T)
    joint = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    weight = np.rint(255 * np.take_along_axis(weights, joint, 1)).astype(int)
    weight[:, 0] += 255 - weight.sum(1)
    bind = np.tile(np.eye(4), (len(SMPL22), 1, 1))
    bind[:, :3, :3] = body.neutral @ figure.turns[: len(SMPL22)].mT
    bind[:, :3, 3] = -(bind[:, :3, :3] @ (body.joints - floor)[..., None])[..., 0]
    return (
        (body.points - floor).astype("<f4"),
        figure.normals.astype("<f4"),
        _linear(figure.colors),
        np.where(weight > 0, joint, 0).astype("u1"),
        weight.astype("u1"),
        figure.triangles.astype("<u2").ravel(),
        bind.astype("<f4"),
    )


def _linear(colors: np.ndarray) -> np.ndarray:
    """Returns linear colors (N, 4) uint8 with alpha of colors (N, 3) from 0 to 255 as on screens."""
    linear = np.rint(255 * (np.asarray(colors) / 255) ** 2.2)
    return np.concatenate([linear, np.full((len(linear), 1), 255)], 1).astype("u1")


def _limbs(rest: np.ndarray) -> tuple[np.ndarray, ...]:
    """Returns the limbs of the rest pose: a mesh with N corners.

    Positions and normals (N, 3), linear colors (N, 4), joints and weights (N, 4), triangles, inverse bind matrices
    (22, 4, 4).
    """
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
        np.concatenate([start + triangles for (*_, triangles), start in zip(limbs, starts, strict=True)])
        .astype("<u2")
        .ravel(),
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
