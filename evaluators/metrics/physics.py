# pyright: standard
"""Physical plausibility: foot skating, floor contact, jitter and static motions."""

from collections.abc import Sequence

import torch
from torch import Tensor

from evaluators.metrics.samples import JointMean, Timed
from flame_mdm.formats.faults import LIMITS, LOW

# Maximum distance from the floor, in meters, that counts as 0
TOLERANCE = 0.005
# Speed in meters per second below which a motion counts as static
STANDING = 0.03


class FootSkating(Timed, JointMean):
    """Foot skating ratio: fraction of frame transitions in which a foot that touches the floor slides.

    A toe joint touches the floor if it is below 5 cm in two adjacent frames. It slides if it moves
    more than 2.5 cm over the ground between these frames (Karunratanakul et al. 2023, "Guided
    Motion Diffusion"). This limit applies to 20 frames per second; at other frame rates, the limit
    is scaled to the same speed, 0.5 m/s. The code released with the paper also requires that the
    mean speed over five frames exceeds the limit, and it averages the ratios of the motions. This
    metric follows the paper: only two frames are considered, and every frame transition has the
    same weight. Lower is better.

    Args:
        fps: frames per second of the motions.
        toes: indices of the toe joints. Default: the toes of the 22 SMPL joints.

    Example:
        >>> metric, joints = FootSkating(fps=20), torch.zeros(1, 3, 22, 3)
        >>> joints[..., 0] = torch.tensor([0.0, 0.1, 0.1])[:, None]  # slides 10 cm, then stands
        >>> metric.update(joints, torch.ones(1, 3, dtype=torch.bool), keys=torch.tensor([0]))
        >>> metric.compute()
        0.5
    """

    higher_is_better = False

    def __init__(self, fps: float, toes: Sequence[int] = (10, 11)):
        super().__init__(fps)
        self.toes = list(toes)

    def measure(self, motion: Tensor) -> Tensor:
        """Returns whether a foot skates in each frame transition of a motion (F, J, 3), as (F - 1,) bool."""
        toes = motion[:, self.toes].double()
        fast = toes[..., [0, 2]].diff(dim=0).norm(dim=-1) * self.fps > LIMITS["skating"][0]
        low = toes[..., 1] < LOW
        return (low[1:] & low[:-1] & fast).any(1)


class Penetration(JointMean):
    """Mean depth of the lowest joint below the floor (y = 0), in meters.

    The mean is taken over all frames; depths up to 5 mm count as 0. Yuan et al. 2023 (PhysDiff)
    measure the lowest vertex of a mesh instead. Lower is better.

    Example:
        >>> metric, joints = Penetration(), torch.full((1, 3, 22, 3), -0.25)
        >>> metric.update(joints, torch.ones(1, 3, dtype=torch.bool), keys=torch.tensor([0]))
        >>> metric.compute()
        0.25
    """

    higher_is_better = False
    unit = "m"
    #: Side of the floor that is measured: -1 = below, 1 = above.
    side = -1

    def measure(self, motion: Tensor) -> Tensor:
        """Returns the lowest joint's distance from the floor in each frame of a motion (F, J, 3), in meters."""
        distance = self.side * motion.double()[..., 1].amin(1)
        return torch.where(distance > TOLERANCE, distance, 0.0)


class Floating(Penetration):
    """Mean height of the lowest joint above the floor (y = 0), in meters.

    The mean is taken over all frames; heights up to 5 mm count as 0. Jumps also count as floating.
    Lower is better.

    Example:
        >>> metric, joints = Floating(), torch.full((1, 3, 22, 3), 0.25)
        >>> metric.update(joints, torch.ones(1, 3, dtype=torch.bool), keys=torch.tensor([0]))
        >>> metric.compute()
        0.25
    """

    side = 1


class Jitter(Timed, JointMean):
    """Mean jerk of the joints in m/s^3, as in Yi et al. 2022 (PIP).

    The jerk is computed from the third difference of the positions. It grows with the frame rate,
    so compare only values for the same frame rate. Lower is better.

    Args:
        fps: frames per second of the motions.

    Example:
        >>> metric, joints = Jitter(fps=20), torch.zeros(1, 5, 22, 3)
        >>> metric.update(joints, torch.ones(1, 5, dtype=torch.bool), keys=torch.tensor([0]))
        >>> metric.compute()
        0.0
    """

    higher_is_better = False
    unit = "m/s^3"

    def measure(self, motion: Tensor) -> Tensor:
        """Returns the jerk (F - 3,) of a motion (F, J, 3) in m/s^3, averaged over the joints."""
        return motion.double().diff(n=3, dim=0).norm(dim=-1).mean(1) * self.fps**3


class StaticShare(Timed, JointMean):
    """Fraction of motions that hardly move (less than 3 cm/s, averaged over joints and frames).

    Real data sets also contain static motions of standing people, so compare the value for
    generated motions with the value for real motions. Lower is better.

    Args:
        fps: frames per second of the motions.

    Example:
        >>> metric, joints = StaticShare(fps=20), torch.zeros(1, 5, 22, 3)
        >>> metric.update(joints, torch.ones(1, 5, dtype=torch.bool), keys=torch.tensor([0]))
        >>> metric.compute()
        1.0
    """

    higher_is_better = False

    def measure(self, motion: Tensor) -> Tensor:
        """Returns whether a motion (F, J, 3) is static, as (1,) bool.

        For a single frame, the result is empty.
        """
        moved = motion.double().diff(dim=0).norm(dim=-1)
        # The speed is undefined for a single frame.
        return (moved.mean() * self.fps < STANDING)[None][: len(moved)]
