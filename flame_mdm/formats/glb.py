"""glTF 2.0 binary files (.glb): a skinned figure and its motion, for Blender, game engines and web viewers.

Khronos Group, "glTF 2.0 Specification", https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from flame_mdm.files import atomic_write
from flame_mdm.formats.poses import Poses
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.visualize.render import SIDE_COLORS
from flame_mdm.visualize.scene import radii, sides

UNSIGNED_BYTE, UNSIGNED_SHORT, FLOAT = 5121, 5123, 5126
VERTICES, INDICES = 34962, 34963
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
SIDES = 10
"""Number of corners of a limb's cross section."""


def write(path: Path, poses: Poses, fps: float, text: str, name: str) -> None:
    """Writes a .glb file in meters, y up; the rest pose faces +z, as the format requires.

    It contains one node per joint, named as in SMPL, one animation that rotates all nodes and moves the root, with one
    key per frame in seconds, and one mesh of rounded limbs skinned to the joints.
    """
    binary = _Binary()
    rest = poses.rest().numpy()
    position, normal, color, joint, index = _figure(rest)
    weight = np.tile(np.array([1, 0, 0, 0], np.float32), (len(joint), 1))
    bind = np.tile(np.eye(4, dtype=np.float32), (len(rest), 1, 1))
    bind[:, 3, :3] = -rest  # matrices are stored in column-major order
    attributes = {
        "POSITION": binary.add(position, VERTICES, bounds=True),
        "NORMAL": binary.add(normal, VERTICES),
        "COLOR_0": binary.add(color, VERTICES),
        "JOINTS_0": binary.add(joint, VERTICES),
        "WEIGHTS_0": binary.add(weight, VERTICES),
    }
    indices = binary.add(index, INDICES)
    matrices = binary.add(bind.reshape(-1, 16))
    times = binary.add(np.arange(len(poses.root), dtype=np.float32) / np.float32(fps), bounds=True)
    turns = poses.quaternions()[..., [1, 2, 3, 0]].float().numpy()
    curves = [("rotation", node, turns[:, node]) for node in range(len(rest))]
    curves.append(("translation", 0, poses.root.float().numpy()))
    offsets = np.concatenate([rest[:1], poses.offsets.numpy()[1:]])
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": offset.tolist()} for name, offset in zip(SMPL22.joints, offsets, strict=True)
    ]
    for parent, child in SMPL22.edges:
        nodes[parent].setdefault("children", []).append(child)
    nodes.append({"name": "figure", "mesh": 0, "skin": 0})
    document = {
        "asset": {
            "version": "2.0",
            "generator": "flame_mdm",
            "extras": {"fps": fps, "text": text, "unit": "metre", "up": "y"},
        },
        "scene": 0,
        "scenes": [{"nodes": [0, len(rest)]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}}],
        "skins": [{"joints": list(range(len(rest))), "skeleton": 0, "inverseBindMatrices": matrices}],
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


class _Binary:
    """The binary part of the file: concatenated arrays, with buffer views and accessors that describe them."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: np.ndarray, target: int | None = None, bounds: bool = False) -> int:
        """Appends numbers (N,) or (N, K) and returns the index of their accessor."""
        rows = array.reshape(len(array), -1)
        component = {"u1": UNSIGNED_BYTE, "u2": UNSIGNED_SHORT, "f4": FLOAT}[rows.dtype.str[1:]]
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": rows.nbytes}
        self.views.append(view if target is None else {**view, "target": target})
        accessor: dict[str, Any] = {"bufferView": len(self.views) - 1, "componentType": component}
        accessor |= {"count": len(rows), "type": KINDS[rows.shape[1]]}
        if bounds:
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(accessor)
        self.data += rows.tobytes()
        self.data += b"\0" * (-len(self.data) % 4)
        return len(self.accessors) - 1


def _figure(rest: np.ndarray) -> tuple[np.ndarray, ...]:
    """Returns the limbs of the rest pose: positions, normals, linear colors, joint (N, 4) of each vertex, triangles."""
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
    starts = np.cumsum([0] + [len(position) for _, _, position, _, _ in limbs])
    position = np.concatenate([position for _, _, position, _, _ in limbs]).astype("<f4")
    normal = np.concatenate([normal for _, _, _, normal, _ in limbs]).astype("<f4")
    color, moved = np.ones((len(position), 4), "<f4"), np.zeros((len(position), 4), "u1")
    for (joint, side, *_), start, end in zip(limbs, starts[:-1], starts[1:], strict=True):
        color[start:end, :3] = (np.array(SIDE_COLORS[side]) / 255) ** 2.2
        moved[start:end, 0] = joint
    index = np.concatenate([start + triangles for (*_, triangles), start in zip(limbs, starts[:-1], strict=True)])
    return position, normal, color, moved, index.astype("<u2").ravel()


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
