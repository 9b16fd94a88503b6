"""`Motion`, and every kind of motion file through every command that takes one."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import TINY

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.commands import compare
from flame_mdm.config import compose, instantiate
from flame_mdm.data.folder import Folder
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.editing import edit, read_motion
from flame_mdm.formats.files import read
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.humanml import HumanML
from flame_mdm.task import MotionGeneration

REPRESENTATION = HumanML()
KINDS = ["sample.npz", "amass.npz", "joints.npz", "walk.bvh", "walk.json", "walk.npy"]


@pytest.fixture(scope="module")
def walk() -> Motion:
    clip = next(clip for clip in Synthetic(clips=20).clips(30.0) if clip.attributes["action"] == "walk")
    return Motion(clip.motion, 30.0, text="a person walks", id="walk")


@pytest.fixture(scope="module")
def folder(walk: Motion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same motion in files of every kind."""
    folder = tmp_path_factory.mktemp("motions")
    for name in ("sample.npz", "walk.bvh", "walk.json", "walk.npy"):
        walk.save(folder / name, **{"seed": 3} if name == "sample.npz" else {})
    np.savez(folder / "joints.npz", joints=walk.joints.astype(float), fps=30)
    Motion(walk.joints, 30.0, text=walk.text, poses=walk.posed()).save(folder / "both.npz")
    with np.load(folder / "both.npz") as both:
        amass = {key: both[key] for key in ("poses", "trans", "betas", "gender", "mocap_framerate")}
    np.savez(folder / "amass.npz", **amass)
    (folder / "both.npz").unlink()
    return folder


@pytest.fixture(scope="module")
def model() -> MotionGeneration:
    torch.manual_seed(0)
    config = compose("quickstart", TINY)
    model = MotionGeneration.build(config, instantiate(config["representation"]))
    model.facts |= {"max_frames": 196, "dataset": "synthetic", "fingerprint": "f00d"}
    return model.eval()


def tolerance(kind: str) -> float:
    """AMASS files have the bones of SMPL's body."""
    return 0.25 if kind == "amass.npz" else 0.02


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_converted(folder: Path, walk: Motion, tmp_path: Path, kind: str):
    rate = ["fps=30"] if kind.endswith(".npy") else []
    for ending in (".bvh", ".glb", ".npz", ".json", ".npy"):
        assert main(["convert", str(folder / kind), f"out={tmp_path / ('out' + ending)}", *rate]) == 0
    again = read(tmp_path / "out.npz")
    assert again.fps == 30
    assert again.poses is not None
    assert np.abs(again.joints - walk.joints).max() < tolerance(kind)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_edited(folder: Path, walk: Motion, model: MotionGeneration, kind: str):
    motion = read_motion(REPRESENTATION, folder / kind, fps=30 if kind.endswith(".npy") else None)
    expected = read_motion(REPRESENTATION, folder / "joints.npz")
    assert motion.fps == 20
    assert motion.features.shape == expected.features.shape
    assert np.abs(motion.joints - expected.joints).max() < tolerance(kind)
    assert edit(model, motion, region="prediction", num_inference_steps=2)[0].feature_error == 0


def test_a_motion_without_features_is_edited(walk: Motion, model: MotionGeneration):
    result = edit(model, walk, region="prediction", num_inference_steps=2)[0]
    assert result.original.features.shape == (len(result.joints), 263)
    assert repr(result).startswith("Edited('#0', 52 frames, 20 fps")


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_own_data(folder: Path, walk: Motion, tmp_path: Path, kind: str):
    (tmp_path / kind).symlink_to(folder / kind)
    (tmp_path / "captions.json").write_text(json.dumps({kind.partition(".")[0]: {"text": "a person walks"}}))
    if kind.endswith(".npy"):
        (tmp_path / "skeleton.yaml").write_text("fps: 30\n")
    (clip,) = Folder(str(tmp_path)).clips(30.0)
    assert clip.motion.shape == walk.joints.shape
    assert np.abs(clip.motion - walk.joints).max() < tolerance(kind)


def test_every_kind_with_a_frame_rate_is_compared(folder: Path):
    found = compare._read(folder)
    assert len(found) == 5
    assert sorted(text for text, _ in found) == ["", "", "", "a person walks", "a person walks"]


def test_a_saved_motion_comes_back(tmp_path: Path, walk: Motion):
    features = np.arange(6, dtype=np.float32).reshape(3, 2)
    made = Motion(walk.joints[:3], 20.0, text="é", features=features, representation="mine")
    made.save(tmp_path / "a.npz", seed=3)
    again = read(tmp_path / "a.npz")
    np.testing.assert_array_equal(again.joints, made.joints)
    np.testing.assert_array_equal(again.features, features)
    assert (again.text, again.fps, again.representation, again.poses) == ("é", 20.0, "mine", None)
    with np.load(tmp_path / "a.npz") as file:
        assert list(file) == ["joints", "features", "fps", "text", "representation", "seed"]


def test_a_motion_is_shown(walk: Motion, monkeypatch: pytest.MonkeyPatch):
    assert repr(walk) == f"Motion('a person walks', {len(walk.joints)} frames, 30 fps, smpl22)"
    assert flame_mdm.Motion is Motion
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    page = walk.show()
    assert "a person walks" in page.read_text()
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace())  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(HTML=str))  # type: ignore[arg-type]
    shown = walk.show()
    assert shown.startswith("<iframe sandbox=")
    assert "<script" not in shown
