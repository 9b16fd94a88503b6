"""FBX and GLB animations as motions: in commands, in data sets, and what is refused."""

import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.fixtures import SHARED, needs_third_party
from support.glb import Glb
from support.motions import posed, synthetic
from support.refusals import bounded

from flame_mdm.data.folder import Folder
from flame_mdm.errors import UserError
from flame_mdm.formats import fbx_scene, glb, glb_animation, scenes, vrma
from flame_mdm.formats.animated import AnimatedNodes, choose
from flame_mdm.formats.layouts import LAYOUTS
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import read
from flame_mdm.representations.skeleton import JOINT, SMPL22
from flame_mdm.visualize.body import mannequin

FILES = SHARED / "data" / "files"
MILLIMETER = 1e-3


CASES = [
    (ending, rig)
    for ending in (".fbx", ".glb")
    for rig in (None, "mixamo", "unreal", "unity", "lafan1", "soma")
]


@pytest.mark.parametrize(("ending", "rig"), [*CASES, (".vrma", None)])
def test_a_motion_comes_back_from_each_kind_of_file_and_rig(
    ending: str, rig: str | None, tmp_path: Path
):
    motion = synthetic("kick")
    motion.save(tmp_path / f"kick{ending}", rig=rig)
    again = read(tmp_path / f"kick{ending}")
    assert again.fps == motion.fps
    # up to the thickness of the soles, and bones of constant length
    lift = (again.joints - motion.joints)[..., 1].mean()
    again.joints[..., 1] -= lift
    assert 0 < lift < 0.04
    assert np.abs(again.joints - motion.posed().joints().numpy()).max() < 0.1 * MILLIMETER


@pytest.mark.parametrize("root_motion", [False, True])
@pytest.mark.parametrize("rig", ["unreal", "soma"])
def test_a_root_is_on_the_floor_and_the_person_on_its_soles(
    rig: str, root_motion: bool, tmp_path: Path
):
    motion = synthetic("walk")
    motion.save(tmp_path / "walk.glb", rig=rig, root_motion=root_motion)
    nodes = glb_animation.read(tmp_path / "walk.glb")
    heights = dict(zip(nodes.names, nodes.positions[..., 1].T, strict=True))
    hips = heights["pelvis" if rig == "unreal" else "Hips"]
    assert np.abs(heights["root" if rig == "unreal" else "Root"]).max() < 0.01 * MILLIMETER
    lift = hips - motion.joints[: len(hips), 0, 1]
    assert lift.min() > 0.02
    assert np.ptp(lift) < 0.01 * MILLIMETER


def test_splines_of_a_glb_file_have_a_slope_before_and_another_one_after_each_key(tmp_path: Path):
    """A node goes along x as t^3 in the first second, and as 1 - 4 u + u^3 in the following half second u."""
    binary = glb.Binary()
    slopes_before, values, slopes_after = (0, 3, -3.25), (0, 1, -0.875), (0, -4, 0)
    keys = np.zeros((3, 3, 3), "f4")  # slope before, value and slope after of each key
    keys[..., 0] = np.transpose([slopes_before, values, slopes_after])
    times = binary.add(np.array([0, 1, 1.5], "f4"), bounds=True)
    sampler = {
        "input": times,
        "output": binary.add(keys.reshape(9, 3)),
        "interpolation": "CUBICSPLINE",
    }
    channel = {"sampler": 0, "target": {"node": 0, "path": "translation"}}
    document = {
        "asset": {"version": "2.0", "extras": {"fps": 20}},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "hips"}],
        "animations": [{"samplers": [sampler], "channels": [channel]}],
    }
    binary.save(tmp_path / "spline.glb", document)

    t = np.arange(31) / 20
    expected = np.where(t < 1, t**3, 1 - 4 * (t - 1) + (t - 1) ** 3)
    positions = glb_animation.read(tmp_path / "spline.glb").positions
    np.testing.assert_allclose(positions[:, 0], np.stack([expected, 0 * t, 0 * t], 1), atol=1e-6)


@needs_third_party
@pytest.mark.parametrize(
    "name", ["mixamo_prerotation.fbx", "mixamo_not_tpose.fbx", "mixamo_not_tpose.glb"]
)
def test_joints_of_other_writers_are_those_of_the_file(name: str, subtests):
    motion = read(FILES / name)
    with np.load(FILES / "mixamo_not_tpose_expected.npz") as expected:
        names = [str(joint).removeprefix("mixamorig:") for joint in expected["names"]]
        walk = expected["walk"][: len(motion.joints)]
    for joint, bone in (
        ("left_knee", "LeftLeg"),
        ("head", "Head"),
        ("right_wrist", "RightHand"),
        ("spine2", "Spine1"),
    ):
        with subtests.test(joint=joint, bone=bone):
            ours = motion.joints[:, SMPL22.joints.index(joint)]
            assert np.abs(ours - walk[:, names.index(bone)]).max() < 0.01 * MILLIMETER


@needs_third_party
def test_a_key_acts_on_scenes_or_is_refused(tmp_path: Path):
    file = FILES / "mixamo_prerotation.fbx"
    plain = read(file)
    assert read(file, fps=60).fps == 60
    resampled = read(file, resample_to=20)
    assert (resampled.fps, len(resampled.joints)) == (20, 21)
    # the file is in centimeters: meters per unit replace what it declares
    np.testing.assert_allclose(read(file, unit=0.009).joints, 0.9 * plain.joints, atol=1e-6)
    with pytest.raises(UserError, match="m long"):
        read(file, unit=1)
    lying = read(file, up="z")
    assert any("lying" in note for note in lying.notes)
    synthetic("kick").save(tmp_path / "kick.npz")
    with pytest.raises(
        UserError,
        match=r"animation=Walk has no effect, because \.npz files contain only one animation",
    ):
        read(tmp_path / "kick.npz", animation="Walk")


@needs_third_party
def test_all_animations_of_a_folder_become_clips(tmp_path: Path):
    shutil.copy(FILES / "mixamo_not_tpose.glb", tmp_path / "hero.glb")
    shutil.copy(FILES / "mixamo_prerotation.fbx", tmp_path / "walk.fbx")
    (tmp_path / "captions.csv").write_text(
        "id,text\nhero/Walk,a person walks\nhero/Wave,a person waves\nhero/Turn,a person turns\nwalk,a person walks\n"
    )
    clips = {clip.id: clip for clip in Folder(str(tmp_path), workers=1).clips(30)}
    assert sorted(clips) == ["hero_Turn", "hero_Walk", "hero_Wave", "walk"]
    assert clips["hero_Wave"].captions == ["a person waves"]
    # the second animation, not the first one
    wave = read(tmp_path / "hero.glb", animation="Wave").joints
    np.testing.assert_allclose(clips["hero_Wave"].motion, wave, atol=1e-5)


def test_a_scene_without_animation_or_with_a_strange_skeleton_is_refused(tmp_path: Path):
    motion = synthetic("kick")
    motion.save(tmp_path / "kick.glb", rig="mixamo")
    content = (tmp_path / "kick.glb").read_bytes()
    (tmp_path / "still.glb").write_bytes(content.replace(b'"animations"', b'"animationz"'))
    with pytest.raises(UserError, match=r"still\.glb: contains no animation"):
        read(tmp_path / "still.glb")
    (tmp_path / "bird.glb").write_bytes(content.replace(b"mixamorig:LeftArm", b"mixamorig:LeftWng"))
    with pytest.raises(UserError, match="unknown skeleton"):
        read(tmp_path / "bird.glb")
    assert len(glb_animation.animations(tmp_path / "bird.glb")) == 1


def mutated(content: bytes, number: int) -> bytes:
    """Content with some bytes changed, removed, repeated or swapped, as decided by a number."""
    draw = np.random.default_rng(number)
    changed = bytearray(content)
    for _ in range(int(draw.integers(1, 6))):
        begin = int(draw.integers(len(changed)))
        end = min(len(changed), begin + int(draw.integers(1, 64)))
        kind = int(draw.integers(5))
        if kind == 0:
            changed[begin] = int(draw.integers(256))
        elif kind == 1:
            del changed[begin:end]
        elif kind == 2:
            changed[begin:begin] = changed[begin:end]
        elif kind == 3:
            changed[begin:end] = draw.bytes(end - begin)
        else:
            changed[begin:end] = b"\xff" * (end - begin)
    return bytes(changed)


def outcome(path: Path) -> tuple[str, np.ndarray]:
    """The error of a file, or "", and its joints."""
    try:
        return "", read(path).joints
    except UserError as error:
        return str(error), np.zeros(0)


@pytest.mark.parametrize("ending", [".fbx", ".glb", ".vrma"])
def test_mutated_files_give_one_line_or_a_motion(ending: str, tmp_path: Path, subtests):
    """Ten mutations of each kind of file; with FLAME_MDM_FUZZ=all, 150."""
    motion = synthetic("kick")
    motion = Motion(motion.joints[:12], motion.fps)
    motion.save(tmp_path / f"kick{ending}")
    content = (tmp_path / f"kick{ending}").read_bytes()
    path = tmp_path / f"mutated{ending}"
    for number in range(150 if os.environ.get("FLAME_MDM_FUZZ") == "all" else 10):
        with subtests.test(number=number):
            path.write_bytes(mutated(content, number))
            with bounded():
                message, joints = outcome(path)
            assert np.isfinite(joints).all(), number
            assert not message or str(path) in message, number
            assert "\n" not in message, number


def test_a_track_of_steps_holds_each_value_until_the_next_key():
    times, values = np.array([0.0, 1.0, 2.0]), np.array([[1.0], [5.0], [7.0]])
    track = glb_animation.Track(times, values, "STEP", np.zeros((2, 3, 1)))
    moments = np.array([0.0, 0.4, 0.9, 1.0, 1.9, 2.0])
    assert track.at(moments)[:, 0].tolist() == [1, 1, 1, 5, 5, 7]


def test_a_cubic_track_has_the_slopes_of_its_keys_per_second():
    """The polynomial t^3 - 3 t, with keys at 1, 3 and 4 seconds."""
    times = np.array([1.0, 3.0, 4.0])
    slopes = np.tile((3 * times**2 - 3)[None, :, None], (2, 1, 1))
    slopes[0, 0], slopes[1, 2] = 100, 100  # before the first key and after the last one
    values = (times**3 - 3 * times)[:, None]
    track = glb_animation.Track(times, values, "CUBICSPLINE", slopes)
    moments = np.array([0.0, 1.0, 1.7, 2.9, 3.5, 4.0, 9.0])
    inside = np.clip(moments, 1, 4)
    np.testing.assert_allclose(track.at(moments)[:, 0], inside**3 - 3 * inside, atol=1e-9)


def test_a_linear_track_of_rotations_turns_at_a_constant_rate_the_shorter_way():
    half = np.radians([0, 50])
    values = np.stack([np.sin(half), 0 * half, 0 * half, np.cos(half)], 1) * [[1], [-1]]
    track = glb_animation.Track(np.array([0.0, 2.0]), values, "LINEAR", np.zeros((2, 2, 4)))
    turned = track.at(np.array([0.0, 0.5, 1.0, 2.0]))
    angles = np.degrees(2 * np.arctan2(turned[:, 0], turned[:, 3]))
    np.testing.assert_allclose(angles[:3], [0, 25, 50], atol=1e-9)


def test_the_densest_keys_of_all_tracks_determine_the_rate(monkeypatch):
    times = {0: [0, 0.5, 1], 1: [0, 1 / 60, 2 / 60], 2: [0, 1 / 30, 2 / 30]}
    monkeypatch.setattr(
        glb_animation.glb,
        "numbers",
        lambda file, accessor, kind: np.array(times[accessor], float)[:, None],
    )
    file: Any = SimpleNamespace(document={"asset": {}})
    items: Any = [
        SimpleNamespace(samplers=[SimpleNamespace(input=number) for number in numbers])
        for numbers in ((0, 1), (2,))
    ]
    assert glb_animation._rate(file, items) == 60
    assert glb_animation._rate(file, items[::-1]) == 60


def test_hands_and_toes_of_a_vrm_avatar_follow_the_limb_in_the_rest_pose_of_the_body():
    motion = posed(1)
    rig = vrma.rest_rig(motion.posed())
    turned = rig.turned(np.tile(np.eye(3), (1, 22, 1, 1)))
    local = rig.local(turned)[0]
    for side, sign in (("left", 1), ("right", -1)):
        for name in ("wrist", "foot"):
            np.testing.assert_allclose(local[JOINT[f"{side}_{name}"]], np.eye(3), atol=1e-9)
        bones = {
            "elbow": (sign, 0, 0),
            "wrist": (sign, 0, 0),
            "knee": (0, -1, 0),
            "ankle": (0, -1, 0),
        }
        for name, direction in bones.items():
            joint = JOINT[f"{side}_{name}"]
            bone = rig.positions[joint] - rig.positions[SMPL22.parents[joint]]
            np.testing.assert_allclose(bone / np.linalg.norm(bone), direction, atol=1e-9)
        toes = rig.positions[JOINT[f"{side}_foot"]] - rig.positions[JOINT[f"{side}_ankle"]]
        assert toes[0] == pytest.approx(0)
        assert toes[2] > 0
    # With these rotations, the avatar has the joints of the body.
    positions = rig.assembled(turned, motion.joints[:, 0].astype(float))
    np.testing.assert_allclose(positions, motion.joints, atol=1e-6)


def test_hips_of_a_vrma_file_are_on_soles_at_rest_and_in_the_motion(tmp_path: Path):
    motion = synthetic("kick")
    motion.save(tmp_path / "kick.vrma")
    poses, fitted = motion.posed(), motion.try_fit()[0]
    assert fitted is not None
    hips = Glb(tmp_path / "kick.vrma").document["nodes"][0]["translation"]
    height = vrma.rest_rig(poses).positions[0, 1] + fitted.lift
    np.testing.assert_allclose(hips, [0, height, 0], atol=1e-6)
    moved = glb_animation.read(tmp_path / "kick.vrma").positions[:, 0]
    np.testing.assert_allclose(moved, poses.root.numpy() + np.array([0, fitted.lift, 0]), atol=1e-5)


def test_an_animated_node_is_scaled_then_turned_then_moved():
    half = 0.5**0.5
    node = {"scale": [2, 3, 4], "rotation": [0, 0, half, half], "translation": [7, 8, 9]}
    slopes = np.zeros((2, 2, 3))
    moves = glb_animation.Track(
        np.array([0.0, 1]), np.array([[0.0, 0, 0], [10, 0, 0]]), "LINEAR", slopes
    )
    fixed = glb_animation._animated(node, {}, np.array([0.0]))[0]
    # x becomes 2 y, and y becomes -3 x
    np.testing.assert_allclose(fixed @ [1, 0, 0, 1], [7, 10, 9, 1], atol=1e-12)
    np.testing.assert_allclose(fixed @ [0, 1, 0, 1], [4, 8, 9, 1], atol=1e-12)
    moved = glb_animation._animated(node, {"translation": moves}, np.array([0.25]))[0]
    np.testing.assert_allclose(moved @ [1, 0, 0, 1], [2.5, 2, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("gaps", "extras", "fps"),
    [
        ([1 / 30], None, 30.0),
        ([0.0333, 0.0334], None, 30.0),
        ([1 / 29.97], None, 30.0),
        ([1 / 24], None, 24.0),
        ([1 / 23.5], None, 30.0),
        ([0.5, 1.0], None, 30.0),
        ([1 / 60, 1 / 60, 0.5], None, 60.0),
        ([1 / 30], {"fps": 12.5}, 12.5),
        ([1 / 30], {"fps": 5000}, 30.0),
    ],
)
def test_the_rate_of_a_glb_file_follows_from_its_keys(monkeypatch, gaps, extras, fps):
    times = np.concatenate([[0], np.cumsum(gaps * 40)])[:, None]
    monkeypatch.setattr(glb_animation.glb, "numbers", lambda file, accessor, kind: times)
    file: Any = SimpleNamespace(document={"asset": {"extras": extras}})
    item: Any = SimpleNamespace(samplers=[SimpleNamespace(input=0)])
    assert glb_animation._rate(file, [item]) == fps


def test_frame_rates_of_fbx_files_by_their_number():
    """As in Autodesk's `FbxTime::EMode`."""
    whole = {1: 120, 2: 100, 3: 60, 4: 50, 5: 48, 6: 30, 7: 30, 10: 25, 11: 24, 12: 1000}
    assert {mode: fbx_scene.TIME_MODES[mode] for mode in whole} == whole
    assert (fbx_scene.TIME_MODES[15], fbx_scene.TIME_MODES[16]) == (96, 72)
    fractions = {8: 29.97, 9: 29.97, 13: 23.976, 17: 59.94, 18: 119.88}
    for mode, rate in fractions.items():
        assert fbx_scene.TIME_MODES[mode] == pytest.approx(rate, abs=1e-3)
        assert fbx_scene.TIME_MODES[mode] * 1.001 == pytest.approx(round(rate), rel=1e-9)
    assert len(fbx_scene.TIME_MODES) == 17
    assert fbx_scene.TICKS == 46186158000
    assert fbx_scene.ORDERS[:6] == ("xyz", "xzy", "yzx", "yxz", "zxy", "zyx")


def test_colors_of_the_skin_are_linear(tmp_path: Path):
    posed(2).save(tmp_path / "a.glb")
    file = Glb(tmp_path / "a.glb")
    attributes = file.document["meshes"][0]["primitives"][0]["attributes"]
    colors = file.array(attributes["COLOR_0"]).astype(float) / 255
    assert (colors[:, 3] == 1).all()
    np.testing.assert_allclose(
        colors[:, :3], (mannequin().colors / 255) ** 2.2, atol=0.5 / 255 + 1e-9
    )


@pytest.mark.parametrize("ending", [".fbx", ".glb"])
def test_a_file_keeps_its_unit_if_the_folder_maps_its_joints(ending: str, tmp_path: Path):
    motion = synthetic("kick")
    motion.save(tmp_path / f"a{ending}", rig="mixamo")
    mapped = {joint: f"mixamorig:{name}" for joint, name in LAYOUTS["Mixamo"].map.items()}
    (tmp_path / "skeleton.yaml").write_text(json.dumps({"map": mapped}))
    again = read(tmp_path / f"a{ending}")
    assert np.abs(again.joints - motion.joints).max() < 0.04
    with pytest.raises(UserError, match=r"human legs are 0\.6 to 1\.2 m"):
        read(tmp_path / f"a{ending}", unit=0.02 if ending == ".fbx" else 2.0)


def test_successive_rotations_in_glb_files_have_no_sign_flips(tmp_path: Path):
    turning = posed(60, heading=np.linspace(0, 4 * np.pi, 60))
    turning.save(tmp_path / "a.glb")
    for (_, name), values in Glb(tmp_path / "a.glb").curves().items():
        if name == "rotation":
            assert ((values[1:] * values[:-1]).sum(1) > 0).all()
            np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1, atol=1e-6)


def test_bones_of_a_vrm_humanoid_are_smpls_joints():
    expected = {"hips": "pelvis", "spine": "spine1", "chest": "spine2", "upperChest": "spine3"}
    expected |= {"neck": "neck", "head": "head"}
    for side in ("left", "right"):
        expected |= {f"{side}Shoulder": f"{side}_collar", f"{side}UpperArm": f"{side}_shoulder"}
        expected |= {f"{side}LowerArm": f"{side}_elbow", f"{side}Hand": f"{side}_wrist"}
        expected |= {f"{side}UpperLeg": f"{side}_hip", f"{side}LowerLeg": f"{side}_knee"}
        expected |= {f"{side}Foot": f"{side}_ankle", f"{side}Toes": f"{side}_foot"}
    assert expected == glb_animation.HUMANOID


def test_nodes_at_the_tips_of_bones_are_end_sites():
    nodes = AnimatedNodes(
        (
            "Hips",
            "Foot",
            "Foot_End",
            "Head",
            "HeadTip",
            "Hand End",
            "Toe.nub",
            "End",
            "a",
        ),
        (-1, 0, 1, 0, 3, 0, 1, 0, 7),
        np.zeros((1, 9, 3)),
        20.0,
        "walk",
        {},
    )
    names = ("Hips", "Foot", "Foot.end", "Head", "Head.end", "Hips.end", "Foot.end")
    assert scenes.joint_names(nodes) == (*names, "End", "a")


def test_an_animation_is_chosen_by_its_name_before_its_number():
    takes = [("2", "first"), ("Walk", "second"), ("10", "third")]
    choices = {
        None: "first",
        "2": "first",
        "1": "first",
        3: "third",
        "Walk": "second",
        "10": "third",
    }
    assert {key: choose(takes, key)[1] for key in choices} == choices
    for key in ("0", "4", "walk", "-1", ""):
        with pytest.raises(UserError, match=r"no such animation.* 1 2, 2 Walk, 3 10$"):
            choose(takes, key)
    many = [(f"take {number}", "") for number in range(1, 23)]
    with pytest.raises(UserError, match=r"19 take 19, 20 take 20 and 2 more$"):
        choose(many, "23")


def test_numbers_of_a_glb_file_may_be_interleaved_and_normalized(tmp_path: Path):
    """Four bytes and two floats per vertex, after eight bytes of something else."""
    rows = np.zeros(3, [("bytes", "i1", 4), ("floats", "<f4", 2)])
    rows["bytes"] = [[127, -127, -128, 0], [64, 1, 2, 3], [5, 6, 7, 8]]
    rows["floats"] = [[0.5, 1.5], [2.5, 3.5], [4.5, 5.5]]
    content = bytes(8) + rows.tobytes()
    accessors = [
        {"bufferView": 0, "componentType": 5120, "type": "VEC4", "count": 3, "normalized": True},
        {"bufferView": 0, "componentType": 5126, "type": "VEC2", "count": 3, "byteOffset": 4},
    ]
    turned = [0.0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 7, 8, 9, 1]  # columns
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"translation": [1, 0, 0]}, {"matrix": turned, "children": [0]}],
    }
    views = [{"buffer": 0, "byteOffset": 8, "byteLength": len(content) - 8, "byteStride": 12}]
    glb.Binary(content, views, accessors).save(tmp_path / "a.glb", document)
    file = glb.read(tmp_path / "a.glb")
    expected = np.maximum(rows["bytes"] / 127, -1)
    np.testing.assert_allclose(glb.numbers(file, 0, "VEC4"), expected, atol=1e-12)
    np.testing.assert_array_equal(glb.numbers(file, 1, "VEC2"), rows["floats"])
    # the node above turns x to y, doubles it and moves it
    assert (file.nodes, file.parents) == ((1, 0), (-1, 0))
    np.testing.assert_allclose(file.worlds[1, :3, 3], [7, 10, 9])
    np.testing.assert_allclose(file.worlds[1] @ [0, 1, 0, 1], [5, 10, 9, 1])


@pytest.mark.parametrize("fps", [12.5, 24.0, 29.97, 30.0, 60.0, 120.0])
def test_an_animation_has_as_many_frames_as_were_written_at_any_rate(fps: float, tmp_path: Path):
    """Times have single precision. The longer one of two tracks counts."""
    for frames in (2, 8, 30, 59, 60, 101, 239):
        binary = glb.Binary()
        moves = np.zeros((frames, 3), "f4")
        moves[:, 0] = np.arange(frames)
        animation = binary.animation("walk", fps, [("translation", 0, moves)])
        short = binary.animation("walk", fps, [("translation", 1, moves[: frames // 2 + 1])])
        short["channels"][0]["sampler"] = 1
        joined = {key: animation[key] + short[key] for key in ("samplers", "channels")}
        document = {
            "asset": {"version": "2.0", "extras": {"fps": fps}},
            "nodes": [{"name": "a"}, {"name": "b"}],
            "animations": [joined],
        }
        binary.save(tmp_path / "a.glb", document)
        positions = glb_animation.read(tmp_path / "a.glb").positions
        np.testing.assert_allclose(positions[:, 0, 0], np.arange(frames), atol=1e-3)
        held = np.minimum(np.arange(frames), frames // 2)
        np.testing.assert_allclose(positions[:, 1, 0], held, atol=1e-3)


def test_all_animations_of_a_file_have_the_rate_of_the_densest_keys(tmp_path: Path):
    """A pose with a key per second is sampled as often as the walk in the same file."""
    binary, moves = glb.Binary(), np.zeros((61, 3), "f4")
    moves[:, 0] = np.arange(61)
    walk = binary.animation("walk", 60, [("translation", 0, moves)])
    pose = binary.animation("pose", 1, [("translation", 0, moves[:3])])
    document = {"asset": {"version": "2.0"}, "nodes": [{"name": "a"}], "animations": [walk, pose]}
    binary.save(tmp_path / "a.glb", document)
    for name, frames, end in (("walk", 61, 60), ("pose", 121, 2)):
        nodes = glb_animation.read(tmp_path / "a.glb", name)
        assert (nodes.animation, nodes.fps, len(nodes.positions)) == (name, 60, frames)
        expected = np.linspace(0, end, frames)
        np.testing.assert_allclose(nodes.positions[:, 0, 0], expected, atol=1e-4)
