"""Cleanup of generated motion, on synthetic motions with known faults."""

import itertools

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d
from support.motions import posed, synthetic

from evaluators.metrics.attributes import read_attributes
from evaluators.metrics.physics import FootSkating
from evaluators.perturbations import draw_in
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.formats.cleanup import (
    _constant_bones,
    _contacts,
    _follow_feet,
    _keep_heights,
    _least_squares,
    _lift,
    _push_out,
    _smooth,
    bend,
    cleaned,
    cleanup,
)
from flame_mdm.formats.faults import depths, find_faults
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import JOINT, SKELETONS, SMPL22

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


def test_paths_are_those_of_whittaker_with_pops_cut_off():
    """A loop with dense matrices: 0.034 times squared third differences, and half a weight at 3 cm."""
    rng = np.random.default_rng(0)
    path = rng.normal(0, 0.01, (40, 3)).cumsum(0)
    path[20] += [0.3, 0.0, -0.2]
    third = np.diff(np.eye(40), n=3, axis=0)
    weight, expected = np.ones(40), path
    for _ in range(4):
        matrix = np.diag(weight) + 0.034 * third.T @ third
        expected = np.linalg.solve(matrix, weight[:, None] * path)
        weight = 1 / (1 + (np.linalg.norm(path - expected, axis=1) / 0.03) ** 2)
    np.testing.assert_allclose(_smooth(path[:, None])[:, 0], expected, atol=1e-9)


def test_bones_have_their_median_length_and_their_own_direction():
    motion = posed(5).joints.astype(float)
    elbow, wrist = (SMPL22.joints.index(f"left_{name}") for name in ("elbow", "wrist"))
    direction = np.array([0.6, 0.0, 0.8])
    motion[:, wrist] = motion[:, elbow] + np.outer([0.2, 0.2, 0.3, 0.7, 0.9], direction)
    bone = np.diff(_constant_bones(motion, SMPL22)[:, [elbow, wrist]], axis=1)[:, 0]
    np.testing.assert_allclose(bone, np.tile(0.3 * direction, (5, 1)), atol=1e-9)


@pytest.mark.parametrize("fps", [20.0, 30.0])
def test_a_toe_is_on_the_floor_if_it_is_low_and_slower_than_half_the_body(fps):
    """The left toe stands on the floor. The right toe moves at 0.25 m/s and then rises.

    The body becomes faster.
    """
    speeds = np.repeat([0.6, 1.2], [20, 19])
    root = np.zeros((40, 3))
    root[1:, 0] = speeds.cumsum() / fps
    toes = np.zeros((40, 2, 3))
    toes[..., 1] = 0.5  # of the floor
    toes[5, :, 1] = 0.2  # a glitch
    toes[:, 1, 2] = 0.25 * np.arange(40) / fps
    toes[10:, 1, 1] += np.repeat([0.035, 0.0, 0.08], 10)
    travel = gaussian_filter1d(speeds, 0.15 * fps, mode="nearest")
    slow = (1 - (0.25 / (0.5 + 0.5 * travel)) ** 2) ** 2
    low = (1 - 0.5**2) ** 2
    # From each frame to the next one: the greater height of both counts.
    expected = slow * np.array([1.0] * 9 + [low] * 11 + [1.0] * 9 + [0.0] * 10)
    contacts = _contacts(toes, root, fps, 0.5)
    np.testing.assert_allclose(contacts[:, 0], np.ones(39), atol=1e-9)
    np.testing.assert_allclose(contacts[:, 1], expected, atol=1e-9)


def test_feet_may_slide_with_half_of_the_body_before_and_two_fifths_after_it_follows_them(
    monkeypatch,
):
    shares = []

    def recorded(toes: np.ndarray, root: np.ndarray, fps: float, share: float) -> np.ndarray:
        shares.append(share)
        return _contacts(toes, root, fps, share)

    monkeypatch.setattr("flame_mdm.formats.cleanup._contacts", recorded)
    cleanup(synthetic("walk").joints[:8], FPS, SMPL22)
    assert shares == [0.5, 0.4]


def test_the_shift_of_a_foot_is_a_least_squares_solution():
    """Steps of planted feet count 30, positions 0.03, and second differences 0.1. The body slides by 6 mm per frame."""
    slides = posed(30, root=np.arange(30)[:, None] * [0.006, 0, 0] + [0, 0.955, 0])
    contacts = np.zeros((30, 4))
    contacts[8:16] = 0.5  # counts half
    first, second = (np.diff(np.eye(30), n=order, axis=0) for order in (1, 2))
    weight = np.zeros(29)
    weight[8:16] = 30 * 0.5
    matrix = first.T @ (weight[:, None] * first) + 0.03 * np.eye(30) + 0.1 * second.T @ second
    shift = np.linalg.solve(matrix, first.T @ (weight * -0.006))
    toe = SMPL22.joints.index("left_foot")
    moved = cleanup(slides.joints, FPS, SMPL22, contacts)[:, toe] - slides.joints[:, toe]
    np.testing.assert_allclose(moved[:, 0], shift, atol=1e-4)
    np.testing.assert_allclose(moved[:, 2], 0, atol=1e-4)


@pytest.mark.parametrize("fps", [20.0, 30.0])
@pytest.mark.parametrize("speed", [0.19, 0.22, 0.25, 0.28, 0.4])
def test_a_body_that_slides_fast_follows_its_feet(fps, speed):
    """The legs compensate for slow drifts of up to 0.2 m/s, and for none above 0.3 m/s."""
    motion = np.zeros((60, 3, 3))
    motion[:, 0, 1] = 1.0
    motion[..., 0] = speed / fps * np.arange(60)[:, None]
    followed = np.diff(_follow_feet(motion, [1, 2], fps)[:, :, 0], axis=0) * fps
    weight = 2 * (1 - (speed / (0.5 + 0.5 * speed)) ** 2) ** 2
    drift = speed * weight / (weight + 0.01)
    expected = speed - drift * np.clip(2 * drift / 0.2 - 2, 0, 1)
    np.testing.assert_allclose(followed[25:35], expected, rtol=1e-3, atol=1e-4)


def test_of_two_feet_that_slide_the_slower_one_counts_more_at_any_rate():
    """The body moves at 0.35 m/s over feet that slide at 0.25 and 0.6 m/s."""
    speeds = []
    for fps in (20.0, 30.0, 60.0):
        motion = np.zeros((80, 3, 3))
        motion[:, 0, 1] = 1.0
        motion[..., 0] = np.outer(np.arange(80) / fps, [0.35, 0.25, 0.6])
        followed = _follow_feet(motion, [1, 2], fps)[:, 1, 0]
        speeds.append(np.diff(followed)[35:45].mean() * fps)
    assert speeds == pytest.approx([0.1198] * 3, abs=1e-4)


def test_a_leg_is_stretched_to_999_thousandths_and_its_knee_stays_in_front():
    motion = np.array([[[0, 1.0, 0], [0, 0.6, 0.3], [0, 0.2, 0], [0, 0.2, 0.1]]] * 3)
    shift = np.array([[0, 0, 0], [0, 0.1, 0.0], [0, -9.0, 0]])
    bent = motion.copy()
    bend(bent, [0, 1, 2, 3], shift)
    np.testing.assert_allclose(bent[0], motion[0], atol=1e-9)
    np.testing.assert_allclose(bent[1, 2:], motion[1, 2:] + shift[1], atol=1e-9)
    np.testing.assert_allclose(bent[1, 1], [0, 0.65, np.sqrt(0.25 - 0.35**2)], atol=1e-9)
    np.testing.assert_allclose(bent[2, 2], [0, 1 - 0.999, 0], atol=1e-9)
    np.testing.assert_allclose(bent[2, 3] - bent[2, 2], [0, 0, 0.1], atol=1e-9)


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


@pytest.mark.parametrize(("fps", "reach"), [(20.0, 9), (40.0, 18)])
def test_a_hand_begins_to_avoid_the_body_half_a_second_before(fps, reach):
    """The shift of one frame is held for 0.15 s before and after it, and fades over four times half of that."""
    walk = synthetic("walk").joints[:1].astype(float)
    motion = np.repeat(walk, 81, axis=0)
    motion[40] = draw_in(walk, 25)[0]
    before = motion.copy()
    for side in ("left", "right"):
        _push_out(motion, SMPL22, side, fps)
    moved = np.flatnonzero(np.abs(motion - before).max((1, 2)) > 1e-9)
    assert (moved.min(), moved.max()) == (40 - reach, 40 + reach)


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


def test_least_squares_are_those_of_the_dense_matrices():
    rng = np.random.default_rng(0)
    rows, values, terms = [], [], []
    for order in (0, 1, 2, 3):
        weight, target = rng.uniform(0.1, 2, 12 - order), rng.normal(size=(12 - order, 2))
        terms.append((order, weight, target))
        rows.append(np.sqrt(weight)[:, None] * np.diff(np.eye(12), n=order, axis=0))
        values.append(np.sqrt(weight)[:, None] * target)
    expected = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
    np.testing.assert_allclose(_least_squares(12, *terms), expected, atol=1e-9)


def test_a_bent_leg_moves_its_foot_by_the_shift_and_keeps_its_bones():
    joints = posed(5, left_hip=(-30, 0, 0), left_knee=(60, 0, 0)).joints.astype(float)
    moved, leg = joints.copy(), [1, 4, 7, 10]
    shift = np.linspace(0, 1, 5)[:, None] * [0.05, 0.1, -0.04]
    bend(moved, leg, shift)
    np.testing.assert_allclose(moved[:, [7, 10]], joints[:, [7, 10]] + shift[:, None], atol=1e-9)
    for parent, joint in ((1, 4), (4, 7), (7, 10)):
        before, after = (
            np.linalg.norm(of[:, joint] - of[:, parent], axis=1) for of in (joints, moved)
        )
        np.testing.assert_allclose(after, before, atol=1e-9)
    others = [joint for joint in range(22) if joint not in leg[1:]]
    np.testing.assert_array_equal(moved[:, others], joints[:, others])
    assert (moved[:, 4, 2] > joints[:, 7, 2]).all(), "the knee stays in front"


def test_a_foot_that_longer_bones_push_down_is_raised_to_its_height():
    crouched = posed(5, left_hip=(-40, 0, 0), left_knee=(60, 0, 0), left_ankle=(-20, 0, 0))
    before = crouched.joints.astype(float)
    motion = before.copy()
    toe, ankle = JOINT["left_foot"], JOINT["left_ankle"]
    motion[:, toe, 1] -= np.array([0, 0.02, 0.05, 0.02, 0])  # only the foot is longer
    _keep_heights(motion, before, SMPL22)
    np.testing.assert_allclose(motion[:, toe, 1], before[:, toe, 1], atol=1e-6)
    raised = [0, 0.02, 0.05, 0.02, 0]
    np.testing.assert_allclose(motion[:, ankle, 1] - before[:, ankle, 1], raised, atol=1e-6)
    others = [joint for joint in range(22) if joint not in (JOINT["left_knee"], ankle, toe)]
    np.testing.assert_array_equal(motion[:, others], before[:, others])
    # A foot that bones push up is not lowered.
    higher = before + np.array([0, 0.1, 0])
    expected = higher.copy()
    _keep_heights(higher, before, SMPL22)
    np.testing.assert_array_equal(higher, expected)


@pytest.mark.parametrize(("height", "is_lifted"), [(0.4, False), (0.0, True)])
def test_toes_are_lifted_to_the_floor_but_not_in_the_air(height: float, is_lifted: bool):
    """A body that hangs has no floor above y = 0."""
    bent = 1 - np.sin(np.clip((np.arange(200) - 90) / 18, 0, 1) * np.pi) ** 2
    hips, knees = (np.array([degrees, 0, 0]) * bent[:, None] for degrees in (-50, 80))
    toes = [JOINT["left_foot"], JOINT["right_foot"]]
    joints = posed(
        200, left_hip=hips, left_knee=knees, right_hip=(-50, 0, 0), right_knee=(80, 0, 0)
    )
    moved = joints.joints.astype(float)
    moved[..., 1] += height - np.percentile(moved[:, toes, 1].min(1), 10)
    assert moved[:, toes, 1].min() < height - 0.1  # the left leg hangs down for a moment
    lowest = cleanup(moved, 20.0, SMPL22)[:, toes, 1].min() - height
    assert (lowest > -0.02) == is_lifted


@pytest.mark.parametrize("down", [0.0, 0.2, -0.3, -0.58, -0.65])
def test_a_bent_leg_keeps_its_bones_wherever_its_foot_is_moved(down: float):
    leg = np.array([[[0, 0.8, 0], [0, 0.4, 0.1], [0, 0.12, 0], [0, 0.05, 0.1]]], float)
    thigh, shin, foot = (np.linalg.norm(bone) for bone in np.diff(leg[0], axis=0))
    moved = leg.copy()
    bend(moved, [0, 1, 2, 3], np.array([[0, -down, 0.0]]))
    np.testing.assert_array_equal(moved[0, 0], leg[0, 0])
    lengths = [np.linalg.norm(bone) for bone in np.diff(moved[0], axis=0)]
    np.testing.assert_allclose(lengths, [thigh, shin, foot], atol=1e-9)
    assert moved[0, 1, 2] >= -1e-9  # the knee stays in front
    distance = 0.68 + down
    if abs(thigh - shin) + 1e-3 < distance < 0.999 * (thigh + shin):
        np.testing.assert_allclose(moved[0, 2], [0, 0.12 - down, 0], atol=1e-9)


@pytest.mark.parametrize(("depth", "lifted"), [(0.005, 0.0), (0.01, 0.0), (0.04, 0.03)])
def test_a_toe_is_lifted_to_one_centimeter_below_the_floor(depth: float, lifted: float):
    crouched = posed(9, left_hip=(-40, 0, 0), left_knee=(60, 0, 0), left_ankle=(-20, 0, 0))
    before = crouched.joints.astype(float)
    toe = JOINT["left_foot"]
    before[..., 1] -= before[:, toe, 1].min() + depth - 0.2
    motion = before.copy()
    leg = next(chain[1:] for chain in SMPL22.chains if chain[-1] == toe)
    _lift(motion, leg, 0.2)
    np.testing.assert_allclose(motion[4, toe] - before[4, toe], [0, lifted, 0], atol=1e-3)


@pytest.mark.parametrize(("side", "other"), [("left", "right"), ("right", "left")])
def test_a_contact_of_a_toe_holds_this_foot_alone(side: str, other: str):
    slides = posed(30, root=np.arange(30)[:, None] * [0.006, 0, 0] + [0, 0.955, 0])
    contacts = np.zeros((30, 4))
    contacts[8:16, SMPL22.feet.index(JOINT[f"{side}_foot"])] = 1
    motion = cleanup(slides.joints, FPS, SMPL22, contacts)
    held, free = (
        np.linalg.norm(np.diff(motion[8:17, JOINT[f"{name}_foot"]][:, [0, 2]], axis=0), axis=1)
        for name in (side, other)
    )
    assert held.max() < 0.001
    assert free.min() > 0.005


@pytest.mark.parametrize(("side", "sign"), [("left", 1), ("right", -1)])
def test_a_hand_in_the_body_leaves_it_away_from_the_axis_and_to_its_own_side(
    monkeypatch, side: str, sign: int
):
    joints = np.tile(posed(1).joints.astype(float), (9, 1, 1))
    wrist, elbow = JOINT[f"{side}_wrist"], JOINT[f"{side}_elbow"]
    joints[:, wrist] = (joints[:, 0] + joints[:, JOINT["neck"]]) / 2 + [0, 0, 0.03]
    joints[:, elbow] = joints[:, wrist] + [0, 0, 0.25]
    depth, away = depths(joints, SMPL22.joints, side)
    assert depth[0, 1] > depth[0, 2]  # the wrist is deeper than the hand
    shifts: list[np.ndarray] = []
    monkeypatch.setattr(
        "flame_mdm.formats.cleanup.bend", lambda motion, arm, shift: shifts.append(shift)
    )
    _push_out(joints, SMPL22, side, FPS)
    direction = away[4, 1] + 0.7 * sign * np.array([1.0, 0, 0])
    expected = depth[4, 1] * direction / np.linalg.norm(direction)
    np.testing.assert_allclose(shifts[0][4], expected, atol=2e-3)


def with_hands(joints: np.ndarray) -> np.ndarray:
    """Joints (F, 24, 3) of a body with hands, 8 cm beyond the wrists."""
    hands = []
    for side in ("left", "right"):
        elbow, wrist = (joints[:, JOINT[f"{side}_{name}"]] for name in ("elbow", "wrist"))
        along = (wrist - elbow) / np.linalg.norm(wrist - elbow, axis=-1, keepdims=True)
        hands.append(wrist + 0.08 * along)
    return np.concatenate([joints, np.stack(hands, 1)], 1)


def test_a_hand_moves_with_its_wrist_out_of_the_body():
    walk = synthetic("walk").joints[:1].astype(float)
    joints = np.repeat(walk, 40, axis=0)
    joints[20] = draw_in(walk, 25)[0]
    skeleton, motion = SKELETONS["smpl24"], with_hands(joints)
    before = motion.copy()
    for number, side in enumerate(("left", "right")):
        _push_out(motion, skeleton, side, FPS)
        wrist, hand = JOINT[f"{side}_wrist"], 22 + number
        moved = motion[20, wrist] - before[20, wrist]
        assert np.linalg.norm(moved) > 0.005
        np.testing.assert_allclose(
            motion[:, hand] - before[:, hand], motion[:, wrist] - before[:, wrist]
        )


def test_a_hand_that_longer_bones_push_down_is_raised_to_its_height():
    before = with_hands(posed(5, left_elbow=(0, -60, 0)).joints.astype(float))
    motion, wrist = before.copy(), JOINT["left_wrist"]
    lowered = np.array([0, 0.02, 0.05, 0.02, 0])
    motion[:, [wrist, 22], 1] -= lowered[:, None]
    motion[:, 22, 1] -= 0.01 * (lowered > 0)  # the hand is lower than the wrist
    _keep_heights(motion, before, SKELETONS["smpl24"])
    ends = motion[:, [wrist, 22], 1].min(1)
    np.testing.assert_allclose(ends, before[:, [wrist, 22], 1].min(1), atol=1e-6)
    others = [joint for joint in range(24) if joint not in (JOINT["left_elbow"], wrist, 22)]
    np.testing.assert_array_equal(motion[:, others], before[:, others])
