"""Features of any numbers, as of a model that is not trained, decode to motions that can be written and shown."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from support.motions import posed
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import read
from flame_mdm.representations import Representation
from flame_mdm.representations.motion272 import Motion272
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.smpl import SMPL
from flame_mdm.sampling.reading import decoded
from flame_mdm.visualize import player_page

FRAMES = 3
REPRESENTATIONS = (SMPL, Rot6D, Motion272)  # those that contain rotations of SMPL's joints
ENDINGS = (".glb", ".bvh", ".gif", ".fbx", ".npz")


def features(kind: str, width: int) -> Tensor:
    """Features (F, D) whose 6D rotations are degenerate, all of them or many."""
    signs = torch.randint(0, 2, (FRAMES, width), generator=torch.Generator().manual_seed(0)) * 2.0 - 1
    noise = torch.randn(FRAMES, 1, generator=torch.Generator().manual_seed(1))
    return {"signs": signs, "parallel": noise.expand(FRAMES, width).clone(), "zeros": 0 * signs}[kind]


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
    if make is Motion272 and kind != "signs":  # its joints are features of their own, and all are at one point
        assert len(refusals) == 3
        assert {message.partition(",")[0] for message in refusals} == {"the bone that ends in left_hip has no length"}
    else:
        assert not refusals
    assert player_page([motion])
    # a file of features has their rotations
    again = read(tmp_path / "motion.npz")
    assert again.poses is not None
    turns = again.poses.rotations
    torch.testing.assert_close(torch.linalg.det(turns), torch.ones(turns.shape[:2], dtype=turns.dtype))
    assert not saved(again, tmp_path)
    assert again.try_fit()[1] == ""
    assert player_page([again])


@pytest.mark.parametrize("joints", [range(22), range(4)], ids=["all", "pelvis"])
def test_a_frame_whose_joints_are_at_one_point_does_not_spoil_a_motion(joints: range, tmp_path: Path) -> None:
    positions = posed(4).joints.copy()
    positions[2, list(joints)] = positions[2, :1]
    motion = Motion(positions, 20)
    assert motion.posed().rotations.isfinite().all()
    assert not saved(motion, tmp_path)
    assert player_page([motion])
