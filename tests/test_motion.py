"""`Motion`, and every kind of motion file through every command that takes one."""

import sys
from dataclasses import replace
from fractions import Fraction
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.motions import posed, synthetic
from support.refusals import error_of
from support.runs import TINY, untrained

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.data.folder import Folder
from flame_mdm.errors import UserError
from flame_mdm.formats import bvh
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import read
from flame_mdm.formats.resampling import check_tree, frame_pairs, frame_rate
from flame_mdm.generator import MotionGenerator
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.motion272 import Motion272
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.smpl import SMPL
from flame_mdm.sampling.editing import edit
from flame_mdm.sampling.reading import read_motion, with_features


@pytest.fixture(scope="module")
def walk() -> Motion:
    return synthetic("walk", 30.0, size=20)


@pytest.fixture(scope="module")
def folder(walk: Motion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same motion in files of every kind."""
    folder = tmp_path_factory.mktemp("motions")
    walk.save(folder / "sample.npz", seed=3)
    for name in ("walk.bvh", "walk.json", "walk.npy"):
        walk.save(folder / name)
    np.savez(folder / "joints.npz", joints=walk.joints.astype(float), fps=30)
    Motion(walk.joints, 30.0, poses=walk.posed()).save(folder / "amass.npz")
    with np.load(folder / "amass.npz") as both:
        amass = {key: both[key] for key in ("poses", "trans", "betas", "gender", "mocap_framerate")}
    np.savez(folder / "amass.npz", **amass)
    return folder


@pytest.fixture(scope="module")
def model() -> MotionGenerator:
    return untrained(TINY, max_frames=196)


@pytest.mark.parametrize(
    "kind", ["sample.npz", "amass.npz", "joints.npz", "walk.bvh", "walk.json", "walk.npy"]
)
def test_every_kind_is_converted_edited_and_own_data(
    folder: Path, walk: Motion, model, tmp_path: Path, kind: str
):
    tolerance = 0.25 if kind == "amass.npz" else 0.02  # AMASS files have the bones of SMPL's body
    rate = 30 if kind.endswith(".npy") else None
    motion = read(folder / kind, rate)
    for ending in (".BVH", ".glb", ".json", ".npy"):
        motion.save(tmp_path / f"new/out{ending}")
    assert (
        main(
            [
                "convert",
                str(folder / kind),
                f"out={tmp_path / 'out.npz'}",
                *[f"fps={rate}"] * bool(rate),
            ]
        )
        == 0
    )
    again = read(tmp_path / "out.npz")
    assert again.fps == 30
    assert again.poses is not None
    assert np.abs(again.joints - walk.joints).max() < tolerance

    original = read_motion(HumanML(), folder / kind, fps=rate)
    expected = read_motion(HumanML(), folder / "joints.npz")
    assert original.fps == 20
    assert original.features.shape == expected.features.shape
    assert np.abs(original.joints - expected.joints).max() < tolerance
    assert edit(model, original, region="prediction", num_inference_steps=2)[0].feature_error == 0

    (own := tmp_path / "own").mkdir()
    (own / kind).symlink_to(folder / kind)
    (own / "captions.csv").write_text(f"id,text\n{kind.partition('.')[0]},a person walks\n")
    if rate:
        (own / "skeleton.yaml").write_text("fps: 30\n")
    (clip,) = Folder(str(own)).clips(30.0)
    assert clip.motion.shape == walk.joints.shape
    assert np.abs(clip.motion - walk.joints).max() < tolerance


def test_a_motion_is_shown(walk: Motion, monkeypatch):
    assert repr(walk) == f"Motion('a person walks', {len(walk.joints)} frames, 30 fps, smpl22)"
    long = Motion(walk.joints, 30.0, text="a person walks " * 20)
    assert f"{'a person walks ' * 3}a person walks…" in repr(long)
    assert flame_mdm.Motion is Motion
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    page = walk.show()
    assert "a person walks" in page.read_text()
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(HTML=str))
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: None))
    assert "a person walks" in walk.show().read_text()  # imported by another package
    monkeypatch.setattr(sys.modules["IPython"], "get_ipython", lambda: SimpleNamespace(kernel=None))
    shown = walk.show()
    assert shown.startswith("<div><iframe sandbox=")
    assert "<script" not in shown


def test_arrays_are_edited_and_what_cannot_be_edited_is_refused_in_one_line(
    walk: Motion, model: MotionGenerator, subtests
):
    how: dict[str, Any] = {"region": "prediction", "num_inference_steps": 2}
    expected, joints = edit(model, walk, "a person jumps", **how)[0], walk.joints
    for array in (joints, torch.from_numpy(joints), joints.tolist()):
        with subtests.test(array=array):
            result = edit(model, array, "a person jumps", fps=30, **how)[0]
            np.testing.assert_array_equal(result.joints, expected.joints)
            assert result.feature_error == 0
    cases: list[tuple[Any, Any, str]] = [
        (joints, None, "an array has no frame rate. Pass one, for example fps=20"),
        (joints, "fast", "fps is fast, not a number of frames per second"),
        (
            joints[:, :13],
            30,
            r"joints have shape \(79, 13, 3\), not \(frames, joints, 3\) with 22 \(smpl22\)",
        ),
        (joints[0], 30, r"joints have shape \(22, 3\), not \(frames, joints, 3\)"),
        (joints[:0], 30, "have no frames"),
        (
            joints[:, :21],
            30,
            r"^motion: expected shape \(frames, 22, 3\) for humanml-clean-smpl22, but found "
            r"\(.*, 21, 3\)",
        ),
        (
            joints * 100,
            30,
            r"^the legs are 8\d\.\d m long .* The unit may be 0\.01 \(centimeters\)",
        ),
        (joints * np.nan, 30, "joints in frame 0 contain NaN"),
        (
            np.tile(joints, (9, 1, 1)),
            30,
            "^the motion: .* frames, but the model was trained on at most 196",
        ),
        (None, 30, r"^NoneType: not a motion\. Pass a path, a Motion, or an array of joints"),
        (walk, 20, r"fps=20: this motion has 30 frames per second\. Omit fps"),
        (Motion(joints * 100, 30, id="take"), None, "^take: the legs are"),
    ]
    for motion, fps, message in cases:
        with subtests.test(message=message):
            with pytest.raises(UserError, match=message) as caught:
                edit(model, motion, fps=fps, region="prediction")
            assert "\n" not in str(caught.value)


def test_parts_keep_their_seconds_at_another_rate(walk: Motion):
    parts = (("a person walks", 0, 30), ("a person stops", 30, 75))
    resampled = replace(walk, parts=parts).resampled(20.0)
    assert resampled.parts == (("a person walks", 0, 20), ("a person stops", 20, 50))


@pytest.mark.parametrize("name", ["a.bvh", "folder/../a.bvh", "link.bvh", "second.bvh"])
def test_a_file_is_not_converted_into_itself_under_any_name(
    name: str, tmp_path: Path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    synthetic("walk").save("a.bvh")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link.bvh").symlink_to("a.bvh")
    (tmp_path / "second.bvh").hardlink_to("a.bvh")
    before = Path("a.bvh").read_bytes()
    assert "this would overwrite the input" in error_of(capsys, "convert", "a.bvh", name)
    assert Path("a.bvh").read_bytes() == before


@pytest.mark.parametrize("ending", ["bvh", "glb"])
def test_a_joint_far_from_constant_bone_lengths_is_named_with_its_frame(ending, tmp_path: Path):
    motion = synthetic("walk")
    line = motion.save(tmp_path / f"walk.{ending}")
    assert "max 0" in line
    assert "in frame" not in line

    motion.joints[7, 21, 1] += 0.05
    line = motion.save(tmp_path / f"walk.{ending}")
    assert "right_wrist in frame 7, where a bone changes its length" in line


def test_joints_at_another_rate_follow_accelerated_paths_and_rotations_turn_evenly():
    times = np.arange(13)[:, None, None] / 30
    joints = synthetic("walk").joints[0] + times**2 * [1.0, 2, 3]
    resampled = Motion(joints, 30.0).resampled(50.0)
    later = np.arange(21)[:, None, None] / 50
    assert resampled.fps == 50
    np.testing.assert_allclose(
        resampled.joints, synthetic("walk").joints[0] + later**2 * [1.0, 2, 3], atol=1e-5
    )
    turning = posed(11, left_shoulder=np.linspace((0, 0, -60), (0, 0, 60), 11))
    faster = turning.resampled(60.0)
    expected = posed(31, left_shoulder=np.linspace((0, 0, -60), (0, 0, 60), 31))
    np.testing.assert_allclose(faster.joints, expected.joints, atol=1e-6)
    assert faster.poses is not None
    assert expected.poses is not None
    np.testing.assert_allclose(faster.poses.rotations, expected.poses.rotations, atol=1e-9)


def test_contacts_at_another_rate_are_those_of_the_nearest_frame(walk: Motion):
    contacts = np.arange(len(walk.joints))[:, None] % 8 >= [4, 2, 6, 1]
    motion = replace(walk, contacts=contacts)
    resampled = motion.resampled(20.0)
    nearest = np.floor(1.5 * np.arange(len(resampled.joints)) + 0.5).astype(int)
    np.testing.assert_array_equal(resampled.contacts, contacts[nearest])
    faster = motion.resampled(90.0)
    nearest = (np.arange(len(faster.joints)) + 1) // 3
    np.testing.assert_array_equal(faster.contacts, contacts[nearest])


def test_tips_of_head_hands_and_toes_are_in_bvh_files(tmp_path: Path):
    synthetic("walk").save(tmp_path / "a.bvh")
    tree = bvh.read(tmp_path / "a.bvh")
    tips = {
        name: tree.offsets[tree.joints.index(f"{name}.end")].tolist()
        for name in ("head", "left_foot", "right_foot", "left_wrist", "right_wrist")
    }
    assert tips == {
        "head": [0, 18, 0],
        "left_foot": [0, 0, 6],
        "right_foot": [0, 0, 6],
        "left_wrist": pytest.approx([8.5, -1, -1.5]),
        "right_wrist": pytest.approx([-8.5, -1, -1.5]),
    }


def test_new_frames_are_at_exact_times_up_to_the_last_frame():
    rates = (Fraction(25, 2), *map(Fraction, (20, 24, 25, 30, 50, 60, 100, 120)))
    for rate, fps, frames in product(rates, rates, (1, 2, 4, 25, 121)):
        before, after, share = frame_pairs(frames, float(rate), float(fps), 1)
        times = [k * rate / fps for k in range(int((frames - 1) * fps / rate) + 1)]
        assert len(before) == len(times)
        np.testing.assert_allclose(before + share, [float(time) for time in times], atol=1e-9)
        assert (after == np.minimum(before + 1, frames - 1)).all()
        assert ((share > -1e-9) & (share < 1 + 1e-9)).all()


def test_rates_from_one_frame_in_ten_seconds_to_a_thousand_per_second_are_read():
    assert [frame_rate(rate) for rate in (0.1, 1000, np.array([30]))] == [0.1, 1000.0, 30.0]
    for rate in (0.0999, 1000.1, True, [20, 20], "20"):
        with pytest.raises(UserError, match=r"from 0\.1 to 1000"):
            frame_rate(rate)


def test_angles_of_a_bvh_file_have_orders_far_from_gimbal_lock(tmp_path: Path):
    synthetic("walk").save(tmp_path / "a.bvh")
    tree = bvh.read(tmp_path / "a.bvh")
    for joint, channels in zip(tree.joints, tree.channels, strict=True):
        order = "".join(name[0] for name in channels if name.endswith("rotation"))
        if channels:
            assert order == ("YXZ" if joint.endswith("shoulder") else "YZX"), joint
    assert tree.channels[0][:3] == ("Xposition", "Yposition", "Zposition")


@pytest.mark.parametrize(
    ("frames", "joints", "size", "fits"),
    [
        (1000, 1000, 0, True),  # a million positions in files of any size
        (1001, 1000, 0, False),
        (2000, 1000, 8_000_000, True),  # four bytes for each position
        (2001, 1000, 8_000_000, False),
        (25_000, 1000, 10**12, True),  # 25 million positions in all
        (25_001, 1000, 10**12, False),
        (500_000, 1, 0, True),
        (500_001, 1, 0, False),
    ],
)
def test_a_file_may_have_as_many_frames_as_its_size_and_its_joints_allow(
    frames: int, joints: int, size: int, fits: bool
):
    if fits:
        check_tree(frames, joints, size)
        return
    with pytest.raises(UserError, match=rf"^{frames:,} frames"):
        check_tree(frames, joints, size)


def test_a_motion_may_have_a_million_positions_after_upsampling():
    assert len(frame_pairs(50_000, 10, 20, 10)[0]) == 99_999
    assert len(frame_pairs(50_000, 20, 10, 100)[0]) == 25_000  # fewer than before
    with pytest.raises(UserError, match="would become 100,001 frames at 20 frames per second"):
        frame_pairs(50_001, 10, 20, 10)


def test_texts_notes_and_the_name_of_a_motion_stay_at_another_rate(walk: Motion):
    motion = replace(walk, text="walks", id="take", notes=("a note",), cleanup=True)
    motion.features = np.zeros((len(walk.joints), 263), np.float32)
    resampled = motion.resampled(60.0)
    kept = ("text", "id", "notes", "cleanup", "skeleton")
    assert [getattr(resampled, key) for key in kept] == [getattr(motion, key) for key in kept]
    assert not resampled.features.size
    assert motion.resampled(motion.fps) is motion


def test_the_summary_of_a_file_states_errors_in_millimeters(tmp_path: Path):
    motion = posed(3)
    for offset, line in ((0.004, "mean joint error 4 mm, max 4 mm"), (0.02, "20 mm, max 20 mm: ")):
        moved = Motion(motion.joints + np.array([offset, 0, 0]), 20, poses=motion.poses)
        summary = moved.save(tmp_path / "a.bvh")
        assert line in summary
        assert ("in frame" in summary) == (offset == 0.02)


@pytest.mark.parametrize("kind", [None, SMPL, Rot6D, Motion272])
def test_rotations_of_a_file_of_this_project_have_its_joints(kind: Any, tmp_path: Path):
    path = np.linspace((0.2, 0.955, 0.1), (0.5, 0.955, 1.0), 9)
    motion = posed(9, root=path, heading=0.7, left_knee=(40, 0, 0), right_elbow=(0, 30, 0))
    if kind is not None:
        motion = with_features(kind(20.0), motion)
        motion.poses = None
    motion.save(tmp_path / "a.npz")
    again = read(tmp_path / "a.npz")
    assert again.poses is not None
    np.testing.assert_allclose(again.poses.joints(), motion.joints[:, :22], atol=1e-4)
