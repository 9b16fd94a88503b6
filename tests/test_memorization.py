"""Distance from the training motions, against brute force and closed forms."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evaluators.metrics.attributes import SideAccuracy, read_side
from evaluators.metrics.memorization import STEP, NearestTraining, TrainingMotions, poses
from flame_mdm.representations.skeleton import SMPL22

FACING = SMPL22.facing


def walk(seed: int, frames: int) -> torch.Tensor:
    """Returns joints (F, 22, 3) of a body whose joints wander."""
    generator = np.random.default_rng(seed)
    body = generator.normal(0, 0.3, (22, 3)) + generator.normal(0, 0.03, (frames, 22, 3)).cumsum(0)
    body[:, list(FACING)] += [(-0.9, 1, 0), (0.9, 1, 0), (-0.9, 2, 0), (0.9, 2, 0)]
    return torch.from_numpy(body)


def moved(joints: torch.Tensor, yaw: float, shift: tuple[float, float]) -> torch.Tensor:
    turn = torch.from_numpy(Rotation.from_euler("y", yaw).as_matrix())
    return joints @ turn.T + torch.tensor([shift[0], 0.0, shift[1]])


def training(motions: list[torch.Tensor], features: torch.Tensor | None = None) -> TrainingMotions:
    lengths = torch.tensor([len(motion) for motion in motions])
    return TrainingMotions(
        torch.cat([poses(motion, FACING) for motion in motions]), lengths, features, FACING
    )


def test_poses_face_forward_on_the_spot():
    motion = walk(0, 12)
    still = poses(motion, FACING)
    torch.testing.assert_close(poses(moved(motion, 1.3, (2.0, -5.0)), FACING), still)
    local = still.unflatten(1, (22, 3))
    assert local[:, 0, [0, 2]].abs().max() == 0
    torch.testing.assert_close(local[..., 1], motion[..., 1])
    right_hip, left_hip, right_shoulder, left_shoulder = FACING
    across = (
        local[:, left_hip]
        - local[:, right_hip]
        + local[:, left_shoulder]
        - local[:, right_shoulder]
    )
    assert across[:, 0].min() > 0
    torch.testing.assert_close(
        across[:, 2], torch.zeros(12, dtype=torch.float64), atol=1e-12, rtol=0
    )


def test_nearest_is_that_of_all_windows_of_which_copies_have_distance_zero(subtests):
    motions = [walk(seed, frames) for seed, frames in enumerate((30, 50, 20))]
    features = torch.randn(3, 5, generator=torch.Generator().manual_seed(0))
    copies = [moved(motions[1][7:43], 0.8, (3, 4)), motions[2], motions[0][:24]]
    distances = training(motions, features).nearest(copies, features[[1, 2, 0]])
    torch.testing.assert_close(distances, torch.zeros(3, 2).to(distances), atol=1e-9, rtol=0)

    # A window across the end of a motion is none; the third motion is too short for the second query.
    across = torch.cat([motions[0][-12:], motions[1][:13]])
    queries = [walk(9, 20), walk(8, 28), across]
    distances = training(motions).nearest(queries, None)
    assert distances.shape == (3, 1)
    for number, (query, distance) in enumerate(zip(queries, distances[:, 0], strict=True)):
        with subtests.test(query=number):
            compared = poses(query, FACING)[::STEP].numpy()
            windows = [
                poses(motion, FACING)[first : first + len(query) : STEP].numpy()
                for motion in motions
                for first in range(len(motion) - len(query) + 1)
            ]
            best = min(
                np.sqrt(((compared - window) ** 2).reshape(-1, 3).sum(1).mean())
                for window in windows
            )
            assert distance.item() == pytest.approx(best, rel=1e-9)
            assert best > 0.05


def test_a_motion_longer_than_all_training_motions_has_no_neighbor():
    motions = [walk(seed, 20) for seed in (0, 1)]
    distances = training(motions).nearest([walk(2, 21), walk(3, 40), walk(4, 41)], None)
    assert distances.tolist() == [[torch.inf]] * 3
    # The only window is the entire set
    assert training(motions[:1]).nearest([moved(motions[0], 2.0, (1, 1))], None).item() < 1e-9


def test_features_are_compared_only_if_both_sides_have_them_and_without_rounding():
    motions = [walk(seed, 20) for seed in (0, 1)]
    features = 1000 + torch.randn(30, 8, generator=torch.Generator().manual_seed(0))
    store = training(motions, features)
    assert store.nearest(motions, None).shape == (2, 1)
    assert training(motions).nearest(motions, features[:2]).shape == (2, 1)
    copies = store.nearest([motions[0]] * 30, features)
    assert copies[:, 1].tolist() == [0.0] * 30
    # The nearest of the training motions counts, not the one with the same number
    shifted = store.nearest(motions, features[[7, 3]] + torch.tensor([3.0, 4.0, *[0.0] * 6]) / 1000)
    torch.testing.assert_close(shifted[:, 1].float(), torch.full((2,), 0.005), rtol=0.05, atol=0)


def test_copies_are_counted():
    metric = NearestTraining()
    real = torch.linspace(0.1, 0.2, 100, dtype=torch.float64)[:, None]
    nearest = torch.cat(
        [torch.zeros(40, 1, dtype=torch.float64), torch.full((60, 1), 0.3, dtype=torch.float64)]
    )
    metric.update(keys=torch.arange(100), nearest=nearest, real_nearest=real)
    assert metric.compute() == {"joints": pytest.approx(0.3), "features": None, "copies": 0.4}


def test_a_copy_is_closer_than_99_percent_of_real_motions_and_features_have_their_own_median():
    metric = NearestTraining()
    real = torch.linspace(0, 1, 101, dtype=torch.float64)[:, None]  # 0.01 at the 1st percentile
    joints = torch.tensor([0.009] + [0.01] * 2 + [0.011] * 98, dtype=torch.float64)
    nearest = torch.stack([joints, torch.linspace(3, 5, 101, dtype=torch.float64)], 1)
    metric.update(keys=torch.arange(101), nearest=nearest, real_nearest=real)
    expected = {"joints": 0.011, "features": 4.0, "copies": 1 / 101}
    assert metric.compute() == pytest.approx(expected)


def raised(side: str, turn: float) -> np.ndarray:
    """Returns a body that raises a hand, turns by `turn` degrees to the left and walks to its left if turn > 0."""
    body = np.zeros((40, 22, 3))
    for joint, name in enumerate(SMPL22.joints):
        body[:, joint, 0] = 0.2 if "left" in name else -0.2 if "right" in name else 0
        body[:, joint, 1] = 1.4 if "shoulder" in name else 0.9
    body[10:20, SMPL22.joints.index(f"{side}_wrist"), 1] = 1.8
    angles = np.linspace(0, turn, 40)
    rotated = np.stack(
        [
            Rotation.from_euler("y", a, degrees=True).apply(f)
            for a, f in zip(angles, body, strict=True)
        ]
    )
    rotated[..., 0] += np.sign(turn) * np.linspace(0, 0.5, 40)[:, None]
    return rotated


def test_sides_are_read_from_the_motion(subtests):
    left, right = raised("left", 60), raised("right", -60)
    for content in ("wave-left-hand", "wave-right-hand", "walk-turn-left", "walk-left"):
        with subtests.test(content=content):
            assert read_side(left, content, 20) == "left"
            assert read_side(right, content, 20) == "right"
    metric = SideAccuracy(fps=20)
    joints = torch.from_numpy(np.stack([left, left, right, right]))
    hands = {
        "bye": "left",
        "walk-turn-right": "right",
        "raise-up-right-hand": "right",
        "wave-both-hands": "both",
    }
    metric.update(joints, torch.ones(4, 40, dtype=torch.bool), list(hands.items()), torch.arange(4))
    assert metric.compute() == {"hand": 1.0, "path": 0.0, "hand_or_path": pytest.approx(2 / 3)}
    metric = SideAccuracy(fps=20)
    metric.update(joints[:1], torch.ones(1, 40, dtype=torch.bool), [("walk", "")], torch.arange(1))
    assert metric.compute() == {"hand": None, "path": None, "hand_or_path": None}
