"""Own motions for every representation: rotations are kept or fitted, KIT-ML's joints come from SMPL's."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from support.motions import posed, synthetic

from flame_mdm.errors import UserError
from flame_mdm.formats.conversion import kit_joints, raw_motion
from flame_mdm.formats.layouts import LAYOUTS
from flame_mdm.formats.motion import Motion
from flame_mdm.representations import Representation
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.motion272 import Motion272
from flame_mdm.representations.rifke import Rifke
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import KIT21, SKELETONS, SMPL22
from flame_mdm.representations.smpl import ADULT, SMPL
from flame_mdm.sampling.reading import read_motion, with_features

ROTATED = [SMPL, Rot6D, Motion272]
ENDINGS = ["npz", "bvh", "json", "npy", "glb", "fbx"]


def canonical(joints: np.ndarray) -> np.ndarray:
    """Joints (F, J, 3) with the first root at the origin, facing +z."""
    moved = joints - joints[:1, :1]
    x, _, z = moved[0, 1] - moved[0, 2]
    length = np.hypot(x, z)
    turn = np.array([[x, 0, z], [0, length, 0], [-z, 0, x]]) / length
    return moved @ turn.T


@pytest.mark.parametrize("kind", ROTATED)
def test_known_rotations_are_kept(kind: type[SMPL] | type[Rot6D] | type[Motion272]):
    turns = np.linspace((0, 0, 0), (40, 10, 5), 31)
    path = np.linspace((0, 0.955, 0), (0.5, 0.955, 1.0), 31)
    motion = posed(
        31, root=path, left_hip=-turns, right_elbow=turns[:, [1, 0, 2]], left_shoulder=(0, 0, -60)
    )
    encoded = with_features(kind(20.0), motion)
    np.testing.assert_allclose(
        canonical(encoded.joints)[:, :22], canonical(motion.joints), atol=1e-4
    )
    assert encoded.notes == ()


@pytest.mark.parametrize("kind", ROTATED)
@pytest.mark.parametrize("ending", [ending for ending in ENDINGS if ending != "bvh"])
def test_files_of_joints_alone_are_fitted_and_the_error_is_stated(
    ending: str, kind: type[SMPL] | type[Rot6D] | type[Motion272], tmp_path: Path
):
    synthetic("walk").save(tmp_path / f"a.{ending}")
    motion = read_motion(kind(20.0), tmp_path / f"a.{ending}", fps=20 if ending == "npy" else None)
    (note,) = motion.notes
    mean = re.search(
        r"rotations were fitted to joints, on the body of an adult: mean error ([\d.]+) cm, max",
        note,
    )
    assert mean is not None
    assert 0 < float(mean[1]) < 4
    walked = synthetic("walk").joints
    scale = (
        np.ptp(motion.joints[:, 0, [0, 2]], axis=0).max()
        / np.ptp(walked[:, 0, [0, 2]], axis=0).max()
    )
    far = np.linalg.norm(canonical(motion.joints)[:, :22] - scale * canonical(walked), axis=-1)
    assert far.mean() < 0.06


def test_rotations_are_resampled_on_the_sphere():
    turning = posed(21, left_shoulder=np.linspace((0, 0, -90), (0, 0, 90), 21))
    raw = raw_motion(turning, SMPL(40.0)).values
    assert raw.shape == (41, 75)
    encoded = SMPL(40.0).decode(SMPL(40.0).encode(raw)).numpy()
    bones = np.linalg.norm(encoded[:, 18] - encoded[:, 16], axis=1)
    np.testing.assert_allclose(bones, bones[0], atol=1e-5)
    np.testing.assert_allclose(encoded[::2, :22], turning.joints, atol=1e-4)


def test_hands_of_24_joints_are_left_out_of_rotations_and_errors():
    body = Motion(synthetic("kick").joints, 20)
    ends = body.joints[:, 20:] + np.array([[0.08, 0, 0], [-0.08, 0, 0]])
    hands = Motion(np.concatenate([body.joints, ends], 1), 20, SKELETONS["smpl24"])
    expected, raw = raw_motion(body, SMPL(20.0)), raw_motion(hands, SMPL(20.0))
    assert torch.equal(raw.values, expected.values)
    assert (raw.note, raw.error) == (expected.note, expected.error)
    assert 0 < raw.error < 0.04


def test_joints_of_kit_are_those_of_smpl_mirrored():
    joints = synthetic("kick").joints.astype(float)
    kit = kit_joints(joints)
    mapped = LAYOUTS["MMM"].model_copy(update={"unit": 1.0}).apply(kit, KIT21.joints)
    same = [
        n
        for n, name in enumerate(SMPL22.joints)
        if name != "spine1" and not name.endswith("collar")
    ]
    np.testing.assert_allclose(mapped[:, same], joints[:, same], atol=1e-5)


@pytest.mark.parametrize("representation", [Rifke(12.5), HumanML("kit21", fps=12.5)])
@pytest.mark.parametrize("ending", ENDINGS)
def test_models_of_kit_take_files_of_22_joints(
    ending: str, representation: Representation, tmp_path: Path
):
    motion = synthetic("walk")
    motion.save(tmp_path / f"a.{ending}")
    encoded = read_motion(
        representation, tmp_path / f"a.{ending}", fps=20 if ending == "npy" else None
    )
    expected = canonical(kit_joints(motion.joints.astype(float)))
    assert encoded.joints.shape[1:] == (21, 3)
    assert abs(len(encoded.joints) - len(motion.joints) * 12.5 / 20) <= 1
    height = np.ptp(encoded.joints[0, :, 1])
    assert height == pytest.approx(np.ptp(expected[0, :, 1]), rel=0.15)


def test_a_skeleton_without_rotations_is_refused():
    motion = Motion(np.random.default_rng(0).normal(size=(9, 21, 3)), 20, KIT21)
    with pytest.raises(
        UserError, match="needs rotations of SMPL's joints, but these cannot be derived from kit21"
    ):
        raw_motion(motion, SMPL())
    assert torch.is_tensor(raw_motion(motion, Rifke()).values)


def test_the_middle_of_a_foot_of_kit_is_halfway_from_the_ankle_to_the_toes():
    joints = synthetic("kick").joints.astype(float)
    kit = kit_joints(joints) * [-1, 1, 1]
    for side in ("left", "right"):
        ankle, toes = (joints[:, SMPL22.joints.index(f"{side}_{n}")] for n in ("ankle", "foot"))
        middle = kit[:, KIT21.joints.index(f"{side}_foot")]
        np.testing.assert_allclose(middle, (ankle + toes) / 2, atol=1e-9)


def test_the_note_states_the_mean_and_the_largest_error_in_centimeters():
    motion = synthetic("kick")
    raw = raw_motion(Motion(motion.joints, 20), SMPL(20.0))
    decoded = SMPL(20.0).decode(SMPL(20.0).encode(raw.values)).numpy()[:, :22]
    legs = [SMPL22.joints.index(f"{s}_{n}") for s in ("left", "right") for n in ("knee", "ankle")]
    lengths = np.linalg.norm(SMPL22.bones(torch.from_numpy(motion.joints)), axis=-1).mean(0)
    scale = np.linalg.norm(np.array(ADULT[:22])[legs], axis=1).sum() / lengths[legs].sum()
    apart = 100 * np.linalg.norm(decoded - scale * motion.joints, axis=-1)
    errors = re.search(r"mean error ([\d.]+) cm, max ([\d.]+) cm", raw.note)
    assert errors is not None
    assert [float(error) for error in errors.groups()] == pytest.approx(
        [apart.mean(), apart.max()], abs=0.06
    )


@pytest.mark.parametrize("knows_rotations", [True, False])
def test_an_accelerated_path_is_kept_between_frames(knows_rotations: bool):
    times, later = np.arange(11)[:, None] / 20, np.arange(26)[:, None] / 50
    way = np.array([1.0, 0.4, -2.0])
    motion = posed(11, root=[0.1, 0.9, 0.3] + times**2 * way)
    if not knows_rotations:
        motion = Motion(motion.joints, 20)
    joints = raw_motion(motion, HumanML(fps=50.0)).values.numpy()[:, 0]
    np.testing.assert_allclose(joints - joints[0], later**2 * way, atol=1e-5)
    # AMASS's coordinates: z is up and x is opposite
    path = raw_motion(motion, SMPL(50.0)).values.numpy()[:, :3]
    np.testing.assert_allclose(path - path[0], later**2 * way[[0, 2, 1]] * [-1, 1, 1], atol=1e-4)
    resampled = motion.resampled(50.0).joints[:, 0]
    np.testing.assert_allclose(resampled - resampled[0], later**2 * way, atol=1e-5)
