"""MotionStreamer's 272 features and MARDM's 67: against the authors' code, and properties."""

import numpy as np
import pytest
import torch
from support.fixtures import golden, groups, meta
from torch import Tensor

from flame_mdm.representations import rotation
from flame_mdm.representations.essential import Essential
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.motion272 import Motion272, face_forward
from flame_mdm.representations.skeleton import SMPL22, forward_kinematics
from flame_mdm.representations.smpl import ADULT

FIXTURE, ESSENTIAL = golden("motion272"), golden("essential67")
one = pytest.mark.parametrize("stem", ["essential67"])


def array(name: str) -> Tensor:
    return torch.from_numpy(FIXTURE[name]).double()


def pose(name: str) -> tuple[Tensor, Tensor]:
    """Translation and rotation matrices of an array of 22 axis-angles, 6 zeros and a translation."""
    values = array(name)
    return values[:, 72:75], rotation.axis_angle_to_matrix(values[:, :66].unflatten(1, (22, 3)))


def cases(suffix: str) -> list:
    names = [name.partition("/")[2] for name in groups(FIXTURE, suffix) if not name.startswith("f64/")]
    return [pytest.param(name, id=f"motion272-{name}") for name in names]


def close(ours: Tensor, theirs: Tensor, atol: float) -> None:
    torch.testing.assert_close(ours.double(), theirs.double(), atol=atol, rtol=0)


# The authors' code ----------------------------------------------------------------------------------------------------


@pytest.mark.golden
@pytest.mark.parametrize("case", cases("face_z"))
def test_features_equal_the_authors(case: str):
    translation, rotations = face_forward(*pose(f"in/{case}/smpl_85"))
    theirs, turned = pose(f"out/{case}/face_z")
    close(translation, theirs, 5e-6)
    close(rotations, turned, 1e-5)
    close(Motion272().features_of(array(f"in/{case}/joints"), turned), array(f"out/{case}/feats"), 2e-6)


@pytest.mark.golden
@pytest.mark.parametrize("case", cases("rec_positions"))
def test_joints_and_rotations_equal_the_authors(case: str):
    features = array(f"{'in' if f'in/{case}/feats' in FIXTURE else 'out'}/{case}/feats")
    close(Motion272().decode(features), array(f"out/{case}/rec_positions"), 5e-6)
    pelvis, rotations = Motion272().poses(features)
    theirs, turned = pose(f"f64/{case}/rec_smpl_85")
    close(pelvis, theirs, 1e-5)
    close(rotations, turned, 1e-5)


@pytest.mark.golden
@pytest.mark.parametrize("stem", ["motion272"])
def test_statistics_equal_the_authors(stem: str):
    frames = torch.cat([array(f"out/{case}/feats") for case in meta(FIXTURE)["config"]["stats_over"]])
    mean, std = Motion272().statistics(frames.float())
    close(mean, array("out/stats/mean"), 1e-6)
    close(std, array("out/stats/std"), 1e-6)


@pytest.mark.golden
@one
def test_essential_features_equal_the_authors(stem: str):
    features = torch.from_numpy(ESSENTIAL["in/feats"])
    representation = Essential(variant="legacy")
    representation.mean, representation.std = (torch.from_numpy(ESSENTIAL[f"in/{name}"]) for name in ("mean", "std"))
    real = torch.arange(features.shape[1]) < torch.from_numpy(ESSENTIAL["in/lengths"])[:, None]
    x = representation.normalize(features[..., : representation.features]) * real[..., None]
    close(x, torch.from_numpy(ESSENTIAL["out/normed"]), 5e-6)
    close(representation.denormalize(x), torch.from_numpy(ESSENTIAL["out/inv"]), 5e-6)
    close(representation.decode(features[..., :67]), torch.from_numpy(ESSENTIAL["out/joints_from_67"]), 5e-6)
    kit = Essential("kit21", "legacy")
    np.testing.assert_array_equal(ESSENTIAL["in/kit_feats"][..., : kit.features], ESSENTIAL["out/kit_slice"])


# Properties -----------------------------------------------------------------------------------------------------------


def raw(frames: int = 50, seed: int = 0) -> Tensor:
    """A raw motion, z up: a body of 24 joints that walks in a circle and bends its joints."""
    generator = torch.Generator().manual_seed(seed)
    time = torch.linspace(0, 1, frames, dtype=torch.float64)
    bend = 0.4 * torch.randn(24, 3, generator=generator).double()
    turns = bend * torch.sin(6 * time)[:, None, None]
    up = rotation.axis_angle_to_matrix(torch.tensor([torch.pi / 2, 0, 0], dtype=torch.float64))
    about = rotation.axis_angle_to_matrix(5 * time[:, None] * torch.tensor([0, 0, 1.0], dtype=torch.float64))
    turns[:, 0] = rotation.matrix_to_axis_angle(about @ up @ rotation.axis_angle_to_matrix(turns[:, 0]))
    way = torch.stack([3 * torch.sin(5 * time), 3 * torch.cos(5 * time), 1 + 0.1 * torch.sin(20 * time)], 1)
    return torch.cat([way, turns.flatten(1)], 1)


def test_decoding_inverts_encoding_up_to_place_and_heading():
    representation, motion = Motion272(), raw()
    features = representation.encode(motion).double()
    offsets = torch.tensor(ADULT, dtype=torch.float64)[:22]
    rotations = rotation.axis_angle_to_matrix(motion[:, 3:69].unflatten(1, (22, 3)))
    world = forward_kinematics(SMPL22, rotations, offsets, motion[:, :3])[..., [1, 2, 0]]  # z up -> y up
    joints = representation.decode(features)
    assert joints[..., 1].min().item() == pytest.approx(0, abs=1e-6)
    assert joints[0, 0, [0, 2]].abs().max() < 1e-6
    close(
        torch.cdist(joints.flatten(0, 1), joints.flatten(0, 1)),
        torch.cdist(world.flatten(0, 1), world.flatten(0, 1)),
        1e-4,
    )
    pelvis, turns = representation.poses(features)
    close(forward_kinematics(SMPL22, turns, offsets, pelvis), joints, 1e-5)
    close(turns[0, 0, [0, 2], 2], torch.tensor([0.0, turns[0, 0, 2, 2]]), 1e-6)
    assert turns[0, 0, 2, 2] > 0, "the root faces +z in the first frame"


def test_features_do_not_depend_on_place_and_heading():
    motion = raw()
    turn = rotation.axis_angle_to_matrix(torch.tensor([0, 0, 2.0], dtype=torch.float64))
    moved = motion.clone()
    moved[:, :3] = motion[:, :3] @ turn.T + torch.tensor([4.0, -2.0, 0.3])
    moved[:, 3:6] = rotation.matrix_to_axis_angle(turn @ rotation.axis_angle_to_matrix(motion[:, 3:6]))
    close(Motion272().encode(moved), Motion272().encode(motion), 2e-6)


def test_cuts_start_like_whole_motions():
    representation = Motion272()
    features = representation.encode(raw())
    cut = representation.rebase(features[20:])
    close(cut[1:], features[21:], 0)
    assert not cut[0, :2].any()
    joints = representation.decode(cut.double())
    assert joints[0, 0, [0, 2]].abs().max() == 0
    whole = representation.decode(features.double())[20:]
    close(
        joints[:, :, None].sub(joints[:, None]).norm(dim=-1), whole[:, :, None].sub(whole[:, None]).norm(dim=-1), 1e-5
    )
    close(joints[1:, 0].sub(joints[:-1, 0]).norm(dim=-1), whole[1:, 0].sub(whole[:-1, 0]).norm(dim=-1), 1e-5)


def test_decoding_is_differentiable_and_takes_batches():
    representation = Motion272()
    features = torch.stack([representation.encode(raw(9, seed)).double() for seed in range(4)]).unflatten(0, (2, 2))
    joints = representation.decode(features)
    assert joints.shape == (2, 2, 9, 22, 3)
    close(joints[1, 0], representation.decode(features[1, 0]), 1e-12)
    assert torch.autograd.gradcheck(
        representation.decode, features[0, 0, :4].clone().requires_grad_(True), fast_mode=True
    )


def test_every_feature_belongs_to_one_joint():
    for representation in (Motion272(), Essential(), Essential("kit21")):
        owners = torch.stack([representation.joint_features([joint]) for joint in range(len(representation.skeleton))])
        assert owners.shape[1] == representation.features
        assert (owners.sum(0) == 1).all()


def test_one_frame_has_no_features():
    with pytest.raises(ValueError, match="1 frame, but encoding needs at least 2"):
        Motion272().encode(raw(1))


def test_essential_features_are_the_first_of_humanml():
    generator = torch.Generator().manual_seed(0)
    joints = torch.randn(1, 22, 3, generator=generator) + 0.01 * torch.randn(30, 22, 3, generator=generator).cumsum(0)
    representation, whole = Essential(), HumanML()
    features = representation.encode(joints)
    assert torch.equal(features, whole.encode(joints)[:, :67])
    assert torch.equal(representation.decode(features), whole.decode(whole.encode(joints)))
    assert [len(x) for x in representation.statistics(features)] == [67, 67]
    assert representation.part_of == whole.name != representation.name
