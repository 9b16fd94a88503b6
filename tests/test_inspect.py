"""Faults of motions, the command that shows them, and perturbations of real motions against closed forms."""

import math
import re
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.motions import Page, posed, synthetic

from evaluators import perturbations as p
from evaluators.encoding import encode
from flame_mdm.__main__ import main
from flame_mdm.commands import FileSettings, read_motions
from flame_mdm.commands.inspect import InspectSettings, _clips
from flame_mdm.errors import UserError
from flame_mdm.formats import faults as faults_module
from flame_mdm.formats.faults import LIMITS, Fault, _away, _stretched, depths, find_faults
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22

FPS, FRAMES = 20, 80
AT = {name: number for number, name in enumerate(SMPL22.joints)}
Change = Callable[[np.ndarray], None]


def body() -> np.ndarray:
    """Joints (80, 22, 3) of a body that stands on the floor, arms down, and swings its arms."""
    swing = np.degrees(0.5 * np.sin(2 * np.pi * np.arange(FRAMES) / FPS))
    arms = {
        side: np.stack([0 * swing, swing, 0 * swing + down], 1)
        for side, down in (("left", -90), ("right", 90))
    }
    joints = posed(FRAMES, left_shoulder=arms["left"], right_shoulder=arms["right"]).joints.astype(
        float
    )
    return joints - [0, joints[..., 1].min(), 0]


def kinds(joints: np.ndarray) -> set[tuple[str, str, int, int]]:
    return {fault[:4] for fault in find_faults(Motion(joints, FPS))}


def slide(joints: np.ndarray, frames: int) -> None:
    joints[20:, :, 0] += 0.05 * np.arange(FRAMES - 20).clip(max=frames - 1)[:, None]  # 1 m/s


def sink(joints: np.ndarray) -> None:
    joints[30:40, :, 1] -= 0.06


def float_(joints: np.ndarray, frames: int, speed: float) -> None:
    joints[:, :, 0] += speed / FPS * np.arange(FRAMES)[:, None]
    joints[30 : 30 + frames, :, 1] += 0.06


def place(
    joint: str, at: str, away: Sequence[float] = (0, 0, 0), frames: slice = slice(30, 40)
) -> Change:
    """A change that puts a joint where another one is, or away from there."""

    def change(joints: np.ndarray) -> None:
        joints[frames, AT[joint]] = joints[frames, AT[at]] + away

    return change


def test_faults_are_found_where_they_are(subtests):
    feet = ("left_foot", "right_foot")
    cases: list[tuple[Change, set[tuple[str, str, int, int]]]] = [
        (lambda joints: slide(joints, 9), {("skating", foot, 20, 28) for foot in feet}),
        (lambda joints: slide(joints, 8), set()),  # no longer than a step takes
        (place("head", "head", (0, 0.4, 0), slice(30, 31)), {("pop", "head", 30, 31)}),
        (place("head", "head", (0, 0, 0.05)), {("bone length", "head", 30, 40)}),
        (sink, {("penetration", foot, 30, 40) for foot in feet}),
        (lambda joints: float_(joints, 7, 0.0), {("floating", "body", 30, 36)}),
        (lambda joints: float_(joints, 6, 0.0), set()),
        (lambda joints: float_(joints, 16, 1.0), {("floating", "body", 30, 46)}),
        (
            lambda joints: float_(joints, 15, 1.0),
            {("skating", k, *span) for k in feet for span in ((0, 29), (45, 79))},
        ),
        # The point is in front of the knee.
        (
            place("left_hip", "left_hip", (0, 0, 0.3)),
            {("limit", "left_knee", 30, 40)},
        ),
        (place("left_wrist", "left_shoulder"), {("limit", "left_elbow", 30, 40)}),
        (place("left_wrist", "spine1", (0.02, 0, 0.02)), {("inside", "left_wrist", 30, 40)}),
        (lambda joints: np.copyto(joints[30:60], joints[30]), {("frozen", "body", 30, 60)}),
    ]
    joints = body()
    assert not kinds(joints)
    joints[:, AT["left_knee"], 2] += 0.3  # knees may bend backward
    assert not {fault for fault in kinds(joints) if fault[0] == "limit"}
    for change, expected in cases:
        with subtests.test(expected=expected):
            joints = body()
            change(joints)
            faults = kinds(joints)
            names = {kind for kind, *_ in expected}
            assert names <= LIMITS.keys()
            assert {fault for fault in faults if fault[0] in names or not expected} == expected


def test_a_fault_has_its_worst_value(subtests):
    knee, hip, ankle = AT["left_knee"], AT["left_hip"], AT["left_ankle"]

    def folded(joints: np.ndarray) -> None:
        """The shin lies at 4, then 12 degrees to the thigh, behind it."""
        for frame, degrees in zip(range(30, 40), [4] * 3 + [12] * 7, strict=True):
            turn = np.radians(degrees)
            thigh = joints[frame, hip] - joints[frame, knee]
            turned = [[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]]
            joints[frame, ankle] = joints[frame, knee] + np.array(turned).T @ thigh

    def sunk(joints: np.ndarray) -> None:
        joints[30:40, AT["left_foot"], 1] -= np.linspace(0.1, 0.06, 10)

    def longer(joints: np.ndarray) -> None:
        bone = joints[:, AT["head"]] - joints[:, AT["neck"]]
        joints[30:33, AT["head"]] += np.array([[0.3], [0.5], [0.2]]) * bone[30:33]

    def away(joints: np.ndarray) -> None:
        joints[30:33, AT["left_wrist"], 2] += [0.0, 1.0, 0.0]

    for change, kind, joint, worst in (
        (folded, "limit", "left_knee", 4),
        (place("left_hip", "left_hip", (0, 0, 0.3)), "limit", "left_knee", None),
        (sunk, "penetration", "left_foot", 0.1),
        (longer, "bone length", "head", 0.5),
        (away, "pop", "left_wrist", 2 * FPS**2),
        (lambda joints: float_(joints, 16, 1.0), "floating", "body", 0.06),
        (lambda joints: slide(joints, 9), "skating", "left_foot", 0.05 * FPS),
    ):
        with subtests.test(kind=kind, joint=joint):
            joints = body()
            floor = -joints[30, AT["left_foot"], 1]
            change(joints)
            faults = find_faults(Motion(joints, FPS))
            (fault,) = (fault for fault in faults if (fault.kind, fault.joint) == (kind, joint))
            if worst is None:
                assert 15 < fault.worst < 90  # bent forward: more than the limit
            else:
                added = {"penetration": floor, "floating": -floor}.get(kind, 0)
                assert fault.worst == pytest.approx(worst + added, rel=0.12, abs=1e-3)


@pytest.mark.parametrize(
    ("speed", "frames", "is_fault"),
    [(0.15, 7, True), (0.25, 7, False), (0.25, 16, True), (0.15, 6, False)],
)
def test_a_body_in_the_air_floats_sooner_if_it_is_slower_than_0_2_meters_per_second(
    speed: float, frames: int, is_fault: bool
):
    joints = body()
    float_(joints, frames, speed)
    # the frame after which the body falls is not slow
    end = 30 + frames - (speed < 0.2)
    floating = {fault for fault in kinds(joints) if fault[0] == "floating"}
    assert floating == ({("floating", "body", 30, end)} if is_fault else set())


@pytest.mark.parametrize(("frames", "is_fault"), [(21, True), (20, False)])
def test_a_body_is_frozen_if_it_does_not_move_for_a_second(frames: int, is_fault: bool):
    joints = body()
    joints[:, :, 0] += 0.05 * np.arange(FRAMES)[:, None]
    joints[30 : 30 + frames] = joints[30]  # one step fewer than frames
    frozen = {fault for fault in kinds(joints) if fault[0] == "frozen"}
    assert frozen == ({("frozen", "body", 30, 29 + frames)} if is_fault else set())


@pytest.mark.parametrize(
    ("usual", "change", "is_fault"),
    [
        (1.0, 0.11, True),
        (1.0, 0.09, False),  # less than 10 %
        (1.0, -0.11, True),
        (0.05, 0.008, False),  # less than 1 cm
        (0.05, 0.012, True),
    ],
)
def test_bones_may_differ_by_10_percent_or_by_a_centimeter(
    usual: float, change: float, is_fault: bool
):
    joints = np.zeros((9, 2, 3))
    joints[:, 1, 1] = usual
    joints[4, 1, 1] += change
    values, flags = _stretched(joints, [(0, 1)])
    assert flags.any(0).tolist() == [False, is_fault]
    assert values[4, 1] == pytest.approx(abs(change) / usual)
    assert not values[[0, 8]].any()


@pytest.mark.parametrize(("degrees", "is_fault"), [(20, False), (40, True), (90, True)])
def test_a_foot_in_line_with_the_shin_does_not_show_the_front_of_the_knee(
    degrees: float, is_fault: bool
):
    joints = body()
    place("left_hip", "left_hip", (0, 0, 0.3))(joints)  # the knee bends forward
    ankle, angle = AT["left_ankle"], np.radians(degrees)
    shin = joints[:, ankle] - joints[:, AT["left_knee"]]
    shin /= np.linalg.norm(shin, axis=1, keepdims=True)
    front = np.cross(shin, [1, 0, 0]) * -1
    front *= np.sign(front[:, 2:])
    toes = np.cos(angle) * shin + np.sin(angle) * front
    joints[:, AT["left_foot"]] = joints[:, ankle] + 0.12 * toes
    joints[..., 1] -= joints[..., 1].min()
    limits = {fault for fault in kinds(joints) if fault[:2] == ("limit", "left_knee")}
    assert limits == ({("limit", "left_knee", 30, 40)} if is_fault else set())


@pytest.mark.parametrize(
    ("points", "start", "end", "expected"),
    [
        ([0.0, 1, 0.5], [0.0, 0, 0], [0.0, 0, 1], [0.0, 1, 0]),  # beside the segment
        ([0.0, 1, -2], [0.0, 0, 0], [0.0, 0, 1], [0.0, 1, -2]),  # before its start
        ([3.0, 0, 5], [0.0, 0, 0], [0.0, 0, 1], [3.0, 0, 4]),  # after its end
        ([3.0, 0, 4], [0.0, 0, 0], [0.0, 0, 0], [3.0, 0, 4]),  # a segment without a length
    ],
)
def test_distances_to_a_bone_are_those_to_its_nearest_point(points, start, end, expected):
    away = _away(np.array([[points]]), np.array([start]), np.array([end]))
    np.testing.assert_allclose(away[0, 0], expected)


def test_a_hand_is_as_deep_in_the_body_as_it_is_inside_the_capsules():
    joints = body()[:1]
    names = SMPL22.joints
    at = {name: joints[0, number] for name, number in AT.items()}
    middle = (at["neck"] + at["pelvis"]) / 2
    trunk = 0.18 * np.linalg.norm(at["neck"] - at["pelvis"])
    thigh = 0.17 * np.linalg.norm(at["left_knee"] - at["left_hip"])
    along = (at["neck"] - at["pelvis"]) / np.linalg.norm(at["neck"] - at["pelvis"])
    side = np.array([1.0, 0, 0])  # the shoulders are level and the body faces +z
    front = np.cross(along, side) * -1
    for wrist, depth, outward in (
        (middle + 0.01 * front, trunk - 0.01, front),
        (middle + 0.014 * side, trunk - 0.01, side),  # the trunk is 1.4 times as wide as deep
        (middle + 0.4 * front, trunk - 0.4, front),
        ((at["left_hip"] + at["left_knee"]) / 2 + [0, 0, 0.02], None, None),
    ):
        moved = joints.copy()
        moved[0, AT["left_wrist"]] = wrist
        deep, away = depths(moved, names, "left")
        if depth is None or outward is None:
            assert thigh - 0.025 < deep[0, 1] <= thigh
            continue
        assert deep[0, 1] == pytest.approx(depth, abs=1e-4)
        np.testing.assert_allclose(away[0, 1], outward, atol=0.02)
    # the middle of the hand lies beyond the wrist, in the direction of the forearm
    moved = joints.copy()
    moved[0, AT["left_elbow"]], moved[0, AT["left_wrist"]] = (
        middle + 1.3 * front,
        middle + 0.3 * front,
    )
    deep, _ = depths(moved, names, "left")
    assert deep[0] == pytest.approx([trunk - 1.3, trunk - 0.3, trunk], abs=1e-4)


def test_the_command_prints_faults_marks_them_and_exits_with_3(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    joints = body()
    Motion(joints, FPS).save("motions/good.npz")
    sink(joints)
    Motion(joints, FPS).save("motions/walks-after=good.npz/bad.npz")  # samples are in such folders
    assert main(["inspect", "motions/good.npz"]) == 0
    assert "good: 0 of 1 motions have faults" in capsys.readouterr().out
    assert main(["inspect", "motions", "both.html"]) == 3
    printed = capsys.readouterr().out
    assert "penetration: left_foot, frames 30 to 39, 0.06 m (limit 0.05)" in printed
    assert "motions: 1 of 2 motions have faults" in printed
    shown = Page(tmp_path / "both.html").motions
    assert [motion["id"] for motion in shown] == ["walks-after=good.npz/bad", "good"], (
        "the worst first"
    )
    assert [30, 40, "penetration"] in [mark[:3] for mark in shown[0]["marks"]]
    assert not shown[1]["marks"]


def test_nothing_to_inspect_is_an_error(tmp_path, capsys, subtests):
    for words, message in (
        ([str(tmp_path)], "no motion files (.npz, "),
        ([str(tmp_path / "absent.npz")], "absent.npz: no such file"),
        (["bandia"], "bandia"),
        ([str(tmp_path), "clips=0"], "clips=0: must be at least 1"),
    ):
        with subtests.test(words=words, message=message):
            assert main(["inspect", *words]) in (1, 2)
            assert message in capsys.readouterr().err


def test_the_worst_clips_of_a_data_set_are_shown(tmp_path, capsys):
    data = ["data.source.clips=40", f"data_root={tmp_path}"]
    assert main(["prepare", "synthetic", *data]) == 0
    capsys.readouterr()
    assert main(["inspect", "synthetic", str(tmp_path / "page.html"), "clips=3", *data]) == 0
    printed = capsys.readouterr().out
    assert "0 of 40 motions have faults" in printed
    assert "the 3 worst motions" in printed
    assert len(Page(tmp_path / "page.html").motions) == 3


def test_motions_are_worst_by_their_kinds_of_faults_and_then_by_their_share_of_faulty_frames(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    first, second = list(LIMITS)[:2]
    spans = {
        "few": (40, [(first, 0, 4)]),
        "short": (20, [(first, 0, 3)]),
        "twice": (40, [(first, 0, 5), (first, 0, 5)]),  # 5 of 40 frames
        "kinds": (40, [(first, 0, 1), (second, 0, 1)]),
        "none": (40, []),
    }
    for name, (frames, _) in spans.items():
        Motion(body()[:frames], FPS, text=name).save(f"motions/{name}.npz")

    def faults_of(motion: Motion) -> list[Fault]:
        return [Fault(kind, "head", start, end, 1.0) for kind, start, end in spans[motion.text][1]]

    monkeypatch.setattr(faults_module, "find_faults", faults_of)
    assert main(["inspect", "motions", "page.html", "clips=3"]) == 3
    shown = Page(tmp_path / "page.html").motions
    assert [motion["caption"] for motion in shown] == ["kinds", "short", "twice"]
    printed = capsys.readouterr().out
    assert "motions: 4 of 5 motions have faults" in printed
    assert re.search(rf"{first} +4 \(80\.0%\)", printed)
    assert re.search(rf"{second} +1 \(20\.0%\)", printed)


@pytest.fixture
def walk() -> np.ndarray:
    return synthetic("walk", size=40, seed=1).joints.astype(float)


def test_jitter_has_the_given_deviation_and_wobble_is_a_slow_sine(walk):
    weak, strong = (p.jitter(walk, sigma, np.random.default_rng(0)) - walk for sigma in (5, 20))
    assert weak.std() == pytest.approx(0.005, rel=0.03)
    np.testing.assert_allclose(4 * weak, strong, atol=1e-12)
    offset = p.wobble(walk, 20, np.random.default_rng(0), fps=20.0) - walk
    np.testing.assert_allclose(offset[20:], offset[:-20], atol=1e-12)  # a period of one second
    assert np.linalg.norm(offset, axis=-1).max() <= 0.02 + 1e-12
    assert np.linalg.norm(offset[:20], axis=-1).max(0).min() > 0.0195


def test_skating_resizing_wrists_drawn_in_and_pops(walk, subtests):
    changed = p.skate(walk, 1.5)
    np.testing.assert_allclose(changed - changed[:, :1], walk - walk[:, :1], atol=1e-12)
    steps = np.diff(changed[:, 0], axis=0)
    np.testing.assert_allclose(
        steps[:, [0, 2]], 1.5 * np.diff(walk[:, 0], axis=0)[:, [0, 2]], atol=1e-12
    )
    np.testing.assert_array_equal(changed[..., 1], walk[..., 1])
    changed, skeleton = p.resize(walk, 10), HumanML().skeleton
    ours, theirs = (
        skeleton.bones(torch.from_numpy(x))[:, 1:].norm(dim=-1) for x in (changed, walk)
    )
    torch.testing.assert_close(ours, 1.1 * theirs)
    np.testing.assert_allclose(changed[:, 0, [0, 2]], walk[:, 0, [0, 2]])
    np.testing.assert_allclose(changed[..., 1], 1.1 * walk[..., 1])

    # wrists are drawn into the trunk, and a pop displaces one frame
    changed = p.draw_in(walk, 10) - walk
    sizes = np.linalg.norm(changed[:, [18, 19, 20, 21]], axis=-1)
    np.testing.assert_allclose(sizes, [[0.05, 0.05, 0.1, 0.1]] * len(walk))
    assert not np.delete(changed, [18, 19, 20, 21], 1).any()
    # A wrist does not move past the axis of the trunk
    far = p.draw_in(walk, 300)
    axis = walk[:, 0] + 0.4 * (walk[:, AT["neck"]] - walk[:, 0])
    for side in ("left", "right"):
        np.testing.assert_allclose(far[:, AT[f"{side}_wrist"]], axis)
        half = (axis - walk[:, AT[f"{side}_wrist"]]) / 2
        np.testing.assert_allclose(far[:, AT[f"{side}_elbow"]], walk[:, AT[f"{side}_elbow"]] + half)
    kinds = [
        {fault.kind for fault in find_faults(Motion(p.draw_in(walk, grade), 20.0))}
        for grade in (0, 40)
    ]
    assert ["inside" in kind for kind in kinds] == [False, True]
    for last in (False, True):
        with subtests.test(last=last):
            offset = p.pop(walk, 5, np.random.default_rng(0), last=last) - walk
            (frame,) = np.unique(np.nonzero(offset)[0])
            assert frame == len(walk) - 1 if last else 0 < frame < len(walk) - 1
            np.testing.assert_allclose(np.linalg.norm(offset[frame], axis=-1), 0.05)
            assert np.ptp(offset[frame], axis=0).max() < 1e-12


def test_freezing_cropping_speeds_frame_rates_and_another_half(walk, subtests):
    for percent, moving in ((10, 18), (50, 10), (100, 1)):
        with subtests.test(percent=percent):
            frozen = p.freeze(walk[:20], percent)
            np.testing.assert_array_equal(frozen[:moving], walk[:moving])
            np.testing.assert_array_equal(
                frozen[moving:], np.repeat(walk[moving - 1 : moving], 20 - moving, 0)
            )
    np.testing.assert_array_equal(p.crop(walk[:40], 25), walk[:30])
    assert len(p.crop(walk[:4], 90)) == 3

    ramp = np.arange(22.0)[:, None, None] * np.ones((1, 2, 3))
    np.testing.assert_allclose(p.play(ramp[:21], 2, 20.0)[:, 0, 0], np.arange(0, 21, 2))
    np.testing.assert_allclose(p.play(ramp[:21], 0.5, 20.0)[:, 0, 0], np.arange(21) / 2)
    for rate in (30, 15, 10):
        with subtests.test(rate=rate):
            back = p.through_rate(ramp, rate, 20.0)
            assert len(back) == len(ramp)
            np.testing.assert_allclose(back[:20], ramp[:20], atol=1e-9)

    other = walk[::-1] + 1.0
    joined = p.continue_with(walk[:40], other, 20.0)
    np.testing.assert_array_equal(joined[:20], walk[:20])
    assert np.linalg.norm(joined[20] - joined[19], axis=-1).max() < 0.3
    rest = other[len(other) // 2 :][8:20]  # after 0.4 seconds
    np.testing.assert_allclose(np.diff(joined[28:40], axis=0), np.diff(rest, axis=0), atol=1e-12)


def test_encoding_keeps_frames_heights_and_features(subtests):
    representation = HumanML()
    motion = torch.from_numpy(synthetic("jump").joints).double()
    features = representation.encode(motion)
    joints = representation.decode(features).double().numpy()
    (again,) = encode(representation, [joints])
    assert again.shape == features.shape
    # The smoothed heading depends on the last frame, which is continued.
    np.testing.assert_allclose(again[:-1], features[:-1].numpy(), atol=1e-2)
    for meters in (-0.05, 0.05):  # lifted motions keep their height
        with subtests.test(meters=meters):
            (encoded,) = encode(representation, [p.lift(joints, 100 * meters)])
            offset = representation.decode(torch.from_numpy(encoded)).numpy() - joints
            np.testing.assert_allclose(
                offset, np.broadcast_to([0, meters, 0], joints.shape), atol=1e-4
            )


def test_encoding_keeps_heights_in_the_units_of_the_features():
    """KIT's features are in units of 1 / 640 m; the body floats 3 cm above the floor."""
    kit = HumanML(skeleton="kit21", fps=12.5, variant="legacy", units_per_metre=640)
    pose = np.random.default_rng(0).uniform(0, 1, (1, 21, 3))
    motion = pose + 0.01 * np.arange(8.0)[:, None, None] * [1.0, 0.0, 0.0]
    motion[..., 1] += 0.03 - motion[..., 1].min()
    (features,) = encode(kit, [motion])
    assert features.shape == (8, 251)
    heights = kit.decode(torch.from_numpy(features)).numpy()[..., 1]
    np.testing.assert_allclose(heights, motion[..., 1], atol=1e-4)


def test_the_selected_animation_is_read_from_each_file_of_a_folder(tmp_path, monkeypatch):
    motion = synthetic("kick")
    for name in ("a", "b"):
        motion.save(tmp_path / f"{name}.glb", rig="mixamo")
    selected: list[str | None] = []

    def read(path: Path, *keys: object, animation: str | None = None) -> Motion:
        selected.append(animation)
        return motion

    monkeypatch.setattr("flame_mdm.formats.readers.read", read)
    settings = FileSettings(animation="Wave")
    for source, count in ((tmp_path, 2), (tmp_path / "a.glb", 1)):
        _, total, motions = read_motions(str(source), settings, [])
        assert (total, len(list(motions))) == (count, count)
    assert selected == ["Wave"] * 3


@pytest.mark.parametrize("fps", [20, 30, 60])
def test_faults_last_for_seconds_and_have_speeds_per_second_at_any_rate(fps: int):
    def kinds_of(change: Change) -> set[str]:
        joints = np.repeat(posed(1).joints.astype(float), 4 * fps, 0)
        joints -= [0, joints[..., 1].min(), 0]
        change(joints)
        return {fault.kind for fault in find_faults(Motion(joints, fps))}

    def moving(speed: float, steps: int, begin: int = 20) -> Change:
        """A body that moves for some steps and stands before and after them."""

        def change(joints: np.ndarray) -> None:
            count = np.clip(np.arange(len(joints)) - begin, 0, steps)
            joints[..., 0] += speed / fps * count[:, None]

        return change

    def aloft(speed: float, frames: int) -> Change:
        def change(joints: np.ndarray) -> None:
            moving(speed, len(joints), 0)(joints)
            joints[20 : 20 + frames, :, 1] += 0.06

        return change

    def popping(acceleration: float) -> Change:
        def change(joints: np.ndarray) -> None:
            joints[30, AT["head"], 2] += acceleration / 2 / fps**2

        return change

    for kind, faulty, sound in (
        ("skating", moving(0.55, math.ceil(0.4 * fps)), moving(0.55, math.ceil(0.4 * fps) - 1)),
        ("skating", moving(0.55, fps), moving(0.45, fps)),
        ("pop", popping(210), popping(190)),
        ("floating", aloft(0.5, math.ceil(0.8 * fps)), aloft(0.5, math.ceil(0.8 * fps) - 1)),
        ("floating", aloft(0.19, math.ceil(0.3 * fps) + 1), aloft(0.21, math.ceil(0.5 * fps))),
        ("frozen", moving(0.019, 9 * fps, 0), moving(0.021, 9 * fps, 0)),
        ("frozen", moving(0.5, 9 * fps, fps), moving(0.5, 9 * fps, fps - 1)),
    ):
        assert kind in kinds_of(faulty), kind
        assert kind not in kinds_of(sound), kind


def faults_named(*kinds: str) -> list[Fault]:
    return [Fault(kind, "head", number, number + 2, 1.0) for number, kind in enumerate(kinds)]


@pytest.mark.parametrize(("clips", "lists"), [(3, True), (2, True), (1, False)])
def test_faults_are_listed_if_the_player_shows_all_motions(
    clips: int, lists: bool, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        Motion(body(), FPS, text=name).save(f"motions/{name}.npz")
    (tmp_path / "motions" / "damaged.npz").write_bytes(b"damaged")
    many = faults_named(*[next(iter(LIMITS))] * 25)
    monkeypatch.setattr(
        faults_module, "find_faults", lambda motion: many if motion.text == "b" else []
    )
    # An unreadable file is the error that decides about the exit code
    assert main(["inspect", "motions", "page.html", f"clips={clips}"]) == 1
    shown = capsys.readouterr()
    assert "motions: 1 of 2 motions have faults" in shown.out
    assert "error: 1 of 3 motions could not be read" in shown.err
    assert ("b: 25 faults" in shown.out) == lists
    listed = [line for line in shown.out.splitlines() if line == f"  {many[0]}"]
    assert len(listed) == lists
    assert (f"  {many[19]}" in shown.out.splitlines()) == lists
    assert f"  {many[20]}" not in shown.out.splitlines()
    page = Page(tmp_path / "page.html")
    assert [motion["caption"] for motion in page.motions] == ["b", "a"][:clips]
    assert len(page.motions[0]["marks"]) == 25
    last = "player: page.html" if lists else "page.html: the 1 worst motions (open in any browser)"
    assert shown.out.splitlines()[-1] == last


def test_clips_of_the_chosen_split_are_inspected(tmp_path):
    assert main(["prepare", "synthetic", "data.source.clips=24", f"data_root={tmp_path}"]) == 0

    def ids(split: str | None) -> list[str]:
        words = ("data.source.clips=24",)
        settings = InspectSettings(
            motion="synthetic", data_root=str(tmp_path), split=split, composed=words
        )
        name, count, motions = _clips(settings)
        assert name.startswith("synthetic-")
        shown = [motion.id for motion in motions]
        assert len(shown) == count
        return shown

    of_splits = [ids(split) for split in ("train", "val", "test")]
    assert all(of_splits)
    assert sorted(ids(None)) == sorted(chain(*of_splits))
    with pytest.raises(UserError, match=r"^unknown split dev\. Available: train, val, test"):
        ids("dev")


def test_files_of_a_folder_are_read_with_the_keys_and_unreadable_ones_are_listed(
    tmp_path, monkeypatch
):
    for name in ("a.npz", "deep/a.npz", "deep/damaged.npz"):
        Motion(body(), FPS).save(tmp_path / name)
    keys: list[tuple[Any, ...]] = []

    def read(path: Path, *values: Any, animation: str | None = None) -> Motion:
        keys.append((*values, animation))
        if path.stem == "damaged":
            raise UserError("the first line\nmore")
        return Motion(body(), FPS)

    monkeypatch.setattr("flame_mdm.formats.readers.read", read)
    failures: list[str] = []
    settings = FileSettings(fps=12.5, unit=0.01, up="z", animation="Wave")
    name, total, motions = read_motions(str(tmp_path), settings, failures)
    assert (name, total) == (tmp_path.name, 3)
    assert [motion.id for motion in motions] == ["a", "deep/a"]
    assert failures == ["the first line"]
    assert set(keys) == {(12.5, 0.01, "z", "Wave")}
