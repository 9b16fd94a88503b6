"""Inverse kinematics, and motion files of every kind written and read back."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from support.analytic import euler_to_matrix
from support.glb import Glb
from support.motions import degrees, largest_step, posed, sway, synthetic
from torch import Tensor

from flame_mdm.data import amass
from flame_mdm.errors import UserError
from flame_mdm.formats import ENDINGS, WRITTEN, bvh
from flame_mdm.formats.body import fit_body
from flame_mdm.formats.layouts import tree_layout
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.poses import Poses, solve
from flame_mdm.formats.readers import read
from flame_mdm.formats.retarget import continuous_euler
from flame_mdm.representations import rotation
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import KIT21, SMPL22
from flame_mdm.representations.smpl import SMPL
from flame_mdm.visualize.body import mannequin

FPS = 20.0


def walking(heading: ArrayLike, root: np.ndarray) -> Poses:
    swing = np.degrees(0.5 * np.sin(2 * np.pi * np.arange(len(root)) / FPS))
    none, bend = np.zeros_like(swing), np.maximum(swing, 0)
    turns: dict[str, Any] = {
        "pelvis": np.stack([none + 6, none, 0.1 * swing], -1),
        "left_shoulder": (0, 0, -69),
    }
    for side, sign in (("left", 1), ("right", -1)):
        turns[f"{side}_hip"] = np.stack([-sign * swing, none, none], -1)
        turns[f"{side}_knee"] = np.stack([34 - bend, none, none], -1)
        turns[f"{side}_elbow"] = np.stack([none, -sign * (23 + abs(swing)), none], -1)
    return posed(len(root), heading=heading, root=root, **turns).posed()


def two_circles() -> Poses:
    """Walks counterclockwise about the origin, twice, in 8 seconds."""
    angle = np.linspace(0, 4 * np.pi, 161)
    return walking(
        angle + np.pi, np.stack([1.5 * np.cos(angle), 0.95 + 0 * angle, -1.5 * np.sin(angle)], -1)
    )


@pytest.fixture(scope="module")
def circle() -> Motion:
    return Motion(
        two_circles().joints().float().numpy(), FPS, text="a person walks </b> é", id="circle"
    )


@pytest.fixture(scope="module")
def clips() -> list[Tensor]:
    actions = ("walk", "kick", "wave", "jump", "punch", "raise")
    return [torch.from_numpy(synthetic(action).joints).double() for action in actions]


def test_recorded_motion_comes_out_exactly_and_neither_limbs_flip_nor_angles_jump(clips, subtests):
    for number, joints in enumerate(clips):
        with subtests.test(clip=number):
            poses = solve(joints, FPS)
            torch.testing.assert_close(poses.joints(), joints, rtol=0, atol=1e-6)
            # A punch stretches the elbow by 50 degrees per frame
            assert largest_step(poses.rotations) < 70
    poses = solve(clips[1], FPS)
    angles = continuous_euler(poses.rotations)
    for joint, order in ((0, "YZX"), (16, "YXZ")):
        again = euler_to_matrix(angles[:, joint], order)
        torch.testing.assert_close(again, poses.rotations[:, joint], rtol=0, atol=1e-6)
    assert torch.rad2deg(angles.diff(dim=0).abs().max()) < 100


def test_euler_angles_go_on_where_the_middle_one_passes_a_quarter_turn():
    bend = torch.linspace(0, 170, 36, dtype=torch.float64).deg2rad()
    axes = torch.stack([0 * bend, 0 * bend, bend], -1)
    angles = continuous_euler(rotation.axis_angle_to_matrix(axes)[:, None], ["YZX"])[:, 0]
    torch.testing.assert_close(angles, axes[:, [1, 2, 0]], rtol=0, atol=1e-6)


def test_turns_and_backward_walks_do_not_flip_and_bent_limbs_show_their_twist(subtests):
    start, way = np.array([0, 0.95, 0]), np.linspace(0, 2, 60)[:, None] * [0, 0, 1]
    for made in (two_circles(), walking(0.0, start - way), walking(np.pi, start + way)):
        with subtests.test(made=made):
            poses = solve(made.joints(), FPS)
            torch.testing.assert_close(poses.joints(), made.joints(), rtol=0, atol=1e-9)
            assert largest_step(poses.rotations) < 1.3 * largest_step(made.rotations) < 20
            # Pelvis and chest are exact
            assert degrees(made.rotations.mT @ poses.rotations)[:, [0, 9]].max() < 5e-5
    # bent limbs show their twist
    turns: dict[str, Any]
    for side, sign in (("left", 1), ("right", -1)):
        for limb, turns in (
            ("hip", {f"{side}_hip": (0, 34, 0), f"{side}_knee": (69, 0, 0)}),
            ("shoulder", {f"{side}_shoulder": (46, 0, 0), f"{side}_elbow": (0, -69 * sign, 0)}),
        ):
            with subtests.test(side=side, limb=limb):
                made = posed(20, **turns).posed()
                joint = SMPL22.joints.index(f"{side}_{limb}")
                solved = solve(made.joints(), FPS).rotations[:, joint]
                assert degrees(solved @ made.rotations[:, joint].mT).max() < 6, (side, limb)


def test_bones_that_change_length_are_met_on_average_and_joints_without_rotations_are_refused(
    clips,
):
    noisy = clips[0] + 0.005 * torch.randn(
        clips[0].shape, generator=torch.Generator().manual_seed(0)
    )
    poses = solve(noisy, FPS)
    lengths = torch.linalg.vector_norm(SMPL22.bones(poses.joints()), dim=-1)
    torch.testing.assert_close(lengths, lengths[:1].expand_as(lengths))
    assert torch.linalg.vector_norm(poses.joints() - noisy, dim=-1).mean() < 0.008
    joints = two_circles().joints()
    with pytest.raises(UserError, match="SMPL's 22 joints"):
        solve(joints[:, :21], FPS)
    joints[:, 4] = joints[:, 1]
    with pytest.raises(UserError, match="left_knee"):
        solve(joints, FPS)


def test_files_bring_joints_back_and_angles_of_bvh_do_not_jump(tmp_path, circle, subtests):
    features = np.arange(6, dtype=np.float32).reshape(3, 2)
    for ending in (".bvh", ".json", ".npy", ".npz"):
        with subtests.test(ending=ending):
            replace(circle, features=features, representation="mine").save(
                tmp_path / f"circle{ending}", seed=3
            )
            again = read(tmp_path / f"circle{ending}", fps=FPS if ending == ".npy" else None)
            np.testing.assert_allclose(again.joints, circle.joints, rtol=0, atol=2e-5)
            assert (again.fps, again.id) == (FPS, "circle")
            assert again.text == ("" if ending in (".bvh", ".npy") else circle.text)
    np.testing.assert_array_equal(again.features, features)
    assert (again.representation, again.poses, np.load(tmp_path / "circle.npz")["seed"]) == (
        "mine",
        None,
        3,
    )
    assert len(list(tmp_path.iterdir())) == 4
    circle.save(tmp_path / "rest.bvh", rest_pose=True)
    tree = bvh.read(tmp_path / "rest.bvh")
    layout, names = tree_layout(tree, {})
    np.testing.assert_allclose(
        layout.apply(tree.positions(), names)[0], circle.posed().rest(), atol=1e-4
    )
    np.testing.assert_allclose(read(tmp_path / "rest.bvh").joints, circle.joints, atol=1e-4)
    # BVH is in centimeters, and its angles do not jump
    file = bvh.read(tmp_path / "circle.bvh")
    assert (file.fps, sum(name.endswith(".end") for name in file.joints)) == (FPS, 5)
    np.testing.assert_allclose(file.frames[:, :3], 100 * circle.joints[:, 0], atol=1e-4)
    np.testing.assert_array_equal(file.offsets[0], 0)
    assert np.abs(np.diff(file.frames[:, 3:], axis=0)).max() < 25
    yaw = file.frames[:, file.channels[0].index("Yrotation")]
    assert yaw[-1] - yaw[0] == pytest.approx(720, abs=1)
    for unit in (1.0, 0.005):
        with (
            subtests.test(unit=unit),
            pytest.raises(
                UserError, match=r"the legs are .* m long .*The unit may be 0\.01 \(centimeters\)"
            ),
        ):
            read(tmp_path / "circle.bvh", unit=unit)


def test_amass_files_are_those_of_amass_and_keep_rotations(tmp_path, subtests):
    made = two_circles()
    Motion(made.joints().float().numpy(), FPS, poses=made).save(tmp_path / "a.npz")
    recording = amass.read(tmp_path / "a.npz", "a.npz")
    assert (recording.fps, recording.gender) == (FPS, "neutral")
    raw = torch.from_numpy(np.concatenate([recording.translation, recording.poses], 1))
    representation = SMPL(FPS)
    joints = representation.decode(representation.encode(raw))[:, :22]
    torch.testing.assert_close(joints, made.joints().float(), rtol=0, atol=1e-5)
    with np.load(tmp_path / "a.npz") as file:  # the keys of SMPL-X files
        names = np.concatenate([file["root_orient"], file["pose_body"]], 1)
        np.testing.assert_array_equal(names, file["poses"][:, :66])
        assert (file["mocap_frame_rate"].item(), file["betas"].shape) == (20.0, (16,))
    # a head that turns about itself shows in no joint position
    head = SMPL22.joints.index("head")
    for width, rate in (
        (72, "mocap_framerate"),
        (156, "mocap_framerate"),
        (165, "mocap_frame_rate"),
    ):
        with subtests.test(width=width):
            poses = 0.2 * np.random.default_rng(0).normal(size=(9, width))
            arrays: dict[str, Any] = {"poses": poses, "trans": np.zeros((9, 3)), rate: 60.0}
            np.savez(tmp_path / "a.npz", **arrays)
            recording = read(tmp_path / "a.npz")
            assert recording.fps == 60
            for ending in (".bvh", ".glb", ".npz"):
                recording.save(tmp_path / f"b{ending}")
            expected = rotation.axis_angle_to_matrix(
                torch.from_numpy(poses[:, 3 * head : 3 * head + 3])
            )
            vectors = torch.from_numpy(np.load(tmp_path / "b.npz")["poses"])[
                :, 3 * head : 3 * head + 3
            ]
            file = bvh.read(tmp_path / "b.bvh")
            of_bvh = torch.from_numpy(file.rotations())[:, file.joints.index("head")]
            of_glb = torch.from_numpy(
                Glb(tmp_path / "b.glb").curves()[head, "rotation"][:, [3, 0, 1, 2]]
            )
            for turns in (
                rotation.axis_angle_to_matrix(vectors),
                of_bvh,
                rotation.quaternion_to_matrix(of_glb),
            ):
                torch.testing.assert_close(turns.double(), expected, rtol=0, atol=1e-5)


def test_features_that_are_rotations_of_smpl_are_exported_and_those_of_humanml_are_not(
    tmp_path, circle, subtests
):
    raw = 0.2 * torch.randn(9, 75, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for representation in (SMPL(FPS), Rot6D(FPS)):
        with subtests.test(representation=representation.name):
            features = representation.encode(raw)
            joints = representation.decode(features).numpy()
            np.savez(
                tmp_path / "a.npz",
                joints=joints,
                features=features,
                fps=FPS,
                representation=representation.name,
            )
            made = read(tmp_path / "a.npz")
            np.testing.assert_allclose(made.posed().joints(), joints[:, :22], atol=1e-5)
            made.save(tmp_path / "b.npz")
            again = np.load(tmp_path / "b.npz")["poses"]
            # All rotations but the root's, whose world differs, are kept.
            np.testing.assert_allclose(again[:, 3:66], raw[:, 6:69], atol=1e-5)
    for name, features in (("a", np.zeros((160, 263))), ("b", np.full((160, 263), 7.0))):
        arrays = {
            "joints": circle.joints,
            "features": features,
            "fps": FPS,
            "representation": "humanml263",
        }
        np.savez(tmp_path / f"{name}.npz", **arrays)
        read(tmp_path / f"{name}.npz").save(tmp_path / f"{name}.bvh")
    assert (tmp_path / "a.bvh").read_text() == (tmp_path / "b.bvh").read_text()


def test_glb_holds_the_motion_and_a_body_on_its_joints(tmp_path, circle, subtests):
    circle.save(tmp_path / "a.glb")
    file = Glb(tmp_path / "a.glb")
    document, curves = file.document, file.curves()
    nodes, animation = document["nodes"], document["animations"][0]
    parents = {child: k for k, node in enumerate(nodes) for child in node.get("children", [])}
    assert [parents[k] for k in range(22)] == [23, *SMPL22.parents[1:]]
    assert tuple(node["name"] for node in nodes[:22]) == SMPL22.joints
    lift = np.array(nodes[23]["translation"])
    np.testing.assert_allclose(file.worlds()[:, :22, :3, 3] - lift, circle.joints, atol=1e-5)
    times = file.array(animation["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(times, np.arange(len(times)) / FPS, atol=1e-6)
    assert (animation["name"], document["asset"]["extras"]["fps"]) == (circle.text, FPS)
    for joint, turns in (
        (joint, curve) for (joint, kind), curve in curves.items() if kind == "rotation"
    ):
        with subtests.test(joint=joint):
            np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1, atol=1e-6)
            assert ((turns[1:] * turns[:-1]).sum(1) > 0).all()

    # a body hangs on the joints
    skin, primitive = file.document["skins"][0], file.document["meshes"][0]["primitives"][0]
    assert skin["joints"] == list(range(22))
    position, normal, joint, weight = (
        file.array(primitive["attributes"][key])
        for key in ("POSITION", "NORMAL", "JOINTS_0", "WEIGHTS_0")
    )
    assert joint.max() < 22
    np.testing.assert_array_equal(weight.astype(int).sum(1), 255)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
    assert 1.4 < np.ptp(position[:, 1]) < 2
    triangles = file.array(primitive["indices"]).reshape(-1, 3)
    a, b, c = (position[triangles[:, k]] for k in range(3))
    outward = (np.cross(b - a, c - a) * normal[triangles].mean(1)).sum(1)
    assert (outward > 0).mean() > 0.995  # normals are smoothed at folds
    assert lift[1] == pytest.approx(0.026, abs=0.003)
    # a program that reads the file shows what our pictures show
    shared = mannequin().weights[:, :22].sum(1) > 0.99
    off = np.linalg.norm(file.skinned(file.worlds()[7]) - fit_body(circle).skinned(7)[0], axis=1)
    assert shared.mean() > 0.65
    assert off[shared].max() < 0.003
    assert "without a body: the bone that ends at" in posed(scale=3.0).save(tmp_path / "giant.glb")
    assert "skins" not in Glb(tmp_path / "giant.glb").document


def test_what_does_not_fit_a_file_is_refused(tmp_path, circle, subtests):
    options: dict[str, Any]
    kit = sway(5, 12.5, KIT21)
    for motion, name, options, message in (
        (circle, "a.glb", {"rest_pose": True}, "rest_pose applies only to .bvh"),
        (
            circle,
            "a.bvh",
            {"rig": "miximo"},
            r"rig=miximo: unknown\. Did you mean mixamo\? Use one of mixamo, unreal",
        ),
        (circle, "a.npz", {"rig": "mixamo"}, r"rig applies only to"),
        (kit, "a.bvh", {}, r"\.json or \.npy"),
        (
            circle,
            "walk.npz.txt",
            {},
            "unsupported motion format. Use one of .bvh, .glb, .fbx, .usda",
        ),
    ):
        with (
            subtests.test(motion=motion, name=name, options=options, message=message),
            pytest.raises(UserError, match=message),
        ):
            motion.save(tmp_path / name, **options)
    assert not list(tmp_path.iterdir())
    kit.save(tmp_path / "a.json")
    assert read(tmp_path / "a.json").skeleton == KIT21


def test_the_twist_of_the_spine_is_shared_evenly():
    twisted = posed(4, spine1=(0, 25, 0), spine2=(0, 20, 0), spine3=(0, 15, 0))
    solved = solve(torch.from_numpy(twisted.joints), FPS)
    for joint in (3, 6, 9):
        vectors = rotation.matrix_to_axis_angle(solved.rotations[:, joint])
        turned = torch.rad2deg(vectors[:, 1])
        torch.testing.assert_close(turned, torch.full_like(turned, 20.0), rtol=0, atol=1.5)


@pytest.mark.parametrize("fps", [20.0, 60.0])
@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("limb", [("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle", "foot")])
def test_a_limb_twists_as_its_bend_shows_smoothed_over_a_tenth_of_a_second(limb, side, fps):
    """The weights of two cues: the squared bend, and 0.15 squared for the direction of the parent.

    The arm is bent by 40 degrees. The leg is straight, so its foot counts as a bend with a sine of
    0.3. The direction of the bend jumps after half of the time.
    """
    frames = round(2 * fps)
    start, middle, end, *foot = (SMPL22.joints.index(f"{side}_{name}") for name in limb)
    joints = np.tile(np.array(posed().joints[0], float), (frames, 1, 1))
    axis = joints[0, middle] - joints[0, start]
    axis /= np.linalg.norm(axis)
    hinge = np.cross(axis, [0, 0, -1 if foot else 1])
    hinge /= np.linalg.norm(hinge)
    angles = np.radians(np.where(np.arange(frames) < frames // 2, 60, -45))
    turned = Rotation.from_rotvec(angles[:, None] * axis)
    bend, sine = np.radians(0 if foot else 40), 0.3 if foot else np.sin(np.radians(40))
    lower = turned.apply(np.cos(bend) * axis + np.sin(bend) * np.cross(hinge, axis))
    length = np.linalg.norm(joints[0, end] - joints[0, middle])
    joints[:, end] = joints[:, middle] + length * lower
    if foot:
        joints[:, foot[0]] = joints[:, end] + 0.12 * turned.apply(np.cross(axis, hinge))
    shown = sine * np.stack([np.cos(angles), np.sin(angles)], 1)
    shown = gaussian_filter1d(shown, 0.1 * fps, axis=0, mode="nearest")
    weighted = np.linalg.norm(shown, axis=1, keepdims=True) * shown + [0.15**2, 0]
    twist = np.arctan2(weighted[:, 1], weighted[:, 0])
    solved = solve(torch.from_numpy(joints), fps).rotations[:, start].numpy()
    expected = Rotation.from_rotvec(twist[:, None] * axis).as_matrix()
    assert degrees(solved.mT @ expected).max() < 0.1


@pytest.mark.parametrize("ending", sorted({*WRITTEN} - {".mp4"}))
def test_extensions_in_capitals_are_those_in_small_letters(tmp_path, ending: str):
    if ending.startswith(".usd"):
        pytest.importorskip("pxr", reason="usd-core is not installed: pip install flame-mdm[usd]")
    motion = posed(2, left_knee=(60, 0, 0))
    summaries = []
    for name in ("a", "A"):
        file = tmp_path / (name + (ending.upper() if name == "A" else ending))
        summaries.append(motion.save(file).removeprefix(f"{file}: "))
        assert file.stat().st_size > 0
    assert summaries[0] == summaries[1]
    if ending in ENDINGS:
        again = read(tmp_path / f"A{ending.upper()}", fps=20)
        np.testing.assert_array_equal(again.joints, read(tmp_path / f"a{ending}", fps=20).joints)
