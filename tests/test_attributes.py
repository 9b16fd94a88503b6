"""Attributes read back from joints, and the skating of feet."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from evaluators.metrics.attributes import ATTRIBUTES, AttributeAccuracy, read_attributes, right_attributes
from evaluators.metrics.physics import FootSkating
from flame_mdm.data import Clip
from flame_mdm.data.synthetic import Synthetic, prompts
from flame_mdm.formats.faults import find_faults
from flame_mdm.formats.motion import Motion

FPS = 20


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    return list(Synthetic(300, seed=20_000).clips(FPS))


def accuracy(motions: list[np.ndarray], requested: list[dict]) -> dict[str, float | None]:
    metric = AttributeAccuracy(FPS)
    for motion, attributes in zip(motions, requested, strict=True):
        metric.update(torch.tensor(motion)[None], torch.ones(1, len(motion), dtype=torch.bool), [attributes])
    return metric.compute()


def generated(motion: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Spoils a motion as small models do: 1.5 cm of drift a joint, sliding, 5 mm of jitter, another size."""
    drift = gaussian_filter1d(rng.normal(size=motion.shape), 4, axis=0)
    slide = gaussian_filter1d(rng.normal(size=(len(motion), 1, 3)), 8, axis=0) * [1, 0, 1]
    jitter = rng.normal(0, 0.005, motion.shape)
    return motion * rng.uniform(0.95, 1.05) + 0.015 * drift / drift.std() + 0.025 * slide / slide.std() + jitter


def test_the_ground_truth_and_noisy_motions_are_read_right(clips: list[Clip]):
    rng, requested = np.random.default_rng(0), [dict(clip.attributes) for clip in clips]
    for motions, least in (
        ([clip.motion for clip in clips], 0.99),
        ([generated(clip.motion, rng) for clip in clips], 0.95),
    ):
        shares = accuracy(motions, requested)
        assert all(share is not None and share >= least for share in shares.values()), shares


def test_place_heading_and_frame_rate_do_not_matter(clips: list[Clip]):
    turn, shift = np.array([[0.6, 0, 0.8], [0, 1, 0], [-0.8, 0, 0.6]]), np.array([3.0, 0.0, -5.0])
    for clip in clips[:60]:
        assert clip.attributes.items() <= read_attributes(clip.motion @ turn.T + shift, FPS).items()
    for clip in Synthetic(60, seed=20_000).clips(30):
        assert clip.attributes.items() <= read_attributes(clip.motion, 30).items()


def test_a_mirrored_motion_shows_the_other_side(clips: list[Clip]):
    swap = [0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 12, 14, 13, 15, 17, 16, 19, 18, 21, 20]
    other = {"left": "right", "clockwise": "counterclockwise"}
    other |= {value: key for key, value in other.items()}
    for clip in clips[:100]:
        mirrored = clip.motion[:, swap] * np.array([-1, 1, 1])
        expected = {name: other.get(str(value), value) for name, value in clip.attributes.items()}
        assert expected.items() <= read_attributes(mirrored, FPS).items()


def test_noise_and_frozen_bodies_do_not_score(clips: list[Clip]):
    rng = np.random.default_rng(0)
    requested = [dict(clip.attributes) for clip in clips if clip.attributes["action"] != "stand"]
    noise = [rng.normal(0, 0.5, (50, 22, 3)) for _ in requested]
    walk = [rng.normal(0, 0.05, (50, 22, 3)).cumsum(0) for _ in requested]
    for motions in (noise, walk, [np.zeros((50, 22, 3))] * len(requested)):
        assert set(accuracy(motions, requested).values()) == {0.0}
    way = np.linspace(0, 2.5, 50)[:, None, None] * np.array([0, 0, 1])
    assert [read_attributes(clip.motion[:1] + way, FPS) for clip in clips[:20]] == [{}] * 20, "gliding is no walk"
    shaking = [clips[0].motion[:1] + rng.normal(0, 0.08, (50, 22, 3)) for _ in requested]
    assert set(accuracy(shaking, requested).values()) == {0.0}
    frozen = [clip.motion[len(clip.motion) // 2].repeat(50, 0).reshape(22, 50, 3).swapaxes(0, 1) for clip in clips]
    frozen = [motion for motion, clip in zip(frozen, clips, strict=True) if clip.attributes["action"] != "stand"]
    shares = accuracy(frozen, requested)
    assert shares["all"] is not None
    assert shares["all"] < 0.06, "a single pose shows a bow at best"


def test_requests_for_the_wrong_thing_do_not_score(clips: list[Clip]):
    waves = [clip for clip in clips if clip.attributes["action"] == "wave" and clip.attributes.get("side") == "left"]
    shares = accuracy([clip.motion for clip in waves], [{"action": "wave", "side": "right"}] * len(waves))
    missing = dict.fromkeys(("count", "direction", "speed", "amount"))
    assert shares == {"action": 1.0, "side": 0.0, "action_and_side": 0.0, "all": 0.0} | missing


def test_all_attributes_are_all():
    requested = {"action": "kick", "side": "left", "count": 2}
    right = right_attributes({"action": "kick", "side": "left", "count": 3}, requested)
    assert right == {"action": True, "side": True, "count": False, "action_and_side": True, "all": False}
    assert right_attributes(requested, requested)["all"]
    assert right_attributes({"action": "run"}, {"action": "run"})["action_and_side"], "without a side"


def test_padding_and_batching_do_not_matter(clips: list[Clip]):
    few = clips[:8]
    frames = max(len(clip.motion) for clip in few) + 7
    joints, mask = torch.full((8, frames, 22, 3), float("nan")), torch.zeros(8, frames, dtype=torch.bool)
    for row, clip in enumerate(few):
        joints[row, : len(clip.motion)], mask[row, : len(clip.motion)] = torch.tensor(clip.motion), True
    metric = AttributeAccuracy(FPS)
    metric.update(joints, mask, [clip.attributes for clip in few])
    assert metric.compute() == accuracy([clip.motion for clip in few], [dict(clip.attributes) for clip in few])


def test_only_attributes_can_be_requested():
    assert all(set(requested) <= set(ATTRIBUTES) for _, requested in prompts())
    metric, joints, mask = AttributeAccuracy(FPS), torch.zeros(1, 30, 22, 3), torch.ones(1, 30, dtype=torch.bool)
    with pytest.raises(ValueError, match="mood"):
        metric.update(joints, mask, [{"action": "walk", "mood": "happy"}])
    with pytest.raises(ValueError, match="1 motions but 2"):
        metric.update(joints, mask, [{"action": "walk"}] * 2)


def skating(toe: np.ndarray, fps: float = FPS, real: int | None = None) -> float | None:
    """Ratio of a body whose left toes follow `toe` (F, 3) while all else stands."""
    joints = torch.zeros(1, len(toe), 22, 3)
    joints[0, :, 10] = torch.tensor(toe, dtype=torch.float32)
    metric = FootSkating(fps)
    metric.update(joints, torch.arange(len(toe))[None] < (len(toe) if real is None else real))
    return metric.compute()


def test_planted_feet_do_not_skate_and_sliding_feet_do():
    way = np.arange(40)[:, None] * np.array([0.6, 0.8, 0.8])
    on_floor, high = np.array([1, 0, 1]), np.array([0, 0.06, 0])
    assert skating(0 * way) == 0
    assert skating(0.026 * way * on_floor) == 1
    assert skating(0.024 * way * on_floor) == 0
    assert skating(0.026 * way * on_floor + high) == 0
    assert skating(0.026 * way * on_floor, fps=10) == 0
    half = np.where(np.arange(40)[:, None] <= 13, 0, way - way[13])
    assert skating(0.05 * half * on_floor) == pytest.approx(26 / 39)
    assert skating(0.05 * half * on_floor, real=14) == 0
    assert skating(way, real=1) is None


def test_the_fault_of_sliding_toes_is_what_the_metric_counts():
    for speed, high, skates in ((0.52, 0, True), (0.48, 0, False), (0.52, 0.06, False)):
        joints = np.zeros((40, 22, 3))
        joints[:, 10] = np.arange(40)[:, None] * speed / FPS * np.array([1, 0, 0]) + np.array([0, high, 0])
        assert skating(joints[:, 10]) == float(skates)
        assert any(fault.kind == "skating" for fault in find_faults(Motion(joints, FPS))) == skates
