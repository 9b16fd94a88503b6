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

VERTICES, INDICES = 34962, 34963  # uses of a buffer view


def write(path: Path, poses: Poses, rig: Rig, fps: float, text: str, name: str, body: FittedBody | None) -> None:
    """Writes a .glb file of the motion in meters, y up; the rest pose faces +z, as the format requires.

    It contains one node per joint, one animation that rotates all nodes and moves the hips, with one key per frame in
    seconds, and a body skinned to the joints, stored in an A-pose, unless it is None. The node above the joints lifts
    it by the thickness of its soles; its toes bend as in pictures. The rig has the bone lengths of the motion. The
    animation is called `text`, or `name` if there is none.
    """
    binary = Binary()
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
    animation = binary.animation(text or name or "motion", fps, curves)
    figure: dict[str, Any] = {}
    if body is not None:
        nodes.append({"name": "figure", "mesh": 0, "skin": 0})
        figure = _skin(binary, body, rig)
    nodes.append({"name": "lifted", "children": [0], "translation": [0, body.lift if body else 0, 0]})
    document = {
        "asset": {"version": "2.0", "generator": "flame_mdm", "extras": {"fps": fps, "text": text}},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(rig.joints), len(nodes)))}],
        "nodes": nodes,
        "animations": [animation],
        **figure,
    }
    binary.save(path, document)


def _skin(binary: Binary, body: FittedBody, rig: Rig) -> dict[str, Any]:
    """Appends a body in its stored pose, lifted onto the floor, and returns the document's parts that describe it.

    Helper bones of the body join their joints.
    """
    mesh, floor = body.mesh, np.array([0, body.points[:, 1].min(), 0])
    weights = mesh.weights[:, : len(SMPL22)].copy()
    np.add.at(weights.T, list(ANCHORS[len(SMPL22) :]), mesh.weights[:, len(SMPL22) :].T)
    joint = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    weight = np.rint(255 * np.take_along_axis(weights, joint, 1)).astype(int)
    weight[:, 0] += 255 - weight.sum(1)
    light = np.rint(255 * (np.asarray(mesh.colors) / 255) ** 2.2)  # colors of screens to linear ones
    attributes = {
        "POSITION": binary.add((body.points - floor).astype("<f4"), VERTICES, bounds=True),
        "NORMAL": binary.add(mesh.normals.astype("<f4"), VERTICES),
        "COLOR_0": binary.add(
            np.pad(light, ((0, 0), (0, 1)), constant_values=255).astype("u1"), VERTICES, normalized=True
        ),
        "JOINTS_0": binary.add(np.where(weight > 0, joint, 0).astype("u1"), VERTICES),
        "WEIGHTS_0": binary.add(weight.astype("u1"), VERTICES, normalized=True),
    }
    indices = binary.add(mesh.triangles.astype("<u2").ravel(), INDICES)
    skinned = [rig.sources.index(number) for number in range(len(SMPL22))]
    others = [joint for joint, source in enumerate(rig.sources) if source < 0]
    bind = np.tile(np.eye(4), (len(rig.joints), 1, 1))
    stored = body.neutral @ mesh.turns[: len(SMPL22)].mT
    moves = -(stored @ (body.joints - floor)[..., None])
    bind[: len(SMPL22), :3] = rig.neutral[skinned].mT @ np.concatenate([stored, moves], -1)
    bind[len(SMPL22) :, :3, :3] = rig.turns[others].mT
    bind[len(SMPL22) :, :3, 3:] = -(rig.turns[others].mT @ rig.positions[others, :, None])
    matrices = binary.add(bind.mT.reshape(-1, 16).astype("<f4"))  # matrices are stored in column-major order
    return {
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}}],
        "skins": [{"joints": skinned + others, "skeleton": 0, "inverseBindMatrices": matrices}],
    }
