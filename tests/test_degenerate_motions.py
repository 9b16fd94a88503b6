"""Features of any numbers, as of a model that is not trained, decode to motions that can be written and shown."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from support.motions import posed
from torch import Tensor

from flame_mdm.__main__ import main
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import read
from flame_mdm.representations import Representation
from flame_mdm.representations.motion272 import Motion272
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.rotation import is_degenerate
from flame_mdm.representations.smpl import SMPL
from flame_mdm.sampling import generation
from flame_mdm.sampling.output import degenerate_notes
from flame_mdm.sampling.reading import decoded
from flame_mdm.visualize import player_page

FRAMES = 3
REPRESENTATIONS = (SMPL, Rot6D, Motion272)  # those that contain rotations of SMPL's joints
ENDINGS = (".glb", ".bvh", ".gif", ".fbx", ".npz")


def features(kind: str, width: int) -> Tensor:
    """Features (F, D) whose 6D rotations are degenerate, all of them or many."""
    signs = (
        torch.randint(0, 2, (FRAMES, width), generator=torch.Generator().manual_seed(0)) * 2.0 - 1
    )
    noise = torch.randn(FRAMES, 1, generator=torch.Generator().manual_seed(1))
    return {"signs": signs, "parallel": noise.expand(FRAMES, width).clone(), "zeros": 0 * signs}[
        kind
    ]


def saved(motion: Motion, folder: Path) -> list[str]:
    """Writes a file of each kind; returns the messages of those that are refused."""
    refusals = []
    for ending in ENDINGS:
        try:
            motion.save(folder / f"motion{ending}")
        except UserError as error:
            refusals.append(str(error))
    return refusals


@pytest.mark.parametrize("kind", ["signs", "parallel", "zeros"])
@pytest.mark.parametrize("make", REPRESENTATIONS)
def test_any_features_decode_to_rotations_and_to_motions_that_can_be_written(
    make: Callable[[], Representation], kind: str, tmp_path: Path
) -> None:
    representation = make()
    motion = decoded(representation, features(kind, representation.features), kind, kind)
    assert np.isfinite(motion.joints).all()
    refusals = saved(motion, tmp_path)
    # Joints are features of this representation, and here all of them are at one point.
    if make is Motion272 and kind != "signs":
        assert len(refusals) == 3
        assert {message.partition(",")[0] for message in refusals} == {
            "the bone that ends at left_hip has no length"
        }
    else:
        assert not refusals
    assert player_page([motion])
    # a file of features has their rotations
    again = read(tmp_path / "motion.npz")
    assert again.poses is not None
    turns = again.poses.rotations
    torch.testing.assert_close(
        torch.linalg.det(turns), torch.ones(turns.shape[:2], dtype=turns.dtype)
    )
    assert not saved(again, tmp_path)
    assert again.try_fit()[1] == ""
    assert player_page([again])


@pytest.mark.parametrize("joints", [range(22), range(4)], ids=["all", "pelvis"])
def test_a_frame_whose_joints_are_at_one_point_does_not_spoil_a_motion(
    joints: range, tmp_path: Path
) -> None:
    positions = posed(4).joints.copy()
    positions[2, list(joints)] = positions[2, :1]
    motion = Motion(positions, 20)
    assert motion.posed().rotations.isfinite().all()
    assert not saved(motion, tmp_path)
    assert player_page([motion])


def test_rotations_that_features_do_not_determine_are_counted() -> None:
    across, along, nothing = [1.0, 0, 0, 0, 1, 0], [1.0, 2, 3, -2, -4, -6], [0.0] * 6
    rows = torch.tensor(
        [
            across,
            along,
            nothing,
            [*across[:3], 0, 0, 0],
            [0, 0, 0, *across[3:]],
            [1e-20] * 3 + [1] * 3,
        ]
    )
    assert is_degenerate(rows).tolist() == [False, True, True, True, True, True]
    assert (
        is_degenerate(torch.randn(1000, 6, generator=torch.Generator().manual_seed(0))).sum() == 0
    )


@pytest.mark.parametrize("make", REPRESENTATIONS)
def test_frames_with_degenerate_rotations_are_named_in_one_line(
    make: Callable[[], Representation],
) -> None:
    representation = make()
    sound = torch.randn(FRAMES, representation.features, generator=torch.Generator().manual_seed(0))
    broken = sound.clone()
    broken[1] = 0
    motions = [decoded(representation, x, "", "") for x in (sound, broken)]
    assert [motion.degenerate for motion in motions] == [0, 1]
    assert degenerate_notes(motions[:1]) == []
    line = "1 of 6 frames have degenerate rotations, which were replaced by arbitrary ones. Train the model longer"
    assert degenerate_notes(motions) == [f"warning: {line}"]


def test_a_command_prints_the_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sample = generation.sample

    def degenerate(*arguments: object, **keywords: object) -> list[Motion]:
        motions = sample(*arguments, **keywords)  # type: ignore[arg-type]
        motions[0].degenerate = 2
        return motions

    monkeypatch.setattr(generation, "sample", degenerate)
    words = ["text=a person walks", "seconds=1", "samples=2", f"out={tmp_path}"]
    assert main(["sample", "quickstart", *words]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(
        line.startswith("warning: 2 of 40 frames have degenerate rotations, ") for line in lines
    )
