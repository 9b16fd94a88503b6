"""Writes a motion with its skeleton and skin as an FBX file: binary 7.4, in centimeters, with y up.

The structure of the scene is the same as in files written by Autodesk's FBX SDK. Some details are
required only by certain programs, which are named in comments. The bones are at the top level of
the scene, because Unreal and Unity would treat a node above them as a bone. The rest pose of the
bones is stored in `PreRotation`, so that rotations of 0 result in the rest pose in every program.
"""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flame_mdm.formats import fbx
from flame_mdm.formats.fbx import Int, Record
from flame_mdm.formats.fbx_scene import TICKS, TIME_MODES
from flame_mdm.formats.retarget import continuous_euler
from flame_mdm.formats.rigged import CONTACTS, Material, RiggedClip, Skin

# Units of length per meter, because the files are in centimeters
PER_METER = 100
# `TimeMode` for a frame rate that is stored in `CustomFrameRate`
CUSTOM_RATE = 14
# A fixed time, so that identical motions result in identical files. Readers compare it with `FileId`.
CREATED = "1970-01-01 10:00:00:000"
FILE_ID = bytes.fromhex("28b32aebb624ccc2bfc8b02aa92bfcf1")
# R = Rz Ry Rx, the order that FBX calls eEulerXYZ
EULER = "ZYX"
# Flags of a key: linear interpolation and its tangents, as Blender and the SDK write them
LINEAR_KEY = 0x4 | 0x100 | 0x2000 | 0x4000
# Distance in meters by which a root is moved back. Blender does not move a pelvis that is exactly
# at the tail of its root.
ROOT_BACK = 1e-4
AXES = ("X", "Y", "Z")
HELD_KEY = 0x2  # flag of a key whose value is held until the next key


def write(path: Path, clip: RiggedClip) -> None:
    """Writes a motion, including the person's skin if the clip includes one."""
    fbx.write(path, _Writer(clip).scene())


class _Writer:
    """Collects the objects of a scene and their connections."""

    def __init__(self, clip: RiggedClip) -> None:
        self.clip = clip
        self.objects = Record("Objects")
        self.connections = Record("Connections")
        self.last_id = 1_000_000
        self.offsets, self.moves = self._lifted()

    def scene(self) -> Record:
        """Returns the record that contains all other records."""
        clip = self.clip
        duration = round((len(clip.turns) - 1) / clip.fps * TICKS)
        bones = self._skeleton()
        materials: dict[Material, int] = {}
        poses: dict[int, np.ndarray] = {}
        for skin in clip.skins:
            poses |= self._mesh(skin, bones, materials)
        if poses and clip.root >= 0:
            # three.js takes the position of the root from the bind pose, so the root is moved back
            # in the bind pose, too.
            poses[bones[clip.root]][2, 3] -= PER_METER * ROOT_BACK
        if poses:
            self._bind_pose(poses)
        self._animation(bones, duration)

        # A file contains, in this order: header, settings, documents, definitions, objects,
        # connections, takes. The objects form a flat list. Connections between ids form a tree
        # whose root is the scene, with id 0.
        root = Record("")
        _header(root)
        root.children.append(_settings(clip.fps, duration))
        documents = root.add("Documents")
        documents.add("Count", Int(1))
        document = documents.add("Document", self._new(), "Scene", "Scene")
        document.add("RootNode", 0)
        root.add("References", block=True)
        root.children.append(_definitions(self.objects))
        root.children += [self.objects, self.connections]
        takes = root.add("Takes")
        takes.add("Current", clip.name)
        take = takes.add("Take", clip.name)
        take.add("FileName", "motion.tak")
        take.add("LocalTime", 0, duration)
        take.add("ReferenceTime", 0, duration)
        return root

    def _new(self) -> int:
        """Returns the id of a new object. Some readers cannot handle negative or small ids."""
        self.last_id += 1
        return self.last_id

    def _object(
        self, kind: str, name: str, category: str, label: str | None = None
    ) -> tuple[int, Record]:
        number = self._new()
        return number, self.objects.add(kind, number, f"{name}\x00\x01{label or kind}", category)

    def _connect(self, child: int, parent: int, target: str | None = None) -> None:
        if target is None:
            self.connections.add("C", "OO", child, parent)
        else:
            self.connections.add("C", "OP", child, parent, target)

    def _lifted(self) -> tuple[np.ndarray, dict[int, np.ndarray]]:
        """Returns the clip's `offsets` (J, 3) and `moves` in centimeters.

        The person is raised by the thickness of the soles. A root on the floor is moved back by
        `ROOT_BACK`, and the hips are moved forward by the same distance.
        """
        clip = self.clip
        offsets, moves = clip.on_soles()
        if clip.root >= 0:
            hips = max(moves)
            back = clip.rest[clip.root].T @ [0, 0, ROOT_BACK]
            offsets[clip.root] -= clip.rest[clip.root] @ back
            offsets[hips] += back
            moves[hips] += back
            if clip.root in moves:
                moves[clip.root] -= clip.turns[:, clip.root] @ back
        return PER_METER * offsets, {joint: PER_METER * moved for joint, moved in moves.items()}

    def _skeleton(self) -> list[int]:
        """Adds the bones in the rest pose and returns their ids."""
        # Each bone is a Model, which contains the transform, and a NodeAttribute, which marks it as
        # a bone. The rest pose is stored as PreRotation, so that the animated rotation is 0 at
        # rest.
        clip, bones = self.clip, []
        before = _degrees(clip.rest[None])[0]
        for joint, name in enumerate(clip.joints):
            attribute, record = self._object("NodeAttribute", name, "LimbNode")
            record.add("TypeFlags", "Skeleton")
            number, record = self._object("Model", name, "LimbNode")
            properties = _model(record, self.offsets[joint], before[joint], clip.scales[joint])
            if joint == 0 and len(clip.contacts):
                for label in CONTACTS:
                    properties.add("P", label, "Number", "", "A+U", 0.0)
            bones.append(number)
            self._connect(attribute, number)
            parent = clip.parents[joint]
            self._connect(number, bones[parent] if parent >= 0 else 0)
        return bones

    def _mesh(
        self, skin: Skin, bones: Sequence[int], materials: dict[Material, int]
    ) -> dict[int, np.ndarray]:
        """Adds a mesh in its bind pose, with its materials and its skin.

        `materials` contains the ids of the materials written so far. Returns the matrix (4, 4) of
        each object in the bind pose, keyed by id.
        """
        # A Geometry contains the vertices, and a Model places it. A Skin deforms the geometry with
        # one Cluster per bone. A cluster contains its vertices, their weights, and the matrices of
        # mesh and bone in the bind pose.
        geometry, record = self._object("Geometry", skin.name, "Mesh")
        _geometry(record, skin)
        model, record = self._object("Model", skin.name, "Mesh")
        _model(record, np.zeros(3), np.zeros(3))
        self._connect(model, 0)
        self._connect(geometry, model)
        for material in skin.palette:
            if material not in materials:
                materials[material] = self._material(material)
            self._connect(materials[material], model)

        deformer, record = self._object("Deformer", skin.name, "Skin")
        record.add("Version", Int(101))
        record.add("Link_DeformAcuracy", 50.0)
        self._connect(deformer, geometry)
        poses = {model: np.eye(4)}
        for index, joint in enumerate(skin.ordered):
            bind = skin.binds[index].copy()
            bind[:3, 3] *= PER_METER
            poses[bones[joint]] = np.linalg.inv(bind)
            rows, columns = np.nonzero((skin.bones == index) & (skin.weights > 0))
            if len(rows):
                name = self.clip.joints[joint]
                cluster, record = self._object("Deformer", name, "Cluster", "SubDeformer")
                record.add("Version", Int(100))
                record.add("UserData", "", "")
                record.add("Indexes", rows.astype("<i4"))
                record.add("Weights", skin.weights[rows, columns].astype("<f8"))
                record.add("Transform", _matrix(bind))
                record.add("TransformLink", _matrix(poses[bones[joint]]))
                self._connect(cluster, deformer)
                self._connect(bones[joint], cluster)
        return poses

    def _material(self, material: Material) -> int:
        """Adds a material and, if present, the material's image. Returns the id of the material."""
        number, record = self._object("Material", material.name, "")
        record.add("Version", Int(102))
        record.add("ShadingModel", "lambert")
        record.add("MultiLayer", Int(0))
        properties = record.add("Properties70")
        properties.add("P", "DiffuseColor", "Color", "", "A", *map(float, material.color))
        properties.add("P", "DiffuseFactor", "Number", "", "A", 1.0)
        if material.image:
            ending = "png" if material.image.startswith(b"\x89PNG") else "jpg"
            # Programs extract the image under this name, so it must not lead to another folder
            file = re.sub(r"[^ \w-]", "_", material.name) + f".{ending}"
            video, record = self._object("Video", material.name, "Clip")
            record.add("Type", "Clip")
            record.add("UseMipMap", Int(0))
            record.add("Filename", file)
            record.add("RelativeFilename", file)
            record.add("Content", material.image)
            texture, record = self._object("Texture", material.name, "")
            record.add("Type", "TextureVideoClip")
            record.add("Version", Int(202))
            record.add("TextureName", f"{material.name}\x00\x01Texture")
            record.add("Media", f"{material.name}\x00\x01Video")
            record.add("FileName", file)
            record.add("RelativeFilename", file)
            self._connect(video, texture)
            self._connect(texture, number, "DiffuseColor")
        return number

    def _bind_pose(self, poses: dict[int, np.ndarray]) -> None:
        """Adds the bind pose of the meshes; `poses` maps each object's id to its matrix (4, 4)."""
        _, record = self._object("Pose", "bind pose", "BindPose")
        record.add("Type", "BindPose")
        record.add("Version", Int(100))
        record.add("NbPoseNodes", Int(len(poses)))
        for number, matrix in poses.items():
            node = record.add("PoseNode")
            node.add("Node", number)
            node.add("Matrix", _matrix(matrix))

    def _animation(self, bones: Sequence[int], duration: int) -> None:
        """Adds one key per frame for all rotations, and for the positions of moving bones."""
        clip = self.clip
        stack, record = self._object("AnimationStack", clip.name, "", "AnimStack")
        record.block = True  # without a block, assimp does not find the animation
        properties = record.add("Properties70")
        for name, value in (("LocalStop", duration), ("ReferenceStop", duration)):
            properties.add("P", name, "KTime", "Time", "", value)
        layer, record = self._object("AnimationLayer", "base layer", "", "AnimLayer")
        record.block = True
        self._connect(layer, stack)

        times = np.round(np.arange(len(clip.turns)) / clip.fps * TICKS).astype("<i8")
        angles = _degrees(clip.rest.mT @ clip.turns)
        for joint, bone in enumerate(bones):
            self._curves(layer, bone, "Lcl Rotation", "R", times, angles[:, joint])
        for joint, moved in self.moves.items():
            self._curves(layer, bones[joint], "Lcl Translation", "T", times, moved)
        # Unreal imports animated bone properties of this kind as curves.
        for name, (changes, planted) in clip.contact_changes().items():
            values = planted[:, None].astype(float)
            self._curves(layer, bones[0], name, name, times[changes], values, (name,), HELD_KEY)

    def _curves(
        self,
        layer: int,
        bone: int,
        target: str,
        label: str,
        times: np.ndarray,
        values: np.ndarray,
        axes: Sequence[str] = AXES,
        interpolation: int = LINEAR_KEY,
    ) -> None:
        """Adds a curve for each axis of a property; `values` has the shape (F, axes)."""
        # An animated property is a CurveNode that is connected to the property of the bone. Each
        # axis has a curve with times, values and flags. One flag applies to all keys.
        node, record = self._object("AnimationCurveNode", label, "", "AnimCurveNode")
        properties = record.add("Properties70")
        self._connect(node, layer)
        self._connect(node, bone, target)
        for axis, name in enumerate(axes):
            properties.add("P", f"d|{name}", "Number", "", "A", float(values[0, axis]))
            curve, record = self._object("AnimationCurve", "", "", "AnimCurve")
            record.add("Default", float(values[0, axis]))
            record.add("KeyVer", Int(4008))
            record.add("KeyTime", times)
            record.add("KeyValueFloat", values[:, axis].astype("<f4"))
            record.add("KeyAttrFlags", np.array([interpolation], "<i4"))
            record.add("KeyAttrDataFloat", np.zeros(4, "<f4"))
            record.add("KeyAttrRefCount", np.array([len(times)], "<i4"))
            self._connect(curve, node, f"d|{name}")


def _degrees(turns: np.ndarray) -> np.ndarray:
    """Converts rotations (F, J, 3, 3) to continuous Euler angles (F, J, 3) in degrees.

    The angles are rotations about x, y and z.
    """
    angles = continuous_euler(torch.from_numpy(turns), [EULER] * turns.shape[1])
    return np.degrees(angles.flip(-1).numpy())


def _matrix(matrix: np.ndarray) -> np.ndarray:
    """Returns the 16 numbers of a matrix. The last four numbers contain the translation."""
    return matrix.T.astype("<f8").ravel()


def _vector(
    properties: Record, name: str, kind: str, flags: str, values: Sequence[float] | np.ndarray
) -> None:
    properties.add(
        "P", name, kind, "Vector" if kind == "Vector3D" else "", flags, *map(float, values)
    )


def _model(record: Record, offset: np.ndarray, before: np.ndarray, scale: float = 1.0) -> Record:
    """Adds the transform of a model at rest, and returns the record of its properties."""
    record.add("Version", Int(232))
    properties = record.add("Properties70")
    properties.add("P", "RotationActive", "bool", "", "", Int(1))
    properties.add("P", "InheritType", "enum", "", "", Int(1))
    # Autodesk's SDK drops meshes without this property.
    properties.add("P", "DefaultAttributeIndex", "int", "Integer", "", Int(0))
    _vector(properties, "PreRotation", "Vector3D", "", before)
    _vector(properties, "Lcl Translation", "Lcl Translation", "A", offset)
    _vector(properties, "Lcl Rotation", "Lcl Rotation", "A", (0, 0, 0))
    _vector(properties, "Lcl Scaling", "Lcl Scaling", "A", (scale, scale, scale))
    record.add("Shading", True)
    record.add("Culling", "CullingOff")
    return properties


def _geometry(record: Record, skin: Skin) -> None:
    record.add("GeometryVersion", Int(124))
    record.add("Vertices", (PER_METER * skin.points).astype("<f8").ravel())
    corners = skin.triangles.astype("<i4").copy()
    corners[:, 2] = ~corners[:, 2]  # the last corner of a polygon is stored as its complement
    record.add("PolygonVertexIndex", corners.ravel())

    normals = record.add("LayerElementNormal", Int(0))
    normals.add("Version", Int(101))
    normals.add("Name", "")
    normals.add("MappingInformationType", "ByPolygonVertex")
    normals.add("ReferenceInformationType", "IndexToDirect")
    normals.add("Normals", np.round(skin.normals, 5).astype("<f8").ravel())
    normals.add("NormalsIndex", skin.triangles.astype("<i4").ravel())

    materials = record.add("LayerElementMaterial", Int(0))
    materials.add("Version", Int(101))
    materials.add("Name", "")
    materials.add("MappingInformationType", "ByPolygon")
    materials.add("ReferenceInformationType", "IndexToDirect")
    materials.add("Materials", skin.materials.astype("<i4"))

    kinds = ["LayerElementNormal", "LayerElementMaterial"]
    if len(skin.uvs):
        kinds.append("LayerElementUV")
        coordinates = record.add("LayerElementUV", Int(0))
        coordinates.add("Version", Int(101))
        coordinates.add("Name", "uv")
        coordinates.add("MappingInformationType", "ByPolygonVertex")
        coordinates.add("ReferenceInformationType", "IndexToDirect")
        coordinates.add("UV", skin.uvs.astype("<f8").ravel())
        coordinates.add("UVIndex", skin.triangles.astype("<i4").ravel())

    layer = record.add("Layer", Int(0))
    layer.add("Version", Int(100))
    for kind in kinds:
        element = layer.add("LayerElement")
        element.add("Type", kind)
        element.add("TypedIndex", Int(0))


def _header(root: Record) -> None:
    header = root.add("FBXHeaderExtension")
    header.add("FBXHeaderVersion", Int(1003))
    header.add("FBXVersion", Int(fbx.VERSION))
    header.add("EncryptionType", Int(0))
    stamp = header.add("CreationTimeStamp")
    stamp.add("Version", Int(1000))
    date = {
        "Year": 1970,
        "Month": 1,
        "Day": 1,
        "Hour": 10,
        "Minute": 0,
        "Second": 0,
        "Millisecond": 0,
    }
    for name, value in date.items():
        stamp.add(name, Int(value))
    header.add("Creator", "flame_mdm")
    root.add("FileId", FILE_ID)
    root.add("CreationTime", CREATED)
    root.add("Creator", "flame_mdm")


def _settings(fps: float, duration: int) -> Record:
    settings = Record("GlobalSettings")
    settings.add("Version", Int(1000))
    properties = settings.add("Properties70")

    def add(name: str, kind: str, label: str, value: Any) -> None:
        properties.add("P", name, kind, label, "", value)

    for name, axis in (("Up", 1), ("Front", 2), ("Coord", 0)):
        add(f"{name}Axis", "int", "Integer", Int(axis))
        add(f"{name}AxisSign", "int", "Integer", Int(1))
    add("OriginalUpAxis", "int", "Integer", Int(1))
    add("OriginalUpAxisSign", "int", "Integer", Int(1))
    add("UnitScaleFactor", "double", "Number", 1.0)
    add("OriginalUnitScaleFactor", "double", "Number", 1.0)
    mode = next((mode for mode, rate in TIME_MODES.items() if abs(rate - fps) < 1e-6), CUSTOM_RATE)
    add("TimeMode", "enum", "", Int(mode))
    add("TimeSpanStart", "KTime", "Time", 0)
    add("TimeSpanStop", "KTime", "Time", duration)
    add("CustomFrameRate", "double", "Number", float(fps))
    return settings


def _definitions(objects: Record) -> Record:
    counts = Counter(record.name for record in objects.children)
    definitions = Record("Definitions")
    definitions.add("Version", Int(100))
    definitions.add("Count", Int(1 + sum(counts.values())))
    definitions.add("ObjectType", "GlobalSettings").add("Count", Int(1))
    for name, count in counts.items():
        definitions.add("ObjectType", name).add("Count", Int(count))
    return definitions
