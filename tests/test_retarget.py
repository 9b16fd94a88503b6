"""Motions on the skeletons of other programs."""

import json
import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from flame_mdm.__main__ import main
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.formats import bvh, characters
from flame_mdm.formats.characters import LIMBS, SIDES
from flame_mdm.formats.glb import Binary
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import read
from flame_mdm.formats.retarget import joint_names, preset, presets
from flame_mdm.representations.rotation import quaternion_to_matrix
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.visualize.body import world_rotations

BLENDED = {"cmu": ("spine1", "left_collar", "right_collar"), "100style": ("spine3",)}
"""Joints that the reader of these skeletons places between two of the file's."""
JOINT = {name: number for number, name in enumerate(SMPL22.joints)}


@pytest.fixture(scope="module")
def kick() -> Motion:
    clip = next(clip for clip in Synthetic(clips=60).clips(20) if clip.attributes["action"] == "kick")
    return Motion(np.asarray(clip.motion), 20.0, id="kick", text="a person kicks")


def read_glb(path: Path) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The document of a .glb file and the arrays of its accessors."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    arrays = []
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        kind = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        arrays.append(np.frombuffer(binary, kind, accessor["count"] * width, start).reshape(-1, width))
    return document, arrays


def glb_worlds(path: Path) -> tuple[dict[str, Any], list[np.ndarray], np.ndarray]:
    """The document and arrays of a .glb file, and the matrices (F, N, 4, 4) of its nodes in the frames."""
    document, arrays = read_glb(path)
    animation = document["animations"][0]
    frames = max(len(arrays[sampler["input"]]) for sampler in animation["samplers"])
    nodes = document["nodes"]
    parts = {
        "translation": np.array([node.get("translation", [0, 0, 0]) for node in nodes], float)[None].repeat(frames, 0),
        "rotation": np.array([node.get("rotation", [0, 0, 0, 1]) for node in nodes], float)[None].repeat(frames, 0),
        "scale": np.array([node.get("scale", [1, 1, 1]) for node in nodes], float)[None].repeat(frames, 0),
    }
    for channel in animation["channels"]:
        target = channel["target"]
        parts[target["path"]][:, target["node"]] = arrays[animation["samplers"][channel["sampler"]]["output"]]
    local = np.tile(np.eye(4), (frames, len(nodes), 1, 1))
    turns = quaternion_to_matrix(torch.from_numpy(parts["rotation"][..., [3, 0, 1, 2]])).numpy()
    local[..., :3, :3] = turns * parts["scale"][..., None, :]
    local[..., :3, 3] = parts["translation"]
    for number, node in enumerate(nodes):
        if "matrix" in node:
            local[:, number] = np.array(node["matrix"]).reshape(4, 4).T
    worlds = local.copy()

    def descend(number: int) -> None:
        for child in nodes[number].get("children", []):
            worlds[:, child] = worlds[:, number] @ local[:, child]
            descend(child)

    for root in document["scenes"][document.get("scene", 0)]["nodes"]:
        descend(root)
    return document, arrays, worlds


def skin(document: dict[str, Any], arrays: list[np.ndarray], worlds: np.ndarray) -> np.ndarray:
    """Vertices (V, 3) of the first mesh of a file with joints in `worlds` (N, 4, 4)."""
    found = next(node for node in document["nodes"] if "skin" in node)
    joints = document["skins"][found["skin"]]["joints"]
    bind = arrays[document["skins"][found["skin"]]["inverseBindMatrices"]].reshape(-1, 4, 4).swapaxes(1, 2)
    attributes = document["meshes"][found["mesh"]]["primitives"][0]["attributes"]
    points = np.pad(arrays[attributes["POSITION"]], ((0, 0), (0, 1)), constant_values=1)
    weights = arrays[attributes["WEIGHTS_0"]] / (255 if arrays[attributes["WEIGHTS_0"]].dtype == np.uint8 else 1)
    blended = np.einsum("vk,vkij->vij", weights, (worlds[joints] @ bind)[arrays[attributes["JOINTS_0"]]])
    return np.einsum("vij,vj->vi", blended, points)[:, :3]


# Known skeletons ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", presets())
def test_a_known_skeleton_brings_the_joints_back(name: str, kick: Motion, tmp_path: Path):
    kick.save(tmp_path / "a.bvh", rig=name)
    back = read(tmp_path / "a.bvh").joints
    exact = [number for joint, number in JOINT.items() if joint not in BLENDED.get(name, ())]
    np.testing.assert_allclose(back[:, exact], kick.joints[:, exact], rtol=0, atol=1e-5)
    assert np.abs(back - kick.joints).max() < 0.07


@pytest.mark.parametrize("name", presets())
def test_joints_and_body_of_a_glb_do_not_depend_on_the_skeleton(name: str, kick: Motion, tmp_path: Path):
    kick.save(tmp_path / "a.glb", rig=name)
    kick.save(tmp_path / "b.glb")
    document, arrays, worlds = glb_worlds(tmp_path / "a.glb")
    rig = preset(name, kick.posed())
    assert [node["name"] for node in document["nodes"][:-2]] == list(rig.joints)
    lift = np.array(document["nodes"][-1]["translation"])  # by the thickness of the soles
    for node, source in enumerate(rig.sources):
        if source >= 0:
            np.testing.assert_allclose(worlds[:, node, :3, 3] - lift, kick.joints[:, source], rtol=0, atol=1e-5)
    for frame in (0, 30):
        expected = glb_worlds(tmp_path / "b.glb")
        moved = skin(document, arrays, worlds[frame])
        np.testing.assert_allclose(moved, skin(*expected[:2], expected[2][frame]), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "joint", "axis", "toward"),
    [
        *(("lafan1", "Hips", "x", (0, 1, 0)), ("lafan1", "Hips", "y", (0, 0, 1)), ("lafan1", "Hips", "z", (1, 0, 0))),
        *(("lafan1", "LeftLeg", "x", "LeftFoot"), ("lafan1", "RightLeg", "x", "RightFoot")),
        *(("lafan1", "LeftArm", "x", "LeftForeArm"), ("lafan1", "RightForeArm", "x", "RightHand")),
        *(("soma", "LeftShin", "x", "LeftFoot"), ("geno", "LeftArm", "y", "LeftForeArm")),
        *(("geno", "RightFoot", "z", "RightToeBase"), ("geno", "RightArm", "z", (0, 0, 1))),
        *(("100style", "LeftShoulder", "x", (1, 0, 0)), ("mixamo", "mixamorig:LeftArm", "y", (0, 1, 0))),
    ],
)
def test_local_axes_are_those_of_the_skeleton(name: str, joint: str, axis: str, toward: Any, kick: Motion):
    rig = preset(name, kick.posed())
    number = rig.joints.index(joint)
    if isinstance(toward, str):
        toward = rig.positions[rig.joints.index(toward)] - rig.positions[number]
        toward /= np.linalg.norm(toward)
    found = rig.neutral[number][:, "xyz".index(axis)]
    np.testing.assert_allclose(found, toward, atol=0.12)  # limbs of SMPL's T-pose slope a little
    np.testing.assert_allclose(np.linalg.det(rig.neutral), 1)


def test_axes_of_soma_on_the_right_are_opposite_to_the_mirrored(kick: Motion):
    rig = preset("soma", kick.posed())
    left, right = (rig.neutral[rig.joints.index(f"{side}Shin")] for side in ("Left", "Right"))
    np.testing.assert_allclose(right, -np.diag([-1, 1, 1]) @ left, atol=0.1)


def test_the_rest_pose_of_unreal_is_an_a_pose(kick: Motion, tmp_path: Path):
    kick.save(tmp_path / "a.bvh", rig="unreal", rest_pose=True)
    file = bvh.read(tmp_path / "a.bvh")
    places = dict(zip(file.joints, file.positions()[0], strict=True))
    arm = places["lowerarm_l"] - places["upperarm_l"]
    assert np.degrees(np.arctan2(-arm[1], arm[0])) == pytest.approx(45, abs=10)
    assert len(file.frames) == len(kick.joints) + 1
    assert min(place[1] for place in places.values()) == pytest.approx(0, abs=1e-3)


def test_rotations_of_the_source_are_kept(kick: Motion):
    """Every joint of the rig has the rotation of its counterpart, also where positions do not show it."""
    from flame_mdm.formats.retarget import retarget

    poses = kick.posed()
    rig = preset("lafan1", poses)
    turned = retarget(poses, rig)[0]
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            turned[:, joint] = turned[:, parent] @ turned[:, joint]
    body = world_rotations(poses.rotations.numpy())
    np.testing.assert_allclose(turned @ rig.neutral.swapaxes(1, 2), body[:, list(rig.sources)], atol=1e-9)


def test_an_unknown_rig_is_refused(kick: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(UserError, match=r"rig=miximo: unknown\. Did you mean mixamo\? Use one of mixamo, unreal, "):
        kick.save(tmp_path / "a.bvh", rig="miximo")
    with pytest.raises(ValueError, match=r"rig is only for \.bvh and \.glb"):
        kick.save(tmp_path / "a.npz", rig="mixamo")
    kick.save(tmp_path / "a.npz")
    assert main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "b.bvh"), "rig=unreal"]) == 0
    assert main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "c.bvh"), "rig=unrael"]) == 1
    assert "rig=unrael: unknown. Did you mean unreal" in capsys.readouterr().err
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["a.npz", "b.bvh"]


# Own characters -------------------------------------------------------------------------------------------------------


def odd_glb(path: Path, kick: Motion, turned: bool = True) -> None:
    """Another character: A-pose, longer legs, odd names, centimeters and z up below a node with scale 0.01."""
    poses = kick.posed()
    longer = poses.offsets.clone()
    longer[[4, 5, 7, 8]] *= 1.2  # legs
    longer[[18, 19, 20, 21]] *= 0.9  # arms
    longer[[10, 11]] *= 1.3  # feet
    other = Motion(type(poses)(longer, poses.rotations, poses.root).joints().float().numpy(), 20.0)
    other.save(path, rig="unreal")
    document = read_glb(path)[0]
    length = len(json.dumps(document, separators=(",", ":")).encode())
    data = bytearray(path.read_bytes()[28 + length + -length % 4 :])
    del document["animations"]
    nodes, roots = document["nodes"], document["scenes"][0]["nodes"]
    lifted = next(number for number, node in enumerate(nodes) if node["name"] == "lifted")
    for node in nodes[: lifted - 1]:
        node["translation"] = [100 * x for x in node["translation"]]
        node["name"] = "Rig Bone-" + node["name"][::-1]
    half = 0.5**0.5
    nodes[lifted] |= {"scale": [0.01] * 3, "rotation": [half if turned else 0.0, 0, 0, half if turned else 1.0]}
    if turned:  # a node that undoes it: the file is y up again
        nodes.append({"name": "armature", "rotation": [-half, 0, 0, half], "children": [lifted]})
        document["scenes"][0]["nodes"] = [len(nodes) - 1 if root == lifted else root for root in roots]
    view = document["bufferViews"][document["accessors"][document["skins"][0]["inverseBindMatrices"]]["bufferView"]]
    bind = np.frombuffer(data, "<f4", view["byteLength"] // 4, view["byteOffset"]).reshape(-1, 4, 4).copy()
    bind[:, :, :3] *= 100  # of columns, as matrices are stored: the mesh stays in meters
    data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]] = bind.tobytes()
    Binary(data, document["bufferViews"], document["accessors"]).save(path, document)


def write_names(path: Path, **other: str | None) -> None:
    """The file of names of `odd_glb`."""
    names = {joint: "Rig Bone-" + name[::-1] for joint, name in joint_names(presets()["unreal"]).items()}
    assert len(names) == len(SMPL22)
    path.write_text("".join(f"{ours}: {json.dumps(theirs)}\n" for ours, theirs in {**names, **other}.items()))


def limbs_off(found: dict[str, np.ndarray], joints: np.ndarray, limbs: tuple[str, ...] = tuple(LIMBS)) -> float:
    """Median angle in degrees between the limbs of a character and those of a motion, of the worst limb."""
    angles = []
    for side in SIDES:
        for start in limbs:
            ours = joints[:, JOINT[f"{side}_{LIMBS[start]}"]] - joints[:, JOINT[f"{side}_{start}"]]
            theirs = found[f"{side}_{LIMBS[start]}"] - found[f"{side}_{start}"]
            cosine = (ours * theirs).sum(1) / np.linalg.norm(ours, axis=1) / np.linalg.norm(theirs, axis=1)
            angles.append(float(np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1))))))
    return max(angles)


def of_glb(path: Path, character: characters.Character) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Positions (F, 3) of SMPL's joints in a written character, and its vertices (F, V, 3)."""
    document, arrays, worlds = glb_worlds(path)
    assert isinstance(character.file, characters.glb.Glb)
    found = {joint: worlds[:, character.file.nodes[number], :3, 3] for joint, number in character.map.items()}
    return found, np.stack([skin(document, arrays, worlds[frame]) for frame in range(len(worlds))])


@pytest.mark.parametrize("turned", [False, True])
def test_a_character_with_odd_names_scale_and_rest_pose(kick: Motion, tmp_path: Path, turned: bool):
    hero = tmp_path / "hero.glb"
    odd_glb(hero, kick, turned)
    write_names(tmp_path / "hero.yaml")
    line = kick.save(tmp_path / "out.glb", character=hero)
    assert ", 22 of 2" in line
    character = characters.read(hero)
    found, points = of_glb(tmp_path / "out.glb", character)
    assert limbs_off(found, kick.joints, ("shoulder", "elbow")) < 0.1
    assert limbs_off(found, kick.joints, ("hip", "knee")) < 6  # the legs reach for the floor
    feet = [JOINT["left_foot"], JOINT["right_foot"]]
    standing = kick.joints[:, feet, 1].min(1) < 0.005
    assert np.median(np.abs(points[standing, :, 1].min(1))) < 0.010
    assert np.abs(points[standing, :, 1].min(1)).max() < 0.03
    before, after = read_glb(hero)[0], read_glb(tmp_path / "out.glb")[0]
    for part in ("meshes", "materials", "skins"):
        assert after[part] == before[part]
    for number, source in (("left_ankle", "left_foot"), ("right_ankle", "right_foot")):
        foot = found[source] - found[number]
        assert np.median(foot[standing, 2]) > 0  # it faces +z, as the motion does


def test_a_character_in_its_own_proportions_is_the_motion(kick: Motion, tmp_path: Path):
    """Bones as long as the motion's: every joint is where the motion's is, up to the height of the soles."""
    for name, ending in (("lafan1", ".glb"), ("unreal", ".glb"), ("mixamo", ".glb")):
        kick.save(tmp_path / f"hero{ending}", rig=name)
        character = characters.read(tmp_path / f"hero{ending}")
        kick.save(tmp_path / f"out{ending}", character=character)
        found, _ = of_glb(tmp_path / "out.glb", character)
        for side in SIDES:
            for joint in ("hip", "knee", "ankle", "foot", "wrist"):
                expected = kick.joints[:, JOINT[f"{side}_{joint}"]]
                off = np.linalg.norm((found[f"{side}_{joint}"] - expected)[:, [0, 2]], axis=1)
                assert np.median(off) < 0.012, (name, side, joint)


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_bvh_character_keeps_its_skeleton(kick: Motion, tmp_path: Path, up: str):
    kick.save(tmp_path / "hero.bvh", rig="unreal", rest_pose=True)
    file = bvh.read(tmp_path / "hero.bvh")
    if up == "z":
        turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        file = characters.replace(file, offsets=file.offsets @ turn.T, end_offsets=file.end_offsets @ turn.T)
        file = characters.replace(file, frames=np.zeros_like(file.frames[:1]))  # its rest pose is that of the offsets
        bvh.write(file, tmp_path / "hero.bvh")
    line = kick.save(tmp_path / "out.bvh", character=tmp_path / "hero.bvh")
    assert "22 of 23 joints follow the motion, 1 keep their angle" in line
    out = bvh.read(tmp_path / "out.bvh")
    assert (out.joints, out.parents, out.channels) == (file.joints, file.parents, file.channels)
    np.testing.assert_array_equal(out.offsets, file.offsets)
    character = characters.read(tmp_path / "hero.bvh")
    places = out.positions() @ character.rig.frame.T / 100
    found = {joint: places[:, number] for joint, number in character.map.items()}
    assert limbs_off(found, kick.joints, ("shoulder", "elbow")) < 0.1
    assert limbs_off(found, kick.joints) < 1
    low = places[:, [character.map["left_foot"], character.map["right_foot"]], 1]
    np.testing.assert_allclose(np.median(low.min(1)), np.median(kick.joints[..., 1].min(1)), atol=0.01)


def test_limbs_of_a_character_do_not_flip(kick: Motion, tmp_path: Path):
    odd_glb(tmp_path / "hero.glb", kick)
    write_names(tmp_path / "hero.yaml")
    world = characters.moved(characters.read(tmp_path / "hero.glb"), kick)[0]
    body = world_rotations(kick.posed().rotations.numpy())

    def step(turns: np.ndarray) -> float:
        trace = np.einsum("fjab,fjab->fj", turns[1:], turns[:-1])
        return float(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))).max())

    assert step(world) < step(body) + 10


def test_spines_of_other_lengths(kick: Motion, tmp_path: Path):
    """The chest, from which the arms start, turns as the motion's, however many joints are below it."""
    kick.save(tmp_path / "hero.bvh", rig="mixamo")
    text = (tmp_path / "hero.bvh").read_text()
    (tmp_path / "hero.bvh").write_text(text.replace("Spine2", "Thorax").replace("Spine1", "Lumbar"))
    character = characters.read(tmp_path / "hero.bvh")
    assert not {"spine2", "spine3"} & character.map.keys()
    assert character.rig.sources[character.map["spine1"]] == JOINT["spine3"]


# Bad input ------------------------------------------------------------------------------------------------------------


def test_a_template_of_names_is_printed(kick: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    hero, out = tmp_path / "hero.glb", str(tmp_path / "out.glb")
    odd_glb(hero, kick)
    kick.save(tmp_path / "a.npz")
    (tmp_path / "hero.yaml").touch()  # as a shell does that redirects the output
    assert main(["convert", str(tmp_path / "a.npz"), out, f"character={hero}"]) == 1
    printed = capsys.readouterr()
    assert printed.out.startswith("# Joints of hero.glb: ")
    assert {line.split(":")[0] for line in printed.out.splitlines()[1:]} == set(JOINT)
    assert "no joint found for pelvis, left_hip" in printed.err
    assert "hero.yaml" in printed.err
    assert printed.err.count("\n") == 1
    assert not (tmp_path / "out.glb").exists()
    write_names(tmp_path / "hero.yaml")
    assert main(["convert", str(tmp_path / "a.npz"), out, f"character={hero}"]) == 0


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"left_nee": "x"}, r"hero\.yaml: left_nee is no joint of SMPL\. Did you mean left_knee"),
        (
            {"left_knee": "Rig Bone-l_flak"},
            r"left_knee: .*hero\.glb has no joint Rig Bone-l_flak\. Did you mean Rig",
        ),
        (
            {"left_knee": "Rig Bone-r_flac"},
            r"hero\.yaml: Rig Bone-r_flac is listed for left_knee and for another",
        ),
        ({"left_knee": None}, r"no joint found for left_knee\. Write"),
        ({"left_knee": "Rig Bone-l_hgiht", "left_hip": "Rig Bone-l_eflac"}, "upright|has no joint"),
    ],
)
def test_wrong_names_are_refused(other: dict[str, str | None], message: str, kick: Motion, tmp_path: Path):
    odd_glb(tmp_path / "hero.glb", kick)
    write_names(tmp_path / "hero.yaml", **other)
    with pytest.raises(UserError, match=message):
        characters.read(tmp_path / "hero.glb")


def changed(path: Path, change: Any) -> None:
    """Rewrites a .glb file with a changed document."""
    document = read_glb(path)[0]
    length = len(json.dumps(document, separators=(",", ":")).encode())
    data = path.read_bytes()[28 + length + -length % 4 :]
    change(document)
    Binary(data, document["bufferViews"], document["accessors"]).save(path, document)


def lying(document: dict[str, Any]) -> None:
    document["nodes"].append({"children": document["scenes"][0].pop("nodes"), "rotation": [0, 0, 0.5**0.5, 0.5**0.5]})
    document["scenes"][0]["nodes"] = [len(document["nodes"]) - 1]


def unskinned(document: dict[str, Any]) -> None:
    del document["skins"]
    for node in document["nodes"]:
        node.pop("skin", None)


def scaled(document: dict[str, Any]) -> None:
    lying(document)
    document["nodes"][-1] |= {"rotation": [0, 0, 0, 1], "scale": [1, 1, 2]}


def mirrored(document: dict[str, Any]) -> None:
    lying(document)
    document["nodes"][-1] |= {"rotation": [0, 0, 0, 1], "scale": [-1, 1, 1]}


def exchanged(document: dict[str, Any]) -> None:
    swap = {"LeftUpLeg": "RightUpLeg", "LeftLeg": "RightLeg", "LeftFoot": "RightFoot", "LeftToeBase": "RightToeBase"}
    swap |= {"LeftShoulder": "RightShoulder", "LeftArm": "RightArm", "LeftForeArm": "RightForeArm"}
    swap |= {"LeftHand": "RightHand"}
    swap |= {right: left for left, right in swap.items()}
    for node in document["nodes"]:
        plain = node["name"].removeprefix("mixamorig:")
        node["name"] = swap.get(plain, plain)


def two(document: dict[str, Any]) -> None:
    count = len(document["nodes"])
    document["nodes"].append({"name": "other"})
    document["scenes"][0]["nodes"].append(count)
    document["skins"].append({"joints": [count]})


def twice(document: dict[str, Any]) -> None:
    document["nodes"].append({"name": "mixamorig:LeftLeg"})
    document["nodes"][0]["children"].append(len(document["nodes"]) - 1)
    document["skins"][0]["joints"].append(len(document["nodes"]) - 1)
    del document["skins"][0]["inverseBindMatrices"]


def short(document: dict[str, Any]) -> None:
    for node in document["nodes"]:
        if node["name"] == "mixamorig:LeftForeArm":
            node["translation"] = [0, 0, 0]
    del document["skins"][0]["inverseBindMatrices"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (unskinned, "0 skeletons with a skin"),
        (lambda document: document.pop("skins"), "damaged, .* skin of a node: there is no number 0, only 0 of them"),
        (two, "2 skeletons with a skin"),
        (twice, "2 joints for left_knee: mixamorig:LeftLeg, mixamorig:LeftLeg"),
        (short, "the bone from left_shoulder to left_elbow has no length"),
        (lying, "the rest pose is not upright, it leans by 90 degrees"),
        (scaled, r"mixamorig:Hips \(pelvis\) is mirrored or scaled unevenly"),
        (mirrored, r"mixamorig:Hips \(pelvis\) is mirrored or scaled unevenly"),
        (exchanged, "the toes point backward"),
        (lambda document: document["nodes"][3]["children"].append(0), "damaged, or not glTF 2.0 in one file: a node"),
        (lambda document: document["nodes"][0].update(rotation=[0, 0, 0, 0]), "damaged"),
        (lambda document: document["nodes"][0].update(translation=["a", 0, 0]), "damaged"),
        (lambda document: document["skins"][0].update(joints=[999]), "damaged"),
        (lambda document: document["skins"][0].update(inverseBindMatrices=999), "damaged"),
        (lambda document: document["buffers"][0].update(uri="hero.bin"), "its data are in another file"),
    ],
)
def test_characters_that_cannot_be_used_are_refused(change: Any, message: str, kick: Motion, tmp_path: Path):
    kick.save(tmp_path / "hero.glb", rig="mixamo")
    changed(tmp_path / "hero.glb", change)
    with pytest.raises((UserError, ValueError), match=message):
        kick.save(tmp_path / "out.glb", character=tmp_path / "hero.glb")
    assert not (tmp_path / "out.glb").exists()


def test_damaged_files_are_refused(kick: Motion, tmp_path: Path):
    kick.save(tmp_path / "hero.glb", rig="mixamo")
    content = (tmp_path / "hero.glb").read_bytes()
    for part in (b"", b"glTF", content[:15], content[:200], content[:5000], b"\0" * 100):
        (tmp_path / "bad.glb").write_bytes(part)
        with pytest.raises(ValueError, match=r"bad\.glb: (damaged|not a \.glb file)"):
            characters.read(tmp_path / "bad.glb")
    with pytest.raises(UserError, match=r"character=hero\.fbx: not a character\. Use a \.bvh or \.glb file"):
        characters.read("hero.fbx")
    with pytest.raises(FileNotFoundError):
        characters.read(tmp_path / "missing.glb")
    with pytest.raises(UserError, match=r"out\.bvh: this character is a \.glb file"):
        kick.save(tmp_path / "out.bvh", character=tmp_path / "hero.glb")


# Many files, and robots -----------------------------------------------------------------------------------------------


def test_a_folder_is_converted(kick: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    kick.save(tmp_path / "in" / "a.npz")
    kick.save(tmp_path / "in" / "below" / "b.json")
    kick.save(tmp_path / "double" / "a.npz")
    kick.save(tmp_path / "double" / "a.json")
    out = tmp_path / "out"
    assert main(["convert", str(tmp_path / "in"), str(out), "format=bvh", "rig=mixamo"]) == 0
    assert [str(path.relative_to(out)) for path in sorted(out.rglob("*.bvh"))] == ["a.bvh", "below/b.bvh"]
    assert main(["convert", str(tmp_path / "in"), str(tmp_path / "on"), f"character={out / 'a.bvh'}"]) == 0
    assert (tmp_path / "on" / "below" / "b.bvh").exists()
    capsys.readouterr()
    for words, message in (
        ([str(tmp_path / "in"), str(out)], "is a folder: name the format"),
        ([str(tmp_path / "in" / "a.npz"), str(tmp_path / "c.bvh"), "format=bvh"], "format=... is for folders"),
        ([str(tmp_path / "empty"), str(out), "format=bvh"], "no motion files"),
        ([str(tmp_path / "in" / "a.npz"), str(tmp_path / "in" / "." / "a.npz")], "the same file as the input"),
        ([str(tmp_path / "in"), str(tmp_path / "in"), "format=json"], "b.json: the same file as the input"),
        ([str(tmp_path / "double"), str(out), "format=bvh"], "another motion has the same name"),
        ([str(tmp_path / "in" / "a.npz"), "/proc/none/a.bvh"], "/proc/none/a.bvh: cannot be written"),
        ([str(tmp_path / "missing.npz"), str(tmp_path / "in" / "a.npz")], "missing.npz: no such file"),
    ):
        (tmp_path / "empty").mkdir(exist_ok=True)
        assert main(["convert", *words]) == 1
        assert message in capsys.readouterr().err


def test_the_npz_has_the_keys_of_smplx_files(kick: Motion, tmp_path: Path):
    kick.poses = kick.posed()
    kick.save(tmp_path / "a.npz")
    kick.poses = None
    with np.load(tmp_path / "a.npz") as file:
        assert file["pose_body"].shape == (len(kick.joints), 63)
        assert file["root_orient"].shape == (len(kick.joints), 3)
        np.testing.assert_array_equal(
            np.concatenate([file["root_orient"], file["pose_body"]], 1), file["poses"][:, :66]
        )
        assert file["mocap_frame_rate"].item() == 20.0
        assert file["betas"].shape == (16,)
        assert str(file["gender"]) == "neutral"


# In Blender -----------------------------------------------------------------------------------------------------------

BLENDER = os.environ.get("FLAME_MDM_BLENDER", sys.executable)
"""A Python that has the package bpy."""


@pytest.mark.tools
@pytest.mark.parametrize("ending", [".glb", ".bvh"])
@pytest.mark.parametrize("name", [None, "mixamo", "unreal", "lafan1", "soma", "geno", "hero"])
def test_blender_shows_the_pose(name: str | None, ending: str, kick: Motion, tmp_path: Path):
    if subprocess.run([BLENDER, "-c", "import bpy"], capture_output=True).returncode:
        pytest.skip("no package bpy: set FLAME_MDM_BLENDER to a Python that has it")
    path = tmp_path / f"a{ending}"
    if name == "hero":
        if ending == ".glb":
            odd_glb(tmp_path / "hero.glb", kick)
            write_names(tmp_path / "hero.yaml")
        else:
            kick.save(tmp_path / "hero.bvh", rig="unreal", rest_pose=True)
        character = characters.read(tmp_path / f"hero{ending}")
        kick.save(path, character=character)
        names = [character.rig.joints[number] for number in character.map.values()]
        _, places, _ = characters.moved(character, kick)
        expected = places[:, list(character.map.values())] * (1 if ending == ".glb" else 0.01)
    else:
        kick.save(path, rig=name)
        rig = preset(name, kick.posed()) if name else None
        names = rig.joints if rig else SMPL22.joints
        expected = np.full((len(kick.joints), len(names), 3), np.nan)
        for joint, source in enumerate(rig.sources if rig else range(len(names))):
            expected[:, joint] = kick.joints[:, source] if source >= 0 else np.nan
        lift = [node["translation"] for node in read_glb(path)[0]["nodes"][-1:]] if ending == ".glb" else [[0, 0, 0]]
        expected += np.array(lift[0])
    script = Path(__file__).parent / "support" / "blender.py"
    done = subprocess.run([BLENDER, script, path, "20"], capture_output=True, text=True, check=True)
    found = json.loads(next(line for line in done.stdout.splitlines() if line.startswith("FOUND"))[5:])
    assert [frame for frame, _ in found] == [0, (len(kick.joints) - 1) // 2, len(kick.joints) - 1]
    compared = 0
    for frame, places in found:
        for joint, place in zip(names, expected[frame], strict=True):
            if joint in places and np.isfinite(place).all():
                np.testing.assert_allclose(places[joint], place, atol=1e-4, err_msg=f"{joint}, frame {frame}")
                compared += 1
    assert compared >= 3 * len(SMPL22)
