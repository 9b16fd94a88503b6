"""FBX, VRMA and USD files in other readers: Autodesk's SDK, three.js, ufbx, assimp, Blender and usd-core."""

import json
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from support.fixtures import ROOT, blender, python_with, script
from support.glb import odd_character, skinned, write_names
from support.motions import synthetic
from support.npm import node
from support.usd import opened, pxr

from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.formats import fbx, fbx_scene, glb, glb_animation, vrma
from flame_mdm.formats.animated import AnimatedNodes
from flame_mdm.formats.body import fit_body
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.retarget import preset, presets
from flame_mdm.formats.rigged import MATERIAL_NAMES, rigged
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.visualize.body import MATERIALS

MILLIMETER = 1e-3
FRAMES = [0, 7, 20, 39]
RIGS = [None, *presets()]
RATES = (20.0, 30.0)
MOTIONS = 10  # synthetic motions at each frame rate


def autodesk(folder: Path, file: Path) -> Path:
    """The .glb file that fbx2gltf makes with Autodesk's SDK, at 30 frames per second."""
    program = folder / "node_modules/fbx2gltf/bin/Linux/FBX2glTF"
    program.chmod(0o755)
    out = file.with_name(f"{file.stem}_autodesk")
    command = [program, "-i", file, "-o", out, "-b", "--anim-framerate", "bake30"]
    subprocess.run(command, capture_output=True, check=True)
    return out.with_suffix(".glb")


def largest_difference(
    names: list[str], first: np.ndarray, other: AnimatedNodes, frames: list[int]
) -> float:
    """The largest distance in meters between positions (F, N, 3) of named joints and nodes of the same name."""
    nodes = [other.names.index(name) for name in names]
    return float(np.abs(first - other.positions[frames][:, nodes]).max())


def bones(motion: AnimatedNodes, meshes: tuple[str, ...] = ("person",)) -> list[int]:
    return [number for number, name in enumerate(motion.names) if name not in meshes]


def of_all_rigs(test: Callable[..., None]) -> Callable[..., None]:
    """Marks a test of outside tools on twenty motions on each rig."""
    return pytest.mark.tools(pytest.mark.slow(pytest.mark.timeout(900)(test)))


@cache
def synthetic_motions() -> list[Motion]:
    """Twenty synthetic motions, ten at each of two frame rates."""
    motions = []
    for fps in RATES:
        for clip in Synthetic(clips=MOTIONS).clips(fps):
            motions.append(Motion(np.asarray(clip.motion), fps, text=clip.captions[0]))
    return motions


@dataclass(frozen=True, eq=False)
class Written:
    """An FBX file, and what our reader says about it."""

    path: Path
    fps: float
    read: AnimatedNodes

    @property
    def joints(self) -> list[str]:
        return [self.read.names[number] for number in bones(self.read)]

    def positions(self, frames: list[int]) -> np.ndarray:
        """Positions (F, J, 3) of the joints in meters, in some frames."""
        return self.read.positions[frames][:, bones(self.read)]


@pytest.fixture(scope="module", params=RIGS)
def on_rig(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> list[Written]:
    """The twenty motions as FBX files of a rig; tests of all readers share them."""
    folder = tmp_path_factory.mktemp(request.param or "smpl")
    files = []
    for number, motion in enumerate(synthetic_motions()):
        path = folder / f"{number}.fbx"
        motion.save(path, rig=request.param)
        files.append(Written(path, motion.fps, fbx_scene.read(path)))
    return files


def check_positions(file: Written, frames: list[int], theirs: list[dict[str, list[float]]]) -> None:
    """Checks the positions by name that a reader found in some frames, in centimeters."""
    for expected, positions in zip(file.positions(frames), theirs, strict=True):
        found = np.array([positions[name] for name in file.joints]) / 100
        assert np.abs(found - expected).max() < 0.01 * MILLIMETER, file.path


@of_all_rigs
def test_autodesk_reads_what_was_written(on_rig: list[Written], node_modules: Path, subtests):
    for file in on_rig:
        with subtests.test(file=file.path.name):
            # both have frames at whole tenths of a second
            tenths = np.arange(int((len(file.read.positions) - 1) / file.fps * 10) + 1) / 10
            converted = autodesk(node_modules, file.path)
            other, scene = glb_animation.read(converted), glb.read(converted)
            theirs = np.round(tenths * other.fps).astype(int).tolist()
            expected = file.positions(np.round(tenths * file.fps).astype(int).tolist())
            assert largest_difference(file.joints, expected, other, theirs) < 0.01 * MILLIMETER
            assert len(scene.skins) == 1
            assert len(scene.document["materials"]) == 5


@of_all_rigs
def test_three_reads_what_was_written(on_rig: list[Written], node_modules: Path, subtests):
    for fps, files in by_rate(on_rig):
        scenes = node("three_fbx.mjs", node_modules, seconds(fps), *(file.path for file in files))
        for file, scene in zip(files, scenes, strict=True):
            with subtests.test(file=file.path.name):
                check_positions(file, FRAMES, scene["frames"])
                assert scene["meshes"] >= 1
                assert len(scene["materials"]) == 5


@of_all_rigs
def test_ufbx_reads_what_was_written(on_rig: list[Written]):
    python = python_with("ufbx", "FLAME_MDM_UFBX")
    for fps, files in by_rate(on_rig):
        paths = [str(file.path) for file in files]
        command = [python, str(ROOT / "tests/support/ufbx_read.py"), seconds(fps), *paths]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        for file, frames in zip(files, json.loads(done.stdout), strict=True):
            check_positions(file, FRAMES, frames)


@of_all_rigs
def test_blender_reads_what_was_written(on_rig: list[Written], tmp_path: Path, subtests):
    for fps, files in by_rate(on_rig):
        scenes = in_blender(tmp_path / "out.json", fps, [file.path for file in files])
        for file, scene in zip(files, scenes, strict=True):
            with subtests.test(file=file.path.name):
                check_blender(file, file.joints, scene)
                assert scene["fps"] == fps


@of_all_rigs
def test_assimp_finds_skeleton_skin_and_animation(on_rig: list[Written], subtests):
    if shutil.which("assimp") is None:
        pytest.skip("assimp is not installed: apt-get install assimp-utils")
    for file in on_rig:
        with subtests.test(file=file.path.name):
            command = ["assimp", "info", str(file.path)]
            report = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            lines = [line.split(":") for line in report.splitlines() if ":" in line]
            facts = {name.strip(): value.strip() for name, value, *_ in lines}
            assert int(facts["Animations"]) == 1
            assert int(facts["Bones"]) >= 22
            assert int(facts["Materials"]) >= 5


def by_rate(files: list[Written]) -> list[tuple[float, list[Written]]]:
    return [(fps, [file for file in files if file.fps == fps]) for fps in RATES]


def seconds(fps: float) -> str:
    """The times of `FRAMES`, as the scripts take them."""
    return ",".join(str(frame / fps) for frame in FRAMES)


def in_blender(out: Path, fps: float, files: list[Path]) -> list[dict[str, Any]]:
    """Contents of files as tests/support/blender_import.py reads them in Blender."""
    script = ROOT / "tests/support/blender_import.py"
    words = [str(out), f"{fps:g}", ",".join(map(str, FRAMES)), *map(str, files)]
    subprocess.run([blender(), str(script), *words], capture_output=True, check=True)
    return json.loads(out.read_text())


def check_blender(file: Written, joints: list[str], scene: dict[str, Any]) -> None:
    """Checks positions, mesh and materials of a file in Blender, whose z is up."""
    expected = file.read.positions[FRAMES][:, [file.read.names.index(name) for name in joints]]
    for frame, positions in zip(expected, scene["frames"], strict=True):
        found = np.array(
            [positions.get(name) or positions[name.replace(":", "_")] for name in joints]
        )
        assert np.abs(found[:, [0, 2, 1]] * [1, 1, -1] - frame).max() < 0.01 * MILLIMETER, file.path
    assert scene["vertices"] >= 2302
    assert len(set(scene["materials"])) >= 5


@pytest.mark.tools
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_surface_in_autodesk_is_that_of_pictures(node_modules: Path, tmp_path: Path, subtests):
    """The vertices of the file that Autodesk's SDK made, skinned, against the vertices of the motion's .glb file."""
    motion = synthetic("kick")
    motion.save(tmp_path / "kick.fbx", rig="mixamo")
    motion.save(tmp_path / "kick.glb", rig="mixamo")
    surfaces = []
    for path, frame in (
        (tmp_path / "kick.glb", 20),
        (autodesk(node_modules, tmp_path / "kick.fbx"), 30),
    ):
        surfaces.append(skinned(path, frame))
    # the SDK's file has a vertex once per material that meets there, in another order
    for name, first, second in (("ours", *surfaces), ("theirs", *surfaces[::-1])):
        with subtests.test(surface=name):
            nearest, _ = KDTree(first).query(second)
            assert nearest.max() < 0.02 * MILLIMETER


@pytest.mark.tools
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_character_becomes_fbx_with_its_own_skin(node_modules: Path, tmp_path: Path, subtests):
    synthetic("kick").save(tmp_path / "hero.glb", rig="mixamo")
    odd_character(tmp_path / "odd.glb", synthetic("kick"))
    write_names(tmp_path / "odd.yaml")
    for name in ("hero", "odd"):
        with subtests.test(name=name):
            motion = synthetic("wave")
            motion.save(tmp_path / "wave.fbx", character=tmp_path / f"{name}.glb")
            motion.save(tmp_path / "wave.glb", character=tmp_path / f"{name}.glb")
            expected = glb_animation.read(tmp_path / "wave.glb")
            ours = fbx_scene.read(tmp_path / "wave.fbx")
            joints = [joint for joint in expected.names if joint in ours.names]
            numbers = [expected.names.index(joint) for joint in joints]
            frames = list(range(len(expected.positions)))
            assert (
                largest_difference(joints, expected.positions[:, numbers], ours, frames)
                < 0.01 * MILLIMETER
            )
            theirs = glb_animation.read(autodesk(node_modules, tmp_path / "wave.fbx"))
            shared = [joint for joint in joints if joint in theirs.names]
            assert len(shared) >= 22
            numbers = [expected.names.index(joint) for joint in shared]
            whole = [0, 20, 40]
            difference = largest_difference(
                shared, expected.positions[whole][:, numbers], theirs, [0, 30, 60]
            )
            assert difference < 0.01 * MILLIMETER


@pytest.mark.tools
@pytest.mark.slow
@pytest.mark.parametrize("rig", ["mixamo", "unreal", "lafan1"])
def test_blender_reads_usd_files(rig: str, tmp_path: Path):
    pxr("Usd")
    motion = synthetic("kick")
    motion.save(tmp_path / "kick.usdc", rig=rig)
    motion.save(tmp_path / "kick.fbx", rig=rig)
    expected = Written(tmp_path / "kick.fbx", motion.fps, fbx_scene.read(tmp_path / "kick.fbx"))
    (scene,) = in_blender(tmp_path / "out.json", motion.fps, [tmp_path / "kick.usdc"])
    # only FBX files have the root 0.1 mm behind the origin
    check_blender(expected, [name for name in expected.joints if name != "root"], scene)
    if rig == "unreal":
        assert all(
            abs(max(frame["root"], key=abs)) < 0.01 * MILLIMETER for frame in scene["frames"]
        )


def test_a_vrm_animation_has_the_positions_of_the_motion_and_the_rest_pose_of_vrm(
    tmp_path: Path, subtests
):
    motion = synthetic("kick")
    motion.save(tmp_path / "kick.vrma")
    read = glb_animation.read(tmp_path / "kick.vrma")
    lift = fit_body(motion).lift
    nodes = [read.humanoid[joint] for joint in SMPL22.joints]
    expected = motion.posed().joints().numpy()
    expected[..., 1] += lift
    # hands, feet and head turn about themselves alone, so all joints are where they were
    assert np.abs(read.positions[:, nodes] - expected).max() < 0.01 * MILLIMETER

    rest = glb.read(tmp_path / "kick.vrma")
    place = {name: rest.worlds[number, :3, 3] for number, name in enumerate(rest.names)}
    for side, sign in (("left", 1), ("right", -1)):
        with subtests.test(side=side, sign=sign):
            for first, second, direction in (
                ("UpperArm", "LowerArm", (sign, 0, 0)),
                ("LowerArm", "Hand", (sign, 0, 0)),
                ("UpperLeg", "LowerLeg", (0, -1, 0)),
                ("LowerLeg", "Foot", (0, -1, 0)),
            ):
                bone = place[side + second] - place[side + first]
                np.testing.assert_allclose(bone / np.linalg.norm(bone), direction, atol=1e-6)
            foot = place[f"{side}Toes"] - place[f"{side}Foot"]
            assert abs(foot[0]) < 1e-9
            assert foot[2] > 0
    # nodes turn nothing at rest and have no scale, and only the hips move
    document = rest.document
    assert all("rotation" not in item and "scale" not in item for item in document["nodes"])
    (animation,) = document["animations"]
    moved = [
        channel["target"]["node"]
        for channel in animation["channels"]
        if channel["target"]["path"] == "translation"
    ]
    assert moved == [
        document["extensions"]["VRMC_vrm_animation"]["humanoid"]["humanBones"]["hips"]["node"]
    ]
    assert len(set(vrma.LIMBS)) == 4


@pytest.mark.tools
@pytest.mark.slow
def test_three_vrm_animation_reads_the_motion(node_modules: Path, tmp_path: Path, subtests):
    """Its normalized tracks, applied to the rest pose by forward kinematics, give our joints."""
    for action in ("walk", "jump", "kick"):
        with subtests.test(action=action):
            path = tmp_path / f"{action}.vrma"
            synthetic(action).save(path)
            issues = node("gltf_validate.mjs", node_modules, path)
            assert (issues["numErrors"], issues["numWarnings"]) == (0, 0)
            tracks = node("three_vrma.mjs", node_modules, path)
            file, ours = glb.read(path), glb_animation.read(path)
            frames = len(ours.positions)
            positions = np.zeros((frames, len(file.names), 3))
            turned = np.tile(np.eye(3), (frames, len(file.names), 1, 1))
            for number, (name, parent) in enumerate(zip(file.names, file.parents, strict=True)):
                turn = Rotation.from_quat(
                    np.array(tracks["rotation"][name]).reshape(frames, 4)
                ).as_matrix()
                if parent < 0:
                    positions[:, number] = np.array(tracks["translation"]["hips"]).reshape(
                        frames, 3
                    )
                    turned[:, number] = turn
                else:
                    offset = file.worlds[number, :3, 3] - file.worlds[parent, :3, 3]
                    positions[:, number] = positions[:, parent] + turned[:, parent] @ offset
                    turned[:, number] = turned[:, parent] @ turn
            assert np.abs(positions - ours.positions).max() < 0.01 * MILLIMETER


# The page in the browser writes FBX with tools/web/fbx.js

WEB = ROOT / "tools" / "web"


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the page's scripts, and the person that the page dresses motions with."""
    folder = tmp_path_factory.mktemp("web")
    for path in WEB.glob("*.js"):
        shutil.copy(path, folder)
    (folder / "package.json").write_text('{"type": "module"}')
    example = synthetic("walk")
    example.save(folder / "template.fbx")
    figure = script("tools/web.py").figure(example)
    (folder / "figure.json").write_text(json.dumps(figure))
    return folder


def test_the_page_finds_in_its_template_what_it_changes(template: Path, subtests):
    root = fbx.read(template / "template.fbx")
    figure = json.loads((template / "figure.json").read_text())
    objects, connections = root.first("Objects"), root.first("Connections")
    assert objects is not None
    assert connections is not None
    kinds = Counter(record.name for record in objects.children)
    assert kinds["AnimationCurve"] == 3 * (len(figure["names"]) + 1)
    assert kinds["AnimationStack"] == 1
    models = {
        record.properties[1].partition("\0")[0]: record.first("Properties70")
        for record in objects.all("Model")
    }
    assert list(models) == [*figure["names"], "person"]
    for name, properties in models.items():
        with subtests.test(name=name):
            assert properties is not None
            values = {record.properties[0]: record.properties[4:] for record in properties.children}
            # the page writes rotations relative to a rest pose without rotations
            assert values["PreRotation"] == [0, 0, 0]
            assert len(values["Lcl Translation"]) == 3
    targets = Counter(
        record.properties[3] for record in connections.children if record.properties[0] == "OP"
    )
    joints = len(figure["names"])
    assert targets == {
        "Lcl Rotation": joints,
        "Lcl Translation": 1,
        **dict.fromkeys(("d|X", "d|Y", "d|Z"), joints + 1),
    }


def of_page(test: Callable[..., None]) -> Callable[..., None]:
    """Marks a test of outside tools on the page's file."""
    return pytest.mark.tools(pytest.mark.slow(test))


def written_by_page(template: Path, motion: Motion, text: str) -> Written:
    """The FBX file of a motion, by the page's scripts under Node."""
    if shutil.which("node") is None:
        pytest.skip("Node.js is not installed")
    poses = motion.posed()
    content = {
        "fps": motion.fps,
        "text": text,
        "frames": len(motion.joints),
        "joints": poses.joints().flatten().tolist(),
        "offsets": poses.offsets.flatten().tolist(),
        "quaternions": Rotation.from_matrix(poses.rotations.reshape(-1, 3, 3))
        .as_quat(scalar_first=True)
        .ravel()
        .tolist(),
    }
    (template / "motion.json").write_text(json.dumps(content))
    path = template / "page.fbx"
    node("web_fbx.mjs", template, path)
    return Written(path, motion.fps, fbx_scene.read(path))


@pytest.fixture(scope="module")
def from_page(template: Path) -> tuple[Written, Motion]:
    """The FBX file of another person's motion, longer than the template's, by the page's scripts under Node."""
    motion = synthetic("kick")
    motion = Motion(1.03 * motion.joints, motion.fps, text=motion.text)
    return written_by_page(template, motion, 'a "kick" über 1 m'), motion


@of_page
def test_the_file_of_the_page_has_the_joints_of_the_page(
    from_page: tuple[Written, Motion], template: Path
):
    file, motion = from_page
    lift = json.loads((template / "figure.json").read_text())["lift"]
    expected = motion.posed().joints().numpy() + np.array([0, lift, 0])
    joints = [file.read.names.index(name) for name in SMPL22.joints]
    assert np.abs(file.read.positions[:, joints] - expected).max() < 0.01 * MILLIMETER
    assert file.read.fps == motion.fps
    root = fbx.read(template / "page.fbx")
    takes, objects = root.first("Takes"), root.first("Objects")
    assert takes is not None
    assert objects is not None
    assert takes.value("Current") == 'a "kick" über 1 m'
    # the skin is bound where the bones are
    for cluster in objects.all("Deformer"):
        if cluster.properties[2] == "Cluster":
            inverse, bind = (
                cluster.value(name).reshape(4, 4) for name in ("Transform", "TransformLink")
            )
            np.testing.assert_allclose(inverse @ bind, np.eye(4), atol=1e-9)


@of_page
def test_autodesk_reads_the_file_of_the_page(from_page: tuple[Written, Motion], node_modules: Path):
    file, _ = from_page
    converted = autodesk(node_modules, file.path)
    other, scene = glb_animation.read(converted), glb.read(converted)
    expected = file.positions([0, 2, 20, 40])
    assert largest_difference(file.joints, expected, other, [0, 3, 30, 60]) < 0.01 * MILLIMETER
    assert (len(scene.skins), len(scene.document["materials"])) == (1, 5)


@of_page
@pytest.mark.parametrize(("size", "tolerance"), [(1.0, 13), (1.03, 20)])
def test_the_skin_of_the_page_has_the_size_of_the_template(
    size: float, tolerance: float, template: Path, node_modules: Path, tmp_path: Path, subtests
):
    """In a file of the page, skin moves with its joints; it is not stretched as in a file of the package.

    The pitch of the head at rest is the template's, too: 4 degrees, or 12 mm, from this motion's. `tolerance` is in
    millimeters.
    """
    motion = synthetic("kick")
    motion = Motion(size * motion.joints, motion.fps, text=motion.text)
    file = written_by_page(template, motion, motion.text)
    motion.save(tmp_path / "python.glb")
    surfaces = [
        skinned(tmp_path / "python.glb", 20),
        skinned(autodesk(node_modules, file.path), 30),
    ]
    for name, first, second in (("ours", *surfaces), ("theirs", *surfaces[::-1])):
        with subtests.test(surface=name):
            nearest, _ = KDTree(first).query(second)
            assert nearest.max() < tolerance * MILLIMETER


@of_page
def test_three_reads_the_file_of_the_page(from_page: tuple[Written, Motion], node_modules: Path):
    file, _ = from_page
    (scene,) = node("three_fbx.mjs", node_modules, seconds(file.fps), file.path)
    check_positions(file, FRAMES, scene["frames"])
    assert len(scene["materials"]) == 5


@of_page
def test_ufbx_reads_the_file_of_the_page(from_page: tuple[Written, Motion]):
    file, _ = from_page
    python = python_with("ufbx", "FLAME_MDM_UFBX")
    command = [python, str(ROOT / "tests/support/ufbx_read.py"), seconds(file.fps), str(file.path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    check_positions(file, FRAMES, json.loads(done.stdout)[0])


@of_page
def test_blender_reads_the_file_of_the_page(from_page: tuple[Written, Motion], tmp_path: Path):
    file, _ = from_page
    (scene,) = in_blender(tmp_path / "out.json", file.fps, [file.path])
    check_blender(file, file.joints, scene)


@pytest.mark.parametrize("ending", [".usda", ".usdc", ".usdz"])
def test_usd_files_are_valid_and_have_the_positions_of_the_motion(
    ending: str, tmp_path: Path, subtests
):
    Usd, UsdGeom, UsdSkel = (pxr(name) for name in ("Usd", "UsdGeom", "UsdSkel"))
    motion = synthetic("kick")
    motion.save(tmp_path / f"kick{ending}", rig="mixamo")
    motion.save(tmp_path / "kick.glb", rig="mixamo")
    expected = glb_animation.read(tmp_path / "kick.glb")
    stage = opened(tmp_path / f"kick{ending}")
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (20, len(motion.joints) - 1)

    cache, root = UsdSkel.Cache(), UsdSkel.Root(stage.GetDefaultPrim())
    cache.Populate(root, Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/person/skeleton")))
    names = [
        joint.rpartition("/")[2].replace("mixamorig_", "mixamorig:")
        for joint in query.GetJointOrder()
    ]
    nodes = [expected.names.index(name) for name in names]
    for frame in FRAMES:
        with subtests.test(frame=frame):
            matrices = query.ComputeJointSkelTransforms(frame)
            positions = np.array([list(matrix.ExtractTranslation()) for matrix in matrices])
            assert np.abs(positions - expected.positions[frame, nodes]).max() < 0.01 * MILLIMETER


@pytest.mark.parametrize("rig", ["mixamo", "unreal"])
def test_usd_files_have_the_rest_pose_and_the_surface_of_a_glb_file(rig: str, tmp_path: Path):
    UsdGeom, UsdSkel = pxr("UsdGeom"), pxr("UsdSkel")
    motion = Motion(synthetic("kick").joints[20:30], 20)
    motion.save(tmp_path / "kick.usdc", rig=rig)
    motion.save(tmp_path / "kick.glb", rig=rig)
    stage = opened(tmp_path / "kick.usdc")
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/person/skeleton"))
    # USD multiplies row vectors by matrices.
    rest, binds = (
        np.array(attribute.Get()).mT
        for attribute in (skeleton.GetRestTransformsAttr(), skeleton.GetBindTransformsAttr())
    )
    paths = list(skeleton.GetJointsAttr().Get())
    file = glb.read(tmp_path / "kick.glb")
    nodes = [
        [name.replace(":", "_") for name in file.names].index(path.rpartition("/")[2])
        for path in paths
    ]
    for joint, path in enumerate(paths):
        if "/" in path:
            rest[joint] = rest[paths.index(path.rpartition("/")[0])] @ rest[joint]
    np.testing.assert_allclose(rest, file.worlds[nodes], atol=1e-6)

    cache, root = UsdSkel.Cache(), UsdSkel.Root(stage.GetDefaultPrim())
    cache.Populate(root, pxr("Usd").PrimDefaultPredicate)
    worlds = np.array(cache.GetSkelQuery(skeleton).ComputeJointSkelTransforms(9)).mT
    (mesh,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    binding = UsdSkel.BindingAPI(mesh.GetPrim())
    points = np.pad(np.array(mesh.GetPointsAttr().Get()), ((0, 0), (0, 1)), constant_values=1)
    bones, weights = (
        np.array(primvar.Get()).reshape(len(points), -1)
        for primvar in (binding.GetJointIndicesPrimvar(), binding.GetJointWeightsPrimvar())
    )
    moves = worlds @ np.linalg.inv(binds)
    moved = np.einsum("vk,vkij,vj->vi", weights, moves[bones], points)[:, :3]
    np.testing.assert_allclose(moved, skinned(tmp_path / "kick.glb", 9), atol=1e-5)


def test_without_usd_core_the_error_says_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(
        UserError, match=r"require the usd-core package\. Run pip install .flame-mdm\[usd\]"
    ):
        synthetic("kick").save(tmp_path / "kick.usdz")
    assert list(tmp_path.iterdir()) == []


def test_a_motion_without_a_body_is_written_as_bones(tmp_path: Path):
    motion = synthetic("kick")
    giant = Motion(motion.joints * 4, motion.fps, text="a giant kicks")
    line = giant.save(tmp_path / "giant.fbx")
    assert "without a body" in line
    assert fbx_scene.read(tmp_path / "giant.fbx").positions.shape[1] == 22


def test_usd_files_have_linear_colors_for_their_triangles_and_boxes_around_the_person(
    tmp_path: Path,
):
    Usd, UsdGeom, UsdShade = (pxr(name) for name in ("Usd", "UsdGeom", "UsdShade"))
    motion = Motion(synthetic("kick").joints[20:23], 20)
    motion.save(tmp_path / "kick.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "kick.usdc"))
    poses, fitted = motion.posed(), fit_body(motion)
    (skin,) = rigged(poses, "kick", 20, preset(None, poses), fitted).skins
    covered = 0
    for number, (name, color) in enumerate(zip(MATERIAL_NAMES, MATERIALS, strict=True)):
        shader = UsdShade.Shader(stage.GetPrimAtPath(f"/person/materials/{name}/surface"))
        linear = list(shader.GetInput("diffuseColor").Get())
        np.testing.assert_allclose(linear, (np.array(color) / 255) ** 2.2, atol=1e-6)
        subset = UsdGeom.Subset(stage.GetPrimAtPath(f"/person/person/{name}"))
        triangles = np.array(subset.GetIndicesAttr().Get())
        np.testing.assert_array_equal(triangles, np.flatnonzero(skin.materials == number))
        covered += len(triangles)
    assert covered == len(skin.triangles)
    boxes = UsdGeom.Boundable(stage.GetDefaultPrim()).GetExtentAttr()
    for frame, joints in enumerate(poses.joints().numpy() + np.array([0, fitted.lift, 0])):
        expected = [joints.min(0) - 0.25, joints.max(0) + 0.25]
        np.testing.assert_allclose(np.array(boxes.Get(frame)), expected, atol=1e-4)
