# pyright: standard
"""Memorization: are generated motions closer to training motions than held-out real motions are?"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from evaluators.metrics.samples import SampleMetric

# Only every fourth frame of a motion is compared, which takes a quarter of the time. The distance
# between a motion and its copy is still 0.
STEP = 4
# A motion counts as a copy if it is closer to a training motion than all but this share of the
# held-out real motions.
CLOSE = 0.01


def poses(joints: Tensor, facing: Sequence[int]) -> Tensor:
    """Converts joint positions (F, J, 3) to poses (F, 3J) that do not depend on position and heading.

    In every frame, joints are relative to the ground point below the pelvis, and the body is turned
    so that it faces +z.
    """
    right_hip, left_hip, right_shoulder, left_shoulder = facing
    left = (
        joints[:, left_hip]
        - joints[:, right_hip]
        + joints[:, left_shoulder]
        - joints[:, right_shoulder]
    )
    left = torch.nn.functional.normalize(left[:, [0, 2]], dim=-1)[:, None]
    local = joints - joints[:, :1] * joints.new_tensor([1.0, 0.0, 1.0])
    across = (local[..., [0, 2]] * left).sum(-1)
    ahead = local[..., 2] * left[..., 0] - local[..., 0] * left[..., 1]
    return torch.stack([across, local[..., 1], ahead], -1).flatten(1)


@dataclass
class TrainingMotions:
    """The training motions, among which `nearest` searches for the nearest neighbors of other motions."""

    #: (N, 3J) poses of all frames of all motions, concatenated; see `poses`.
    poses: Tensor
    #: (M,) int64, number of frames of each motion.
    lengths: Tensor
    #: (M, E) features from the extractor, or None if there is no extractor.
    features: Tensor | None
    #: Right hip, left hip, right shoulder and left shoulder; see `Skeleton.facing`.
    facing: Sequence[int]

    def nearest(self, joints: Sequence[Tensor], features: Tensor | None) -> Tensor:
        """Returns the distances between motions and their nearest training motions.

        Args:
            joints: joint positions (F, J, 3) of B motions in meters.
            features: (B, E) features of the motions, or None.

        Returns:
            (B, 2), or (B, 1) without features. The first column is the root mean square distance,
            in meters, between the joints of the motion and the joints of the best-matching training
            window of the same length. This distance is computed from every fourth frame, and is
            infinite if no training motion is long enough. The second column is the distance between
            the features.
        """
        squares = self.poses.square().sum(-1)
        # Number of frames from each frame to the end of its motion
        left = torch.cat([torch.arange(int(length), 0, -1) for length in self.lengths])
        of_joints = torch.stack(
            [self._closest(poses(motion, self.facing), squares, left) for motion in joints]
        )
        if features is None or self.features is None:
            return of_joints[:, None]
        # With matrix products, the distance to a copy would consist mainly of rounding errors.
        exact = "donot_use_mm_for_euclid_dist"
        return torch.stack(
            [of_joints, torch.cdist(features, self.features, compute_mode=exact).min(1).values], 1
        )

    def _closest(self, motion: Tensor, squares: Tensor, left: Tensor) -> Tensor:
        # |a - b|^2 = |a|^2 + |b|^2 - 2 a b: one matrix product compares the motion with all windows
        # at once. |a|^2 is the same for all windows and is left out.
        compared = motion[::STEP]
        starts = len(squares) - len(motion) + 1
        if starts < 1:
            return motion.new_tensor(torch.inf)
        inner = compared @ self.poses.T
        total = squares.new_zeros(starts)
        for number, frame in enumerate(range(0, len(motion), STEP)):
            total += squares[frame : frame + starts] - 2 * inner[number, frame : frame + starts]
        total[left[:starts] < len(motion)] = torch.inf
        best = int(total.argmin())
        if total[best].isinf():
            return total[best]
        # The distance is recomputed from the differences, because the expanded square has
        # rounding errors of about a millimeter.
        difference = compared - self.poses[best : best + len(motion) : STEP]
        return (difference.square().sum() / (difference.numel() / 3)).sqrt()


class NearestTraining(SampleMetric):
    """Distance to the nearest training motion, and the share of copies.

    This metric was introduced in this project. A motion counts as a copy if its joints are
    unusually close to a training motion: closer than the joints of 99 % of the held-out real
    motions (all but the share `CLOSE`). By this definition, about 1 % of real motions are copies.
    If a model repeats the training set, all of its motions are copies.

    The values `joints`, in meters, and `features` are the medians of the distances. `copies` is
    the share of copies, in [0, 1]. `update` takes `nearest` (B, 1 or 2) and `real_nearest` (B, 1 or
    2), both from `TrainingMotions.nearest`, and `keys` (B,).

    Example:
        >>> metric = NearestTraining()
        >>> nearest, real = torch.tensor([[0.0], [0.5]]), torch.tensor([[0.25], [0.5]])
        >>> metric.update(nearest=nearest, real_nearest=real, keys=torch.arange(2))
        >>> metric.compute()
        {'joints': 0.25, 'features': None, 'copies': 0.5}
    """

    states = ("nearest", "real_nearest")
    names = ("joints", "features", "copies")
    units: Mapping[str, str] = {"joints": "m"}
    directions: Mapping[str, bool | None] = {"copies": False}
    summary = "copies"

    def value(self, nearest: Tensor, real: Tensor) -> dict[str, float | None]:
        """Returns the medians `joints` (in meters) and `features`, and the share `copies` in [0, 1]."""
        joints, *features = nearest.quantile(0.5, dim=0).tolist()
        limit = real[:, 0].quantile(CLOSE)
        return {
            "joints": joints,
            "features": features[0] if features else None,
            "copies": (nearest[:, 0] < limit).double().mean().item(),
        }
