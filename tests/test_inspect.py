"""Faults of motions, and the command that shows them."""

import math
from collections.abc import Callable

import numpy as np
from support.motions import Page

from flame_mdm.__main__ import main
from flame_mdm.formats.faults import LIMITS, find_faults
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.skeleton import SMPL22

FPS, FRAMES = 20, 80
AT = {name: number for number, name in enumerate(SMPL22.joints)}


def body() -> np.ndarray:
    """Joints (80, 22, 3) of a body that stands on the floor, arms down, toes forward, and swings its arms."""
    offsets = 0.1 * np.array(SMPL22.raw_offsets, float)
    offsets[[4, 5, 7, 8], 1] = -0.4
    offsets[[13, 14], 0] = 0.22, -0.22
    offsets[[18, 19, 20, 21], 1] = -0.25
    pose = np.zeros((22, 3))
    for joint, parent in enumerate(SMPL22.parents):
        pose[joint] = pose[parent] + offsets[joint] if parent >= 0 else 0
    pose[:, 1] -= pose[:, 1].min()
    joints = np.repeat(pose[None], FRAMES, 0)
    swing = 0.5 * np.sin(2 * math.pi * np.arange(FRAMES) / FPS)
    for side in ("left", "right"):
        shoulder = joints[:, AT[f"{side}_shoulder"]]
        for name in ("elbow", "wrist"):
            arm = np.linalg.norm(joints[:, AT[f"{side}_{name}"]] - shoulder, axis=-1)
            way = np.stack([np.zeros(FRAMES), -np.cos(swing), np.sin(swing)], 1)
            joints[:, AT[f"{side}_{name}"]] = shoulder + arm[:, None] * way
    return joints


def kinds(joints: np.ndarray) -> set[tuple[str, str, int, int]]:
    return {fault[:4] for fault in find_faults(Motion(joints, FPS))}


def slide(joints: np.ndarray, frames: int) -> None:
    joints[20 : 20 + frames, :, 0] += np.linspace(0, 0.05 * (frames - 1), frames)[:, None]  # 1 m/s
    joints[20 + frames :, :, 0] += 0.05 * (frames - 1)


def pop(joints: np.ndarray) -> None:
    joints[30, AT["head"], 1] += 0.4


def stretch(joints: np.ndarray) -> None:
    joints[30:40, AT["head"]] += 0.5 * (joints[30:40, AT["head"]] - joints[30:40, AT["neck"]])


def sink(joints: np.ndarray) -> None:
    joints[30:40, :, 1] -= 0.06


def float_(joints: np.ndarray, frames: int, speed: float) -> None:
    joints[:, :, 0] += speed / FPS * np.arange(FRAMES)[:, None]
    joints[30 : 30 + frames, :, 1] += 0.06


def knee(joints: np.ndarray) -> None:
    joints[30:40, AT["left_hip"], 2] += 0.3  # the hip in front of the knee


def fold(joints: np.ndarray) -> None:
    joints[30:40, AT["left_wrist"]] = joints[30:40, AT["left_shoulder"]]


def hand(joints: np.ndarray) -> None:
    joints[30:40, AT["left_wrist"]] = joints[30:40, AT["spine1"]] + [0.02, 0, 0.02]


def freeze(joints: np.ndarray) -> None:
    joints[30:60] = joints[30]


def test_faults_are_found_where_they_are():
    feet, both = ("left_foot", "right_foot"), ("left", "right")
    cases: list[tuple[Callable[[np.ndarray], None], set[tuple[str, str, int, int]]]] = [
        (lambda joints: slide(joints, 9), {("skating", foot, 20, 28) for foot in feet}),
        (lambda joints: slide(joints, 8), set()),  # no longer than a step takes
        (pop, {("pop", "head", 30, 31)}),
        (stretch, {("bone length", "head", 30, 40)}),
        (sink, {("penetration", f"{side}_{part}", 30, 40) for side in both for part in ("ankle", "foot")}),
        (lambda joints: float_(joints, 7, 0.0), {("floating", "body", 30, 36)}),
        (lambda joints: float_(joints, 6, 0.0), set()),
        (lambda joints: float_(joints, 16, 1.0), {("floating", "body", 30, 46)}),
        (lambda joints: float_(joints, 15, 1.0), {("skating", k, *span) for k in feet for span in ((0, 29), (45, 79))}),
        (knee, {("limit", "left_knee", 30, 40)}),
        (fold, {("limit", "left_elbow", 30, 40)}),
        (hand, {("inside", "left_wrist", 30, 40)}),
        (freeze, {("frozen", "body", 30, 60)}),
    ]
    joints = body()
    assert not kinds(joints)
    joints[:, AT["left_knee"], 2] += 0.3  # knees may bend backward
    assert not {fault for fault in kinds(joints) if fault[0] == "limit"}
    for change, expected in cases:
        joints = body()
        change(joints)
        faults = kinds(joints)
        names = {kind for kind, *_ in expected}
        assert names <= LIMITS.keys()
        assert {fault for fault in faults if fault[0] in names or not expected} == expected


def test_the_command_prints_faults_marks_them_and_exits_with_3(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    joints = body()
    Motion(joints, FPS).save("motions/good.npz")
    sink(joints)
    Motion(joints, FPS).save("motions/walks-after=good.npz/bad.npz")  # samples are in such folders
    assert main(["inspect", "motions/good.npz"]) == 0
    assert "good: 0 of 1 motions with faults" in capsys.readouterr().out
    assert main(["inspect", "motions", "both.html"]) == 3
    printed = capsys.readouterr().out
    assert "penetration: left_foot, frames 30 to 39, 0.06 m (limit 0.05)" in printed
    assert "motions: 1 of 2 motions with faults" in printed
    shown = Page(tmp_path / "both.html").motions
    assert [motion["id"] for motion in shown] == ["walks-after=good.npz/bad", "good"], "the worst first"
    assert [30, 40, "penetration"] in [mark[:3] for mark in shown[0]["marks"]]
    assert not shown[1]["marks"]


def test_nothing_to_inspect_is_an_error(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    for words, message in (
        ([], "no data set named"),
        ([str(tmp_path / "empty")], "the folder has no motion files"),
        ([str(tmp_path / "absent.npz")], "absent.npz: no such file. Give a motion file (.npz"),
        (["bandia"], "bandia"),
        ([str(tmp_path / "absent.npz"), "clips=0"], "clips=0: must be at least 1"),
    ):
        assert main(["inspect", *words]) in (1, 2)
        assert message in "".join(capsys.readouterr()) or not words


def test_a_data_set_is_inspected(tmp_path, capsys):
    data = ["data.source.clips=40", f"data_root={tmp_path}"]
    assert main(["prepare", "synthetic", *data]) == 0
    capsys.readouterr()
    assert main(["inspect", "synthetic", str(tmp_path / "page.html"), "clips=3", *data]) == 0
    printed = capsys.readouterr().out
    assert "0 of 40 motions with faults" in printed
    assert "the 3 worst motions" in printed
    assert len(Page(tmp_path / "page.html").motions) == 3
