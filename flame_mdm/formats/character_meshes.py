"""Converts the meshes of a .glb character, so that writers of other formats can use them."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image

from flame_mdm.errors import UserError
from flame_mdm.formats import glb
from flame_mdm.formats.body import PosedFigure
from flame_mdm.formats.characters import Character, moved
from flame_mdm.formats.rigged import Material, RiggedClip, Skin

# Mode of a primitive that consists of triangles
TRIANGLES = 4
# Maximum number of vertices in a character
MAX_VERTICES = 2_000_000
# Maximum size of an image file in bytes
MAX_IMAGE = 64 * 2**20


def character_clip(character: Character, motion: PosedFigure, name: str) -> RiggedClip:
    """Returns a clip in which a character performs a motion, including the character's meshes.

    `name` is the name of the animation.

    Raises:
        UserError: If a mesh is stored in a form that cannot be converted.
    """
    file = character.file
    world, positions, rig = moved(character, motion)
    hips = rig.hips
    parents = np.array(rig.parents)
    above = np.where(parents >= 0, rig.scales[parents], 1)
    try:
        skins = meshes(file)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise UserError(
            f"a mesh of this character cannot be converted: {error}. Save a .glb file instead"
        ) from error
    return RiggedClip(
        name=name,
        fps=motion.fps,
        joints=_distinct(rig.joints),
        parents=rig.parents,
        offsets=rig.offsets(),
        rest=rig.rest(),
        turns=rig.local(world),
        moves={hips: rig.within(positions[:, hips], hips)},
        lift=0.0,
        skins=tuple(skins),
        scales=rig.scales / above,
    )


def _distinct(names: Sequence[str]) -> tuple[str, ...]:
    """Returns the names, with a number appended to each duplicate."""
    counts: dict[str, int] = {}
    distinct = []
    for name in names:
        counts[name] = counts.get(name, 0) + 1
        distinct.append(name if counts[name] == 1 else f"{name} {counts[name]}")
    return tuple(distinct)


def meshes(file: glb.Glb) -> list[Skin]:
    """Returns one skinned mesh for each part of each mesh in a file.

    Parts without a skin move with their node.

    Raises:
        ValueError: If a part is compressed, has no triangles, or is damaged.
    """
    rank = {index: number for number, index in enumerate(file.nodes)}
    palette = [_material(file, number) for number in range(len(file.document.get("materials", [])))]
    skins = []
    for index, node in enumerate(file.document.get("nodes", [])):
        if "mesh" not in node:
            continue
        mesh = file.document["meshes"][node["mesh"]]
        for number, primitive in enumerate(mesh["primitives"]):
            name = str(mesh.get("name") or node.get("name") or "mesh")
            title = name if len(mesh["primitives"]) == 1 else f"{name} {number + 1}"
            bound = file.skins[node["skin"]] if "skin" in node else None
            skins.append(_part(file, primitive, title, bound, rank[index], palette))
            if sum(len(skin.points) for skin in skins) > MAX_VERTICES:
                raise ValueError(f"it has more than {MAX_VERTICES:,} vertices")
    return skins


def _part(
    file: glb.Glb,
    primitive: dict[str, Any],
    name: str,
    bound: glb.Skin | None,
    node: int,
    palette: Sequence[Material],
) -> Skin:
    if primitive.get("mode", TRIANGLES) != TRIANGLES or primitive.get("extensions"):
        raise ValueError(f"{name} is compressed, or does not consist of triangles")
    attributes = primitive["attributes"]
    points = glb.numbers(file, attributes["POSITION"], "VEC3")
    if "indices" in primitive:
        corners = glb.numbers(file, primitive["indices"], "SCALAR").astype(int).ravel()
    else:
        corners = np.arange(len(points))
    if len(corners) % 3 or (len(corners) and corners.max() >= len(points)):
        raise ValueError(f"{name} has triangles whose vertices are missing")
    triangles = corners.reshape(-1, 3)
    normals = _normals(file, attributes, points, triangles)
    uvs = np.zeros((0, 2))
    if "TEXCOORD_0" in attributes:
        uvs = glb.numbers(file, attributes["TEXCOORD_0"], "VEC2")
        # glTF measures v from the upper edge of the image
        uvs = np.stack([uvs[:, 0], 1 - uvs[:, 1]], 1)

    if bound is None or "JOINTS_0" not in attributes:
        ordered = (node,)
        bones = np.zeros((len(points), 1), int)
        weights = np.ones((len(points), 1))
        binds = np.eye(4)[None]
    else:
        ordered = tuple(bound.joints)
        bones = glb.numbers(file, attributes["JOINTS_0"], "VEC4").astype(int)
        weights = glb.numbers(file, attributes["WEIGHTS_0"], "VEC4")
        if not (bones >= 0).all() or not (bones < len(ordered)).all():
            raise ValueError(f"{name} has a vertex that is bound to an unknown joint")
        weights = np.maximum(weights, 0)
        weights = weights / np.maximum(weights.sum(1, keepdims=True), 1e-9)
        binds = bound.binds if len(bound.binds) else np.linalg.inv(file.worlds[bound.joints])
    material = primitive.get("material")
    return Skin(
        name=name,
        points=points,
        normals=normals,
        triangles=triangles,
        palette=(
            palette[material] if material is not None else Material("material", (0.8, 0.8, 0.8)),
        ),
        materials=np.zeros(len(triangles), int),
        ordered=ordered,
        bones=bones,
        weights=weights,
        binds=binds,
        uvs=uvs,
    )


def _normals(
    file: glb.Glb, attributes: dict[str, Any], points: np.ndarray, triangles: np.ndarray
) -> np.ndarray:
    """Returns the normals (V, 3) of a mesh.

    If the file stores no normals, the mean normals of the adjacent triangles are used.
    """
    if "NORMAL" in attributes:
        return glb.numbers(file, attributes["NORMAL"], "VEC3")
    first, second, third = points[triangles].transpose(1, 0, 2)
    areas = np.cross(second - first, third - first)
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], areas)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _material(file: glb.Glb, number: int) -> Material:
    material = file.document["materials"][number]
    surface = material.get("pbrMetallicRoughness", {})
    linear = np.clip(np.array(surface.get("baseColorFactor", [1, 1, 1, 1]), float)[:3], 0, 1)
    red, green, blue = (linear ** (1 / 2.2)).tolist()
    name = str(material.get("name") or f"material {number + 1}")
    image = b""
    if "baseColorTexture" in surface:
        texture = file.document["textures"][surface["baseColorTexture"]["index"]]
        image = _image(file, texture.get("source"))
    return Material(name, (red, green, blue), image)


def _image(file: glb.Glb, number: int | None) -> bytes:
    """Returns the contents of a PNG or JPEG image that is stored in the file.

    Returns b"" if the image is stored outside the file or in another format.
    """
    if number is None:
        return b""
    image = file.document["images"][number]
    if "bufferView" not in image:
        return b""
    view = file.document["bufferViews"][image["bufferView"]]
    start = view.get("byteOffset", 0)
    content = file.data[start : start + view["byteLength"]]
    if len(content) > MAX_IMAGE:
        raise ValueError("an image is larger than 64 MiB")
    with Image.open(io.BytesIO(content), formats=["PNG", "JPEG"]) as picture:
        picture.verify()
    return content
