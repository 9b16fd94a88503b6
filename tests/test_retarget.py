"""Motions on the skeletons of other programs, and on a user's own characters."""

import io
import itertools
import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from support.fixtures import blender
from support.glb import Glb, changed, odd_character, skinned, write_names
from support.motions import largest_step, posed, synthetic

from flame_mdm.__main__ import main
from flame_mdm.errors import UserError
from flame_mdm.formats import bvh, character_meshes, characters, fbx, fbx_scene, glb, glb_animation
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.posture import world_rotations
from flame_mdm.formats.readers import read
from flame_mdm.formats.retarget import preset, presets, retarget
from flame_mdm.formats.rig import (
    LIMBS,
    SIDES,
    RestPose,
    Rig,
    _bent,
    fitted,
    follow,
    rest_pose,
)
from flame_mdm.formats.rigged import RiggedClip
from flame_mdm.representations.skeleton import JOINT, SMPL22
from flame_mdm.representations.smpl import ADULT

BLENDED = {"cmu": ("spine1", "left_collar", "right_collar"), "100style": ("spine3",)}
"""Joints that the reader of these skeletons places between two of the file's."""


@pytest.fixture
def kick() -> Motion:
    return synthetic("kick")


def joints_of(file: Glb, character: characters.Character) -> dict[str, np.ndarray]:
    worlds = file.worlds()
    return {
        joint: worlds[:, character.file.nodes[number], :3, 3]
        for joint, number in character.map.items()
    }


ORDERS = {
    **{"mixamo": "XYZ", "unreal": "ZYX", "unity": "ZXY", "rigify": "XYZ"},
    **{"lafan1": "ZYX", "soma": "ZYX", "cmu": "ZYX", "100style": "YXZ"},
}


def test_each_skeleton_has_the_euler_order_of_its_program(tmp_path, subtests):
    """In the order of the channels of a BVH file."""
    assert ORDERS.keys() == presets().keys()
    for rig, order in ORDERS.items():
        with subtests.test(rig=rig, order=order):
            synthetic("kick").save(tmp_path / "a.bvh", rig=rig)
            channels = bvh.read(tmp_path / "a.bvh").channels
            written = {
                "".join(name[0] for name in names if name.endswith("rotation"))
                for names in channels
                if names
            }
            assert written == {order}, rig


def test_a_known_skeleton_brings_the_joints_back_also_as_a_character_and_does_not_change_the_body(
    kick, tmp_path, subtests
):
    kick.save(tmp_path / "b.glb")
    plain = Glb(tmp_path / "b.glb")
    points = [plain.skinned(plain.worlds()[frame]) for frame in (0, 30)]
    # The thickness of the soles; of a rig with a root, the hips are lifted, not the node
    lift = np.array(plain.document["nodes"][-1]["translation"])
    for name in presets():
        with subtests.test(name=name):
            kick.save(tmp_path / "a.bvh", rig=name)
            back = read(tmp_path / "a.bvh").joints
            exact = [
                number for joint, number in JOINT.items() if joint not in BLENDED.get(name, ())
            ]
            np.testing.assert_allclose(
                back[:, exact], kick.joints[:, exact], rtol=0, atol=1e-5, err_msg=name
            )
            assert np.abs(back - kick.joints).max() < 0.07, name

            kick.save(tmp_path / "a.glb", rig=name)
            file = Glb(tmp_path / "a.glb")
            worlds, rig = file.worlds(), preset(name, kick.posed())
            assert [node["name"] for node in file.document["nodes"][:-2]] == list(rig.joints)
            nodes = [node for node, source in enumerate(rig.sources) if source >= 0]
            expected = kick.joints[:, [source for source in rig.sources if source >= 0]]
            np.testing.assert_allclose(
                worlds[:, nodes][..., :3, 3] - lift, expected, rtol=0, atol=1e-5, err_msg=name
            )
            for frame, moved in zip((0, 30), points, strict=True):
                np.testing.assert_allclose(
                    file.skinned(worlds[frame]), moved, rtol=0, atol=1e-5, err_msg=name
                )
            if name in (
                "lafan1",
                "unreal",
                "mixamo",
            ):  # as a character, up to the height of the soles
                kick.save(tmp_path / "out.glb", character=tmp_path / "a.glb")
                at = joints_of(
                    Glb(tmp_path / "out.glb"), characters.read_skinned(tmp_path / "a.glb")
                )
                for joint in (
                    f"{side}_{part}"
                    for side in SIDES
                    for part in ("hip", "knee", "ankle", "foot", "wrist")
                ):
                    off = np.linalg.norm(
                        (at[joint] - kick.joints[:, JOINT[joint]])[:, [0, 2]], axis=1
                    )
                    assert np.median(off) < 0.012, (name, joint)


def test_local_axes_are_those_of_the_skeleton_and_rotations_those_of_the_source(
    kick: Motion, subtests
):
    """Each axis points toward a direction, or toward another joint."""
    for name, joint, axis, toward in (
        *(
            ("lafan1", "Hips", "x", (0, 1, 0)),
            ("lafan1", "Hips", "y", (0, 0, 1)),
            ("lafan1", "Hips", "z", (1, 0, 0)),
        ),
        *(("lafan1", "LeftLeg", "x", "LeftFoot"), ("lafan1", "RightLeg", "x", "RightFoot")),
        *(("lafan1", "LeftArm", "x", "LeftForeArm"), ("lafan1", "RightForeArm", "x", "RightHand")),
        *(("soma", "LeftShin", "x", "LeftFoot"), ("100style", "LeftShoulder", "x", (1, 0, 0))),
        ("mixamo", "mixamorig:LeftArm", "y", (0, 1, 0)),
    ):
        with subtests.test(name=name, joint=joint, axis=axis):
            rig = preset(name, kick.posed())
            at, number = dict(zip(rig.joints, rig.positions, strict=True)), rig.joints.index(joint)
            direction = (
                at[toward] - at[joint] if isinstance(toward, str) else np.array(toward, float)
            )
            actual = rig.neutral[number][:, "xyz".index(axis)]
            # limbs of SMPL's T-pose slope a little
            np.testing.assert_allclose(
                actual, direction / np.linalg.norm(direction), atol=0.12, err_msg=f"{name} {joint}"
            )
            np.testing.assert_allclose(np.linalg.det(rig.neutral), 1)
    rig = preset("soma", kick.posed())
    left, right = (rig.neutral[rig.joints.index(f"{side}Shin")] for side in ("Left", "Right"))
    # The right knee turns in the direction opposite to the mirrored left knee.
    np.testing.assert_allclose(right, -np.diag([-1, 1, 1]) @ left, atol=0.1)
    # every joint has the rotation of its counterpart, also where positions do not show it
    poses = kick.posed()
    rig = preset("lafan1", poses)
    turned = retarget(poses, rig)[0]
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            turned[:, joint] = turned[:, parent] @ turned[:, joint]
    body = world_rotations(poses.rotations.numpy())
    np.testing.assert_allclose(
        turned @ rig.neutral.swapaxes(1, 2), body[:, list(rig.sources)], atol=1e-9
    )


def limbs_off(at: dict[str, np.ndarray], joints: np.ndarray, *limbs: str) -> float:
    """Median angle in degrees between a limb of a character and of a motion, for the worst limb."""
    angles = []
    for side, start in itertools.product(SIDES, limbs):
        ours = joints[:, JOINT[f"{side}_{LIMBS[start]}"]] - joints[:, JOINT[f"{side}_{start}"]]
        theirs = at[f"{side}_{LIMBS[start]}"] - at[f"{side}_{start}"]
        cosine = (
            (ours * theirs).sum(1) / np.linalg.norm(ours, axis=1) / np.linalg.norm(theirs, axis=1)
        )
        angles.append(float(np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1))))))
    return max(angles)


@pytest.mark.parametrize("turned", [False, True])
def test_a_character_with_odd_names_scale_and_rest_pose(
    kick: Motion, tmp_path: Path, turned: bool, subtests
):
    hero = tmp_path / "hero.glb"
    odd_character(hero, kick, turned)
    write_names(tmp_path / "hero.yaml")
    assert ", 22 of 2" in kick.save(tmp_path / "out.glb", character=hero)
    file = Glb(tmp_path / "out.glb")
    at = joints_of(file, characters.read_skinned(hero))
    assert limbs_off(at, kick.joints, "shoulder", "elbow") < 0.1
    assert limbs_off(at, kick.joints, "hip", "knee") < 6  # the legs reach for the floor
    standing = kick.joints[:, [JOINT["left_foot"], JOINT["right_foot"]], 1].min(1) < 0.005
    lowest = np.abs([file.skinned(world)[:, 1].min() for world in file.worlds()[standing]])
    assert np.median(lowest) < 0.010
    assert lowest.max() < 0.03
    before = Glb(hero).document
    assert all(file.document[part] == before[part] for part in ("meshes", "materials", "skins"))
    for side in SIDES:
        with subtests.test(side=side):
            # The character faces +z, as the motion does.
            assert np.median((at[f"{side}_foot"] - at[f"{side}_ankle"])[standing, 2]) > 0
    world = characters.moved(characters.read(hero), kick)[0]
    # No limb flips
    assert largest_step(world) < largest_step(world_rotations(kick.posed().rotations.numpy())) + 10


def own_bvh(path: Path, kick: Motion, changes: str) -> bvh.Bvh:
    """Writes a skeleton with Unreal's names as a user's own file, and returns it."""
    kick.save(path, rig="unreal", rest_pose=True)
    file = bvh.read(path)
    if changes == "z up":  # its rest pose is the pose of the offsets
        turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        file = replace(file, offsets=file.offsets @ turn.T, frames=np.zeros_like(file.frames[:1]))
    elif changes == "root alone moves":
        hips = file.joints.index("pelvis")
        columns = file.columns()[hips]
        moving = [
            columns.start + number
            for number, name in enumerate(file.channels[hips])
            if "position" in name
        ]
        offsets = file.offsets.copy()
        offsets[hips] = file.frames[0, moving]
        channels = list(file.channels)
        channels[hips] = tuple(name for name in file.channels[hips] if "rotation" in name)
        frames = np.delete(file.frames, moving, axis=1)
        file = replace(file, offsets=offsets, channels=tuple(channels), frames=frames)
    bvh.write(file, path)
    return bvh.read(path)


def test_the_skin_of_a_persons_legs_is_not_twisted_when_the_person_is_a_character(
    kick: Motion, tmp_path: Path
):
    """The knees of SMPL's body bend sideways at rest, which must not be taken for the axis of the joint."""
    kick.save(tmp_path / "person.glb")
    kick.save(tmp_path / "again.glb", character=tmp_path / "person.glb")
    first, again = (skinned(tmp_path / f"{name}.glb", 0) for name in ("person", "again"))
    legs = first[:, 1] < 0.6
    assert legs.sum() > 400
    assert np.linalg.norm(again - first, axis=1)[legs].max() < 0.002


@pytest.mark.parametrize("changes", ["first frame", "z up", "root alone moves"])
def test_a_bvh_character_keeps_its_skeleton(kick: Motion, tmp_path: Path, changes: str):
    hero, out = tmp_path / "hero.bvh", tmp_path / "out.bvh"
    before = own_bvh(hero, kick, changes)
    assert "22 of 23 joints follow the motion, 1 keep their angle" in kick.save(out, character=hero)

    file, character = bvh.read(out), characters.read(hero)
    assert (file.joints, file.parents, file.channels) == (
        before.joints,
        before.parents,
        before.channels,
    )
    assert (len(file.frames), file.fps) == (len(kick.joints), kick.fps)
    np.testing.assert_array_equal(file.offsets, before.offsets)

    positions = file.positions() @ character.rig.frame.T / 100
    at = {joint: positions[:, number] for joint, number in character.map.items()}
    assert limbs_off(at, kick.joints, "shoulder", "elbow") < 0.1
    assert limbs_off(at, kick.joints, *LIMBS) < 1
    lowest = np.minimum(at["left_foot"][:, 1], at["right_foot"][:, 1])
    np.testing.assert_allclose(np.median(lowest), np.median(kick.joints[..., 1].min(1)), atol=0.01)
    walked = at["pelvis"][-1] - at["pelvis"][0]
    np.testing.assert_allclose(walked, kick.joints[-1, 0] - kick.joints[0, 0], atol=0.01)


def test_a_file_of_a_bvh_character_has_the_frame_rate_of_the_motion(kick: Motion, tmp_path: Path):
    own_bvh(tmp_path / "hero.bvh", kick, "z up")
    faster = Motion(kick.joints[:5], 30)
    summary = faster.save(tmp_path / "out.bvh", character=tmp_path / "hero.bvh")
    assert "5 frames at 30 per second" in summary
    assert bvh.read(tmp_path / "out.bvh").fps == 30


def test_the_summary_of_a_glb_character_counts_all_nodes(kick: Motion, tmp_path: Path):
    kick.save(tmp_path / "hero.glb", rig="soma")
    count = len(glb.read(tmp_path / "hero.glb").names)
    assert count == 24 + 2  # 24 joints, the node of the mesh, and the node that raises the person
    summary = kick.save(tmp_path / "out.glb", character=tmp_path / "hero.glb")
    assert summary.endswith("22 of 26 joints follow the motion, 4 keep their angle")


def test_a_bvh_character_whose_body_cannot_turn_or_move_is_refused(
    kick: Motion, tmp_path: Path, subtests
):
    hero = tmp_path / "hero.bvh"
    own_bvh(hero, kick, "first frame")
    with pytest.raises(UserError, match=r"out\.glb: a \.bvh character has no meshes"):
        kick.save(tmp_path / "out.glb", character=hero)
    text = hero.read_text()
    lines = text.splitlines()
    elbow = next(number for number, line in enumerate(lines) if "lowerarm_l" in line) + 3
    numbers = lines.copy()
    numbers[elbow] = (
        numbers[elbow]
        .replace("3 Zrotation", "2")
        .replace("3 Xrotation", "2")
        .replace("3 Yrotation", "2")
    )
    rows = next(number for number, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    numbers[rows:] = [row.rsplit(" ", 1)[0] for row in lines[rows:]]
    fixed = [line.replace("6 Xposition Yposition Zposition", "3") for line in lines[:rows]]
    fixed += [" ".join(row.split()[3:6] + row.split()[9:]) for row in lines[rows:]]
    for changed_lines, message in (
        (numbers, r"lowerarm_l \(left_elbow\) has 2 rotation channels"),
        (fixed, "pelvis and the joints above it have no position channels"),
    ):
        with subtests.test(changed_lines=changed_lines, message=message):
            hero.write_text("\n".join(changed_lines) + "\n")
            with pytest.raises(UserError, match=message):
                kick.save(tmp_path / "out.bvh", character=hero)
            assert not (tmp_path / "out.bvh").exists()


def test_names_of_joints_are_read_from_a_file(
    kick: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str], subtests
):
    hero, names, out = tmp_path / "hero.glb", tmp_path / "hero.yaml", str(tmp_path / "out.glb")
    odd_character(hero, kick)
    kick.save(tmp_path / "a.npz")
    names.touch()  # as a shell does that redirects the output
    assert main(["convert", str(tmp_path / "a.npz"), out, f"character={hero}"]) == 1
    printed = capsys.readouterr()
    assert printed.out.startswith("# Joints of hero.glb: ")
    assert {line.split(":")[0] for line in printed.out.splitlines()[1:]} == set(JOINT)
    assert "no joint found for pelvis, left_hip" in printed.err
    other: dict[str, Any]
    for other, message in (
        (
            {"left_nee": "x"},
            r"hero\.yaml: left_nee is not an SMPL joint\. Did you mean left_knee",
        ),
        (
            {"left_knee": "Rig Bone-l_flak"},
            r"left_knee: .*hero\.glb has no joint Rig Bone-l_flak\. Did you mean Rig",
        ),
        (
            {"left_knee": "Rig Bone-r_flac"},
            r"hero\.yaml: Rig Bone-r_flac is listed for left_knee and for another",
        ),
        ({"left_knee": None}, r"no joint found for left_knee\. Add"),
        ({"left_knee": "Rig Bone-l_hgiht", "left_hip": "Rig Bone-l_eflac"}, "upright|has no joint"),
    ):
        with subtests.test(other=other, message=message):
            write_names(names, **other)
            with pytest.raises(UserError, match=message):
                characters.read(hero)
    write_names(names)
    assert main(["convert", str(tmp_path / "a.npz"), out, f"character={hero}"]) == 0


def below_another(document: dict[str, Any], **fields: Any) -> None:
    document["nodes"].append({"children": document["scenes"][0].pop("nodes"), **fields})
    document["scenes"][0]["nodes"] = [len(document["nodes"]) - 1]


def exchanged(document: dict[str, Any]) -> None:
    for node in document["nodes"]:
        node["name"] = (
            node["name"].replace("Left", "?").replace("Right", "Left").replace("?", "Right")
        )


def with_joint(document: dict[str, Any], name: str, skin: int) -> None:
    """Adds a node below the first one, as a joint of a skin without bind matrices."""
    document["nodes"][0]["children"].append(len(document["nodes"]))
    joints = [joint for own in document["skins"][skin:] for joint in own["joints"]]
    document["skins"][skin:] = [{"joints": [*joints, len(document["nodes"])]}]
    document["nodes"].append({"name": name})


def short(document: dict[str, Any]) -> None:
    next(node for node in document["nodes"] if node["name"] == "mixamorig:LeftForeArm")[
        "translation"
    ] = [0, 0, 0]
    del document["skins"][0]["inverseBindMatrices"]


def unskinned(document: dict[str, Any]) -> None:
    del document["skins"]
    for node in document["nodes"]:
        node.pop("skin", None)


def test_characters_that_cannot_be_used_are_refused(kick: Motion, tmp_path: Path, subtests):
    kick.save(tmp_path / "mixamo.glb", rig="mixamo")
    hero = tmp_path / "hero.glb"
    for change, message in (
        (unskinned, "one skeleton with a skin, but found 0"),
        (lambda d: with_joint(d, "other", 1), "one skeleton with a skin, but found 2"),
        (
            lambda d: with_joint(d, "mixamorig:LeftLeg", 0),
            r"2 joints for left_knee: mixamorig:LeftLeg, mixamorig:L",
        ),
        (short, "the bone from left_shoulder to left_elbow has no length"),
        (
            lambda d: below_another(d, rotation=[0, 0, 0.5**0.5, 0.5**0.5]),
            "not upright: it leans by 90 degrees",
        ),
        (
            lambda d: below_another(d, scale=[1, 1, 2]),
            r"mixamorig:Hips \(pelvis\) is mirrored or scaled unevenly",
        ),
        (
            lambda d: below_another(d, scale=[-1, 1, 1]),
            r"mixamorig:Hips \(pelvis\) is mirrored or scaled unevenly",
        ),
        (exchanged, "the toes point backward"),
        (
            lambda d: d["buffers"][0].update(uri="hero.bin"),
            r"single glTF 2\.0 file \(\.glb\): buffers\.0\.uri",
        ),
    ):
        with subtests.test(change=change, message=message):
            hero.write_bytes((tmp_path / "mixamo.glb").read_bytes())
            changed(hero, change)
            with pytest.raises(UserError, match=message):
                kick.save(tmp_path / "out.glb", character=hero)
            assert not (tmp_path / "out.glb").exists()
    with pytest.raises(UserError, match=r"out\.bvh: a \.glb character can only"):
        kick.save(tmp_path / "out.bvh", character=tmp_path / "mixamo.glb")


OFFSETS = np.array(ADULT[:22])


def standing(change: Callable[[np.ndarray], object] = lambda positions: None) -> RestPose:
    """The rest pose of SMPL's skeleton, whose joints (22, 3) are changed."""
    positions = np.zeros((22, 3))
    for parent, joint in SMPL22.edges:
        positions[joint] = positions[parent] + OFFSETS[joint]
    change(positions)
    turns = np.tile(np.eye(3), (22, 1, 1))
    names, up = SMPL22.joints, (0, 1, 0)
    return rest_pose("it", names, SMPL22.parents, positions, turns, JOINT, positions, up)


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(
    ("limb", "bend"), [(("shoulder", "elbow", "wrist"), 1), (("hip", "knee", "ankle"), -1)]
)
@pytest.mark.parametrize(
    ("degrees", "around", "is_shown"),
    [
        (30, 0, True),  # bent as usual: elbows forward, knees backward
        (30, 50, True),  # the limb is twisted
        (30, 150, False),  # bent the wrong way
        (10, 50, False),  # nearly straight
    ],
)
def test_a_limb_turns_about_the_axis_that_its_bend_at_rest_shows(
    side: str, limb: tuple[str, ...], bend: int, degrees: float, around: float, is_shown: bool
):
    first, middle, end = (JOINT[f"{side}_{name}"] for name in limb)

    def bent(positions: np.ndarray) -> None:
        along = unit(positions[middle] - positions[first])
        ahead = unit(np.array([0, 0, bend]) - along * along[2] * bend)
        angles = np.radians([degrees, around])
        across = np.cos(angles[1]) * ahead + np.sin(angles[1]) * np.cross(along, ahead)
        lower = np.cos(angles[0]) * along + np.sin(angles[0]) * across
        moved = positions[middle] + np.linalg.norm(OFFSETS[end]) * lower
        foot = [JOINT[f"{side}_foot"]] if limb[0] == "hip" else []
        positions[[end, *foot]] += moved - positions[end]

    character = standing(bent)
    rig = fitted(character, OFFSETS)
    upper = rig.positions[middle] - rig.positions[first]
    lower = rig.positions[end] - rig.positions[middle]
    hinge = np.cross(upper, lower) if is_shown else np.cross(upper, [0, 0, bend])
    ours = np.cross(OFFSETS[middle], [0, 0, bend])
    for joint, bone, their_bone in ((first, OFFSETS[middle], upper), (middle, OFFSETS[end], lower)):
        neutral = rig.neutral[joint]
        np.testing.assert_allclose(neutral @ unit(their_bone), unit(bone), atol=1e-9)
        # the axes agree as far as they are perpendicular to the bones
        theirs = unit(hinge - unit(their_bone) * (unit(their_bone) @ hinge))
        expected = unit(ours - unit(bone) * (unit(bone) @ ours))
        np.testing.assert_allclose(neutral @ theirs, expected, atol=1e-9)
    if limb[0] == "shoulder":
        np.testing.assert_array_equal(rig.neutral[end], rig.neutral[middle])


def test_offsets_and_local_rotations_of_a_scaled_and_turned_skeleton_give_its_rest_pose():
    random = np.random.default_rng(0)
    angles = random.uniform(-180, 180, (5, 3))
    frame, *turned = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    rig = Rig(
        joints=("root", "hips", "spine", "leg"),
        parents=(-1, 0, 1, 1),
        positions=random.normal(size=(4, 3)),
        turns=np.stack(turned),
        sources=(-1, 0, 3, 1),
        neutral=np.tile(np.eye(3), (4, 1, 1)),
        orders=("XYZ",) * 4,
        frame=frame,
        scales=np.array([1.0, 0.01, 0.01, 0.02]),
    )
    offsets, rest = rig.offsets(), rig.rest()
    turns, positions = [rig.frame @ rest[0]], [rig.frame @ offsets[0]]
    for joint, parent in list(enumerate(rig.parents))[1:]:
        turns.append(turns[parent] @ rest[joint])
        bone = rig.scales[parent] * offsets[joint]
        positions.append(positions[parent] + turns[parent] @ bone)
    np.testing.assert_allclose(turns, rig.turns, atol=1e-12)
    np.testing.assert_allclose(positions, rig.positions, atol=1e-12)


def about_y(degrees: float, positions: np.ndarray) -> None:
    positions[:] = positions @ Rotation.from_euler("y", degrees, degrees=True).as_matrix().T


def legs_lean(positions: np.ndarray) -> None:
    for joint in (4, 5, 7, 8, 10, 11):
        positions[joint, 2] += 1.2


@pytest.mark.parametrize(("degrees", "is_snapped"), [(0, True), (6, True), (12, False), (94, True)])
def test_a_character_is_turned_to_the_nearest_axis_if_it_is_close(degrees: float, is_snapped: bool):
    frame = standing(lambda positions: about_y(degrees, positions)).rig.frame
    turned = round(degrees / 90) * 90 if is_snapped else degrees
    expected = Rotation.from_euler("y", -turned, degrees=True).as_matrix()
    np.testing.assert_allclose(frame, expected, atol=1e-9 if is_snapped else 0.03)


def test_legs_that_lean_are_no_rest_pose():
    with pytest.raises(UserError, match="it: the rest pose is not upright: it leans by"):
        standing(legs_lean)


@pytest.mark.parametrize(
    ("raised", "height"),
    [(0.0, 0.0), (0.05, 0.0), (-0.05, 0.0), (0.3, 0.3), (-0.3, -0.3)],
)
def test_a_body_near_the_floor_stands_on_it_and_another_one_keeps_its_height(
    raised: float, height: float
):
    motion = posed(3, root=[[0, 0.955, 0], [0.1, 0.955, 0.2], [0.2, 0.955, 0.4]])
    joints = motion.joints.astype(float)
    joints[..., 1] -= joints[..., 1].min()
    straight = np.tile(np.eye(3), (22, 1, 1))
    world = np.tile(straight, (3, 1, 1, 1))
    moved = joints + np.array([0, raised, 0])
    _, positions, _ = follow(standing(), moved, OFFSETS, straight, world)
    # SMPL's own skeleton stands as the body does.
    np.testing.assert_allclose(positions, joints + np.array([0, height, 0]), atol=0.01)


@pytest.mark.parametrize(
    ("target", "knee"),
    [
        ((0, -0.5, 0), None),
        ((0.1, -0.4, 0.3), None),
        ((0, -0.05, 0), None),  # too close: the leg is folded as far as it can be
        ((0, -2, 0), (0, -0.4, 0)),  # too far: the leg is straight
    ],
)
def test_a_leg_bends_to_its_target_with_bones_of_constant_length(target, knee):
    hip, before, ankle = (np.array([row], float) for row in ((0, 0, 0), (0, -0.4, 0), (0, -0.7, 0)))
    forward = np.array([[0, 0, 1.0]])
    new = _bent(hip, before, ankle, np.array([target], float), forward)[0]
    assert np.linalg.norm(new) == pytest.approx(0.4, abs=1e-6)
    distance = np.linalg.norm(target)
    if 0.1 < distance < 0.7:
        assert np.linalg.norm(new - target) == pytest.approx(0.3, abs=1e-6)
        assert new[2] > 0  # a straight leg bends forward
        assert new[0] == pytest.approx(target[0] * (new @ target) / distance**2, abs=0.08)
    if knee is not None:
        np.testing.assert_allclose(new, knee, atol=0.03)


def skin_of(clip: RiggedClip, frame: int) -> np.ndarray:
    """Vertices (V, 3) of all skins of a clip in a frame, whose joints may have scales."""
    worlds: list[np.ndarray] = []
    for joint, parent in enumerate(clip.parents):
        local = np.eye(4)
        local[:3, :3] = clip.scales[joint] * clip.turns[frame, joint]
        local[:3, 3] = clip.moves[joint][frame] if joint in clip.moves else clip.offsets[joint]
        worlds.append(worlds[parent] @ local if parent >= 0 else local)
    surfaces = []
    for skin in clip.skins:
        moves = np.stack(worlds)[list(skin.ordered)] @ skin.binds
        points = np.pad(skin.points, ((0, 0), (0, 1)), constant_values=1)
        moved = np.einsum("vkij,vj->vki", moves[skin.bones], points)[..., :3]
        surfaces.append((skin.weights[..., None] * moved).sum(1))
    return np.concatenate(surfaces)


@pytest.mark.parametrize("name", ["hero", "odd"])
def test_a_character_as_fbx_moves_its_joints_and_skin_as_in_its_glb_file(
    name: str, kick: Motion, tmp_path: Path
):
    kick.save(tmp_path / "hero.glb", rig="mixamo")
    odd_character(tmp_path / "odd.glb", kick)
    write_names(tmp_path / "odd.yaml")
    motion, path = Motion(synthetic("wave").joints[:30], 20), tmp_path / f"{name}.glb"
    motion.save(tmp_path / "wave.glb", character=path)
    summary = motion.save(tmp_path / "wave.fbx", character=path)
    theirs, ours = glb_animation.read(tmp_path / "wave.glb"), fbx_scene.read(tmp_path / "wave.fbx")
    joints = [joint for joint in theirs.names if joint in ours.names]
    assert len(joints) >= 22
    rows = ([file.names.index(joint) for joint in joints] for file in (theirs, ours))
    expected, positions = (
        file.positions[:, row] for file, row in zip((theirs, ours), rows, strict=True)
    )
    np.testing.assert_allclose(positions, expected, atol=1e-5)
    clip = character_meshes.character_clip(characters.read_skinned(path), motion, "wave")
    for frame in (0, 29):
        surface = skin_of(clip, frame)
        np.testing.assert_allclose(surface, skinned(tmp_path / "wave.glb", frame), atol=1e-5)
    assert f"{len(clip.joints)} joints, 1 meshes" in summary


def test_meshes_of_a_character_keep_their_parts_materials_and_images(kick: Motion, tmp_path: Path):
    path, image = tmp_path / "hero.glb", io.BytesIO()
    kick.save(path)
    Image.new("RGB", (2, 2), (9, 8, 7)).save(image, "PNG")
    file = Glb(path)
    document = file.document
    data = glb.Binary(file.binary, document["bufferViews"], document["accessors"])
    view = len(data.views)
    document["bufferViews"] = [
        *data.views,
        {"buffer": 0, "byteOffset": len(data.data), "byteLength": len(image.getvalue())},
    ]
    document["images"] = [{"bufferView": view, "mimeType": "image/png"}, {"uri": "elsewhere.png"}]
    document["textures"] = [{"source": 1}, {"source": 0}]
    surface = {"baseColorFactor": [0.5, 0.25, 2.0, 1], "baseColorTexture": {"index": 1}}
    document["materials"] = [{"name": "../cloth", "pbrMetallicRoughness": surface}, {}]
    (mesh,) = document["meshes"]
    (whole,) = mesh["primitives"]
    bare = {"POSITION": whole["attributes"]["POSITION"]}
    mesh |= {"name": "body"}
    mesh["primitives"] = [
        whole | {"material": 0},
        {"attributes": bare, "indices": whole["indices"]},
    ]
    data.data += image.getvalue()
    binary = bytes(data.data) + b"\0" * (-len(data.data) % 4)
    document["buffers"][0]["byteLength"] = len(binary)
    file.binary = binary
    file.save(path)
    first, second = character_meshes.meshes(glb.read(path))
    assert (first.name, second.name) == ("body 1", "body 2")
    (cloth,), (plain,) = first.palette, second.palette
    assert (cloth.name, cloth.image) == ("../cloth", image.getvalue())
    np.testing.assert_allclose(cloth.color, [0.5 ** (1 / 2.2), 0.25 ** (1 / 2.2), 1])
    assert (plain.name, plain.image) == ("material", b"")
    # The second part is bound to no joint, so it follows its node.
    assert second.bones.tolist() == [[0]] * len(second.points)
    np.testing.assert_array_equal(second.binds, np.eye(4)[None])
    # It has no normals, so they are computed. The first part has the normals of the same surface.
    np.testing.assert_allclose(np.linalg.norm(second.normals, axis=1), 1)
    assert (first.normals * second.normals).sum(1).mean() > 0.98

    kick.save(tmp_path / "wave.fbx", character=path)
    objects = fbx.read(tmp_path / "wave.fbx").first("Objects")
    assert objects is not None
    (video,) = objects.all("Video")
    assert video.value("RelativeFilename") == "___cloth.png", "a file beside the scene"


def test_normals_that_a_file_lacks_are_means_of_its_triangles_weighted_by_area():
    points = np.array([[1.0, 0, 0], [0, 2, 0], [0, 0, 1], [0, 0, 0]])
    triangles = np.array([[0, 1, 2], [3, 1, 0], [3, 2, 1], [3, 0, 2]])
    normals = character_meshes._normals(None, {}, points, triangles)  # type: ignore[arg-type]
    # twice the areas: (2, 1, 2) of the slope, and 2, 2 and 1 of the sides in the three planes
    sums = [[2, 0, 0], [0, 1, 0], [0, 0, 2], [-2, -1, -2]]
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    np.testing.assert_allclose(normals, sums / lengths, atol=1e-12)


def test_joints_with_the_same_name_are_numbered():
    assert character_meshes._distinct(["a", "b", "a", "a"]) == ("a", "b", "a 2", "a 3")


def test_a_folder_is_converted(kick: Motion, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    short = Motion(kick.joints[:5], 20)
    for name in ("in/a.npz", "in/below/b.json", "double/a.npz", "double/a.json"):
        short.save(tmp_path / name)
    folder, out = str(tmp_path / "in"), tmp_path / "out"
    assert main(["convert", folder, str(out), "format=bvh", "rig=mixamo"]) == 0
    assert [str(path.relative_to(out)) for path in sorted(out.rglob("*.bvh"))] == [
        "a.bvh",
        "below/b.bvh",
    ]
    kick.save(tmp_path / "hero.glb")
    assert (
        main(["convert", folder, str(tmp_path / "on"), f"character={tmp_path / 'hero.glb'}"]) == 0
    )
    assert (tmp_path / "on" / "below" / "b.glb").exists()
    assert main(["convert", folder, str(tmp_path / "tree"), f"character={out / 'a.bvh'}"]) == 0
    assert (tmp_path / "tree" / "below" / "b.bvh").exists()
    assert main(["convert", str(tmp_path / "double"), str(out), "format=bvh"]) == 1
    assert "another motion has the same name" in capsys.readouterr().err


@pytest.mark.tools
@pytest.mark.parametrize(
    ("name", "ending"), itertools.product(("mixamo", "unreal", "lafan1", "soma"), (".glb", ".bvh"))
)
def test_blender_shows_the_pose(name: str, ending: str, kick: Motion, tmp_path: Path, subtests):
    path, rig = tmp_path / f"a{ending}", preset(name, kick.posed())
    kick.save(path, rig=name)
    lift = np.array(Glb(path).document["nodes"][-1]["translation"]) if ending == ".glb" else 0
    script = Path(__file__).parent / "support" / "blender.py"
    done = subprocess.run(
        [blender(), script, path, "20"], capture_output=True, text=True, check=True
    )
    shown = json.loads(
        next(line for line in done.stdout.splitlines() if line.startswith("FOUND"))[5:]
    )
    assert [frame for frame, _ in shown] == [0, (len(kick.joints) - 1) // 2, len(kick.joints) - 1]
    for frame, positions in shown:
        with subtests.test(frame=frame):
            joints = {
                rig.joints.index(joint): position
                for joint, position in positions.items()
                if joint in rig.joints
            }
            followed = {
                joint: position for joint, position in joints.items() if rig.sources[joint] >= 0
            }
            assert len(followed) >= len(SMPL22)
            for joint, position in followed.items():
                expected = kick.joints[frame, rig.sources[joint]] + lift
                np.testing.assert_allclose(
                    position, expected, atol=1e-4, err_msg=f"{rig.joints[joint]}, frame {frame}"
                )


AXES = {
    "lafan1": {
        "Hips": ("up", "forward"),
        "Arm": ("along", "back"),
        "Hand": ("along", "back"),
        "UpLeg": ("along", "forward"),
        "Foot": ("along", "up"),
        "Toe": ("forward", "up"),
    },
    "soma": {
        "Chest": ("up", "forward"),
        "Arm": ("along", "up"),
        "Hand": ("along", "up"),
        "Leg": ("along", "back"),
        "Shin": ("along", "back"),
        "Foot": ("along", "down"),
        "ToeBase": ("forward", "down"),
    },
}
TOWARD = {"up": (0, 1, 0), "down": (0, -1, 0), "forward": (0, 0, 1), "back": (0, 0, -1)}


@pytest.mark.parametrize("name", AXES)
def test_the_first_two_axes_of_each_joint_have_the_directions_of_the_program(name, subtests):
    rig = preset(name, posed().posed())
    for joint, directions in AXES[name].items():
        middle = joint in ("Hips", "Chest")
        for side, mirror in (("", 1),) if middle else (("Left", 1), ("Right", -1)):
            with subtests.test(joint=side + joint):
                number = rig.joints.index(side + joint)
                source = rig.sources[number]
                end = SMPL22.parents.index(source) if source in SMPL22.parents else source
                for axis, direction in enumerate(directions):
                    toward = ADULT[end] if direction == "along" else TOWARD[direction]
                    expected = np.array(toward, float) * [
                        1 if direction == "along" else mirror,
                        1,
                        1,
                    ]
                    expected *= -1 if name == "soma" and mirror < 0 else 1
                    cosine = rig.neutral[number][:, axis] @ expected / np.linalg.norm(expected)
                    assert cosine > (0.995 if axis == 0 else 0.85)


def test_unreals_arms_hang_by_45_degrees_more_than_smpls():
    rig = preset("unreal", posed().posed())
    for side, sign in (("l", 1), ("r", -1)):
        shoulder, elbow, wrist = (
            rig.positions[rig.joints.index(f"{name}_{side}")]
            for name in ("upperarm", "lowerarm", "hand")
        )
        for bone, name in ((elbow - shoulder, "left_elbow"), (wrist - elbow, "left_wrist")):
            x, y, _ = ADULT[JOINT[name]]
            slope = np.degrees(np.arctan2(-bone[1], sign * bone[0]))
            assert slope == pytest.approx(45 + np.degrees(np.arctan2(-y, x)), abs=1e-3)


@pytest.mark.parametrize(
    ("name", "joint", "before", "after", "share"),
    [
        ("rigify", "spine.005", "spine.004", "spine.006", 0.5),
        ("soma", "Neck2", "Neck1", "Head", 0.5),
        ("cmu", "Neck", "Spine1", "Neck1", 0.0),
        ("cmu", "LeftHipJoint", "Hips", "LeftUpLeg", 0.0),
        ("100style", "Chest", "Hips", "Chest2", 0.5),
    ],
)
def test_a_joint_without_a_counterpart_lies_between_its_neighbors(
    name, joint, before, after, share
):
    rig = preset(name, posed().posed())
    at = dict(zip(rig.joints, rig.positions, strict=True))
    expected = (1 - share) * at[before] + share * at[after]
    np.testing.assert_allclose(at[joint], expected, atol=1e-9)


def test_units_of_files_of_known_skeletons():
    units = {name: preset(name, posed().posed()).unit for name in presets()}
    assert units.pop("cmu") == pytest.approx(0.0254 / 0.45)
    assert set(units.values()) == {0.01}


@pytest.mark.parametrize("part", ["trunk", "legs"])
@pytest.mark.parametrize(("degrees", "is_upright"), [(38, True), (52, False)])
@pytest.mark.parametrize("sign", [1, -1])
def test_trunk_and_legs_of_a_rest_pose_may_lean_by_45_degrees(part, degrees, is_upright, sign):
    legs = [JOINT[f"{s}_{name}"] for s in SIDES for name in ("knee", "ankle", "foot")]
    moved = legs if part == "legs" else [n for n in range(3, 22) if n not in legs]

    def lean(positions: np.ndarray) -> None:
        turn = Rotation.from_euler("x", sign * degrees, degrees=True).as_matrix()
        start = positions[[JOINT["left_hip"], JOINT["right_hip"]]].mean(0)
        positions[moved] = start + (positions[moved] - start) @ turn.T
        for side in SIDES:  # the feet point ahead
            ankle, foot = JOINT[f"{side}_ankle"], JOINT[f"{side}_foot"]
            positions[foot] = positions[ankle] + OFFSETS[foot]

    if is_upright:
        standing(lean)
        return
    with pytest.raises(UserError, match=r"not upright: it leans by \d+ degrees"):
        standing(lean)


@pytest.mark.parametrize("size", [0.8, 1.25])
def test_the_path_and_the_steps_of_a_character_are_scaled_to_its_legs(size: float):
    def resized(positions: np.ndarray) -> None:
        for side in SIDES:
            for name, above in (("knee", "hip"), ("ankle", "knee"), ("foot", "ankle")):
                joint, parent = JOINT[f"{side}_{name}"], JOINT[f"{side}_{above}"]
                scale = 1 if name == "foot" else size
                positions[joint] = positions[parent] + scale * OFFSETS[joint]

    path = np.linspace((0.1, 0.8, 0.2), (0.5, 0.8, 1.5), 5)
    bent: dict[str, Any] = {f"{side}_hip": (-40, 0, 0) for side in SIDES}
    bent |= {f"{side}_knee": (70, 0, 0) for side in SIDES}
    bent |= {f"{side}_ankle": (-30, 0, 0) for side in SIDES}
    motion = posed(5, root=path, **bent)
    joints = motion.joints.astype(float)
    joints[..., 1] -= joints[..., 1].min() - 0.05
    world = world_rotations(motion.posed().rotations.numpy())
    character = standing(resized)
    _, positions, _ = follow(character, joints, OFFSETS, np.tile(np.eye(3), (22, 1, 1)), world)
    hips, toes = ([JOINT[f"{side}_{name}"] for side in SIDES] for name in ("hip", "foot"))
    middle = positions[:, hips].mean(1)[:, [0, 2]]
    np.testing.assert_allclose(middle, size * joints[:, hips].mean(1)[:, [0, 2]], atol=1e-6)
    np.testing.assert_allclose(
        positions[:, toes][..., [0, 2]], size * joints[:, toes][..., [0, 2]], atol=1e-6
    )
    np.testing.assert_allclose(
        positions[:, toes, 1], size * (joints[:, toes, 1] - joints[..., 1].min()), atol=0.01
    )
    for parent, joint in SMPL22.edges:
        bone = np.linalg.norm(positions[:, joint] - positions[:, parent], axis=1)
        rest = np.linalg.norm(character.rig.positions[joint] - character.rig.positions[parent])
        np.testing.assert_allclose(bone, rest, atol=1e-9)


def test_a_part_of_a_character_has_its_weights_texture_and_joints(tmp_path: Path):
    """Weights add up to 1, v is measured from below, and a skin without matrices is bound as it is stored."""
    binary = glb.Binary()
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
    uvs = np.array([[0, 0.25], [1, 0], [0.5, 1]], "<f4")
    attributes = {
        "POSITION": binary.add(points, bounds=True),
        "TEXCOORD_0": binary.add(uvs.ravel()),
        "JOINTS_0": binary.add(np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 1, 1, 0]], "u1")),
        "WEIGHTS_0": binary.add(
            np.array([[0.2, 0.2, 0, 0], [3, 1, 0, 0], [0, 0.5, -0.5, 0]], "<f4")
        ),
    }
    binary.accessors[attributes["TEXCOORD_0"]] |= {"type": "VEC2", "count": 3}
    bare = {"attributes": {"POSITION": attributes["POSITION"]}}
    document = {
        "asset": {"version": "2.0"},
        "nodes": [
            {"name": "cloth", "mesh": 0, "skin": 0},
            {"children": [2, 0], "translation": [1, 0, 0]},
            {"children": [3], "translation": [0, 2, 0]},
            {"translation": [0, 0, 3]},
        ],
        "meshes": [{"primitives": [{"attributes": attributes}, bare]}],
        "skins": [{"joints": [3, 2]}],
    }
    binary.save(tmp_path / "a.glb", document)
    file = glb.read(tmp_path / "a.glb")
    assert file.nodes == (1, 2, 0, 3)
    bound, fixed = character_meshes.meshes(file)
    assert (bound.name, fixed.name) == ("cloth 1", "cloth 2")
    assert bound.triangles.tolist() == fixed.triangles.tolist() == [[0, 1, 2]]
    np.testing.assert_allclose(bound.uvs, [[0, 0.75], [1, 1], [0.5, 0]], atol=1e-7)
    assert bound.ordered == (3, 1)
    assert bound.bones.tolist() == [[0, 1, 0, 0], [1, 0, 0, 0], [0, 1, 1, 0]]
    weights = [[0.5, 0.5, 0, 0], [0.75, 0.25, 0, 0], [0, 1, 0, 0]]
    np.testing.assert_allclose(bound.weights, weights, atol=1e-7)
    np.testing.assert_allclose(bound.binds[:, :3, 3], [[-1, -2, -3], [-1, -2, 0]])
    # without joints, a part moves with the node of its mesh
    assert fixed.ordered == (2,)
    np.testing.assert_allclose(bound.normals, [[0, 0, 1]] * 3)
