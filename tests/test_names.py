"""Names of joints: every spelling of a known skeleton is recognized, and ambiguous ones are refused."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.motions import posed, synthetic

from flame_mdm.errors import UserError
from flame_mdm.formats import bvh
from flame_mdm.formats.layouts import (
    LAYOUTS,
    UNITS,
    _spelled,
    _variants,
    check_feet,
    check_order,
    check_size,
    find_layout,
    leg_length,
)
from flame_mdm.formats.names import best_match, spelled, spellings
from flame_mdm.formats.readers import read
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.representations.smpl import ADULT

MIXAMO = [str(LAYOUTS["Mixamo"].map[joint]) for joint in SMPL22.joints]


def _short(name: str) -> str:
    return name.replace("left_", "L_").replace("right_", "R_")


def _side_last(name: str) -> str:
    for side in ("Left", "Right"):
        if name.startswith(side):
            return f"{name.removeprefix(side)}.{side[0]}"
    return name


SPELLINGS: dict[str, tuple[list[str], Callable[[str], str], str]] = {
    "namespace": (MIXAMO, lambda name: f"mixamorig:{name}", "Mixamo"),
    "numbered namespace": (MIXAMO, lambda name: f"mixamorig12:{name}", "Mixamo"),
    "joined prefix": (MIXAMO, lambda name: f"mixamorig{name}", "Mixamo"),
    "nested namespaces": (MIXAMO, lambda name: f"scene:hero:{name}", "Mixamo"),
    "underscore": (MIXAMO, lambda name: f"Character1_{name}", "Mixamo"),
    "space": (MIXAMO, lambda name: f"Actor {name}", "Mixamo"),
    "path": (MIXAMO, lambda name: f"Armature|{name}", "Mixamo"),
    "capitals": (MIXAMO, str.upper, "Mixamo"),
    "side last": (MIXAMO, _side_last, "Mixamo"),
    "SMPL's in capitals": (list(SMPL22.joints), str.capitalize, "SMPL"),
    "SMPL's with L and R": (list(SMPL22.joints), lambda name: _short(name).title(), "SMPL"),
    "SMPL's of a body": (list(SMPL22.joints), lambda name: f"m_avg_{_short(name).title()}", "SMPL"),
    "SMPL's in words": (list(SMPL22.joints), lambda name: name.replace("_", " "), "SMPL"),
}


@pytest.mark.parametrize("case", SPELLINGS)
def test_a_skeleton_is_recognized_in_every_spelling(case: str):
    names, spell, skeleton = SPELLINGS[case]
    spelled_names = [spell(name) for name in names]
    layout = find_layout(spelled_names, {})
    assert layout.name == skeleton
    assert layout.map == dict(zip(SMPL22.joints, spelled_names, strict=True))


@pytest.mark.parametrize("skeleton", LAYOUTS)
def test_no_known_skeleton_is_taken_for_another(skeleton: str):
    layout = LAYOUTS[skeleton]
    names = list(layout.joints or layout.pairs())
    recognized = find_layout(names, {})
    assert recognized.map == layout.map
    assert recognized.name == ("SOMA" if skeleton == "SOMA 30" else skeleton)
    assert find_layout([f"Bip001 {name}" for name in names], {}).name == recognized.name


@pytest.mark.parametrize(
    ("names", "skeleton"),
    [
        (
            "Hips Spine1 Spine2 Spine3 Spine4 Neck Head LeftShoulder LeftArm LeftForeArm LeftHand RightShoulder "
            "RightArm RightForeArm RightHand LeftThigh LeftShin LeftFoot LeftToe LeftToeTip RightThigh "
            "RightShin RightFoot RightToe RightToeTip",
            "Rokoko",
        ),
        (
            "Hips Chest Chest2 LeftCollar LeftShoulder LeftElbow LeftWrist LeftWrist.end RightCollar RightShoulder "
            "RightElbow RightWrist RightWrist.end Neck Head Head.end LeftHip LeftKnee LeftAnkle LeftAnkle.end RightHip "
            "RightKnee RightAnkle RightAnkle.end",
            "mocapbank without toes",
        ),
        (
            "Hips Chest Neck Head Head.end LeftCollar LeftUpArm LeftLowArm LeftHand LeftHand.end RightCollar "
            "RightUpArm RightLowArm RightHand RightHand.end LeftUpLeg LeftLowLeg LeftFoot LeftFoot.end "
            "RightUpLeg RightLowLeg RightFoot RightFoot.end",
            "Biovision limbs without toes",
        ),
        (
            "pelvis spine.001 neck face thigh.L shin.L foot.L foot.L.end thigh.R shin.R foot.R foot.R.end upper_arm.L "
            "forearm.L forearm.L.end upper_arm.R forearm.R forearm.R.end",
            "Rigify trunk of two without toes and hands",
        ),
        (
            "spine spine.001 spine.002 spine.003 spine.004 spine.005 spine.006 shoulder.L upper_arm.L forearm.L "
            "forearm.L.end shoulder.R upper_arm.R forearm.R forearm.R.end thigh.L shin.L foot.L toe.L thigh.R shin.R "
            "foot.R toe.R",
            "Rigify without hands",
        ),
    ],
)
def test_skeletons_of_other_programs_are_recognized(names: str, skeleton: str):
    assert find_layout(names.split(), {}).name == skeleton


@pytest.mark.parametrize(
    ("names", "candidates"),
    [
        (
            [f"{person}:{name}" for person in ("A", "B") for name in MIXAMO],
            "Hips could refer to A:Hips or B:Hips",
        ),
        ([*map(str.upper, MIXAMO), "Left_Leg"], "LeftLeg could refer to LEFTLEG or Left_Leg"),
    ],
)
def test_names_that_may_mean_two_joints_are_refused_with_both(names: list[str], candidates: str):
    with pytest.raises(UserError, match=candidates):
        find_layout(names, {})


def test_an_exact_name_is_preferred():
    assert find_layout([*map(str.upper, MIXAMO), *MIXAMO], {}).map == LAYOUTS["Mixamo"].map


def test_a_map_of_the_user_is_matched_like_a_known_skeleton():
    map = {joint: name.lower() for joint, name in zip(SMPL22.joints, MIXAMO, strict=True)}
    layout = find_layout([f"Character1_{name}" for name in MIXAMO], {"map": map})
    assert layout.map["left_hip"] == "Character1_LeftUpLeg"
    assert layout.name == "own map"


def test_the_side_is_marked_in_four_ways():
    left, right = spellings("clavicle_l", "clavicle_r"), spellings("RightClavicle", "LeftClavicle")
    assert set(left) == {"claviclel", "clavicleleft", "lclavicle", "leftclavicle"}
    assert set(right) == {"clavicler", "clavicleright", "rclavicle", "rightclavicle"}
    assert spelled({"lowerback": "lowerback"}) == {"lowerback": "lowerback"}
    assert best_match(["Head"], {"a": {"neck": "neck"}, "b": {"head": "top"}}) == (
        "b",
        {"top": [0]},
        [],
    )


@pytest.mark.parametrize("text", ["ROOT {name}\n", "ROOT {name} {{ "])
def test_names_of_bvh_files_are_the_rest_of_the_line(text: str, tmp_path: Path):
    synthetic().save(tmp_path / "a.bvh", rig="mixamo")
    content = (tmp_path / "a.bvh").read_text().replace("mixamorig:", "Actor  One ")
    if "{{" in text:
        content = content.replace("\n{\n", " {\n", 1)
    (tmp_path / "b.bvh").write_text(content)
    assert bvh.read(tmp_path / "b.bvh").joints[0] == "Actor One Hips"
    np.testing.assert_array_equal(read(tmp_path / "b.bvh").joints, read(tmp_path / "a.bvh").joints)
    bvh.write(bvh.read(tmp_path / "b.bvh"), tmp_path / "c.bvh")
    assert bvh.read(tmp_path / "c.bvh").joints == bvh.read(tmp_path / "b.bvh").joints


def test_the_unit_and_the_axis_of_a_small_figure_that_lies_are_proposed_together(tmp_path: Path):
    synthetic().save(tmp_path / "a.bvh", rig="mixamo")
    file = bvh.read(tmp_path / "a.bvh")
    turned = replace(
        file, joints=("Top", *file.joints), parents=(-1, *(parent + 1 for parent in file.parents))
    )
    turned = replace(turned, offsets=np.concatenate([np.zeros((1, 3)), 0.26 * file.offsets]))
    turned = replace(turned, channels=(("Xrotation",), *file.channels))
    body = np.concatenate([0.26 * file.frames[:, :3], file.frames[:, 3:]], 1)
    bvh.write(
        replace(turned, frames=np.concatenate([np.full((len(body), 1), 90.0), body], 1)),
        tmp_path / "b.bvh",
    )
    with pytest.raises(
        UserError, match=r"0\.0\d+, the legs have the usual length of 0\.83 m.* set up=z"
    ):
        read(tmp_path / "b.bvh")


@pytest.mark.parametrize("name", [name for name, layout in _variants().items() if layout.used])
def test_layouts_that_fit_the_joints_of_another_equally_well_give_the_same_joints(name: str):
    layout = _variants()[name]
    joints = sorted(layout.used)
    positions = np.random.default_rng(0).normal(size=(1, len(joints), 3))
    for key, skeleton in _spelled().items():
        match = best_match(joints, {key: skeleton})
        if match.missing or len(match.numbers) < len(joints):
            continue
        other = _variants()[key].model_copy(
            update={"unit": layout.unit, "mirrored": layout.mirrored}
        )
        names = [""] * len(joints)
        for joint, (number,) in match.numbers.items():
            names[number] = joint
        np.testing.assert_allclose(
            other.apply(positions, names), layout.apply(positions, joints), atol=1e-6
        )


def test_a_unit_is_proposed_for_figures_that_have_no_usual_one():
    joints = synthetic().joints
    with pytest.raises(UserError, match=r"The unit may be 0\.01 \(centimeters\)"):
        check_size(100 * joints, 1.0)
    figure = 0.26 * joints  # legs of about 0.2 m in centimeters, as of drawn figures
    with pytest.raises(
        UserError,
        match=r"No common unit fits the file; with 0\.0\d+, the legs have the usual length of 0\.83 m",
    ) as error:
        check_size(figure, 0.01)
    unit = float(str(error.value).partition("common unit fits the file; with ")[2].split(",")[0])
    check_size(figure * unit / 0.01, unit)
    with pytest.raises(UserError, match=r"The unit is wrong"):
        check_size(0 * joints, 0.01)


METERS = ("SMPL", "VRoid", "Quaternius", "Rigify trunk of two", "SOMA", "SOMA 30")
OTHER_UNITS = {"CMU": 0.0254 / 0.45, "CMU ASF": 0.0254 / 0.45, "MMM": 1 / 640}


@pytest.mark.parametrize("name", LAYOUTS)
def test_units_and_sides_of_known_skeletons(name: str):
    expected = 1.0 if name in METERS else OTHER_UNITS.get(name, 0.01)
    assert LAYOUTS[name].unit == pytest.approx(expected, rel=1e-9)
    assert LAYOUTS[name].mirrored == (name == "MMM")
    assert LAYOUTS[name].up == "y"


BLENDS = {
    "Xsens": {"spine3": (0.5, 0.5)},
    "CMU": {"spine1": (0.5, 0.5), "left_collar": (0.5, 0.5)},
    "Bandai-Namco": {"spine1": (0.6, 0.4)},
    "MMM": {"spine1": (0.5, 0.5), "left_collar": (0.5, 0.5)},
    "CMU ASF": {
        "spine1": (0.12, 0.88),
        "spine2": (0.13, 0.87),
        "spine3": (0.73, 0.27),
        "left_collar": (0.62, 0.38),
    },
    "Daz": {"pelvis": (0.48, 0.26, 0.26), "spine3": (0.82, 0.18), "left_collar": (0.5, 0.5)},
    "Character Creator": {
        "pelvis": (0.2, 0.8),
        "spine1": (0.6, 0.4),
        "spine2": (0.8, 0.2),
        "spine3": (0.6, 0.4),
        "left_collar": (0.85, 0.15),
    },
    "Rokoko": {"spine2": (0.5, 0.5)},
    "mocapbank": {"spine2": (0.3, 0.7)},
    "Biovision": {"spine2": (0.65, 0.35), "spine3": (0.5, 0.5)},
    "Biovision limbs": {"spine2": (0.65, 0.35), "spine3": (0.5, 0.5)},
    "Quaternius": {"spine2": (0.5, 0.5)},
    "Rigify trunk of two": {
        "spine1": (0.5, 0.5),
        "spine3": (0.8, 0.2),
        "head": (0.5, 0.5),
        "left_collar": (0.5, 0.5),
    },
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_joints_that_a_skeleton_lacks_lie_between_two_of_its_joints(name: str):
    layout = LAYOUTS[name]
    blends = {
        joint: tuple(source.values())
        for joint, source in layout.map.items()
        if isinstance(source, dict) and not joint.startswith("right_")
    }
    assert blends == BLENDS.get(name, {})
    for joint, source in layout.map.items():
        if isinstance(source, dict):
            assert sum(source.values()) == pytest.approx(1), joint
            at = {number: k * 1.0 for k, number in enumerate(source)}
            points = np.array([[[at.get(n, 0.0), 0, 0] for n in layout.used]])
            mapped = layout.apply(points, list(layout.used))[0, SMPL22.joints.index(joint), 0]
            expected = sum(k * share for k, share in enumerate(source.values()))
            assert abs(mapped) == pytest.approx(layout.unit * expected, rel=1e-5), joint


@pytest.mark.parametrize(
    ("leg", "children", "fits"),
    [
        *((0.59, False, False), (0.61, False, True), (1.19, False, True), (1.21, False, False)),
        *((0.24, True, False), (0.26, True, True), (0.5, True, True), (1.21, True, False)),
    ],
)
def test_legs_of_adults_and_children_have_limits(leg: float, children: bool, fits: bool):
    joints = synthetic("walk").joints[:3]
    joints = joints * leg / leg_length(joints)
    if fits:
        check_size(joints, 1.0, children)
        return
    with pytest.raises(UserError, match=r"human legs are (0\.25|0\.6) to 1\.2 m long"):
        check_size(joints, 1.0, children)


MARKS = (("Left", "Right"), ("left", "right"), ("L", "R"), ("l", "r"))


@pytest.mark.parametrize("name", LAYOUTS)
def test_joints_on_the_left_are_called_left(name: str):
    layout = LAYOUTS[name]
    sided = {joint: source for joint, source in layout.map.items() if joint.startswith("left_")}
    assert len(sided) == 8
    for joint, source in sided.items():
        other = layout.map["right_" + joint.removeprefix("left_")]
        names, others = ([source], [other]) if isinstance(source, str) else (source, other)
        for left, right in zip(names, others, strict=True):
            mirrored = {
                left[:start] + opposite + left[start + len(mark) :]
                for mark, opposite in MARKS
                for start in range(len(left))
                if left.startswith(mark, start)
            }
            assert right in mirrored or right == left, (joint, left, right)


@pytest.mark.parametrize("name", list(UNITS)[1:])
def test_the_unit_in_which_the_legs_of_a_file_are_of_usual_length_is_proposed(name: str):
    assert UNITS["feet"] == pytest.approx(12 * UNITS["inches"])
    assert UNITS["the unit of CMU's recordings"] == pytest.approx(0.0254 / 0.45, rel=1e-6)
    joints = synthetic().joints[:3].astype(float)
    joints *= 0.83 / leg_length(joints) / UNITS[name]
    with pytest.raises(
        UserError, match=rf"The unit may be {UNITS[name]:.6g} \({re.escape(name)}\)"
    ):
        check_size(joints, 1.0)


@pytest.mark.parametrize(
    ("lower", "both", "fits"),
    [
        (20, 0, True),  # a person who kneels on one knee
        (20, 5, True),
        (20, 6, False),
        (11, 11, False),
        (9, 9, True),  # most of the time, the lower foot points forward
    ],
)
def test_feet_point_backward_if_the_lower_one_mostly_does_and_both_often_do(lower, both, fits):
    joints = np.tile(posed(1).joints.astype(float), (20, 1, 1))
    at = {joint: number for number, joint in enumerate(SMPL22.joints)}
    joints[:, [at["right_ankle"], at["right_foot"]], 1] += 0.2
    for side, frames in (("left", lower), ("right", both)):
        ankle, foot = at[f"{side}_ankle"], at[f"{side}_foot"]
        joints[:frames, foot, 2] = 2 * joints[:frames, ankle, 2] - joints[:frames, foot, 2]
    if fits:
        check_feet(joints)
        return
    with pytest.raises(UserError, match="the toes point backwards"):
        check_feet(joints)


@pytest.mark.parametrize(
    ("ratio", "change", "fault"),
    [
        (1.45, 0.0, ""),
        (1.55, 0.0, "left and right limbs differ"),
        (1.0, 0.24, ""),
        (1.0, 0.26, "the limbs change"),
    ],
)
def test_limbs_of_a_body_in_the_right_order_are_as_long_as_their_counterparts_and_keep_their_length(
    ratio: float, change: float, fault: str
):
    joints = np.zeros((10, 22, 3))
    steps = 1 + change * np.resize([1, -1], 10)
    for parent, joint in SMPL22.edges:
        name = SMPL22.joints[joint]
        is_limb = name.endswith(("knee", "ankle", "elbow", "wrist"))
        size = (ratio if name.startswith("left") else 1) * steps if is_limb else np.ones(10)
        joints[:, joint] = joints[:, parent] + size[:, None] * ADULT[joint]
    if not fault:
        check_order(joints, 22, "SMPL")
        return
    with pytest.raises(
        UserError, match=rf"22 joints like SMPL, but not in the same order: {fault}"
    ):
        check_order(joints, 22, "SMPL")
