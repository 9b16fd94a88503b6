import json
import struct
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from support.analytic import euler_to_matrix
from torch import Tensor

from flame_mdm.__main__ import main
from flame_mdm.data import amass
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.formats import bvh
from flame_mdm.formats.layouts import LAYOUTS
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.poses import Poses, solve
from flame_mdm.formats.readers import read
from flame_mdm.formats.retarget import continuous_euler
from flame_mdm.representations import rotation
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import KIT21, SMPL22, SMPL24, global_rotations
from flame_mdm.representations.smpl import ADULT, SMPL
from flame_mdm.visualize.body import fit_body, mannequin

FPS = 20.0
ROTATED = (".bvh", ".glb", ".npz")


def body(frames: int, turns: dict[str, Tensor], heading: Tensor | float = 0.0, root: Tensor | None = None) -> Poses:
    """SMPL's body with some joints turned by axis-angle vectors (F, 3); the heading is about the vertical."""
    vectors = torch.zeros(frames, 22, 3, dtype=torch.float64)
    for name, vector in turns.items():
        vectors[:, SMPL22.joints.index(name)] = vector
    rotations = rotation.axis_angle_to_matrix(vectors)
    yaw = torch.zeros(frames, 3, dtype=torch.float64)
    yaw[:, 1] = heading
    rotations[:, 0] = rotation.axis_angle_to_matrix(yaw) @ rotations[:, 0]
    root = torch.tensor([[0.0, 0.95, 0.0]]).expand(frames, 3).double() if root is None else root
    return Poses(torch.tensor(ADULT[:22], dtype=torch.float64), rotations, root)


def walk(heading: Tensor, root: Tensor) -> Poses:
    """Legs and arms swing, knees and elbows bend, the body leans."""
    swing = 0.5 * torch.sin(2 * torch.pi * torch.arange(len(root)) / FPS).double()
    none = torch.zeros_like(swing)
    bend = torch.relu(swing)
    turns = {
        "pelvis": torch.stack([none + 0.1, none, 0.1 * swing], -1),
        "left_hip": torch.stack([-swing, none, none], -1),
        "right_hip": torch.stack([swing, none, none], -1),
        "left_knee": torch.stack([0.1 + bend, none, none], -1),
        "right_knee": torch.stack([0.6 - bend, none, none], -1),
        "left_shoulder": torch.stack([none, none, none - 1.2], -1),
        "right_shoulder": torch.stack([none, none, none + 1.2], -1),
        "left_elbow": torch.stack([none, -0.4 - swing.abs(), none], -1),
        "right_elbow": torch.stack([none, 0.4 + swing.abs(), none], -1),
    }
    return body(len(root), turns, heading, root)


def two_circles() -> Poses:
    """Walks counterclockwise about the origin, twice, in 8 seconds."""
    angle = torch.linspace(0, 4 * torch.pi, 161, dtype=torch.float64)
    root = torch.stack([1.5 * torch.cos(angle), 0.95 + 0 * angle, -1.5 * torch.sin(angle)], -1)
    return walk(angle + torch.pi, root)


def backward(heading: float) -> Poses:
    """Walks 2 m backward."""
    way = -torch.linspace(0, 2, 60, dtype=torch.float64)
    root = torch.stack([way * np.sin(heading), 0.95 + 0 * way, way * np.cos(heading)], -1)
    return walk(torch.full((60,), heading, dtype=torch.float64), root)


def largest_step(poses: Poses) -> float:
    """Degrees that any joint turns from one frame to the next, at most."""
    q = poses.quaternions()
    return float(torch.rad2deg(2 * torch.acos((q[1:] * q[:-1]).sum(-1).abs().clamp(max=1))).max())


def motion(known: Poses, **options: Any) -> Motion:
    return Motion(known.joints().float().numpy(), FPS, **options)


def off(a: Motion, b: Motion) -> float:
    return float(np.abs(a.joints - b.joints).max())


# Inverse kinematics ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clips() -> list[np.ndarray]:
    """Each action of the synthetic set."""
    found = {clip.attributes["action"]: clip.motion for clip in Synthetic(clips=60).clips(FPS)}
    assert {"walk", "kick", "wave", "jump", "punch", "raise"} <= set(found)
    return list(found.values())


def test_positions_of_recorded_motion_come_out_exactly(clips):
    for clip in clips:
        joints = torch.from_numpy(np.asarray(clip, np.float64))
        torch.testing.assert_close(solve(joints, FPS).joints(), joints, rtol=0, atol=1e-6)


def test_limbs_do_not_flip(clips):
    for clip in clips:
        poses = solve(torch.from_numpy(np.asarray(clip)), FPS)
        assert largest_step(poses) < 70  # a punch stretches the elbow by 50 degrees a frame


@pytest.mark.parametrize("make", [two_circles, lambda: backward(0.0), lambda: backward(np.pi)])
def test_turns_and_backward_walks_do_not_flip(make):
    made = make()
    poses = solve(made.joints(), FPS)
    torch.testing.assert_close(poses.joints(), made.joints(), rtol=0, atol=1e-9)
    assert largest_step(poses) < 1.3 * largest_step(made) < 20
    q = poses.quaternions()
    assert ((q[1:] * q[:-1]).sum(-1) > 0.9).all()
    turned = rotation.quaternion_to_axis_angle(
        rotation.multiply(rotation.inverse(rotation.matrix_to_quaternion(made.rotations)), q)
    )
    assert torch.linalg.vector_norm(turned, dim=-1)[:, [0, 9]].max() < 1e-6  # pelvis and chest are exact


def test_pelvis_faces_forward_when_walking_backward():
    joints = backward(0.7).joints()
    facing = solve(joints, FPS).rotations[:, 0, :, 2]
    way = torch.nn.functional.normalize(joints[-1, 0] - joints[0, 0], dim=0)
    assert (facing @ way).max() < -0.9


def test_only_the_root_sees_the_heading(clips):
    """Rotations relative to the parent do not depend on where a body faces, so no heading is special."""
    joints = torch.from_numpy(np.asarray(clips[0], np.float64))
    straight = solve(joints, FPS)
    for heading in np.linspace(0, 2 * np.pi, 9):
        turned = solve(rotation.rotate_y(joints, torch.tensor(heading)), FPS)
        torch.testing.assert_close(turned.rotations[:, 1:], straight.rotations[:, 1:], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("limb", "bent", "twist", "bend"),
    [
        ("left_hip", "left_knee", (0, 0.6, 0), (1.2, 0, 0)),
        ("right_hip", "right_knee", (0, 0.6, 0), (1.2, 0, 0)),
        ("left_shoulder", "left_elbow", (0.8, 0, 0), (0, -1.2, 0)),
        ("right_shoulder", "right_elbow", (0.8, 0, 0), (0, 1.2, 0)),
    ],
)
def test_bent_limbs_show_their_twist(limb, bent, twist, bend):
    made = body(20, {limb: torch.tensor(twist).double(), bent: torch.tensor(bend).double()})
    found = solve(made.joints(), FPS)
    k = SMPL22.joints.index(limb)
    angle = rotation.matrix_to_axis_angle(found.rotations[:, k] @ made.rotations[:, k].mT)
    assert torch.rad2deg(torch.linalg.vector_norm(angle, dim=-1)).max() < 6


def test_bones_that_change_length_are_met_on_average(clips):
    joints = torch.from_numpy(np.asarray(clips[0], np.float64))
    noisy = joints + 0.005 * torch.randn(joints.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    poses = solve(noisy, FPS)
    lengths = torch.linalg.vector_norm(SMPL22.bones(poses.joints()), dim=-1)
    torch.testing.assert_close(lengths, lengths[:1].expand_as(lengths))
    assert torch.linalg.vector_norm(poses.joints() - noisy, dim=-1).mean() < 0.008


def test_joints_without_rotations_are_refused():
    joints = two_circles().joints()
    with pytest.raises(ValueError, match="22 joints of SMPL"):
        solve(joints[:, :21], FPS)
    joints[:, 4] = joints[:, 1]
    with pytest.raises(ValueError, match="left_knee"):
        solve(joints, FPS)


# Files ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".bvh", ".json", ".npy", ".npz"])
def test_files_bring_joints_back(tmp_path, ending):
    made = motion(two_circles(), text="a person walks </b> é", id="circle")
    made.save(tmp_path / f"circle{ending}")
    again = read(tmp_path / f"circle{ending}", fps=FPS if ending == ".npy" else None)
    assert again.fps == FPS
    assert off(made, again) < 2e-5
    assert again.id == "circle"
    assert again.text == ("" if ending in (".bvh", ".npy") else made.text)
    assert [path.name for path in tmp_path.iterdir()] == [f"circle{ending}"]


def test_bvh_is_in_centimetres_and_its_angles_do_not_jump(tmp_path):
    made = motion(two_circles())
    made.save(tmp_path / "circle.bvh")
    file = bvh.read(tmp_path / "circle.bvh")
    assert file.fps == FPS
    np.testing.assert_allclose(file.frames[:, :3], 100 * made.joints[:, 0], atol=1e-4)
    np.testing.assert_array_equal(file.offsets[0], 0)
    assert np.abs(np.diff(file.frames[:, 3:], axis=0)).max() < 25
    yaw = file.frames[:, 3 + file.channels[0][3:].index("Yrotation")]
    assert yaw[-1] - yaw[0] == pytest.approx(720, abs=1)
    assert len(file.end_parents) == 5


def test_euler_angles_are_those_rotations_however_they_are_unwound(clips):
    poses = solve(torch.from_numpy(np.asarray(clips[1])), FPS)
    angles = continuous_euler(poses.rotations)
    for joint, order in ((0, "YZX"), (16, "YXZ")):
        again = euler_to_matrix(angles[:, joint], order)
        torch.testing.assert_close(again, poses.rotations[:, joint], rtol=0, atol=1e-6)
    assert torch.rad2deg(angles.diff(dim=0).abs().max()) < 100


@pytest.mark.parametrize("prefix", ["", "mixamorig:"])
def test_bvh_of_mixamo_is_known_by_its_names(tmp_path, prefix):
    made = motion(two_circles())
    made.save(tmp_path / "a.bvh")
    text = (tmp_path / "a.bvh").read_text()
    for ours, theirs in LAYOUTS["Mixamo"].map.items():
        assert isinstance(theirs, str) or len(theirs) == 1
        theirs = "".join(theirs)
        text = text.replace(f" {ours}\n", f" {prefix}{theirs}\n")
    (tmp_path / "b.bvh").write_text(text)
    assert off(made, read(tmp_path / "b.bvh")) < 2e-5
    (tmp_path / "c.bvh").write_text(text.replace("Spine2", "Chest9"))
    with pytest.raises(ValueError, match=r"c\.bvh: unknown skeleton\. Mixamo is the nearest .*missing: Spine2\."):
        read(tmp_path / "c.bvh")


def test_bvh_in_another_unit_is_noticed(tmp_path):
    made = motion(two_circles())
    made.save(tmp_path / "a.bvh")
    for unit in (1.0, 0.005):
        with pytest.raises(ValueError, match=r"the legs are .* m long .*The unit may be 0\.01 \(centimeters\)"):
            read(tmp_path / "a.bvh", unit=unit)
    half = read(tmp_path / "a.bvh", unit=0.005, any_size=True)
    np.testing.assert_allclose(half.joints, made.joints / 2, atol=1e-5)


def test_amass_file_is_one_of_amass(tmp_path):
    made = two_circles()
    motion(made, poses=made).save(tmp_path / "a.npz")
    recording = amass.read(tmp_path / "a.npz", "a.npz")
    assert recording.fps == FPS
    assert recording.gender == "neutral"
    np.testing.assert_allclose(recording.translation[:, 2], 0.95)  # z up
    raw = torch.from_numpy(np.concatenate([recording.translation, recording.poses], 1))
    representation = SMPL(FPS)
    joints = representation.decode(representation.encode(raw))[:, :22]
    torch.testing.assert_close(joints, made.joints().float(), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("width", "rate"), [(72, "mocap_framerate"), (156, "mocap_framerate"), (165, "mocap_frame_rate")]
)
@pytest.mark.parametrize("ending", ROTATED)
def test_rotations_of_amass_are_kept(tmp_path, width, rate, ending):
    """A head that turns about itself shows in no joint position."""
    poses = 0.2 * np.random.default_rng(0).normal(size=(9, width))
    arrays: dict[str, Any] = {"poses": poses, "trans": np.zeros((9, 3)), rate: 60.0}
    np.savez(tmp_path / "a.npz", **arrays)
    recording = read(tmp_path / "a.npz")
    assert recording.fps == 60
    recording.save(tmp_path / f"b{ending}")
    head = SMPL22.joints.index("head")
    wanted = rotation.axis_angle_to_matrix(torch.from_numpy(poses[:, 3 * head : 3 * head + 3]))
    if ending == ".npz":
        vectors = torch.from_numpy(np.load(tmp_path / "b.npz")["poses"])[:, 3 * head : 3 * head + 3]
        found = rotation.axis_angle_to_matrix(vectors)
    elif ending == ".bvh":
        found = torch.from_numpy(bvh.read(tmp_path / "b.bvh").rotations())
        found = found[:, bvh.read(tmp_path / "b.bvh").joints.index("head")]
    else:
        found = Glb(tmp_path / "b.glb").rotations()[:, head]
    torch.testing.assert_close(found.double(), wanted, rtol=0, atol=1e-5)


@pytest.mark.parametrize("representation", [SMPL(FPS), Rot6D(FPS)], ids=lambda r: r.name)
def test_features_that_are_rotations_of_smpl_are_exported_as_they_are(tmp_path, representation):
    raw = 0.2 * torch.randn(9, 75, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    features = representation.encode(raw)
    joints = representation.decode(features).numpy()
    assert joints.shape[1] == len(SMPL24)
    np.savez(tmp_path / "a.npz", joints=joints, features=features, fps=FPS, representation=representation.name)
    made = read(tmp_path / "a.npz")
    np.testing.assert_allclose(made.posed().joints(), joints[:, :22], atol=1e-5)
    made.save(tmp_path / "b.npz")
    again = np.load(tmp_path / "b.npz")["poses"]
    np.testing.assert_allclose(again[:, 3:66], raw[:, 6:69], atol=1e-5)  # all but the root, whose world differs


def test_rotations_among_humanml_features_are_never_used(tmp_path):
    made = motion(two_circles())
    for name, features in (("a", np.zeros((160, 263))), ("b", np.full((160, 263), 7.0))):
        np.savez(tmp_path / f"{name}.npz", joints=made.joints, features=features, fps=FPS, representation="humanml263")
        read(tmp_path / f"{name}.npz").save(tmp_path / f"{name}.bvh")
    assert (tmp_path / "a.bvh").read_text() == (tmp_path / "b.bvh").read_text()
    np.save(tmp_path / "features.npy", features)
    with pytest.raises(ValueError, match="not SMPL's and cannot be exported"):
        read(tmp_path / "features.npy", fps=FPS)


class Glb:
    """A .glb file read back from its bytes."""

    TYPES: ClassVar = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}

    def __init__(self, path: Path):
        data = path.read_bytes()
        magic, version, length = struct.unpack("<4sII", data[:12])
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack("<I4s", data[12:20])
        assert kind == b"JSON"
        assert size % 4 == 0
        self.json = json.loads(data[20 : 20 + size])
        size_bin, kind = struct.unpack("<I4s", data[20 + size : 28 + size])
        assert kind == b"BIN\0"
        self.binary = data[28 + size :]
        assert len(self.binary) == size_bin == self.json["buffers"][0]["byteLength"]

    def array(self, number: int) -> np.ndarray:
        accessor = self.json["accessors"][number]
        view = self.json["bufferViews"][accessor["bufferView"]]
        kind = {5121: "u1", 5123: "<u2", 5126: "<f4"}[accessor["componentType"]]
        begin, size = view["byteOffset"], view["byteLength"]
        assert begin % 4 == 0
        array = np.frombuffer(self.binary[begin : begin + size], kind).copy().reshape(accessor["count"], -1)
        assert array.shape[1] == self.TYPES[accessor["type"]]
        if "min" in accessor:
            assert array.min(0).tolist() == accessor["min"]
            assert array.max(0).tolist() == accessor["max"]
        return array

    def curves(self) -> dict[tuple[int, str], np.ndarray]:
        animation = self.json["animations"][0]
        return {
            (channel["target"]["node"], channel["target"]["path"]): self.array(
                animation["samplers"][channel["sampler"]]["output"]
            )
            for channel in animation["channels"]
        }

    def rotations(self) -> Tensor:
        curves = self.curves()
        turns = np.stack([curves[node, "rotation"] for node in range(22)], 1)[..., [3, 0, 1, 2]]
        return rotation.quaternion_to_matrix(torch.from_numpy(turns))


def test_glb_holds_the_motion(tmp_path):
    made = motion(two_circles(), text="walks")
    made.save(tmp_path / "a.glb")
    file = Glb(tmp_path / "a.glb")
    nodes = file.json["nodes"]
    parents = {child: k for k, node in enumerate(nodes) for child in node.get("children", [])}
    assert [parents[k] for k in range(22)] == [23, *SMPL22.parents[1:]]
    assert tuple(node["name"] for node in nodes[:22]) == SMPL22.joints
    offsets = torch.tensor([node["translation"] for node in nodes[:22]])
    root = torch.from_numpy(file.curves()[0, "translation"])
    poses = Poses(offsets.double(), file.rotations().double(), root.double())
    np.testing.assert_allclose(poses.joints(), made.joints, atol=1e-5)
    times = file.array(file.json["animations"][0]["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(times, np.arange(len(times)) / FPS, atol=1e-6)
    assert file.json["animations"][0]["name"] == "walks"
    assert file.json["asset"]["extras"]["fps"] == FPS
    for turns in (curve for (_, kind), curve in file.curves().items() if kind == "rotation"):
        np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1, atol=1e-6)
        assert ((turns[1:] * turns[:-1]).sum(1) > 0).all()


@pytest.mark.parametrize("figure", ["body", "bones"])
def test_glb_has_a_figure_that_hangs_on_the_joints(tmp_path, figure):
    made = motion(two_circles())
    made.save(tmp_path / "a.glb", figure=figure)
    file = Glb(tmp_path / "a.glb")
    skin, primitive = file.json["skins"][0], file.json["meshes"][0]["primitives"][0]
    assert skin["joints"] == list(range(22))
    rest = np.zeros((22, 3))
    for k, parent in enumerate(SMPL22.parents):
        rest[k] = np.array(file.json["nodes"][k]["translation"]) + (rest[parent] if parent >= 0 else 0)
    bind = file.array(skin["inverseBindMatrices"]).reshape(22, 4, 4).swapaxes(1, 2)
    if figure == "bones":
        np.testing.assert_allclose(bind[:, :3, 3], -rest, atol=1e-6)
    position, normal, joint, weight = (
        file.array(primitive["attributes"][key]) for key in ("POSITION", "NORMAL", "JOINTS_0", "WEIGHTS_0")
    )
    assert joint.max() < 22
    np.testing.assert_array_equal(weight.astype(int).sum(1), 255)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
    assert 1.4 < np.ptp(position[:, 1]) < 2
    corners = position[file.array(primitive["indices"]).reshape(-1, 3)]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = normal[file.array(primitive["indices"]).reshape(-1, 3)].mean(1)
    assert ((outward * normals).sum(1) > 0).mean() > 0.995  # normals are smoothed at folds
    lifted = file.json["nodes"][23]
    assert lifted["children"] == [0]
    assert lifted["translation"][1] == pytest.approx(0.026 if figure == "body" else 0, abs=0.003)
    if figure == "body":  # a program that reads the file shows what our pictures show
        world, drawn = global_rotations(file.rotations().double(), SMPL22.parents)[7].numpy(), fit_body(made)
        moves = np.tile(np.eye(4), (22, 1, 1))
        moves[:, :3, :3], moves[:, :3, 3] = world, made.joints[7] + np.array(lifted["translation"])
        moves = moves @ bind
        blended = (moves[joint] * weight[..., None, None] / 255).sum(1)
        points = (blended[:, :3, :3] @ position[..., None])[..., 0] + blended[:, :3, 3]
        shared = mannequin().weights[:, :22].sum(1) > 0.99
        off = np.linalg.norm(points - drawn.skinned(7)[0], axis=1)
        assert shared.mean() > 0.65
        assert off[shared].max() < 0.003


def test_a_bvh_file_may_begin_with_its_rest_pose(tmp_path):
    made = motion(two_circles())
    said = made.save(tmp_path / "a.bvh", rest_pose=True)
    assert said.endswith("the first frame is the rest pose")
    joints = read(tmp_path / "a.bvh").joints
    np.testing.assert_allclose(joints[0], made.posed().rest(), atol=1e-4)
    np.testing.assert_allclose(joints[1:], made.joints, atol=1e-4)


@pytest.mark.parametrize(
    ("file", "options", "says"),
    [
        ("a.glb", {"figure": "stick"}, "figure=stick: unknown. Use body or bones"),
        ("a.bvh", {"figure": "bones"}, "figure is only for .glb"),
        ("a.glb", {"rest_pose": True}, "rest_pose only for .bvh"),
    ],
)
def test_figures_and_rest_poses_of_other_files_are_refused(tmp_path, file, options, says):
    with pytest.raises(ValueError, match=says):
        motion(two_circles()).save(tmp_path / file, **options)
    assert not list(tmp_path.iterdir())


def test_a_motion_of_kit_is_written_as_joints_alone(tmp_path):
    made = Motion(np.random.default_rng(0).normal(size=(5, len(KIT21), 3)), 12.5, KIT21)
    made.save(tmp_path / "a.json")
    assert read(tmp_path / "a.json").skeleton == KIT21
    with pytest.raises(ValueError, match=r"\.json or \.npy"):
        made.save(tmp_path / "a.bvh")
    assert not (tmp_path / "a.bvh").exists()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npz", b"PK\x03\x04 cut", "damaged"),
        ("a.npy", b"\x93NUMPY", "damaged"),
        ("a.json", b"[1, 2]", "not a motion in JSON"),
        ("a.json", b'{"fps": 20}', "joints"),
        ("a.bvh", b"HIERARCHY\nROOT", "ends inside"),
        ("a.fbx", b"", r"\.npz, \.bvh, \.json, \.npy"),
    ],
)
def test_damaged_files_are_named(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read(tmp_path / name)
    assert name in str(caught.value)


# The command ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def sample(tmp_path) -> Path:
    """What `make sample` writes."""
    path = tmp_path / "motion_000.npz"
    np.savez(path, joints=motion(two_circles()).joints, fps=FPS, text="a person walks in circles", seed=0)
    return path


@pytest.mark.parametrize("ending", [*ROTATED, ".json", ".npy"])
def test_command_converts(sample, tmp_path, ending, capsys):
    out = tmp_path / f"it's (a) ${ending}"
    assert main(["convert", str(sample), f"out={out}"]) == 0
    assert out.stat().st_size > 1000
    assert f"{out}: 161 frames at 20 per second" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nothing.npz", "out=a.bvh"], "nothing.npz: no such file"),
        (["{sample}"], "name an input and an output file"),
        (["{sample}", "out=a.fbx"], ".bvh, .glb, .npz, .json, .npy"),
        (["{sample}", "out=a.glb", "unit=0.01"], "meters"),
    ],
)
def test_command_says_what_is_wrong_in_one_line(sample, words, message, capsys):
    assert main(["convert", *(word.format(sample=sample) for word in words)]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
