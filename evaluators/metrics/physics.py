"""Physical plausibility: foot skating, floor contact, jitter and static motions."""

import torch
from torch import Tensor

from evaluators.metrics.samples import SampleMetric, Share, real_frames
from flame_mdm.formats.faults import LIMITS, LOW

TOLERANCE = 0.005  # distance from the floor, in meters, that counts as 0
STANDING = 0.03  # speed in meters per second below which a motion counts as static


class FootSkating(Share):
    """Foot skating ratio: fraction of frame transitions in which a foot that touches the floor slides.

    A toe joint touches the floor if it is below 5 cm in two adjacent frames, and slides if it moves more than 2.5 cm
    over the ground between them (Karunratanakul et al. 2023, "Guided Motion Diffusion"). The 2.5 cm are for 20 frames
    per second; at other frame rates, the same speed of 0.5 m/s is the limit. There are two deviations from the code
    released with the paper: that code also requires this speed in the mean of five frames, which the paper does not;
    and it averages the ratios of the motions, while here every frame transition has the same weight.

    Args:
        toes: indices of the toe joints; the default is for the 22 SMPL joints.
    """

    higher_is_better = False

    def __init__(self, fps: float, toes: tuple[int, ...] = (10, 11)):
        super().__init__()
        self.fps, self.toes = fps, list(toes)

    def update(self, joints: Tensor, mask: Tensor) -> None:
        real_frames("FootSkating", joints, mask)
        toes = joints[:, :, self.toes].double()
        moved = (toes[:, 1:, :, [0, 2]] - toes[:, :-1, :, [0, 2]]).norm(dim=-1)
        low = toes[..., 1] < LOW
        slides = (low[:, 1:] & low[:, :-1] & (moved * self.fps > LIMITS["skating"][0])).any(-1)
        real = mask[:, 1:] & mask[:, :-1]
        self.hits += (slides & real).sum()
        self.total += real.sum()


class MeanOverFrames(SampleMetric):
    """Mean of a value per frame over all frames of all motions."""

    higher_is_better = False
    states = ("total", "frames")

    def update(self, joints: Tensor, mask: Tensor, keys: Tensor) -> None:
        motions = real_frames(type(self).__name__, joints, mask)
        values = [self.frame_values(motion.double()) for motion in motions]
        if values:
            total = torch.stack([v.sum() for v in values])
            self.keep(keys=keys, total=total[:, None], frames=total.new_tensor([[len(v)] for v in values]))

    def value(self, total: Tensor, frames: Tensor) -> float | None:
        return (total.sum() / frames.sum()).item() if frames.sum() else None

    def frame_values(self, motion: Tensor) -> Tensor:
        """(F, J, 3) -> (F',), one value per frame that can be measured."""
        raise NotImplementedError


class DistanceFromFloor(MeanOverFrames):
    """Mean distance of the lowest joint from the floor, y = 0, in meters, on one side of it."""

    side: int

    def frame_values(self, motion: Tensor) -> Tensor:
        distance = self.side * motion[..., 1].amin(1)
        return torch.where(distance > TOLERANCE, distance, 0.0)


class Penetration(DistanceFromFloor):
    """Mean depth of the lowest joint below the floor, y = 0, in meters.

    Yuan et al. 2023 (PhysDiff) measure the lowest vertex of a mesh instead. In both cases, depths up to 5 mm count as
    0.
    """

    side = -1


class Floating(DistanceFromFloor):
    """Mean height of the lowest joint above the floor, y = 0, in meters.

    Jumps count as floating, too: compare with the value of real motions. Yuan et al. 2023 (PhysDiff) measure the lowest
    vertex of a mesh instead. In both cases, heights up to 5 mm count as 0.
    """

    side = 1


class Jitter(MeanOverFrames):
    """Mean jerk of the joints, the third derivative of their positions, in m/s^3.

    Computed by third differences, as in Yi et al. 2022 (PIP). It grows with the frame rate: compare only values for
    equal frame rates.
    """

    def __init__(self, fps: float):
        super().__init__()
        self.fps = fps

    def frame_values(self, motion: Tensor) -> Tensor:
        """Returns the jerk of every four consecutive frames, averaged over joints."""
        return motion.diff(n=3, dim=0).norm(dim=-1).mean(1) * self.fps**3


class StaticShare(Share):
    """Fraction of motions that hardly move: less than 3 cm/s on average over joints and frames.

    A generator that stands still has many static motions, but so do real data sets with standing people: compare with
    the value of real motions.
    """

    higher_is_better = False

    def __init__(self, fps: float):
        super().__init__()
        self.fps = fps

    def update(self, joints: Tensor, mask: Tensor) -> None:
        for motion in real_frames("StaticShare", joints, mask):
            moved = motion.double().diff(dim=0).norm(dim=-1)
            if len(moved):
                self.hits += (moved.mean() * self.fps < STANDING).long()
                self.total += 1
