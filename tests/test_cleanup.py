"""Cleanup of generated motion, on synthetic motions with known faults."""

import itertools

import numpy as np
import pytest
import torch
from support.motions import posed, synthetic

from evaluators.metrics.attributes import read_attributes
from evaluators.metrics.physics import FootSkating
from evaluators.perturbations import draw_in
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.formats.cleanup import cleaned, cleanup
from flame_mdm.formats.faults import find_faults
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SKELETONS, SMPL22

FPS = 20


@pytest.fixture(scope="module")
def clips() -> list:
    source = Synthetic(100)
    return [source.clip(index, FPS) for index in range(100)]


def skating(motions: list[np.ndarray]) -> float:
    metric = FootSkating(FPS)
    for number, motion in enumerate(motions):
        mask = torch.ones(1, len(motion), dtype=torch.bool)
        metric.update(torch.from_numpy(motion)[None], mask, torch.tensor([number]))
    return metric.compute()


def peak(motions: list[np.ndarray]) -> float:
    """Mean of the maximum acceleration of a joint, in meters per squared frame."""
    return float(
        np.mean([np.linalg.norm(np.diff(motion, n=2, axis=0), axis=-1).max() for motion in motions])
    )


def bones(motion: np.ndarray) -> np.ndarray:
    return np.linalg.norm(SMPL22.bones(torch.from_numpy(motion)).numpy()[:, 1:], axis=-1)


def test_real_motion_hardly_changes(clips):
    after = [cleanup(clip.motion, FPS, SMPL22) for clip in clips]
    change = [
        np.linalg.norm(new - clip.motion, axis=-1).mean()
        for new, clip in zip(after, clips, strict=True)
    ]
    assert np.mean(change) < 0.003
    assert skating(after) <= skating([clip.motion for clip in clips]) + 0.005
    misread = [
        clip.id
        for new, clip in zip(after, clips, strict=True)
        if not clip.attributes.items() <= read_attributes(new, FPS).items()
    ]
    assert not misread


def test_faults_are_repaired(clips):
    real = [clip.motion for clip in clips if clip.attributes["action"] == "walk"]
    rng = np.random.default_rng(0)
    faulty = []
    for motion in real:
        # Joints that tremble, so that bones change their lengths.
        bad = motion + rng.normal(0, 0.008, motion.shape).astype(np.float32)
        bad[..., 2] += 0.4 / FPS * np.arange(len(bad))[:, None]  # the body slides
        bad[-3, 18:] += 0.3  # the arms pop in one of the last frames
        faulty.append(bad)
    after = [cleanup(motion, FPS, SMPL22) for motion in faulty]
    assert skating(faulty) > 0.5
    assert skating(after) < 0.05
    assert peak(faulty) > 3 * peak(real)
    assert peak(after) < 1.5 * peak(real)
    lengths = [bones(motion) for motion in after]
    stretch = [np.abs(of_motion / np.median(of_motion, 0) - 1).max() for of_motion in lengths]
    assert max(stretch) < 1e-4, stretch


def test_limbs_stay_above_the_floor_between_poses_that_differ_much():
    """The frames between a crawl and a walk are means of both poses, with short bones."""
    crawl, walk = synthetic("crawl").joints, synthetic("walk").joints
    walk = walk + np.array([0, 0, crawl[-1, 0, 2]], np.float32)
    share = np.linspace(0, 1, 10, dtype=np.float32)[:, None, None]
    motion = np.concatenate([crawl, (1 - share) * crawl[-1] + share * walk[0], walk])
    # Without bent limbs, joints would be 0.2 m lower.
    assert cleanup(motion, FPS, SMPL22)[..., 1].min() > motion[..., 1].min() - 0.02


def test_toes_below_the_floor_are_lifted_without_a_jolt(clips):
    deep = np.repeat(clips[0].motion[:1], 120, 0)
    deep[50:62, :, 1] -= 0.06 * np.sin(np.linspace(0, np.pi, 12))[:, None] ** 2
    toes = [chain[-1] for chain in SMPL22.chains[:2]]
    after = cleanup(deep, FPS, SMPL22)
    assert deep[:, toes, 1].min() < -0.05
    assert after[:, toes, 1].min() > -0.012
    assert peak([after[:, toes]]) < peak([deep[:, toes]])


def test_the_floor_may_be_far_below_the_origin(clips):
    motion = clips[0].motion
    lower = motion - np.array([0, 0.9, 0], np.float32)
    after = cleanup(lower, FPS, SMPL22) + np.array([0, 0.9, 0], np.float32)
    np.testing.assert_allclose(after, cleanup(motion, FPS, SMPL22), atol=1e-5)


def test_contacts_of_the_features_find_feet_that_slide_fast():
    """The feet of a run slide about as fast as they would swing, so only the features tell which of them stand."""
    representation = HumanML(fps=FPS, skeleton="smpl22", variant="clean")
    clip = Synthetic(1000).clip(143, FPS)
    assert clip.attributes["action"] == "run"
    features = representation.encode(torch.from_numpy(clip.motion))
    contacts = representation.contacts(features)
    assert contacts is not None
    slides = representation.decode(features).numpy()
    slides[..., 2] += 1.8 / FPS * np.sin(2.5 * np.arange(len(slides)))[:, None]
    guessed, with_features = (
        skating([cleanup(slides, FPS, SMPL22, c)]) for c in (None, contacts.numpy())
    )
    assert guessed > 0.05
    assert with_features < 0.02


def test_a_foot_stands_from_the_first_frame_of_its_contact_to_the_frame_after_the_last():
    """A contact of frame 8 means that the foot stands from frame 8 to frame 9; the body slides by 6 mm per frame."""
    slides = posed(30, root=np.arange(30)[:, None] * [0.006, 0, 0] + [0, 0.955, 0])
    contacts = np.zeros((30, 4))
    contacts[8:16] = 1
    motion = cleanup(slides.joints, FPS, SMPL22, contacts)
    toe = motion[:, SMPL22.joints.index("left_foot")][:, [0, 2]]
    steps = np.linalg.norm(np.diff(toe, axis=0), axis=1)
    assert (steps[8:16] < 0.001).all(), "from frame 8 to frame 16"
    assert min(steps[7], steps[16]) > 0.008


def test_a_foot_that_is_in_contact_with_even_odds_is_held_too():
    slides = posed(30, root=np.arange(30)[:, None] * [0.006, 0, 0] + [0, 0.955, 0])
    moved = []
    for odds in (0.25, 0.5, 0.75):
        contacts = np.zeros((30, 4))
        contacts[8:16] = odds
        toe = cleanup(slides.joints, FPS, SMPL22, contacts)[:, SMPL22.joints.index("left_foot")]
        moved.append(np.linalg.norm(np.diff(toe[8:17, [0, 2]], axis=0), axis=1).mean())
    assert moved[2] <= moved[1] < 0.5 * moved[0]


def test_a_foot_that_lands_does_not_skate():
    motion = torch.full((3, 22, 3), 0.5)
    for toe in (10, 11):
        motion[:, toe, 0], motion[:, toe, 1] = torch.arange(3) / 10, torch.tensor([0.3, 0.0, 0.0])
    assert FootSkating(FPS).measure(motion).tolist() == [False, True]


def test_one_foot_that_slides_is_enough_to_skate():
    motion = torch.full((3, 22, 3), 0.5)
    motion[:, [10, 11], 1] = 0.0
    motion[:, 10, 0] = torch.tensor([0.0, 0.1, 0.1])
    assert FootSkating(FPS).measure(motion).tolist() == [True, False]


def test_hands_leave_the_body_without_a_jolt(clips):
    """Wrists of a walk are drawn 25 cm into the trunk and back within a second; all bones keep their lengths."""
    clip = next(clip for clip in clips if clip.attributes["action"] == "walk")
    motion = np.asarray(clip.motion, float)
    pull = np.exp(-(((np.arange(len(motion)) - 25) / 7) ** 2))[:, None, None]
    motion = motion + pull * (draw_in(motion, 25) - motion)
    after = cleanup(motion, FPS, SMPL22)
    kinds = [
        {fault.kind for fault in find_faults(Motion(x, FPS))} & {"inside", "pop"}
        for x in (motion, after)
    ]
    assert kinds == [{"inside"}, set()]
    jerk = [np.linalg.norm(np.diff(x, n=3, axis=0), axis=-1).mean() for x in (motion, after)]
    assert jerk[1] < 1.1 * jerk[0]
    assert np.ptp(bones(after), axis=0).max() < 1e-5


def test_any_length_and_skeleton(subtests):
    rng = np.random.default_rng(1)
    for (name, skeleton), frames in itertools.product(SKELETONS.items(), (1, 3, 4, 5, 40)):
        with subtests.test(frames=frames):
            joints = rng.normal(0, 0.3, (frames, len(skeleton), 3)).cumsum(0)
            after = cleanup(joints, 12.5, skeleton)
            assert after.shape == joints.shape, (name, frames)
            assert np.isfinite(after).all(), (name, frames)


def test_what_no_longer_fits_is_dropped(tmp_path):
    motion = synthetic("walk")
    motion.features, motion.contacts, motion.poses = (
        np.zeros((9, 263)),
        np.zeros((9, 4), bool),
        motion.posed(),
    )
    after = cleaned(motion)
    assert (motion.cleanup, after.cleanup, after.poses, after.contacts) == (False, True, None, None)
    assert not after.features.size
    after.save(tmp_path / "a.npz")
    assert np.load(tmp_path / "a.npz")["cleanup"]
