"""Physical plausibility: foot skating, floor contact, jitter and static motions."""

from collections.abc import Sequence

import torch
from torch import Tensor

from evaluators.metrics.samples import SampleMetric, Share, Timed
from flame_mdm.formats.faults import LIMITS, LOW

TOLERANCE = 0.005  # distance from the floor, in meters, that counts as 0
STANDING = 0.03  # speed in meters per second below which a motion counts as static


class FootSkating(Timed, Share):
    """Foot skating ratio: fraction of frame transitions in which a foot that touches the floor slides.

    A toe joint touches the floor if it is below 5 cm in two adjacent frames, and slides if it moves more than 2.5 cm
    over the ground between them (Karunratanakul et al. 2023, "Guided Motion Diffusion"). The 2.5 cm are for 20 frames
    per second; at other frame rates, the same speed of 0.5 m/s is the limit. There are two deviations from the code
    released with the paper: that code also requires this speed in the mean of five frames, which the paper does not;
    and it averages the ratios of the motions, while here every frame transition has the same weight.

    The default `toes` are those of the 22 SMPL joints.
    """

    higher_is_better = False

    def __init__(self, fps: float, toes: Sequence[int] = (10, 11)):
        super().__init__(fps)
        self.toes = list(toes)

    def update(self, joints: Tensor, mask: Tensor) -> None:
        for motion in self.real_frames(joints, mask):
            toes = motion[:, self.toes].double()
            fast = toes[..., [0, 2]].diff(dim=0).norm(dim=-1) * self.fps > LIMITS["skating"][0]
            low = toes[..., 1] < LOW
            self.hits += (low[1:] & low[:-1] & fast).any(1).sum()
            self.total += len(fast)


class MeanOverFrames(SampleMetric):
    """Mean of a value per frame over all frames of all motions."""

    higher_is_better = False
    states = ("total", "frames")

    def update(self, joints: Tensor, mask: Tensor, keys: Tensor) -> None:
        values = [self.frame_values(motion.double()) for motion in self.real_frames(joints, mask)]
        if values:
            total = torch.stack([v.sum() for v in values])
            super().update(keys=keys, total=total[:, None], frames=total.new_tensor([[len(v)] for v in values]))

    def value(self, total: Tensor, frames: Tensor) -> float | None:
        return (total.sum() / frames.sum()).item() if frames.sum() else None

    def frame_values(self, motion: Tensor) -> Tensor:
        """(F, J, 3) -> (F',), one value per frame that can be measured."""
        raise NotImplementedError


class Penetration(MeanOverFrames):
    """Mean depth of the lowest joint below the floor, y = 0, in meters; depths up to 5 mm count as 0.

    Yuan et al. 2023 (PhysDiff) measure the lowest vertex of a mesh instead.
    """

    side = -1  # of the floor

    def frame_values(self, motion: Tensor) -> Tensor:
        distance = self.side * motion[..., 1].amin(1)
        return torch.where(distance > TOLERANCE, distance, 0.0)


class Floating(Penetration):
    """Mean height of the lowest joint above the floor, as for `Penetration`.

    Jumps count as floating, too: compare with the value of real motions.
    """

    side = 1


class Jitter(Timed, MeanOverFrames):
    """Mean jerk of the joints, the third difference of their positions, in m/s^3, as in Yi et al. 2022 (PIP).

    It grows with the frame rate: compare only values for equal frame rates.
    """

    def frame_values(self, motion: Tensor) -> Tensor:
        return motion.diff(n=3, dim=0).norm(dim=-1).mean(1) * self.fps**3


class StaticShare(Timed, Share):
    """Fraction of motions that hardly move: less than 3 cm/s on average over joints and frames.

    A generator that stands still has many static motions, but so do real data sets with standing people: compare with
    the value of real motions.
    """

    higher_is_better = False

    def update(self, joints: Tensor, mask: Tensor) -> None:
        for motion in self.real_frames(joints, mask):
            moved = motion.double().diff(dim=0).norm(dim=-1)
            if len(moved):
                self.hits += (moved.mean() * self.fps < STANDING).long()
                self.total += 1
