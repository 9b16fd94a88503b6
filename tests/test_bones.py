"""Rotations from the bones of BVH files: what joint positions cannot show arrives in features of rotations."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.motions import posed, synthetic

from flame_mdm.errors import UserError
from flame_mdm.formats import bvh
from flame_mdm.formats.cleanup import cleaned
from flame_mdm.formats.conversion import raw_motion
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.posture import shortest_turns
from flame_mdm.formats.readers import read
from flame_mdm.formats.retarget import presets
from flame_mdm.representations.motion272 import Motion272
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import JOINT, SMPL22
from flame_mdm.representations.smpl import ADULT, SMPL
from flame_mdm.sampling.reading import with_features

FRAMES = 12
ANGLES = np.linspace(0, 80, FRAMES)[:, None]


def twisting() -> Motion:
    """A body that walks, turns its forearms and its head about their own axes, and raises an arm."""
    forearm = ANGLES * ADULT[JOINT["left_wrist"]] / np.linalg.norm(ADULT[JOINT["left_wrist"]])
    return posed(
        FRAMES,
        root=np.linspace((0, 0.955, 0), (0.3, 0.955, 0.5), FRAMES),
        heading=np.linspace(0.4, 1.2, FRAMES),
        left_elbow=Rotation.from_rotvec(forearm, degrees=True).as_euler("xyz", degrees=True),
        head=ANGLES * [0, 0.5, 0],
        right_shoulder=ANGLES * [0, 0, 0.5],
        left_hip=ANGLES * [-0.3, 0, 0],
        left_knee=ANGLES * [0.4, 0, 0],
    )


def largest_angle(motion: Motion, expected: torch.Tensor) -> float:
    """Largest angle, in radians, between a file's bones and the rotations of a body (F, 22, 3, 3)."""
    assert motion.bones.poses is not None, motion.bones.reason
    between = expected.mT @ motion.bones.poses.rotations
    vectors = Rotation.from_matrix(between.reshape(-1, 3, 3).numpy()).as_rotvec()
    return float(np.linalg.norm(vectors, axis=1).max())


def rotations(motion: Motion) -> torch.Tensor:
    return motion.posed().rotations


def with_axes(tree: bvh.Bvh, axes: np.ndarray, world: np.ndarray | None = None) -> bvh.Bvh:
    """The same motion with other local axes (J, 3, 3) of the joints, in a world turned by a rotation (3, 3)."""
    turned = np.eye(3) if world is None else world
    above = [axes[parent] if parent >= 0 else turned for parent in tree.parents]
    frames, columns = tree.frames.copy(), tree.columns()
    for joint, names in enumerate(tree.channels):
        order = "".join(name[0] for name in names if name.endswith("rotation"))
        if order:
            local = above[joint].T @ tree.rotations()[:, joint] @ axes[joint]
            angles = Rotation.from_matrix(local).as_euler(order, degrees=True)
            frames[:, columns[joint].stop - 3 : columns[joint].stop] = angles
        if len(names) == 6:
            place = slice(columns[joint].start, columns[joint].start + 3)
            frames[:, place] = tree.translations()[:, joint] @ above[joint]
    offsets = np.stack([offset @ turn for offset, turn in zip(tree.offsets, above, strict=True)])
    return replace(tree, offsets=offsets, frames=frames)


@pytest.fixture
def changed(tmp_path: Path) -> Callable[..., Motion]:
    """Writes a motion as a BVH file, changes its tree, and reads the file."""

    def changed(change: Callable[[bvh.Bvh], bvh.Bvh], rest_pose: bool = False, **keys) -> Motion:
        twisting().save(tmp_path / "plain.bvh", rest_pose=rest_pose)
        bvh.write(change(bvh.read(tmp_path / "plain.bvh")), tmp_path / "changed.bvh")
        return read(tmp_path / "changed.bvh", **keys)

    return changed


@pytest.mark.parametrize("rest_pose", [False, True])
@pytest.mark.parametrize("rig", [None, *presets()])
def test_rotations_of_our_files_come_back(
    rig: str | None, rest_pose: bool, tmp_path: Path, subtests
):
    for motion in (twisting(), synthetic("kick")):
        with subtests.test(motion=motion):
            motion.save(tmp_path / "a.bvh", rig=rig, rest_pose=rest_pose)
            again = read(tmp_path / "a.bvh")
            kept = len(again.joints)
            assert kept >= len(motion.joints) - 1
            assert largest_angle(again, rotations(motion)[-kept:]) < 1e-4


def test_a_twist_of_the_forearm_arrives_in_features_although_no_joint_moves(tmp_path: Path):
    forearm = np.array(ADULT[JOINT["left_wrist"]])
    twists = Rotation.from_rotvec(ANGLES * forearm / np.linalg.norm(forearm), degrees=True)
    motion = posed(FRAMES, left_elbow=twists.as_euler("xyz", degrees=True))
    assert np.ptp(motion.joints, axis=0).max() < 1e-6
    motion.save(tmp_path / "a.bvh")

    features = with_features(Rot6D(20.0), read(tmp_path / "a.bvh")).features
    rows = features[:, :144].reshape(FRAMES, 24, 6)
    expected = twists.as_matrix()[:, :2].reshape(FRAMES, 6)
    np.testing.assert_allclose(rows[:, JOINT["left_elbow"]], expected, atol=1e-5)
    still = [n for n in range(1, 24) if n != JOINT["left_elbow"]]
    np.testing.assert_allclose(
        rows[:, still], [[[1, 0, 0, 0, 1, 0]] * len(still)] * FRAMES, atol=1e-5
    )


@pytest.mark.parametrize("kind", [SMPL, Rot6D, Motion272])
def test_decoded_features_are_as_near_as_the_note_says(kind, tmp_path: Path):
    motion = synthetic("walk")
    motion.save(tmp_path / "a.bvh")
    encoded = with_features(kind(20.0), read(tmp_path / "a.bvh"))
    (note,) = encoded.notes
    start = "rotations were read from the file, on the body of an adult: mean error "
    assert note.startswith(start)
    assert 0 < float(note.removeprefix(start).split()[0]) < 4
    raw = raw_motion(read(tmp_path / "a.bvh"), SMPL(20.0))
    decoded = SMPL(20.0).decode(SMPL(20.0).encode(raw.values)).numpy()[:, :22]
    legs = [JOINT[f"{side}_{name}"] for side in ("left", "right") for name in ("knee", "ankle")]
    lengths = np.linalg.norm(SMPL22.bones(torch.from_numpy(motion.joints)), axis=-1).mean(0)
    scale = np.linalg.norm(ADULT[:22], axis=1)[legs].sum() / lengths[legs].sum()
    apart = np.linalg.norm(decoded - scale * motion.joints, axis=-1)
    assert apart.mean() == pytest.approx(raw.error, abs=1e-4)


def test_arms_of_another_rest_pose_are_raised_by_the_smallest_rotation(changed):
    lowered = Rotation.from_euler("z", -50, degrees=True).as_matrix()

    def in_a_pose(tree: bvh.Bvh) -> bvh.Bvh:
        axes = np.tile(np.eye(3), (len(tree.joints), 1, 1))
        for joint, end in (("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist")):
            bone = np.array(ADULT[JOINT[end]])
            axes[tree.joints.index(joint)] = shortest_turns(bone, lowered @ bone).T
        axes[tree.joints.index("left_wrist")] = axes[tree.joints.index("left_elbow")]
        return with_axes(tree, axes)

    assert largest_angle(changed(in_a_pose), rotations(twisting())) < 1e-4


@pytest.mark.parametrize("up", ["y", "z", "-y"])
def test_the_rest_pose_of_a_file_may_face_anywhere(up: str, changed):
    degrees = {"y": ("y", 120), "z": ("x", -90), "-y": ("z", 180)}[up]
    world = Rotation.from_euler(*degrees, degrees=True).as_matrix()

    def turned(tree: bvh.Bvh) -> bvh.Bvh:
        return with_axes(tree, np.tile(world, (len(tree.joints), 1, 1)), world)

    motion = changed(turned, up=up)
    expected = rotations(twisting()).clone()
    if up == "y":
        expected[:, 0] = torch.from_numpy(world.T) @ expected[:, 0]
    if up == "-y":
        about = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
        expected[:, 0] = about @ expected[:, 0]
    assert largest_angle(motion, expected) < 1e-4


def test_a_rest_pose_in_front_shows_the_axes_of_the_joints_and_without_one_joints_are_fitted(
    changed,
):
    def any_axes(tree: bvh.Bvh) -> bvh.Bvh:
        vectors = np.random.default_rng(1).normal(size=(len(tree.joints), 3))
        return with_axes(tree, Rotation.from_rotvec(vectors).as_matrix())

    kept = changed(any_axes, rest_pose=True)
    assert largest_angle(kept, rotations(twisting())[-len(kept.joints) :]) < 1e-4
    unknown = changed(any_axes)
    assert unknown.bones.poses is None
    note = raw_motion(unknown, SMPL(20.0)).note
    assert note.startswith("rotations were fitted to joints (the rest pose in the file is unknown)")


def test_rotations_that_do_not_move_the_joints_are_not_used(changed):
    def by_positions(tree: bvh.Bvh) -> bvh.Bvh:
        rotations, positions = tree.rotations(), tree.positions()
        bones = positions - positions[:, np.maximum(tree.parents, 0)]
        bones[:, 0] = positions[:, 0]
        channels = tuple(bvh.CHANNELS if names else () for names in tree.channels)
        columns = [
            np.concatenate([bones[:, joint], np.zeros((len(rotations), 3))], 1)
            for joint, names in enumerate(channels)
            if names
        ]
        return replace(tree, channels=channels, frames=np.concatenate(columns, 1))

    motion = changed(by_positions)
    np.testing.assert_allclose(motion.joints, twisting().joints, atol=1e-4)
    assert motion.bones.poses is None
    assert "cm from their positions)" in raw_motion(motion, SMPL(20.0)).note


def test_rotations_follow_the_frame_rate_and_end_with_cleanup(tmp_path: Path):
    twisting().save(tmp_path / "a.bvh")
    motion = read(tmp_path / "a.bvh").resampled(40.0)
    assert largest_angle(motion.resampled(20.0), rotations(twisting())) < 1e-4
    raw = raw_motion(read(tmp_path / "a.bvh"), SMPL(40.0)).values
    assert len(raw) == len(motion.joints) == 2 * FRAMES - 1
    assert cleaned(motion).bones.poses is None


@pytest.mark.parametrize("seed", range(20))
def test_mixed_orders_and_missing_channels_give_one_line_or_rotations_that_fit(seed: int, changed):
    rng = np.random.default_rng(seed)

    def mutated(tree: bvh.Bvh) -> bvh.Bvh:
        channels, frames = [], []
        for names, columns in zip(tree.channels, tree.columns(), strict=True):
            kept = np.arange(len(names))
            if rng.random() < 0.3:
                kept = rng.permutation(kept)[rng.random(len(kept)) < 0.9]
            channels.append(tuple(names[number] for number in kept))
            frames.append(tree.frames[:, columns][:, kept])
        return replace(tree, channels=tuple(channels), frames=np.concatenate(frames, 1))

    motion, refusal = None, ""
    try:
        motion = changed(mutated)
    except UserError as error:
        refusal = str(error)
    assert "\n" not in refusal
    if motion is None:
        return
    assert raw_motion(motion, SMPL(20.0)).values.isfinite().all()
    assert motion.bones.poses is not None, motion.bones.reason
    apart = motion.bones.poses.joints().numpy() - motion.joints
    assert np.linalg.norm(apart, axis=-1).mean() < 1e-4
