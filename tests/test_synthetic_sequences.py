"""Synthetic clips in which one motion goes over into the next: no jump where they meet, true captions, one body."""

import hashlib
import json

import numpy as np
import pytest

from flame_mdm.data import Clip
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.data.synthetic_motions.body import Body
from flame_mdm.data.synthetic_motions.joining import frames_of, join
from flame_mdm.data.synthetic_sequences import SyntheticSequences
from flame_mdm.representations.skeleton import SMPL22

FPS = 20
PARENTS = list(SMPL22.parents)


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    return list(SyntheticSequences(240, seed=2, workers=1).clips(FPS))


def walking(seconds: float) -> Body:
    """A body that stands, and whose place, heading and feet move at an even speed."""
    t = np.arange(round(seconds * FPS) + 1) / FPS
    body = Body(np.random.default_rng(0), t)
    body.position[:, 2] = t
    body.ankles[..., 2] += t
    body.heading = 0.5 * t
    return body


def test_the_second_motion_goes_on_from_the_place_and_heading_of_the_first():
    first, second = walking(1.0), walking(2.0)
    joined = join(first, second)
    assert len(joined.t) == len(first.t) + len(second.t) - 1
    np.testing.assert_allclose(joined.heading[[20, 60]], [0.5, 1.5], atol=1e-12)
    np.testing.assert_array_equal(joined.position[:20], first.position[:20])
    # The second motion walks 2 m ahead, in the heading of 0.5 in which the first one ends.
    moved = joined.position[-1] - joined.position[20]
    np.testing.assert_allclose(moved[[0, 2]], [2 * np.sin(0.5), 2 * np.cos(0.5)], atol=0.02)


def test_a_difference_of_angles_fades_and_heights_are_not_added():
    first, second = walking(1.0), walking(2.0)
    first.arms[0, 0] = 1.0
    second.arms[0, 0] = 0.2
    first.position[:, 1], second.position[:, 1] = 0.6, 0.9
    joined = join(first, second, blend=0.5)
    np.testing.assert_allclose(joined.arms[0, 0, [0, 20, 31, 60]], [1.0, 1.0, 0.2, 0.2], atol=1e-9)
    np.testing.assert_allclose(joined.position[[0, 20, 31, 60], 1], [0.6, 0.6, 0.9, 0.9], atol=1e-9)


def test_a_foot_that_stands_elsewhere_takes_a_step():
    first, second = walking(0.5), walking(2.0)
    second.ankles[1, :, 0] -= 0.2
    joined = join(first, second, blend=0.5)
    start = first.ankles[1, -1]
    rise = joined.ankles[1, :, 1].max() - start[1]
    assert 0.05 < rise < 0.08
    assert joined.ankles[0, :, 1].max() == pytest.approx(start[1])


def test_bones_keep_their_length_between_a_plank_and_a_standing_body():
    """Clip 105 goes from a plank to a turn, in which a foot cannot reach its footprint."""
    motion = SyntheticSequences(240, seed=2, workers=1).clip(105, FPS).motion
    bones = np.linalg.norm(motion[:, 1:] - motion[:, PARENTS[1:]], axis=-1)
    np.testing.assert_allclose(bones, np.tile(bones[0], (len(bones), 1)), atol=2e-6)


def test_a_body_that_is_played_backward_shows_the_same_poses():
    body = walking(1.0)
    backward = frames_of(body, np.arange(len(body.t))[::-1])
    np.testing.assert_array_equal(backward.joints(), body.joints()[::-1])


def test_a_clip_depends_on_seed_and_number_alone(clips: list[Clip]):
    again = SyntheticSequences(10, seed=2, workers=1).clip(7, FPS)
    assert (again.id, again.captions) == (clips[7].id, clips[7].captions)
    np.testing.assert_array_equal(again.motion, clips[7].motion)
    other = SyntheticSequences(10, seed=3, workers=1).clip(7, FPS)
    assert other.id != clips[7].id


def test_the_clips_do_not_change():
    """Models were trained on them. Each number is a weighted sum of the joints of a clip."""
    source = SyntheticSequences(1, seed=3, workers=1)
    few = [source.clip(number, 10) for number in range(16)]
    said = json.dumps(
        [[clip.id, clip.captions, clip.split, clip.action, clip.attributes] for clip in few]
    )
    assert hashlib.sha256(said.encode()).hexdigest()[:16] == "06bdeec4473d7b9b"
    lengths = [36, 44, 36, 39, 59, 29, 34, 34, 59, 32, 31, 56, 52, 49, 46, 35]
    assert [len(clip.motion) for clip in few] == lengths
    values = [clip.motion.astype(float).ravel() for clip in few]
    sums = [joints @ np.linspace(-1, 2, len(joints)) for joints in values]
    expected = [441.409, 1324.9022, 232.7405, 516.3413, 1099.5975, 831.1498, 651.7075, 773.9362]
    expected += [582.0907, 454.0531, 481.3932, 765.9159, 1975.1338, 588.552, 1486.1439, 356.9638]
    np.testing.assert_allclose(sums, expected, atol=3e-4)


def test_nothing_jumps_where_motions_meet(clips: list[Clip]):
    """No joint has a larger speed or jerk than in clips with one motion, which have no seam."""
    single = [Synthetic(240, seed=2, actions="all").clip(n, FPS).motion for n in range(240)]

    def largest(motions: list[np.ndarray], order: int) -> float:
        steps = [np.linalg.norm(np.diff(m, n=order, axis=0), axis=-1).max() for m in motions]
        return max(steps) * FPS**order

    joined = [clip.motion for clip in clips]
    assert largest(joined, 1) < 1.2 * largest(single, 1)
    assert largest(joined, 3) < 1.2 * largest(single, 3)


def test_one_body_that_begins_at_the_origin_and_stays_above_the_floor(clips: list[Clip]):
    motion = clips[0].motion
    first = np.linalg.norm(motion[:1, 1:] - motion[:1, PARENTS[1:]], axis=-1)
    for clip in clips:
        assert len(clip.motion) >= 51, clip.id
        np.testing.assert_allclose(clip.motion[0, 0, [0, 2]], 0, atol=1e-6)
        # Knees get up to 6 cm below the floor on the way into a plank and out of it, toes do not.
        assert clip.motion[..., 1].min() > -0.07, clip.id
        assert clip.motion[:, [10, 11], 1].min() > -1e-6, clip.id
        bones = np.linalg.norm(clip.motion[:, 1:] - clip.motion[:, PARENTS[1:]], axis=-1)
        np.testing.assert_allclose(bones, np.tile(first, (len(bones), 1)), atol=2e-6)


def test_planted_feet_do_not_slide(clips: list[Clip]):
    """Of all frames in which a toe joint rests on the floor, nearly none moves it by more than a centimeter."""
    moved = []
    for clip in clips:
        toes = clip.motion[:, [10, 11]]
        resting = (toes[1:, :, 1] < 1e-4) & (toes[:-1, :, 1] < 1e-4)
        moved.append(np.linalg.norm(np.diff(toes[..., [0, 2]], axis=0), axis=-1)[resting])
    assert len(np.concatenate(moved)) > 140 * FPS
    assert (np.concatenate(moved) > 0.01).mean() < 0.01


def test_who_walks_does_not_stop_and_who_sits_stays_seated(clips: list[Clip], subtests):
    walks = [clip for clip in clips if clip.attributes.get("direction") == "forward"]
    walks = [c for c in walks if c.attributes["action"] == "walk" and "while" not in c.attributes]
    assert len(walks) > 2
    for clip in walks:
        with subtests.test(clip=clip.id):
            speed = np.linalg.norm(np.diff(clip.motion[-12:, 0, [0, 2]], axis=0), axis=-1) * FPS
            assert speed.min() > 0.3, clip.id
    sits = [clip for clip in clips if clip.attributes["action"] in ("sit", "seated", "type")]
    assert len(sits) > 2
    for clip in sits:
        with subtests.test(clip=clip.id):
            assert (clip.motion[-5:, 0, 1] < 0.65).all(), clip.id


def test_motions_follow_others_in_every_posture(clips: list[Clip]):
    heights = np.array([clip.motion[0, 0, 1] for clip in clips])
    assert (heights < 0.3).any(), "nobody lies at the beginning"
    assert ((heights > 0.5) & (heights < 0.65)).any(), "nobody sits at the beginning"
    moving = [np.linalg.norm(np.diff(c.motion[:6], axis=0), axis=-1).max() * FPS for c in clips]
    assert np.mean(np.array(moving) > 1.0) > 0.2, "few clips begin in motion"
