"""glTF 2.0 binary files (.glb): a skinned figure and its motion, for Blender, game engines and web viewers.

Khronos Group, "glTF 2.0 Specification", https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from flame_mdm.errors import first_line
from flame_mdm.formats.poses import Poses
from flame_mdm.formats.retarget import Rig, retarget
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.safe_io import MEBIBYTE, atomic_write, parse_json, regular_file
from flame_mdm.visualize.body import ANCHORS, Figure
from flame_mdm.visualize.render import SIDE_COLORS
from flame_mdm.visualize.scene import radii, sides

UNSIGNED_BYTE, UNSIGNED_SHORT, FLOAT = 5121, 5123, 5126
VERTICES, INDICES = 34962, 34963
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
SIDES = 10
"""Number of corners of a limb's cross section."""
LIMIT = 512 * MEBIBYTE
"""Maximum size of a file that is read."""


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
    resting[:, :3, 3] = -(rig.turns[others].mT @ rig.places[others, :, None])[..., 0]
    bind = np.concatenate([bind, resting])
    matrices = binary.add(bind.mT.reshape(-1, 16))  # matrices are stored in column-major order
    moved = poses if body is None else Poses(poses.offsets, torch.from_numpy(body.local()), poses.root)
    turns, root = retarget(moved, rig)
    turns = quaternions(np.concatenate([rig.rest()[None], turns]))
    curves = [("rotation", node, turns[1:, node]) for node in range(len(rig.joints))]
    curves.append(("translation", rig.hips, root.astype("f4")))
    animated = animation(binary, text or name or "motion", fps, curves)
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
        "animations": [animated],
        "accessors": binary.accessors,
        "bufferViews": binary.views,
        "buffers": [{"byteLength": len(binary.data)}],
    }
    save(path, document, binary.data)


def animation(binary: Binary, name: str, fps: float, curves: Sequence[tuple[str, int, np.ndarray]]) -> dict[str, Any]:
    """Returns an animation of properties of nodes: property, node, values (F, K) in frames."""
    times = binary.add(np.arange(len(curves[0][2]), dtype=np.float32) / np.float32(fps), bounds=True)
    return {
        "name": name,
        "samplers": [{"input": times, "output": binary.add(values)} for _, _, values in curves],
        "channels": [
            {"sampler": sampler, "target": {"node": node, "path": kind}}
            for sampler, (kind, node, _) in enumerate(curves)
        ],
    }


def save(path: Path, document: dict[str, Any], data: bytes | bytearray) -> None:
    """Writes a .glb file with a document and a binary part, whose length is a multiple of 4."""
    head = json.dumps(document, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    chunks = struct.pack("<I4s", len(head), b"JSON") + head + struct.pack("<I4s", len(data), b"BIN\0") + bytes(data)
    with atomic_write(path) as temporary:
        temporary.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """Converts rotations (F, ..., 3, 3) to float32 quaternions x, y, z, w without sign changes between frames."""
    turns = rotation.continuous(rotation.matrix_to_quaternion(torch.from_numpy(matrices)), dim=0)
    return turns[..., [1, 2, 3, 0]].float().numpy()


@dataclass(frozen=True, eq=False)
class Glb:
    """A .glb file that is read. N nodes, in an order in which parents precede their children.

    Attributes:
        document: the JSON part.
        data: the binary part.
        nodes: index of each node in the document.
        names: name of each node.
        parents: number of each node's parent, -1 for a root.
        worlds: (N, 4, 4), coordinates of each node to those of the world.
        skins: for each skin, the numbers of its joints, their inverse bind matrices (K, 4, 4), which may be missing,
            and the corners (C, 3) of boxes around its meshes.
    """

    document: dict[str, Any]
    data: bytes
    nodes: tuple[int, ...]
    names: tuple[str, ...]
    parents: tuple[int, ...]
    worlds: np.ndarray
    skins: tuple[tuple[list[int], np.ndarray, np.ndarray], ...]


def read(path: Path) -> Glb:
    """Reads nodes and skins of a .glb file.

    Raises:
        FileNotFoundError: the file does not exist.
        UserError: the path is not a regular file, or the file is too large.
        ValueError: the file is damaged, or not a .glb file of glTF 2.0.
    """
    regular_file(path, LIMIT)
    content = path.read_bytes()
    if content[:4] != b"glTF":
        raise ValueError(f"{path}: not a .glb file")
    try:
        (size,) = struct.unpack_from("<I", content, 12)
        document = parse_json(content[20 : 20 + size])
        data = content[28 + size :]
        nodes = document["nodes"]
        below = [node.get("children", []) for node in nodes]
        above = {child: number for number, children in enumerate(below) for child in children}
        order = [number for number in range(len(nodes)) if number not in above]
        if len(above) != sum(map(len, below)):
            raise ValueError("a node has two parents")
        for number in order:
            order += below[number]
        if len(order) != len(nodes):
            raise ValueError("a node is its own parent")
        rank = {number: k for k, number in enumerate(order)}
        parents = tuple(rank[above[number]] if number in above else -1 for number in order)
        worlds = np.stack([_matrix(nodes[number]) for number in order])
        for k, parent in enumerate(parents):
            worlds[k] = worlds[parent] @ worlds[k] if parent >= 0 else worlds[k]
        skins = tuple(_read_skin(document, data, number, rank) for number in range(len(document.get("skins", ()))))
        names = tuple(str(nodes[number].get("name", f"node {number}")) for number in order)
        finite = np.isfinite(worlds).all() and all(np.isfinite(part).all() for _, *parts in skins for part in parts)
        if not finite or any("uri" in buffer for buffer in document.get("buffers", [])):
            raise ValueError("numbers are not finite" if not finite else "its data are in another file")
    except (KeyError, TypeError, IndexError, AttributeError, OverflowError, struct.error, ValueError) as error:
        raise ValueError(f"{path}: damaged, or not glTF 2.0 in one file: {first_line(error)}") from error
    return Glb(document, data, tuple(order), names, parents, worlds, skins)


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """Returns the matrix (4, 4) from a node's coordinates to those of its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    made = np.eye(4)
    made[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix() * node.get("scale", [1, 1, 1])
    made[:3, 3] = node.get("translation", [0, 0, 0])
    return made


def _read_skin(
    document: dict[str, Any], data: bytes, number: int, rank: dict[int, int]
) -> tuple[list[int], np.ndarray, np.ndarray]:
    skin, accessors = document["skins"][number], document["accessors"]
    joints = [rank[joint] for joint in skin["joints"]]
    binds = np.zeros((0, 4, 4))
    if "inverseBindMatrices" in skin:
        accessor = accessors[skin["inverseBindMatrices"]]
        view = document["bufferViews"][accessor["bufferView"]]
        if accessor["componentType"] != FLOAT or view.get("byteStride", 64) != 64:
            raise ValueError("inverse bind matrices are not floats")
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        values = np.frombuffer(data, "<f4", 16 * len(joints), start)
        binds = values.reshape(-1, 4, 4).mT.astype(float)
    corners = [np.zeros((0, 3))]
    for node in document["nodes"]:
        for part in document["meshes"][node["mesh"]]["primitives"] if node.get("skin") == number else ():
            accessor = accessors[part["attributes"]["POSITION"]]
            whole = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535}.get(accessor["componentType"], 1)
            box = np.array([accessor["min"], accessor["max"]], float) / (whole if accessor.get("normalized") else 1)
            corners.append(np.stack([box[[i, j, k], [0, 1, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]))
    return joints, binds, np.concatenate(corners)


class Binary:
    """The binary part of the file: concatenated arrays, with buffer views and accessors that describe them."""

    def __init__(self, data: bytes = b"", views: Sequence[Any] = (), accessors: Sequence[Any] = ()) -> None:
        self.data = bytearray(data) + b"\0" * (-len(data) % 4)
        self.views: list[dict[str, int]] = list(views)
        self.accessors: list[dict[str, Any]] = list(accessors)

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
