"""FBX, VRMA and USD files in other readers: Autodesk's SDK, three.js, ufbx, assimp, Blender and usd-core."""

import importlib.util
import json
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from support.fixtures import ROOT, blender
from support.glb import odd_character, write_names
from support.motions import synthetic

from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.formats import fbx_scene, glb, glb_animation, vrma
from flame_mdm.formats.animated import AnimatedNodes
from flame_mdm.formats.body import fit_body
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.retarget import presets
from flame_mdm.representations.skeleton import SMPL22

PACKAGES = {
    "fbx2gltf": "0.9.7",
    "three": "0.187.0",
    "@pixiv/three-vrm": "3.5.5",
    "@pixiv/three-vrm-animation": "3.5.5",
    "gltf-validator": "2.0.0-dev.3.10",
}
"""Packages of npm that read the files; fbx2gltf contains Autodesk's FBX SDK."""
MILLIMETER = 1e-3
FRAMES = [0, 7, 20, 41]
RIGS = [None, *presets()]
MOTIONS = 10  # synthetic motions at each of two frame rates


@pytest.fixture(scope="session")
def node_modules() -> Path:
    """A folder with the packages of npm; installed once, and again when a version changes."""
    if shutil.which("npm") is None:
        pytest.skip("npm is not installed")
    folder = ROOT / ".pytest_cache" / "npm"
    manifest = json.dumps({"dependencies": PACKAGES})
    if not (folder / "package.json").exists() or (folder / "package.json").read_text() != manifest:
        folder.mkdir(parents=True, exist_ok=True)
        words = [f"{name}@{version}" for name, version in PACKAGES.items()]
        subprocess.run(["npm", "install", "--silent", "--no-save", *words], cwd=folder, check=True)
        (folder / "package.json").write_text(manifest)
    return folder


def node(script: str, folder: Path, *words: object) -> Any:
    command = ["node", ROOT / "tests/support" / script, folder, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def autodesk(folder: Path, file: Path) -> Path:
    """The .glb file that fbx2gltf makes with Autodesk's SDK, at 30 frames per second."""
    program = folder / "node_modules/fbx2gltf/bin/Linux/FBX2glTF"
    program.chmod(0o755)
    out = file.with_name(f"{file.stem}_autodesk")
    command = [program, "-i", file, "-o", out, "-b", "--anim-framerate", "bake30"]
    subprocess.run(command, capture_output=True, check=True)
    return out.with_suffix(".glb")


def largest_difference(names: list[str], first: np.ndarray, other: AnimatedNodes, frames: list[int]) -> float:
    """The largest distance in meters between positions (F, N, 3) of named joints and nodes of the same name."""
    nodes = [other.names.index(name) for name in names]
    return float(np.abs(first - other.positions[frames][:, nodes]).max())


def bones(motion: AnimatedNodes, meshes: tuple[str, ...] = ("person",)) -> list[int]:
    return [number for number, name in enumerate(motion.names) if name not in meshes]


@pytest.mark.tools
@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("rig", RIGS)
def test_autodesk_and_three_read_what_was_written(rig: str | None, node_modules: Path, tmp_path: Path):
    """Ten motions on each rig at each of two frame rates, in Autodesk's SDK, three.js and our reader."""
    for fps in (20.0, 30.0):
        for number, clip in enumerate(Synthetic(clips=MOTIONS).clips(fps)):
            motion = Motion(np.asarray(clip.motion), fps, text=clip.captions[0])
            path = tmp_path / f"{number}_{fps:g}.fbx"
            motion.save(path, rig=rig)
            ours = fbx_scene.read(path)
            numbers = bones(ours)
            names = [ours.names[joint] for joint in numbers]
            # both have frames at whole tenths of a second
            seconds = np.arange(int((len(ours.positions) - 1) / fps * 10) + 1) / 10
            frames = np.round(seconds * fps).astype(int).tolist()
            converted = autodesk(node_modules, path)
            other, file = glb_animation.read(converted), glb.read(converted)
            expected = ours.positions[frames][:, numbers]
            in_theirs = np.round(seconds * other.fps).astype(int).tolist()
            assert largest_difference(names, expected, other, in_theirs) < 0.01 * MILLIMETER
            assert len(file.skins) == 1
            assert len(file.document["materials"]) == 5
            if fps == 20:
                scene = node("three_fbx.mjs", node_modules, path, *(frame / fps for frame in FRAMES))
                assert scene["meshes"] >= 1
                for frame, positions in zip(FRAMES, scene["frames"], strict=True):
                    theirs = np.array([positions[name] for name in names]) / 100
                    assert np.abs(theirs - ours.positions[frame, numbers]).max() < 0.01 * MILLIMETER


@pytest.mark.tools
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_surface_in_autodesk_is_that_of_pictures(node_modules: Path, tmp_path: Path):
    """The vertices of the file that Autodesk's SDK made, skinned, against the vertices of the motion's .glb file."""
    motion = synthetic("kick")
    motion.save(tmp_path / "kick.fbx", rig="mixamo")
    motion.save(tmp_path / "kick.glb", rig="mixamo")
    surfaces = []
    for path, frame in ((tmp_path / "kick.glb", 20), (autodesk(node_modules, tmp_path / "kick.fbx"), 30)):
        surfaces.append(skinned(path, frame))
    # the SDK's file has a vertex once per material that meets there, in another order
    for first, second in (surfaces, surfaces[::-1]):
        nearest, _ = KDTree(first).query(second)
        assert nearest.max() < 0.02 * MILLIMETER


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


@pytest.mark.tools
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_character_becomes_fbx_with_its_own_skin(node_modules: Path, tmp_path: Path):
    synthetic("kick").save(tmp_path / "hero.glb", rig="mixamo")
    odd_character(tmp_path / "odd.glb", synthetic("kick"))
    write_names(tmp_path / "odd.yaml")
    for name in ("hero", "odd"):
        motion = synthetic("wave")
        motion.save(tmp_path / "wave.fbx", character=tmp_path / f"{name}.glb")
        motion.save(tmp_path / "wave.glb", character=tmp_path / f"{name}.glb")
        expected = glb_animation.read(tmp_path / "wave.glb")
        ours = fbx_scene.read(tmp_path / "wave.fbx")
        joints = [joint for joint in expected.names if joint in ours.names]
        numbers = [expected.names.index(joint) for joint in joints]
        frames = list(range(len(expected.positions)))
        assert largest_difference(joints, expected.positions[:, numbers], ours, frames) < 0.01 * MILLIMETER
        theirs = glb_animation.read(autodesk(node_modules, tmp_path / "wave.fbx"))
        shared = [joint for joint in joints if joint in theirs.names]
        assert len(shared) >= 22
        numbers = [expected.names.index(joint) for joint in shared]
        whole = [0, 20, 40]
        difference = largest_difference(shared, expected.positions[whole][:, numbers], theirs, [0, 30, 60])
        assert difference < 0.01 * MILLIMETER


UFBX = """
import json, sys, ufbx
scene = ufbx.load_file(sys.argv[1])
kept = [scene]  # its objects are freed too early
stacks = scene.anim_stacks
stack = stacks[0]
animation = stack.anim
kept += [stacks, stack, animation]
frames = []
for time in map(float, sys.argv[2:]):
    evaluated = ufbx.evaluate_scene(scene, animation, time)
    nodes = evaluated.nodes
    kept += [evaluated, nodes]
    positions = {}
    for number in range(len(nodes)):
        node = nodes[number]
        matrix = node.node_to_world
        column = matrix.c3
        kept += [node, matrix, column]
        positions[node.name] = [column.x, column.y, column.z]
    frames.append(positions)
print(json.dumps(frames))
sys.stdout.flush()
import os
os._exit(0)
"""


@pytest.mark.tools
@pytest.mark.slow
@pytest.mark.parametrize("rig", RIGS)
def test_ufbx_reads_what_was_written(rig: str | None, tmp_path: Path):
    if importlib.util.find_spec("ufbx") is None:
        pytest.skip("ufbx is not installed: pip install ufbx==0.0.5")
    synthetic("kick").save(tmp_path / "kick.fbx", rig=rig)
    ours = fbx_scene.read(tmp_path / "kick.fbx")
    times = [str(frame / 20) for frame in FRAMES]
    command = [sys.executable, "-c", UFBX, str(tmp_path / "kick.fbx"), *times]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    for frame, positions in zip(FRAMES, json.loads(done.stdout), strict=True):
        for number in bones(ours):
            theirs = np.array(positions[ours.names[number]]) / 100
            assert np.abs(theirs - ours.positions[frame, number]).max() < 0.01 * MILLIMETER


@pytest.mark.tools
@pytest.mark.slow
@pytest.mark.parametrize("rig", ["mixamo", "unreal", "lafan1"])
@pytest.mark.parametrize("ending", [".fbx", ".usdc"])
def test_blender_reads_what_was_written(rig: str, ending: str, tmp_path: Path):
    if ending == ".usdc":
        pytest.importorskip("pxr", reason="usd-core is not installed")
    motion = synthetic("kick")
    motion.save(tmp_path / f"kick{ending}", rig=rig)
    motion.save(tmp_path / "kick.fbx", rig=rig)
    expected = fbx_scene.read(tmp_path / "kick.fbx")
    script = ROOT / "tests/support/blender_import.py"
    words = [str(tmp_path / f"kick{ending}"), str(tmp_path / "out.json"), *map(str, FRAMES)]
    subprocess.run([blender(), str(script), *words], capture_output=True, check=True)
    result = json.loads((tmp_path / "out.json").read_text())
    moving = [number for number in bones(expected) if expected.names[number] != "root"]
    for frame, positions in zip(FRAMES, result["frames"], strict=True):
        for number in moving:
            name = expected.names[number]
            x, y, z = positions.get(name) or positions[name.replace(":", "_")]
            # Blender's z is up
            assert np.abs(np.array([x, z, -y]) - expected.positions[frame, number]).max() < 0.05 * MILLIMETER
    assert result["vertices"] >= 2302
    assert len(set(result["materials"])) >= 5


@pytest.mark.tools
def test_assimp_finds_skeleton_skin_and_animation(tmp_path: Path):
    if shutil.which("assimp") is None:
        pytest.skip("assimp is not installed: apt-get install assimp-utils")
    synthetic("kick").save(tmp_path / "kick.fbx", rig="unity")
    command = ["assimp", "info", str(tmp_path / "kick.fbx")]
    report = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    facts = {line.split(":")[0].strip(): line.split(":")[1].strip() for line in report.splitlines() if ":" in line}
    assert int(facts["Animations"]) == 1
    assert int(facts["Bones"]) >= 22
    assert int(facts["Materials"]) >= 5


def test_a_vrm_animation_has_the_positions_of_the_motion_and_the_rest_pose_of_vrm(tmp_path: Path):
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
        channel["target"]["node"] for channel in animation["channels"] if channel["target"]["path"] == "translation"
    ]
    assert moved == [document["extensions"]["VRMC_vrm_animation"]["humanoid"]["humanBones"]["hips"]["node"]]
    assert len(set(vrma.LIMBS)) == 4


@pytest.mark.tools
@pytest.mark.slow
def test_three_vrm_animation_reads_the_motion(node_modules: Path, tmp_path: Path):
    """Its normalized tracks, applied to the rest pose by forward kinematics, give our joints."""
    for action in ("walk", "jump", "kick"):
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
            turn = Rotation.from_quat(np.array(tracks["rotation"][name]).reshape(frames, 4)).as_matrix()
            if parent < 0:
                positions[:, number] = np.array(tracks["translation"]["hips"]).reshape(frames, 3)
                turned[:, number] = turn
            else:
                offset = file.worlds[number, :3, 3] - file.worlds[parent, :3, 3]
                positions[:, number] = positions[:, parent] + turned[:, parent] @ offset
                turned[:, number] = turned[:, parent] @ turn
        assert np.abs(positions - ours.positions).max() < 0.01 * MILLIMETER


@pytest.mark.parametrize("ending", [".usda", ".usdc", ".usdz"])
def test_usd_files_are_valid_and_have_the_positions_of_the_motion(ending: str, tmp_path: Path):
    pytest.importorskip("pxr", reason="usd-core is not installed: pip install .[usd]")
    names = ("Usd", "UsdGeom", "UsdSkel", "UsdValidation")
    Usd, UsdGeom, UsdSkel, UsdValidation = (cast(Any, import_module(f"pxr.{name}")) for name in names)

    motion = synthetic("kick")
    motion.save(tmp_path / f"kick{ending}", rig="mixamo")
    motion.save(tmp_path / "kick.glb", rig="mixamo")
    expected = glb_animation.read(tmp_path / "kick.glb")
    stage = Usd.Stage.Open(str(tmp_path / f"kick{ending}"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (20, len(motion.joints) - 1)

    cache, root = UsdSkel.Cache(), UsdSkel.Root(stage.GetDefaultPrim())
    cache.Populate(root, Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/person/skeleton")))
    names = [joint.rpartition("/")[2].replace("mixamorig_", "mixamorig:") for joint in query.GetJointOrder()]
    nodes = [expected.names.index(name) for name in names]
    for frame in FRAMES:
        matrices = query.ComputeJointSkelTransforms(frame)
        positions = np.array([list(matrix.ExtractTranslation()) for matrix in matrices])
        assert np.abs(positions - expected.positions[frame, nodes]).max() < 0.01 * MILLIMETER


def test_without_usd_core_the_error_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(UserError, match=r"need the package usd-core: install it with pip install .flame-mdm\[usd\]"):
        synthetic("kick").save(tmp_path / "kick.usdz")
    assert list(tmp_path.iterdir()) == []


def test_a_motion_without_a_body_is_written_as_bones(tmp_path: Path):
    motion = synthetic("kick")
    giant = Motion(motion.joints * 4, motion.fps, text="a giant kicks")
    line = giant.save(tmp_path / "giant.fbx")
    assert "without a body" in line
    assert fbx_scene.read(tmp_path / "giant.fbx").positions.shape[1] == 22
