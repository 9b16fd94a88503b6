"""glTF 2.0 binary files (.glb).

Readers receive a validated document, and writers use `Binary` for the binary part. Source: Khronos
Group, "glTF 2.0 Specification", https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

import json
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError
from scipy.spatial.transform import Rotation

from flame_mdm.errors import UserError, first_line
from flame_mdm.representations import rotation
from flame_mdm.safe_io import MEBIBYTE, atomic_write, parse_json, regular_file

UNSIGNED_BYTE, UNSIGNED_SHORT, FLOAT = 5121, 5123, 5126
# For each integer type, the integer that represents 1 in normalized accessors
WHOLE = {
    5120: 127,
    UNSIGNED_BYTE: 255,
    5122: 32767,
    UNSIGNED_SHORT: 65535,
}
COMPONENTS = {
    5120: "<i1",
    UNSIGNED_BYTE: "<u1",
    5122: "<i2",
    UNSIGNED_SHORT: "<u2",
    5125: "<u4",
    FLOAT: "<f4",
}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}  # numbers per item
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
# Maximum size of a file that is read
LIMIT = 512 * MEBIBYTE
# Maximum size in bytes of the JSON part, which takes several times as much memory once it is parsed
DOCUMENT_LIMIT = 16 * MEBIBYTE
# Maximum number of nodes, and of items in any other list
MAX_NODES, MAX_ITEMS = 4096, 65_536
# Maximum absolute value of a coordinate or matrix entry
LARGEST = 1e9
# For each corner of a box (8, 3), whether each coordinate is the minimum (0) or the maximum (1)
CORNERS = np.array([*product((0, 1), repeat=3)])
HARMLESS = re.compile(r"KHR_(materials|texture|lights|mesh|draco)_|EXT_texture_|VRM")
"""Extensions that a character may require, because they do not change nodes, skins or bounds."""

Item = TypeVar("Item")
# Index in another list, or number of bytes. A missing index is -1.
Index = Annotated[int, Field(ge=0, lt=2**40)]
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Items = Annotated[list[Item], Field(max_length=MAX_ITEMS), FailFast()]
NodeItems = Annotated[list[Item], Field(max_length=MAX_NODES), FailFast()]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]


class _Object(BaseModel):
    """Base class for the parts of the document that are read.

    Types are checked strictly. Keys for which no field is defined are ignored here, but copied
    unchanged when the file is written.
    """

    model_config = ConfigDict(strict=True)


class _Node(_Object):
    name: Annotated[str, Field(max_length=1000)] = ""
    children: NodeItems[Index] = []
    mesh: Index = -1
    skin: Index = -1
    matrix: Annotated[list[Number], Field(min_length=16, max_length=16)] | None = None
    translation: Vector = [0, 0, 0]
    rotation: Annotated[list[Number], Field(min_length=4, max_length=4)] = [0, 0, 0, 1]
    scale: Vector = [1, 1, 1]

    def local(self) -> np.ndarray:
        """Returns the matrix (4, 4) from the node's coordinates to its parent's coordinates."""
        if self.matrix is not None:
            return np.array(self.matrix, float).reshape(4, 4).T
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(self.rotation).as_matrix() * self.scale
        matrix[:3, 3] = self.translation
        return matrix


class _Primitive(_Object):
    attributes: dict[str, Index]


class _Mesh(_Object):
    primitives: Items[_Primitive]


class _Skin(_Object):
    joints: Annotated[list[Index], Field(min_length=1, max_length=MAX_NODES)]
    inverseBindMatrices: Index = -1


class _Buffer(_Object):
    uri: None = None


class _View(_Object):
    buffer: Index
    byteOffset: Index = 0
    byteStride: Index = 0


class _Accessor(_Object):
    bufferView: Index = -1
    byteOffset: Index = 0
    componentType: Index
    type: str
    count: Index
    normalized: bool = False
    min: Annotated[list[Number], Field(max_length=16)] = []
    max: Annotated[list[Number], Field(max_length=16)] = []


class _Asset(_Object):
    version: Annotated[str, Field(pattern=r"^2\.\d+$")]


class _Document(_Object):
    asset: _Asset
    extensionsRequired: Annotated[list[str], Field(max_length=256)] = []
    nodes: NodeItems[_Node] = []
    meshes: NodeItems[_Mesh] = []
    skins: Annotated[list[_Skin], Field(max_length=256), FailFast()] = []
    buffers: NodeItems[_Buffer] = []
    bufferViews: Items[_View] = []
    accessors: Items[_Accessor] = []
    animations: NodeItems[dict[str, Any]] = []


def _item(items: Sequence[Item], index: int, name: str) -> Item:
    """Returns an item from a list in the document, or raises `ValueError` if it does not exist."""
    if not 0 <= index < len(items):
        raise ValueError(
            f"{name}: index {index} does not exist, because there are only {len(items)}"
        )
    return items[index]


def _ordered(nodes: Sequence[_Node]) -> tuple[list[int], dict[int, int]]:
    """Returns the node indices, parents first, and a mapping from child nodes to their parents.

    Raises:
        ValueError: If the nodes do not form trees.
    """
    above = {child: number for number, node in enumerate(nodes) for child in node.children}
    if len(above) != sum(len(node.children) for node in nodes):
        raise ValueError("a node has two parents")
    order = [number for number in range(len(nodes)) if number not in above]
    for number in order:
        order += _item(nodes, number, "child").children
    if len(order) != len(nodes):
        raise ValueError("a node is its own parent")
    return order, above


@dataclass(frozen=True, eq=False)
class Skin:
    """A skin in a .glb file.

    Attributes:
        joints: indices of the K joints.
        binds: (K, 4, 4), inverse bind matrices, or (0, 4, 4) if the file contains none.
        corners: (C, 3), corners of the bounding boxes of the skinned meshes.
    """

    joints: list[int]
    binds: np.ndarray
    corners: np.ndarray


@dataclass(frozen=True, eq=False)
class Glb:
    """A valid .glb file with N nodes, in which parents precede their children."""

    # The JSON part, with the lists `buffers`, `bufferViews` and `accessors`
    document: dict[str, Any]
    # The binary part
    data: bytes
    # Index of each node in the document
    nodes: tuple[int, ...]
    # Name of each node
    names: tuple[str, ...]
    # Index of each node's parent, or -1 for a root
    parents: tuple[int, ...]
    # (N, 4, 4), from each node's coordinates to its parent's coordinates
    locals: np.ndarray
    # (N, 4, 4), from each node's coordinates to the world
    worlds: np.ndarray
    # Skins of the meshes
    skins: tuple[Skin, ...]


def read(path: Path) -> Glb:
    """Reads a .glb file.

    Raises:
        UserError: If the file is too large or damaged, or if it is not glTF 2.0 in a single file.
    """
    regular_file(path, LIMIT)
    content = path.read_bytes()
    if content[:4] != b"glTF":
        raise UserError(f"{path}: not a .glb file")
    try:
        document, data = _chunks(content)
        parts = _Document.model_validate(document)
        if unread := [name for name in parts.extensionsRequired if not HARMLESS.match(name)]:
            raise UserError(
                f"it requires {unread[0][:80]}, which is not supported. Export the file without this compression"
            )
        order, above = _ordered(parts.nodes)
        rank = np.argsort(order).tolist()  # index in the document -> index in `Glb`
        parents = tuple(rank[above[number]] if number in above else -1 for number in order)
        with np.errstate(all="ignore"):
            local = np.array([parts.nodes[number].local() for number in order]).reshape(-1, 4, 4)
            worlds = local.copy()
            for k, parent in enumerate(parents):
                worlds[k] = worlds[parent] @ local[k] if parent >= 0 else local[k]
        if not (np.abs(worlds) <= LARGEST).all():
            raise ValueError("numbers are not finite, or too large")
        skins = _skins(parts, data, rank)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except (ValueError, struct.error) as error:
        reason = first_line(error)
        if isinstance(error, ValidationError):
            first = error.errors(include_url=False, include_input=False)[0]
            reason = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise UserError(
            f"{path} is damaged, or is not a single glTF 2.0 file (.glb): {reason}"
        ) from error
    names = tuple(parts.nodes[number].name or f"node {number}" for number in order)
    for name in ("buffers", "bufferViews", "accessors"):
        document.setdefault(name, [])
    return Glb(document, data, tuple(order), names, parents, local, worlds, skins)


def _chunks(content: bytes) -> tuple[Any, bytes]:
    """Returns the parsed document and the binary part of a file."""
    version, _, size, kind = struct.unpack_from("<III4s", content, 4)
    if version != 2 or kind != b"JSON" or size > DOCUMENT_LIMIT:
        raise ValueError(f"it has version {version}, and its first chunk {kind!r} has {size} bytes")
    if len(content) < 20 + size:
        raise ValueError("the file ends too early")
    document = parse_json(content[20 : 20 + size])
    if len(content) < 28 + size:
        return document, b""
    length, kind = struct.unpack_from("<I4s", content, 20 + size)
    if kind != b"BIN\0" or len(content) < 28 + size + length:
        raise ValueError(
            f"its second chunk {kind!r} should have {length} bytes, but the file is shorter"
        )
    return document, content[28 + size : 28 + size + length]


def _skins(parts: _Document, data: bytes, rank: Sequence[int]) -> tuple[Skin, ...]:
    """Returns the skins. `rank` converts node indices in the document to indices in `Glb`."""
    corners: list[list[np.ndarray]] = [[np.zeros((0, 3))] for _ in parts.skins]
    for node in (node for node in parts.nodes if min(node.mesh, node.skin) >= 0):
        boxes = _item(corners, node.skin, "skin")
        boxes += [
            _corners(parts, primitive)
            for primitive in _item(parts.meshes, node.mesh, "mesh").primitives
        ]
        if sum(map(len, corners)) > MAX_ITEMS:
            raise ValueError(f"it has more than {MAX_ITEMS:,} parts of skinned meshes")
    skins = []
    for skin, boxes in zip(parts.skins, corners, strict=True):
        joints = [_item(rank, joint, "joint of a skin") for joint in skin.joints]
        skins.append(Skin(joints, _binds(parts, skin, data), np.concatenate(boxes)))
    return tuple(skins)


def _corners(parts: _Document, primitive: _Primitive) -> np.ndarray:
    """Returns the corners (8, 3) of the bounding box of a mesh part."""
    accessor = _item(parts.accessors, primitive.attributes.get("POSITION", -1), "POSITION")
    if {len(accessor.min), len(accessor.max)} != {3}:
        raise ValueError("a mesh has no bounds for its positions")
    box = np.array([accessor.min, accessor.max], float)
    box /= WHOLE.get(accessor.componentType, 1) if accessor.normalized else 1
    return box[CORNERS, np.arange(3)]


def _binds(parts: _Document, skin: _Skin, data: bytes) -> np.ndarray:
    """Returns a skin's inverse bind matrices (K, 4, 4), or an array (0, 4, 4) if there are none."""
    if skin.inverseBindMatrices < 0:
        return np.zeros((0, 4, 4))
    accessor = _item(parts.accessors, skin.inverseBindMatrices, "inverseBindMatrices")
    view = _item(parts.bufferViews, accessor.bufferView, "bufferView")
    fits = (accessor.componentType, accessor.type) == (FLOAT, "MAT4") and accessor.count >= len(
        skin.joints
    )
    if view.buffer or view.byteStride not in (0, 64) or not fits:
        raise ValueError(
            "inverse bind matrices are not floats, or there are fewer matrices than joints"
        )
    values = np.frombuffer(
        data, "<f4", 16 * len(skin.joints), view.byteOffset + accessor.byteOffset
    )
    with np.errstate(all="ignore"):  # checked below
        binds = values.reshape(-1, 4, 4).mT.astype(float)
    if not ((np.abs(binds) <= LARGEST).all() and (np.abs(np.linalg.det(binds)) > 1e-30).all()):
        raise ValueError("inverse bind matrices are not finite, or have no inverse")
    return binds


def numbers(file: Glb, accessor: int, kind: str) -> np.ndarray:
    """Returns an accessor's numbers (N, C) as float64.

    Normalized integers are scaled so that the largest integer becomes 1.

    Args:
        file: the file.
        accessor: index of the accessor in the document.
        kind: required type of the accessor, such as "VEC3".

    Raises:
        ValueError: If the file contains no such accessor, or if the accessor is invalid.
    """
    item = _Accessor.model_validate(_item(file.document["accessors"], accessor, "accessor"))
    view = _View.model_validate(_item(file.document["bufferViews"], item.bufferView, "bufferView"))
    if item.type != kind or item.componentType not in COMPONENTS or view.buffer:
        raise ValueError(f"accessor {accessor}: not {kind} in the binary part of the file")
    dtype = np.dtype(COMPONENTS[item.componentType])
    width = WIDTHS[kind]
    stride = view.byteStride or dtype.itemsize * width
    start = view.byteOffset + item.byteOffset
    size = stride * (item.count - 1) + dtype.itemsize * width if item.count else 0
    if stride < dtype.itemsize * width or start + size > len(file.data):
        raise ValueError(f"accessor {accessor}: ends outside the file")
    values = np.ndarray(
        (item.count, width), dtype, file.data, start, (stride, dtype.itemsize)
    ).astype(float)
    if item.normalized and item.componentType in WHOLE:
        values = np.maximum(values / WHOLE[item.componentType], -1)
    return values


class Binary:
    """The binary part of a file: concatenated arrays with their buffer views and accessors."""

    def __init__(
        self, data: bytes = b"", views: Sequence[Any] = (), accessors: Sequence[Any] = ()
    ) -> None:
        self.data = bytearray(data) + b"\0" * (-len(data) % 4)
        self.views, self.accessors = list(views), list(accessors)

    def add(
        self,
        array: np.ndarray,
        target: int | None = None,
        bounds: bool = False,
        normalized: bool = False,
    ) -> int:
        """Appends numbers (N,) or (N, K) and returns the index of their accessor.

        If `normalized` is set, the numbers are bytes that represent values from 0 to 1.
        """
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

    def animation(
        self, name: str, fps: float, curves: Sequence[tuple[str, int, np.ndarray]]
    ) -> dict[str, Any]:
        """Appends an animation of nodes and returns it.

        A curve consists of a property, a node, and one row of values (F, K) per frame.
        """
        times = self.add(
            np.arange(len(curves[0][2]), dtype=np.float32) / np.float32(fps), bounds=True
        )
        samplers = [{"input": times, "output": self.add(values)} for _, _, values in curves]
        targets = [{"node": node, "path": kind} for kind, node, _ in curves]
        channels = [
            {"sampler": sampler, "target": target} for sampler, target in enumerate(targets)
        ]
        return {"name": name, "samplers": samplers, "channels": channels}

    def save(self, path: Path, document: dict[str, Any]) -> None:
        """Writes a .glb file with this binary part.

        Adds the accessors, the views and the buffer to the document.
        """
        binary, *others = document.get("buffers") or [{}]
        document |= {"accessors": self.accessors, "bufferViews": self.views}
        document["buffers"] = [{**binary, "byteLength": len(self.data)}, *others]
        head = json.dumps(document, separators=(",", ":")).encode()
        head += b" " * (-len(head) % 4)
        chunks = (
            struct.pack("<I4s", len(head), b"JSON")
            + head
            + struct.pack("<I4s", len(self.data), b"BIN\0")
        )
        chunks += self.data
        with atomic_write(path) as temporary:
            temporary.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """Converts rotations (F, ..., 3, 3) to float32 quaternions (x, y, z, w).

    The signs do not flip between successive frames.
    """
    turns = rotation.continuous(rotation.matrix_to_quaternion(torch.from_numpy(matrices)), dim=0)
    return turns[..., [1, 2, 3, 0]].float().numpy()
