""".glb files for tests: read back from their bytes independently of the product, changed, and made anew."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flame_mdm.formats import glb, glb_animation
from flame_mdm.formats.glb import Binary
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.retarget import joint_names, presets
from flame_mdm.representations.rotation import quaternion_to_matrix

KINDS = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Glb:
    """A .glb file read back from its bytes: the document and the binary part."""

    def __init__(self, path: Path):
        data = path.read_bytes()
        magic, version, length = struct.unpack("<4sII", data[:12])
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack("<I4s", data[12:20])
        assert (kind, size % 4) == (b"JSON", 0)
        self.document: dict[str, Any] = json.loads(data[20 : 20 + size])
        binary_size, kind = struct.unpack("<I4s", data[20 + size : 28 + size])
        self.binary = data[28 + size :]
        assert kind == b"BIN\0"
        assert len(self.binary) == binary_size == self.document["buffers"][0]["byteLength"]

    def array(self, number: int) -> np.ndarray:
        """Numbers (N, K) of an accessor; its bounds are right."""
        accessor = self.document["accessors"][number]
        view = self.document["bufferViews"][accessor["bufferView"]]
        begin = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        assert begin % 4 == 0
        width = WIDTHS[accessor["type"]]
        array = np.frombuffer(
            self.binary, KINDS[accessor["componentType"]], accessor["count"] * width, begin
        ).copy()
        array = array.reshape(-1, width)
        assert accessor.get("min", array.min(0).tolist()) == array.min(0).tolist()
        assert accessor.get("max", array.max(0).tolist()) == array.max(0).tolist()
        return array

    def curves(self) -> dict[tuple[int, str], np.ndarray]:
        """Values of the first animation: (node, property) -> (F, K)."""
        animation = self.document["animations"][0]
        outputs = [self.array(sampler["output"]) for sampler in animation["samplers"]]
        targets = [
            (channel["target"], outputs[channel["sampler"]]) for channel in animation["channels"]
        ]
        return {(target["node"], target["path"]): values for target, values in targets}

    def worlds(self) -> np.ndarray:
        """Matrices (F, N, 4, 4) of the nodes in the frames of the first animation."""
        nodes, curves = self.document["nodes"], self.curves()
        frames = max(map(len, curves.values()))
        default = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}
        parts = {
            key: np.array([node.get(key, value) for node in nodes], float)[None].repeat(frames, 0)
            for key, value in default.items()
        }
        for (node, key), values in curves.items():
            parts[key][:, node] = values
        local = np.tile(np.eye(4), (frames, len(nodes), 1, 1))
        turns = quaternion_to_matrix(torch.from_numpy(parts["rotation"][..., [3, 0, 1, 2]])).numpy()
        local[..., :3, :3] = turns * parts["scale"][..., None, :]
        local[..., :3, 3] = parts["translation"]
        for number, node in enumerate(nodes):
            if "matrix" in node:
                local[:, number] = np.array(node["matrix"]).reshape(4, 4).T
        worlds, waiting = (
            local.copy(),
            list(self.document["scenes"][self.document.get("scene", 0)]["nodes"]),
        )
        for number in waiting:
            for child in nodes[number].get("children", []):
                worlds[:, child] = worlds[:, number] @ local[:, child]
                waiting.append(child)
        return worlds

    def skinned(self, worlds: np.ndarray) -> np.ndarray:
        """Vertices (V, 3) of the first mesh with a skin, while the nodes have the matrices (N, 4, 4)."""
        node = next(node for node in self.document["nodes"] if "skin" in node)
        skin = self.document["skins"][node["skin"]]
        bind = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        attributes = self.document["meshes"][node["mesh"]]["primitives"][0]["attributes"]
        points = np.pad(self.array(attributes["POSITION"]), ((0, 0), (0, 1)), constant_values=1)
        weights = self.array(attributes["WEIGHTS_0"])
        weights = weights / (255 if weights.dtype == np.uint8 else 1)
        moves = (worlds[skin["joints"]] @ bind)[self.array(attributes["JOINTS_0"])]
        return np.einsum("vij,vj->vi", np.einsum("vk,vkij->vij", weights, moves), points)[:, :3]

    def save(self, path: Path) -> None:
        """Writes the document and the binary part, whatever they are."""
        Path(path).write_bytes(packed(json.dumps(self.document).encode(), self.binary))


def packed(document: bytes, binary: bytes = b"") -> bytes:
    """The bytes of a .glb file with any document and binary part."""
    document += b" " * (-len(document) % 4)
    chunks = struct.pack("<I4s", len(document), b"JSON") + document
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary if binary else b""
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def changed(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Rewrites a file with a changed document."""
    file = Glb(path)
    change(file.document)
    file.save(path)


def odd_character(path: Path, motion: Motion, turned: bool = True) -> None:
    """Another character: A-pose, longer legs, odd names, centimeters and z up below a node with scale 0.01."""
    poses = motion.posed()
    longer = poses.offsets.clone()
    longer[[4, 5, 7, 8]] *= 1.2  # legs
    longer[[18, 19, 20, 21]] *= 0.9  # arms
    longer[[10, 11]] *= 1.3  # feet
    joints = type(poses)(longer, poses.rotations, poses.root).joints()
    Motion(joints.float().numpy(), 20.0).save(path, rig="unreal")
    file = Glb(path)
    document, data = file.document, bytearray(file.binary)
    del document["animations"]
    nodes, roots = document["nodes"], document["scenes"][0]["nodes"]
    lifted = next(number for number, node in enumerate(nodes) if node["name"] == "lifted")
    for node in nodes[: lifted - 1]:
        node["translation"] = [100 * x for x in node["translation"]]
        node["name"] = "Rig Bone-" + node["name"][::-1]
    half = 0.5**0.5
    nodes[lifted] |= {
        "scale": [0.01] * 3,
        "rotation": [half if turned else 0.0, 0, 0, half if turned else 1.0],
    }
    if turned:  # a node that undoes it: the file is y up again
        nodes.append({"name": "armature", "rotation": [-half, 0, 0, half], "children": [lifted]})
        document["scenes"][0]["nodes"] = [
            len(nodes) - 1 if root == lifted else root for root in roots
        ]
    view = document["bufferViews"][
        document["accessors"][document["skins"][0]["inverseBindMatrices"]]["bufferView"]
    ]
    part = slice(view["byteOffset"], view["byteOffset"] + view["byteLength"])
    bind = np.frombuffer(data[part], "<f4").reshape(-1, 4, 4).copy()
    bind[:, :, :3] *= 100  # of columns, as matrices are stored: the mesh stays in meters
    data[part] = bind.tobytes()
    Binary(bytes(data), document["bufferViews"], document["accessors"]).save(path, document)


def write_names(path: Path, **other: str | None) -> None:
    """The file of names of `odd_character`, with other names of some joints."""
    names = {
        joint: "Rig Bone-" + name[::-1] for joint, name in joint_names(presets()["unreal"]).items()
    }
    lines = (f"{joint}: {json.dumps(name)}\n" for joint, name in {**names, **other}.items())
    path.write_text("".join(lines))


def skinned(path: Path, frame: int) -> np.ndarray:
    """Vertices (V, 3) of all skinned meshes of a .glb file in a frame of its first animation."""
    file = glb.read(path)
    worlds = glb_animation.world_matrices_of(path)[frame]
    points = []
    for item in file.document["nodes"]:
        if "mesh" not in item or "skin" not in item:
            continue
        skin = file.skins[item["skin"]]
        for primitive in file.document["meshes"][item["mesh"]]["primitives"]:
            attributes = primitive["attributes"]
            local = glb.numbers(file, attributes["POSITION"], "VEC3")
            joints = glb.numbers(file, attributes["JOINTS_0"], "VEC4").astype(int)
            weights = glb.numbers(file, attributes["WEIGHTS_0"], "VEC4")
            moves = worlds[skin.joints] @ skin.binds
            homogeneous = np.pad(local, ((0, 0), (0, 1)), constant_values=1)
            moved = np.einsum("vkij,vj->vki", moves[joints], homogeneous)[..., :3]
            points.append((weights[..., None] * moved).sum(1) / weights.sum(1, keepdims=True))
    return np.concatenate(points)
