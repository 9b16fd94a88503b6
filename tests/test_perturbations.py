"""Perturbations of real motions, against closed forms."""

import numpy as np
import pytest
import torch

from evaluators import perturbations as p
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.formats.faults import find_faults
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.humanml import HumanML


@pytest.fixture(scope="module")
def walk() -> np.ndarray:
    made = Synthetic(clips=40, seed=1).clips(20.0)
    clip = next(clip for clip in made if clip.attributes["action"] == "walk")
    return np.asarray(clip.motion, np.float64)


def draws() -> np.random.Generator:
    return np.random.default_rng(0)


def test_jitter_has_the_given_deviation_and_wobble_is_a_slow_sine(walk):
    weak, strong = (p.jitter(walk, sigma, draws()) - walk for sigma in (5, 20))
    assert weak.std() == pytest.approx(0.005, rel=0.03)
    np.testing.assert_allclose(4 * weak, strong, atol=1e-12)
    offset = p.wobble(walk, 20, draws(), fps=20.0) - walk
    np.testing.assert_allclose(offset[20:], offset[:-20], atol=1e-12)  # a period of one second
    assert np.linalg.norm(offset, axis=-1).max() <= 0.02 + 1e-12
    assert np.linalg.norm(offset[:20], axis=-1).max(0).min() > 0.0195


def test_skating_multiplies_the_speed_of_the_root_and_resizing_scales_all_bones(walk):
    changed = p.skate(walk, 1.5)
    np.testing.assert_allclose(changed - changed[:, :1], walk - walk[:, :1], atol=1e-12)
    steps = np.diff(changed[:, 0], axis=0)
    np.testing.assert_allclose(steps[:, [0, 2]], 1.5 * np.diff(walk[:, 0], axis=0)[:, [0, 2]], atol=1e-12)
    np.testing.assert_array_equal(changed[..., 1], walk[..., 1])
    changed, skeleton = p.resize(walk, 10), HumanML().skeleton
    ours, theirs = (skeleton.bones(torch.from_numpy(x))[:, 1:].norm(dim=-1) for x in (changed, walk))
    torch.testing.assert_close(ours, 1.1 * theirs)
    np.testing.assert_allclose(changed[:, 0, [0, 2]], walk[:, 0, [0, 2]])
    np.testing.assert_allclose(changed[..., 1], 1.1 * walk[..., 1])


def test_wrists_are_drawn_into_the_trunk_and_a_pop_displaces_one_frame(walk):
    changed = p.draw_in(walk, 10) - walk
    np.testing.assert_allclose(
        np.linalg.norm(changed[:, [18, 19, 20, 21]], axis=-1), [[0.05, 0.05, 0.1, 0.1]] * len(walk)
    )
    assert not np.delete(changed, [18, 19, 20, 21], 1).any()
    kinds = [{fault.kind for fault in find_faults(Motion(p.draw_in(walk, grade), 20.0))} for grade in (0, 40)]
    assert ["inside" in kind for kind in kinds] == [False, True]
    for last in (False, True):
        offset = p.pop(walk, 5, draws(), last=last) - walk
        (frame,) = np.unique(np.nonzero(offset)[0])
        assert frame == len(walk) - 1 if last else 0 < frame < len(walk) - 1
        np.testing.assert_allclose(np.linalg.norm(offset[frame], axis=-1), 0.05)
        assert np.ptp(offset[frame], axis=0).max() < 1e-12


def test_freezing_cropping_speeds_and_frame_rates(walk):
    for percent, moving in ((10, 18), (50, 10), (100, 1)):
        frozen = p.freeze(walk[:20], percent)
        np.testing.assert_array_equal(frozen[:moving], walk[:moving])
        np.testing.assert_array_equal(frozen[moving:], np.repeat(walk[moving - 1 : moving], 20 - moving, 0))
    np.testing.assert_array_equal(p.crop(walk[:40], 25), walk[:30])
    assert len(p.crop(walk[:4], 90)) == 3

    ramp = np.arange(22.0)[:, None, None] * np.ones((1, 2, 3))
    np.testing.assert_allclose(p.play(ramp[:21], 2, 20.0)[:, 0, 0], np.arange(0, 21, 2))
    np.testing.assert_allclose(p.play(ramp[:21], 0.5, 20.0)[:, 0, 0], np.arange(21) / 2)
    for rate in (30, 15, 10):
        back = p.through_rate(ramp, rate, 20.0)
        assert len(back) == len(ramp)
        np.testing.assert_allclose(back[:20], ramp[:20], atol=1e-9)


def test_the_other_half_begins_where_the_first_ends_and_becomes_the_other(walk):
    other = walk[::-1] + 1.0
    joined = p.continue_with(walk[:40], other, 20.0)
    np.testing.assert_array_equal(joined[:20], walk[:20])
    assert np.linalg.norm(joined[20] - joined[19], axis=-1).max() < 0.3
    rest = other[len(other) // 2 :][8:20]  # after 0.4 seconds
    np.testing.assert_allclose(np.diff(joined[28:40], axis=0), np.diff(rest, axis=0), atol=1e-12)


def test_encoding_keeps_frames_heights_and_features():
    representation = HumanML()
    motion = torch.from_numpy(np.asarray(next(Synthetic(clips=1, seed=2).clips(20.0)).motion, np.float64))
    features = representation.encode(motion)
    joints = representation.decode(features).double().numpy()
    (again,) = p.encode(representation, [joints])
    assert again.shape == features.shape
    # The smoothed heading depends on the last frame, which is continued.
    np.testing.assert_allclose(again[:-1], features[:-1].numpy(), atol=1e-2)
    for meters in (-0.05, 0.05):  # lifted motions keep their height
        (encoded,) = p.encode(representation, [p.lift(joints, 100 * meters)])
        offset = representation.decode(torch.from_numpy(encoded)).numpy() - joints
        np.testing.assert_allclose(offset, np.broadcast_to([0, meters, 0], joints.shape), atol=1e-4)


def test_names_and_grades_are_unique_and_ordered_by_strength():
    assert len({perturbation.name for perturbation in p.PERTURBATIONS}) == len(p.PERTURBATIONS)
    for perturbation in p.PERTURBATIONS:
        grades = list(perturbation.grades)
        assert sorted(grades, reverse=grades[-1] < grades[0]) == grades
