"""Motions on the skeletons of other programs."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from flame_mdm.__main__ import main
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.formats import bvh
from flame_mdm.formats.files import read
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.retarget import preset, presets, world_rotations
from flame_mdm.representations.rotation import quaternion_to_matrix
from flame_mdm.representations.skeleton import SMPL22

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
    animation = document["animations"][-1]
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
        toward = rig.places[rig.joints.index(toward)] - rig.places[number]
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
