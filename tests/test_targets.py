"""Targets in the world: way points, joint positions and poses."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.errors import UserError
from flame_mdm.processes.guidance import Positions, reach
from flame_mdm.sampling.targets import errors, read_targets

TEXT = "a person walks forward"


@pytest.fixture(scope="module")
def model() -> flame_mdm.MotionGenerator:
    return flame_mdm.load("quickstart")


def bones(motion: flame_mdm.Motion) -> np.ndarray:
    """Lengths (F, N) of all bones but those of the root."""
    return np.linalg.norm(motion.skeleton.bones(torch.from_numpy(motion.joints)).numpy()[:, 1:], axis=-1)


def test_a_linear_decoder_is_solved_exactly_and_changes_least():
    """Two of six features decide on the position: both change by half, and smoothly in time."""
    x, index = torch.zeros(1, 9, 6), torch.tensor([4])

    def to_joints(features: torch.Tensor) -> torch.Tensor:
        position = features[..., 0] + features[..., 1]
        return torch.stack([position, features[..., 2], features[..., 3]], -1)[..., None, :]

    goal = Positions(index, torch.tensor([0]), torch.tensor([0]), torch.tensor([2.0]))
    free = torch.ones_like(x, dtype=torch.bool)
    no_bones = torch.zeros(3, 0, dtype=torch.long)
    moved = reach(x, to_joints, goal, no_bones, free, smoothness=1.0)[0]
    assert moved[4, :2].tolist() == pytest.approx([1.0, 1.0], abs=1e-2)
    assert moved[5, 0] == pytest.approx(float(moved[4, 0] * np.exp(-0.5)), rel=1e-4)
    assert not moved[:, 2:].any()
    free[..., 1] = False
    moved = reach(x, to_joints, goal, no_bones, free, smoothness=1.0)[0]
    assert moved[4, :2].tolist() == pytest.approx([2.0, 0.0], abs=1e-2)


def test_way_points_joints_and_poses_are_reached(model, tmp_path):
    bow = flame_mdm.generate(model, "a person bows", seconds=2, num_inference_steps=10)[0]
    bow.save(tmp_path / "bow.npz")
    content = {
        "root": [{"time": 1, "position": [0.3, 0.4]}, {"time": 2, "position": [None, 1.2]}],
        "joints": [{"time": 1.5, "joint": "right_wrist", "position": [None, 1.3, None]}],
        "poses": [{"time": 2.4, "file": "bow.npz", "frame": 20}],
    }
    file = tmp_path / "targets.json"
    file.write_text(json.dumps(content))
    targets = read_targets(model.representation, file)
    assert len(targets.positions.values) == 2 + 1 + 1 + 1
    options: dict[str, Any] = {"seconds": 2.5, "num_inference_steps": 10}
    motion, plain = (flame_mdm.generate(model, TEXT, targets=source, **options)[0] for source in (file, None))
    assert errors(motion, targets).max() < 0.03 < errors(plain, targets).max()
    local = slice(4, 4 + 21 * 3)
    np.testing.assert_allclose(motion.features[48, local], bow.features[20, local], atol=1e-5)
    arms = np.linalg.norm(motion.joints[:, 18:22] - motion.joints[:, 16:20], axis=-1)
    np.testing.assert_allclose(arms[30], np.median(arms, 0), rtol=0.05)
    # a pose at a position faces its heading
    entry = {"time": 1.0, "file": str(tmp_path / "bow.npz"), "frame": 5, "position": [0.2, 0.5], "heading": 90}
    pose = read_targets(model.representation, {"poses": [entry]}).positions.values.reshape(22, 3)
    assert pose[0, [0, 2]].tolist() == pytest.approx([0.2, 0.5])
    left = (pose[1] - pose[2] + pose[16] - pose[17]).numpy()
    assert np.degrees(np.arctan2(-left[2], left[0])) == pytest.approx(90, abs=1e-3)


def test_targets_of_a_sequence(model):
    targets = {"root": [{"time": t, "position": [0.1 * t, 0.3 * t]} for t in (1, 2, 3, 4)]}
    motion = flame_mdm.generate(model, f"{TEXT} @2.4 | {TEXT} @2.4", targets=targets, num_inference_steps=10)[0]
    assert errors(motion, read_targets(model.representation, targets)).max() < 0.05


def test_bad_targets_give_one_clear_line(model, tmp_path):
    for content, message in (
        ([], "give an object with root, joints, poses"),
        ({"roots": []}, "unknown key 'roots'. Did you mean root?"),
        ({"root": {"time": 1, "position": [0, 1]}}, "root is {.*}, not a list"),
        ({"root": [{"time": "1", "position": [0, 1]}]}, r"root\[0\].time='1': give a number"),
        ({"root": [[0, 1]]}, r"root\[0\] is \[0, 1\]. Give an object with position, time"),
        ({"root": [{"time": 1, "position": [1]}]}, r"root\[0\].position=\[1\]: give 2 numbers"),
        ({"root": [{"time": 1, "position": [0, 30]}]}, "30.0 m from the start in 1 seconds is impossible"),
        ({"root": [{"time": 9, "position": [0, 1]}]}, "9 seconds is after .* last frame is at 1.95 seconds"),
        ({"joints": [{"time": 1, "joint": "left_rist", "position": [0, 1, 0]}]}, "no joint 'left_rist'.*left_wrist"),
        ({"joints": [{"time": 1, "joint": "head", "position": [0, 9, 0]}]}, "height 9 m is impossible"),
        ({"poses": [{"time": 1, "file": "no.npz"}]}, "no.npz"),
    ):
        (tmp_path / "t.json").write_text(json.dumps(content))
        with pytest.raises((UserError, FileNotFoundError), match=message) as raised:
            flame_mdm.generate(model, TEXT, seconds=2, targets=tmp_path / "t.json")
        assert "\n" not in str(raised.value)


def test_the_command_prints_the_distance(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("t.json").write_text('{"root": [{"time": 1.5, "position": [0.5, 0.5]}]}')
    words = [f"text={TEXT}", "samples=1", "seconds=2", "num_inference_steps=4", "targets=t.json"]
    assert main(["sample", "quickstart", *words]) == 0
    assert "distance from the targets: mean " in capsys.readouterr().out
    Path("t.json").write_text("{")
    assert main(["sample", "quickstart", *words]) == 1
    assert "targets=t.json: not JSON" in capsys.readouterr().err


@pytest.mark.slow
def test_targets_that_the_text_does_not_suggest_do_not_stretch_bones(model):
    """Steering may not leave what the denoiser was trained on, and bones keep their lengths around a target."""
    target = {"joints": [{"time": 1.5, "joint": "right_wrist", "position": [-0.5, 1.5, 0.2]}]}
    options: dict[str, Any] = {"seconds": 3, "seed": 1, "num_inference_steps": 20}
    before, after = (
        flame_mdm.generate(model, "a person stands still", targets=t, **options)[0] for t in (None, target)
    )
    assert np.abs(np.median(bones(after), 0) / np.median(bones(before), 0) - 1).max() < 0.05
    target = {"joints": [{"time": 1.5, "joint": "right_wrist", "position": [None, 1.4, None]}]}
    lengths = bones(flame_mdm.generate(model, TEXT, seconds=3, targets=target, num_inference_steps=20)[0])
    assert np.abs(lengths / np.median(lengths, 0) - 1).max() < 0.15  # 0.6, if kept in the frame of the target alone
