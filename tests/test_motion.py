"""`Motion`, and every kind of motion file through every command that takes one."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.motions import synthetic
from support.runs import TINY, untrained

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.data.folder import Folder
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import read
from flame_mdm.representations.humanml import HumanML
from flame_mdm.sampling.editing import edit
from flame_mdm.sampling.reading import read_motion
from flame_mdm.task import MotionGeneration

REPRESENTATION = HumanML()
KINDS = ["sample.npz", "amass.npz", "joints.npz", "walk.bvh", "walk.json", "walk.npy"]


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
    Motion(walk.joints, 30.0, text=walk.text, poses=walk.posed()).save(folder / "both.npz")
    with np.load(folder / "both.npz") as both:
        amass = {key: both[key] for key in ("poses", "trans", "betas", "gender", "mocap_framerate")}
    np.savez(folder / "amass.npz", **amass)
    (folder / "both.npz").unlink()
    return folder


@pytest.fixture(scope="module")
def model() -> MotionGeneration:
    return untrained(TINY, max_frames=196)


def tolerance(kind: str) -> float:
    """AMASS files have the bones of SMPL's body."""
    return 0.25 if kind == "amass.npz" else 0.02


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_converted_edited_and_own_data(
    folder: Path, walk: Motion, model: MotionGeneration, tmp_path: Path, kind: str
):
    rate = 30 if kind.endswith(".npy") else None
    motion = read(folder / kind, rate)
    for ending in (".bvh", ".glb", ".json", ".npy"):
        motion.save(tmp_path / f"out{ending}")
    assert main(["convert", str(folder / kind), f"out={tmp_path / 'out.npz'}", *[f"fps={rate}"] * bool(rate)]) == 0
    again = read(tmp_path / "out.npz")
    assert again.fps == 30
    assert again.poses is not None
    assert np.abs(again.joints - walk.joints).max() < tolerance(kind)

    original = read_motion(REPRESENTATION, folder / kind, fps=rate)
    expected = read_motion(REPRESENTATION, folder / "joints.npz")
    assert original.fps == 20
    assert original.features.shape == expected.features.shape
    assert np.abs(original.joints - expected.joints).max() < tolerance(kind)
    assert edit(model, original, region="prediction", num_inference_steps=2)[0].feature_error == 0

    (own := tmp_path / "own").mkdir()
    (own / kind).symlink_to(folder / kind)
    (own / "captions.csv").write_text(f"id,text\n{kind.partition('.')[0]},a person walks\n")
    if rate:
        (own / "skeleton.yaml").write_text("fps: 30\n")
    (clip,) = Folder(str(own)).clips(30.0)
    assert clip.motion.shape == walk.joints.shape
    assert np.abs(clip.motion - walk.joints).max() < tolerance(kind)


def test_a_saved_motion_comes_back(tmp_path: Path, walk: Motion):
    features = np.arange(6, dtype=np.float32).reshape(3, 2)
    made = Motion(walk.joints[:3], 20.0, text="é", features=features, representation="mine")
    made.save(tmp_path / "a.npz", seed=3)
    again = read(tmp_path / "a.npz")
    np.testing.assert_array_equal(again.joints, made.joints)
    np.testing.assert_array_equal(again.features, features)
    assert (again.text, again.fps, again.representation, again.poses) == ("é", 20.0, "mine", None)
    with np.load(tmp_path / "a.npz") as file:
        assert list(file) == ["joints", "features", "fps", "text", "representation", "cleanup", "seed"]


def test_a_motion_is_shown(walk: Motion, monkeypatch: pytest.MonkeyPatch):
    assert repr(walk) == f"Motion('a person walks', {len(walk.joints)} frames, 30 fps, smpl22)"
    long = Motion(walk.joints, 30.0, text="a person walks " * 20)
    assert f"{'a person walks ' * 3}a person walks…" in repr(long)
    assert flame_mdm.Motion is Motion
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    page = walk.show()
    assert "a person walks" in page.read_text()
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(HTML=str))  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: None))  # type: ignore[arg-type]
    assert "a person walks" in walk.show().read_text()  # imported by another package
    notebook = SimpleNamespace(kernel=None)
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: notebook))  # type: ignore[arg-type]
    shown = walk.show()
    assert shown.startswith("<div><iframe sandbox=")
    assert "<script" not in shown


@pytest.mark.parametrize("name", ["new/walk.BVH", "walk.gif", "walk.MP4"])
def test_the_extension_selects_the_format(walk: Motion, tmp_path: Path, name: str):
    if name.endswith("MP4"):
        pytest.importorskip("av")
    begin = {"bvh": b"HIERARCHY", "gif": b"GIF89a", "mp4": b"\0\0\0\x20ftyp"}[name[-3:].lower()]
    short = Motion(walk.joints[:5], 30.0)
    assert short.save(tmp_path / name).startswith(f"{tmp_path / name}: 5 frames at 30 per second")
    assert (tmp_path / name).read_bytes().startswith(begin)


def test_arrays_are_edited(walk: Motion, model: MotionGeneration):
    how: dict[str, Any] = {"region": "prediction", "num_inference_steps": 2}
    expected = edit(model, walk, "a person jumps", **how)[0]
    for joints in (walk.joints, torch.from_numpy(walk.joints), walk.joints.tolist()):
        result = edit(model, joints, "a person jumps", fps=30, **how)[0]
        np.testing.assert_array_equal(result.joints, expected.joints)
        assert result.feature_error == 0


def test_what_cannot_be_edited_is_refused_in_one_line(walk: Motion, model: MotionGeneration):
    joints = walk.joints
    cases: list[tuple[Any, Any, str]] = [
        (joints, None, "an array has no frame rate: set it, for example with fps=20"),
        (joints, "fast", "fps is fast, not a number of frames per second"),
        (joints[:, :13], 30, r"joints of shape \(79, 13, 3\), not \(frames, joints, 3\) with 22 \(smpl22\)"),
        (joints[0], 30, r"joints of shape \(22, 3\), not \(frames, joints, 3\)"),
        (joints[:0], 30, "have no frames"),
        (joints[:, :21], 30, r"^motion: shape \(.*, 21, 3\), but humanml-clean-smpl22 takes \(frames, 22, 3\)"),
        (joints * 100, 30, r"^the legs are 8\d\.\d m long .* The unit may be 0\.01 \(centimeters\)"),
        (joints * np.nan, 30, "joints in frame 0 are not finite"),
        (np.tile(joints, (9, 1, 1)), 30, "^the motion: .* frames, but the model was trained on at most 196"),
        (None, 30, r"^NoneType: not a motion\. Give a path, a Motion, or an array of joints"),
        (walk, 20, r"fps=20: this motion has 30 frames per second\. Omit fps"),
        (Motion(joints * 100, 30, id="take"), None, "^take: the legs are"),
    ]
    for motion, fps, message in cases:
        with pytest.raises(UserError, match=message) as caught:
            edit(model, motion, fps=fps, region="prediction")
        assert "\n" not in str(caught.value)
