# pyright: reportAttributeAccessIssue=false
# The modules of usd-core come from C++ and have no types.
"""Writes a motion with its skeleton and skin as a Universal Scene Description (UsdSkel) file.

The file may be .usda, .usdc or .usdz. Source: Pixar, "UsdSkel",
https://openusd.org/release/api/usd_skel_page_front.html. Writing requires the usd-core package
(extra `usd`).
"""

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from flame_mdm.errors import UserError
from flame_mdm.formats.glb import quaternions
from flame_mdm.formats.rigged import RiggedClip, Skin
from flame_mdm.safe_io import atomic_write


def write(path: Path, clip: RiggedClip) -> None:
    """Writes a clip in meters, with y up. Raises `UserError` if usd-core is not installed."""
    try:
        from pxr import Sdf, Usd, UsdGeom, UsdSkel, UsdUtils
    except ImportError as error:
        advice = 'Run pip install "flame-mdm[usd]"'
        raise UserError(
            f"{path}: {path.suffix} files require the usd-core package. {advice}"
        ) from error

    with atomic_write(path) as temporary, tempfile.TemporaryDirectory() as folder:
        suffix = path.suffix.lower()
        ending = ".usdc" if suffix == ".usdz" else suffix
        file = Path(folder) / f"motion{ending}"
        stage = Usd.Stage.CreateNew(str(file))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(clip.fps)
        stage.SetFramesPerSecond(clip.fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(clip.turns) - 1)
        root = UsdSkel.Root.Define(stage, "/person")
        stage.SetDefaultPrim(root.GetPrim())

        _skeleton(stage, clip)
        for skin in clip.skins:
            _mesh(stage, skin)
        _extent(stage, root, clip)
        stage.GetRootLayer().Save()
        if suffix == ".usdz":
            package = Path(folder) / "motion.usdz"
            UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(file)), str(package))
            file = package
        temporary.write_bytes(file.read_bytes())


def _paths(clip: RiggedClip) -> list[str]:
    """Returns the path from the root to each joint, composed of the names that `_name` returns."""
    paths: list[str] = []
    for name, parent in zip(clip.joints, clip.parents, strict=True):
        paths.append(f"{paths[parent]}/{_name(name)}" if parent >= 0 else _name(name))
    return paths


def _name(name: str) -> str:
    """Returns a name that contains only letters, digits and underscores, and does not begin with a digit."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"
    return f"_{plain}" if plain[0].isdigit() else plain


def _matrices(values: np.ndarray) -> Any:
    """Returns matrices (N, 4, 4) in USD's convention: the translation is in the last row."""
    from pxr import Gf, Vt

    return Vt.Matrix4dArray([Gf.Matrix4d(matrix.T.tolist()) for matrix in values])


def _skeleton(stage: Any, clip: RiggedClip) -> None:
    from pxr import Gf, Sdf, UsdSkel, Vt

    skeleton = UsdSkel.Skeleton.Define(stage, "/person/skeleton")
    paths = _paths(clip)
    skeleton.CreateJointsAttr(paths)
    offsets, moves = clip.on_soles()
    rest = np.tile(np.eye(4), (len(paths), 1, 1))
    rest[:, :3, :3] = clip.rest * clip.scales[:, None, None]
    rest[:, :3, 3] = offsets
    skeleton.CreateRestTransformsAttr(_matrices(rest))
    bound = rest.copy()
    for joint, parent in enumerate(clip.parents):
        if parent >= 0:
            bound[joint] = bound[parent] @ rest[joint]
    for skin in clip.skins:
        bound[list(skin.ordered)] = np.linalg.inv(skin.binds)
    skeleton.CreateBindTransformsAttr(_matrices(bound))

    animation = UsdSkel.Animation.Define(stage, "/person/skeleton/animation")
    animation.CreateJointsAttr(paths)
    animation.CreateScalesAttr(
        Vt.Vec3hArray([Gf.Vec3h(size, size, size) for size in clip.scales.tolist()])
    )
    turns = quaternions(clip.turns)
    moved = np.tile(offsets, (len(clip.turns), 1, 1))
    for joint, path in moves.items():
        moved[:, joint] = path
    rotations, translations = animation.CreateRotationsAttr(), animation.CreateTranslationsAttr()
    for frame in range(len(turns)):
        values = [Gf.Quatf(float(w), float(x), float(y), float(z)) for x, y, z, w in turns[frame]]
        rotations.Set(Vt.QuatfArray(values), frame)
        translations.Set(Vt.Vec3fArray.FromNumpy(moved[frame].astype("f4")), frame)
    # Booleans are held until the next sample, so only the frames in which they change are written.
    for name, (frames, planted) in clip.contact_changes().items():
        contact = animation.GetPrim().CreateAttribute(name, Sdf.ValueTypeNames.Bool, custom=True)
        for frame, value in zip(frames.tolist(), planted.tolist(), strict=True):
            contact.Set(value, frame)
    binding = UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    binding.CreateAnimationSourceRel().SetTargets([animation.GetPath()])


def _mesh(stage: Any, skin: Skin) -> None:
    from pxr import Gf, Sdf, UsdGeom, UsdShade, UsdSkel, Vt

    mesh = UsdGeom.Mesh.Define(stage, f"/person/{_name(skin.name)}")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(skin.points.astype("f4")))
    mesh.CreateFaceVertexCountsAttr([3] * len(skin.triangles))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(skin.triangles.astype("i4").ravel()))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(skin.normals.astype("f4")))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))

    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([Sdf.Path("/person/skeleton")])
    joints = np.array(skin.ordered, "i4")[skin.bones]
    shares = skin.weights.astype("f4")
    binding.CreateJointIndicesPrimvar(False, skin.bones.shape[1]).Set(
        Vt.IntArray.FromNumpy(joints.ravel())
    )
    binding.CreateJointWeightsPrimvar(False, skin.bones.shape[1]).Set(
        Vt.FloatArray.FromNumpy(shares.ravel())
    )
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1))

    for number, paint in enumerate(skin.palette):
        material = UsdShade.Material.Define(stage, f"/person/materials/{_name(paint.name)}")
        shader = UsdShade.Shader.Define(stage, f"/person/materials/{_name(paint.name)}/surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        linear = np.array(paint.color) ** 2.2
        shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(
            Gf.Vec3f(*linear.tolist())
        )
        shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        triangles = np.nonzero(skin.materials == number)[0].astype("i4")
        subset = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).CreateMaterialBindSubset(
            _name(paint.name), Vt.IntArray.FromNumpy(triangles)
        )
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)


def _extent(stage: Any, root: Any, clip: RiggedClip) -> None:
    """Declares the person's bounding box in each frame, computed from the joints."""
    from pxr import UsdGeom, Vt

    positions, _ = clip.world()  # scales are ignored, because the box only has to be large enough
    positions[..., 1] += clip.lift
    # Distance in meters from a joint to the farthest point of the surface around it, at the tips of
    # the hands and the head
    margin = 0.25
    boxes = UsdGeom.Boundable(root.GetPrim()).CreateExtentAttr()
    for frame, points in enumerate(positions):
        box = np.stack([points.min(0) - margin, points.max(0) + margin]).astype("f4")
        boxes.Set(Vt.Vec3fArray.FromNumpy(box), frame)
