"""Writes a motion with its skeleton and skin as a .glb file.

The file is in meters, with y up and the rest pose facing +z.
"""

from pathlib import Path
from typing import Any

import numpy as np

from flame_mdm.formats.glb import Binary, quaternions
from flame_mdm.formats.rigged import RiggedClip, Skin, contact_events

VERTICES, INDICES = 34962, 34963  # values of a buffer view's target in glTF


def write(path: Path, clip: RiggedClip, text: str) -> None:
    """Writes a clip with one node per joint, and with the person's skin if the clip includes one.

    `text` is stored in the file. The node `lifted`, which is the parent of the joints, is raised by
    the thickness of the soles, so that the person stands on the soles. In a rig with a root on the
    floor, the hips are raised instead, so that the root stays on the floor.
    """
    offsets, moves, lift = clip.offsets, clip.moves, clip.lift
    if clip.root >= 0:
        offsets, moves = clip.on_soles()
        lift = 0.0
    binary = Binary()
    turns = quaternions(np.concatenate([clip.rest[None], clip.turns]))
    curves = [("rotation", node, turns[1:, node]) for node in range(len(clip.joints))]
    curves += [("translation", node, moved.astype("f4")) for node, moved in moves.items()]
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": offset.tolist(), "rotation": turn.tolist()}
        for name, offset, turn in zip(clip.joints, offsets, turns[0], strict=True)
    ]
    for joint, parent in enumerate(clip.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(joint)
    animation = binary.animation(clip.name, clip.fps, curves)
    if len(clip.contacts):
        animation["extras"] = {
            "markers": [event._asdict() for event in contact_events(clip.contacts, clip.fps)]
        }
    figure: dict[str, Any] = {}
    for skin in clip.skins:
        nodes.append({"name": "figure", "mesh": 0, "skin": 0})
        figure = _skin(binary, skin)
    nodes.append({"name": "lifted", "children": [0], "translation": [0, lift, 0]})
    document = {
        "asset": {
            "version": "2.0",
            "generator": "flame_mdm",
            "extras": {"fps": clip.fps, "text": text},
        },
        "scene": 0,
        "scenes": [{"nodes": list(range(len(clip.joints), len(nodes)))}],
        "nodes": nodes,
        "animations": [animation],
        **figure,
    }
    binary.save(path, document)


def _skin(binary: Binary, skin: Skin) -> dict[str, Any]:
    """Appends a person's mesh and returns the document's entries for the mesh."""
    light = np.rint(255 * (skin.colors / 255) ** 2.2)  # from screen colors to linear colors
    light = np.pad(light, ((0, 0), (0, 1)), constant_values=255).astype("u1")
    attributes = {
        "POSITION": binary.add(skin.points.astype("<f4"), VERTICES, bounds=True),
        "NORMAL": binary.add(skin.normals.astype("<f4"), VERTICES),
        "COLOR_0": binary.add(light, VERTICES, normalized=True),
        "JOINTS_0": binary.add(skin.bones, VERTICES),
        "WEIGHTS_0": binary.add(
            np.rint(255 * skin.weights).astype("u1"), VERTICES, normalized=True
        ),
    }
    indices = binary.add(skin.triangles.astype("<u2").ravel(), INDICES)
    # Matrices are stored in column-major order
    matrices = binary.add(skin.binds.mT.reshape(-1, 16).astype("<f4"))
    return {
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}}],
        "skins": [{"joints": list(skin.ordered), "skeleton": 0, "inverseBindMatrices": matrices}],
    }
