# pyright: standard
"""Physics metrics of published benchmarks. The floor is y = 0.

Each benchmark has its own units, thresholds and frame rate. The values are comparable neither
between benchmarks nor with values from `evaluators.metrics.physics`.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from scipy.signal import find_peaks
from torch import Tensor

from evaluators.metrics.samples import JointMean, MotionMean, Rows, SampleMetric, Timed

# Left ankle or heel, left toe, right ankle or heel and right toe of the 22 SMPL joints
FEET = (
    7,
    10,
    8,
    11,
)
JERK_OF_REAL_MOTIONS: dict[float, float] = {20: 0.033031363, 30: 0.016383045}
"""FlowMDM's mean jerk of real motions, by frame rate: HumanML3D (20) and BABEL (30 per second)."""
Values = dict[str, Tensor | float]


class PublishedPhysics(Timed, JointMean):
    """Base class for published physics metrics, which are means over motions.

    `measured` is the fraction of motions for which all values are defined.

    Args:
        fps: frames per second of the motions.
        feet: indices of the foot joints.
    """

    higher_is_better = False
    summary = None
    directions: Mapping[str, bool | None] = {"measured": None}
    # The only frame rate at which the values are defined, or None for any frame rate
    required_fps: float | None = None

    def __init__(self, fps: float, feet: Sequence[int] = FEET):
        super().__init__(fps)
        self.feet = list(feet)

    def value(self, sums: Tensor, counts: Tensor) -> dict[str, float | None]:
        """Returns the means, keyed by name.

        Raises `UserError` if the means are undefined at the frame rate of the motions.
        """
        if not self.defined:
            raise self.error(
                f"only defined at {self.required_fps:g} frames per second, but the motions have {self.fps:g}"
            )
        return self.means(sums, counts) | {"measured": (counts > 0).all(1).double().mean().item()}

    @property
    def defined(self) -> bool:
        """Whether the values are defined at the frame rate of the motions."""
        return self.required_fps in (None, self.fps)

    def readings(self, motions: Rows) -> dict[str, np.ndarray]:
        """Returns the sum and count (N, 2) of each motion's values, keyed by name.

        Returns {} if the values are undefined.
        """
        return super().readings(motions) if self.defined else {}


class MBenchQuality(PublishedPhysics):
    """Motion quality of MBench (ViMoGen, bf891de), in meters per frame, at 20 frames per second.

    - `jitter_degree`: mean norm of the second difference of the joint positions, plus the same
      mean for positions relative to the root.
    - `dynamic_degree`: mean norm of the first difference of the joint positions, plus the same mean
      for relative positions. A higher value means more motion.
    - `ground_penetration`: mean depth of the toes that are more than 5 mm below the floor, or 0 if
      there are no such toes.
    - `foot_sliding`: mean horizontal distance that a toe in contact moves per frame.
    - `foot_floating`: number of frames in which the body moves without the support of a foot,
      divided by the total number of frames. The value can exceed 1.

    A toe counts as in contact if it moves less than 1 cm per frame (even in the air) or is below
    2 cm. The published code uses z as the height, although y is the height in its pipeline. This
    implementation uses y.

    Args:
        fps: frames per second of the motions. For rates other than 20, `compute` raises
            `UserError`.
        toes: indices of the left and the right toe.

    Example:
        >>> metric, joints = MBenchQuality(fps=20), torch.zeros(1, 5, 22, 3)
        >>> metric.update(joints, torch.ones(1, 5, dtype=torch.bool), keys=torch.tensor([0]))
        >>> metric.compute()["jitter_degree"]
        0.0
    """

    parts = (
        "jitter_degree",
        "dynamic_degree",
        "ground_penetration",
        "foot_sliding",
        "foot_floating",
    )
    names = (*parts, "measured")
    unit = "m/frame"
    units: Mapping[str, str] = {"ground_penetration": "m", "foot_floating": "", "measured": ""}
    directions: Mapping[str, bool | None] = {"dynamic_degree": None, "measured": None}
    required_fps = 20

    def __init__(self, fps: float, toes: Sequence[int] = (10, 11)):
        super().__init__(fps, toes)

    def measure(self, motion: Tensor) -> Values:
        """Computes the values of a motion (F, J, 3), keyed by name."""
        motion = motion.double()
        local, feet = motion - motion[:, :1], motion[:, self.feet]
        height, contact = feet[..., 1], mbench_contact(feet)
        sliding = (_speed(feet[..., [0, 2]]) * contact).sum(0) / (contact.sum(0) + 1e-6)
        deep = height[height < -0.005]
        carried, lagging, swinging = mbench_floating(motion, feet, contact)
        return {
            "jitter_degree": sum(x.diff(n=2, dim=0).norm(dim=-1).mean() for x in (motion, local)),
            "dynamic_degree": sum(x.diff(dim=0).norm(dim=-1).mean() for x in (motion, local)),
            "ground_penetration": -deep.mean() if len(deep) else 0.0,
            "foot_sliding": sliding.mean(),
            "foot_floating": (carried + 0.5 * lagging + swinging) / len(motion)
            if len(motion) > 1
            else math.nan,
        }


def mbench_contact(feet: Tensor) -> Tensor:
    """Returns whether feet (F, 2, 3) are in contact, as (F, 2) bool.

    For a single frame, the result has the shape (0, 2).
    """
    speed = _speed(feet)
    return (speed < 0.01) | (feet[: len(speed), :, 1] < 0.02)


def _speed(points: Tensor) -> Tensor:
    """Returns the distances (F, ...), in meters, that points (F, ..., 3) move until the next frame.

    The last distance is repeated. For a single frame, the result is empty.
    """
    speed = points.diff(dim=0).norm(dim=-1)
    return torch.cat([speed, speed[-1:]])


def mbench_floating(motion: Tensor, feet: Tensor, contact: Tensor) -> tuple[int, int, int]:
    """Counts the frames of `foot_floating` in a motion (F, J, 3).

    `feet` (F, 2, 3) contains the positions of the two feet, and `contact` (F, 2) bool states
    whether each foot is in contact.

    Returns the numbers of frames of three kinds. In the first kind, the movement of the feet on the
    ground does not match the movement of the body. In the second kind, a foot in the air moves much
    less than the body; these frames have half the weight in the score. In the third kind, both feet
    swing to and fro in the air.
    """
    root = _speed(motion[:, 0])
    rate = _speed(feet - motion[:, :1]) / (root[:, None] + 1e-6)
    bad = (_speed(feet) > 1.2e-4) & ((rate < 0.6) | ((rate > 1.75) & (root[:, None] > 1.2e-4)))
    resting = root < 0.001
    carried = (contact.any(1) & (bad | ~contact).all(1) & ~resting).sum()
    lagging = swinging = 0
    for foot in (0, 1):
        for begin, end in _runs(~contact[:, foot]):
            if 2 * int(resting[begin:end].sum()) <= end - begin:
                lagging += int((rate[begin:end, foot] < 0.4).sum())
    for begin, end in _runs(~contact.any(1)):  # both feet
        path = feet[begin + 1 : end, 0] - feet[begin, 0]
        path = path / (path.norm(dim=-1, keepdim=True) + 1e-6)
        angles = torch.rad2deg(torch.acos((path @ path[-1]).clamp(-1, 1)))
        swinging += end - begin if len(find_peaks(angles.numpy())[0]) > 2 else 0
    return int(carried), lagging, swinging


def _runs(aloft: Tensor) -> list[tuple[int, int]]:
    """Returns the start and (exclusive) end of each series of at least four consecutive True values."""
    runs = torch.nn.functional.pad(aloft.int(), (1, 1)).diff().nonzero().view(-1, 2).tolist()
    return [(begin, end) for begin, end in runs if end - begin >= 4]


class KimodoQuality(PublishedPhysics):
    """Foot skating of Kimodo (7330e7e), in m/s, from joints and from predicted contacts.

    - `skate_from_height`: mean speed of toes at heights below 5 cm.
    - `skate_ratio`: among the toes' frame-to-frame movements that begin and end at heights below
      5 cm, the fraction that is faster than 0.2 m/s.
    - `low`: mean fraction of the toes' movements that begin at a height below 5 cm. If this
      fraction is 0, the first two values are also 0.
    - `skate_from_contacts`, `skate_max`: mean and maximum speeds of heels and toes in contact.
    - `contact_consistency`: fraction of contacts that agree with a heuristic (slower than 0.15 m/s
      and below 10 cm). Higher is better.

    Speeds are computed in three dimensions. For motions with a single frame, speeds are undefined.

    Args:
        fps: frames per second of the motions.
        feet: indices of the left heel, left toe, right heel and right toe.

    Example:
        >>> metric, joints = KimodoQuality(fps=20), torch.zeros(1, 5, 22, 3)
        >>> metric.update(joints, torch.ones(1, 5, dtype=torch.bool), keys=torch.tensor([0]))
        >>> metric.compute()["skate_ratio"]
        0.0
    """

    parts = (
        "skate_from_height",
        "skate_ratio",
        "low",
        "skate_from_contacts",
        "skate_max",
        "contact_consistency",
    )
    names = (*parts, "measured")
    unit = "m/s"
    units: Mapping[str, str] = {
        "skate_ratio": "",
        "low": "",
        "contact_consistency": "",
        "measured": "",
    }
    directions: Mapping[str, bool | None] = {
        "low": None,
        "contact_consistency": True,
        "measured": None,
    }

    def update(
        self, joints: Tensor, mask: Tensor, keys: Tensor, contacts: Tensor | None = None
    ) -> None:
        """Adds B motions.

        Args:
            joints: (B, F, J, 3) positions in meters, with y up and the floor at y = 0.
            mask: (B, F) bool, True for real frames.
            keys: (B,) int64, unique keys of the motions.
            contacts: (B, F, 4) bool, predicted contacts of the feet. If None, the values that
                require contacts are not computed.

        Raises:
            UserError: If a motion contains NaN or infinity.
        """
        motions = self.real_frames(joints, mask)
        labels = (
            [None] * len(motions)
            if contacts is None
            else contacts[mask].split(mask.sum(1).tolist())
        )
        self.add(keys, [self.measure(*pair) for pair in zip(motions, labels, strict=True)])

    def extras(self, motions: Rows, i: int) -> dict[str, Tensor]:
        """Returns the contacts of motion i, if it has any."""
        return {"contacts": motions["contacts"][i][None]} if "contacts" in motions else {}

    def measure(self, motion: Tensor, contacts: Tensor | None = None) -> Values:
        """Computes a motion's values from its joints (F, J, 3) and, if known, contacts (F, 4)."""
        if len(motion) < 2:
            return {}
        feet = motion[:, self.feet]
        speed = feet.double().diff(dim=0).norm(dim=-1) * self.fps
        low, toes = feet[:, 1::2, 1] < 0.05, speed[:, 1::2]
        first, both = low[:-1], low[:-1] & low[1:]
        values: Values = {
            "skate_from_height": (toes * first).sum() / (first.sum() + 1e-6),
            "skate_ratio": ((toes > 0.2) & both).sum() / (both.sum() + 1e-6),
            "low": first.double().mean(),
        }
        if contacts is not None:
            on = contacts[:-1]
            values["skate_from_contacts"] = (speed * on).sum() / (on.sum() + 1e-6)
            values["skate_max"] = (speed * on).max()
            heuristic = (speed < 0.15) & (feet[:-1, :, 1] < 0.10)
            values["contact_consistency"] = (heuristic == on).double().mean()
        return values


class KimodoConstraints(MotionMean):
    """Constraint errors of Kimodo (7330e7e) for edits: distances of kept parts from real motions.

    Distances are in meters and are averaged over motions.

    - `root2d_err`: horizontal distance of the root from the real root, in frames in which the root
      is kept.
    - `root2d_err_p95`: 95th percentile of `root2d_err` over motions.
    - `root2d_acc`: fraction of the frames with a kept root in which the distance is at most 10 cm.
    - `fullbody_keyframe`: distance of all joints from the real joints, in frames in which all
      joints are kept.
    - `end_effector`: distance of the kept joints from the real joints, in all other frames.

    In Kimodo's code, the user draws the root trajectory; in this implementation, the root
    trajectory of the real motion is used.

    Example:
        >>> metric, real = KimodoConstraints(), torch.zeros(1, 5, 22, 3)
        >>> joints, mask = real + torch.tensor([0.0, 0.5, 0.0]), torch.ones(1, 5, dtype=torch.bool)
        >>> kept = torch.ones(1, 5, 22, dtype=torch.bool)
        >>> metric.update(joints, real, mask, kept, keys=torch.tensor([0]))
        >>> values = metric.compute()
        >>> values["fullbody_keyframe"], values["root2d_err"]  # half a meter too high
        (0.5, 0.0)
    """

    higher_is_better = False
    unit = "m"
    units: Mapping[str, str] = {"root2d_acc": ""}
    directions: Mapping[str, bool | None] = {"root2d_acc": True}
    summary = None
    parts = ("root2d_err", "root2d_acc", "fullbody_keyframe", "end_effector")
    names = (*parts, "root2d_err_p95")

    def update(
        self, joints: Tensor, real_joints: Tensor, mask: Tensor, kept: Tensor, keys: Tensor
    ) -> None:
        """Adds B edits.

        Args:
            joints: (B, F, J, 3) edited motions in meters, with y up.
            real_joints: (B, F', J, 3) motions before editing, in the same order, F' >= F.
            mask: (B, F) bool, True for real frames.
            kept: (B, F, J) bool, True if the edit kept this joint in this frame.
            keys: (B,) int64, unique keys of the edits.

        Raises:
            UserError: If an edited motion contains NaN or infinity.
        """
        motions = self.real_frames(joints, mask)
        parts = kept[mask].split(mask.sum(1).tolist())
        errors = []
        for motion, real, part in zip(motions, real_joints, parts, strict=True):
            off, full = motion.double() - real[: len(motion)], part.all(1)
            errors.append(
                constraint_errors(
                    off[part[:, 0], 0][:, [0, 2]], off[full], off[part & ~full[:, None]]
                )
            )
        self.add(keys, errors)

    def value(self, sums: Tensor, counts: Tensor) -> dict[str, float | None]:
        """Returns the means over motions and the percentile `root2d_err_p95`, keyed by name."""
        roots = sums[counts[:, 0] > 0, 0]
        return self.means(sums, counts) | {
            "root2d_err_p95": roots.quantile(0.95).item() if len(roots) else None
        }


def constraint_errors(root: Tensor, full: Tensor, parts: Tensor) -> dict[str, Tensor]:
    """Computes the values of `KimodoConstraints` from the offsets (N, 2) or (..., 3) between two motions.

    A value is NaN if there are no offsets for it.
    """
    root, full, parts = (offset.norm(dim=-1) for offset in (root, full, parts))
    near = (root <= 0.1).double()
    values = (root.mean(), near.mean(), full.mean(), parts.mean())
    return dict(zip(KimodoConstraints.parts, values, strict=True))


class PhysicalFootContact(PublishedPhysics):
    """Physical foot contact score (PFC) of EDGE (17c3428), x 10^4: acceleration without a planted foot.

    The score is the mean over frames of a product of three factors: the horizontal movement of each
    foot, in meters per frame, and the root's acceleration relative to its maximum. Downward
    accelerations count as 0. The movement of a foot is the smaller of the movements of its ankle
    and its toe. Motions without acceleration are left out of the mean, whereas EDGE's code includes
    them as NaN. Lower is better.

    Args:
        fps: frames per second of the motions. For rates other than 30, `compute` raises
            `UserError`.
        feet: indices of the left ankle, left toe, right ankle and right toe.

    Example:
        >>> metric, joints = PhysicalFootContact(fps=30), torch.zeros(1, 4, 22, 3)
        >>> joints[0, :, 0, 0] = torch.tensor([0.0, 0.0, 0.1, 0.3])  # the root speeds up, the feet stand
        >>> metric.update(joints, torch.ones(1, 4, dtype=torch.bool), keys=torch.tensor([0]))
        >>> metric.compute()
        {'pfc': 0.0, 'measured': 1.0}
    """

    parts = ("pfc",)
    names = (*parts, "measured")
    required_fps = 30

    def measure(self, motion: Tensor) -> Values:
        """Computes the score of a motion (F, J, 3).

        The score is NaN if the root does not accelerate, or if the motion has fewer than 3 frames.
        """
        motion = motion.double()
        # EDGE's code divides by the frame duration first. This order determines whether the
        # rounding errors of a steady root become 0.
        acceleration = (motion[:, 0].diff(dim=0) * self.fps).diff(dim=0) * self.fps
        acceleration[:, 1].clamp_(min=0)
        acceleration = acceleration.norm(dim=-1)
        if not len(acceleration) or not acceleration.max():
            return {"pfc": math.nan}
        steps = motion[1:, self.feet][..., [0, 2]].diff(dim=0).norm(dim=-1)
        left, right = steps[:, :2].amin(1), steps[:, 2:].amin(1)
        return {"pfc": 1e4 * (left * right * acceleration / acceleration.max()).mean()}


class TransitionJerk(SampleMetric):
    """Peak jerk and area under the jerk, at transitions between kept and generated frames.

    The computation follows FlowMDM's code (e81c67f). The jerk of a joint is the L1 norm of the
    third difference of its position, in meters per frame^3. The jerk of a frame is the largest jerk
    of any joint. A window is centered at the first frame after each change between kept and
    generated frames, provided that the motion contains the whole window. The jerk is averaged over
    windows, frame by frame. `peak` is the maximum of this mean curve. `area` is the sum of the
    curve's absolute differences from the jerk of real motions, and grows with the size of the
    window; it is undefined at frame rates that are not in `JERK_OF_REAL_MOTIONS`. `windows` is the
    number of windows.

    Args:
        fps: frames per second of the motions.
        window: number of frames per window. Published values use 60 frames at 20 frames per second,
            and 30 frames at 30 frames per second.

    Example:
        >>> metric, joints = TransitionJerk(fps=20, window=8), torch.zeros(1, 12, 22, 3)
        >>> kept = torch.zeros(1, 12, 22, dtype=torch.bool)
        >>> kept[:, :6] = True
        >>> metric.update(joints, torch.ones(1, 12, dtype=torch.bool), kept, keys=torch.tensor([0]))
        >>> values = metric.compute()
        >>> values["peak"], values["windows"]
        (0.0, 1)
    """

    higher_is_better = False
    unit = "m/frame^3"
    units: Mapping[str, str] = {"windows": ""}
    directions: Mapping[str, bool | None] = {"windows": None}
    summary = None
    states = ("total", "windows")
    names = ("peak", "area", "windows")

    def __init__(self, fps: float, window: int):
        super().__init__()
        self.real, self.window = JERK_OF_REAL_MOTIONS.get(round(fps, 6)), window

    def update(self, joints: Tensor, mask: Tensor, kept: Tensor, keys: Tensor) -> None:
        """Adds B motions.

        Args:
            joints: (B, F, J, 3) positions in meters.
            mask: (B, F) bool, True for real frames.
            kept: (B, F, J) bool, True if the edit kept this joint in this frame.
            keys: (B,) int64, unique keys of the motions.

        Raises:
            UserError: If a motion contains NaN or infinity.
        """
        parts = kept[mask].split(mask.sum(1).tolist())
        total = torch.zeros(len(keys), self.window - 3, dtype=torch.float64)
        count = torch.zeros(len(keys), 1, dtype=torch.long)
        for row, (motion, part) in enumerate(
            zip(self.real_frames(joints, mask), parts, strict=True)
        ):
            seams = (part[1:] != part[:-1]).any(1).nonzero()[:, 0] + 1
            for start in (seams - self.window // 2).tolist():
                if 0 <= start <= len(motion) - self.window:
                    total[row] += transition_jerk(motion[start : start + self.window])
                    count[row] += 1
        super().update(keys=keys, total=total, windows=count)

    def value(self, total: Tensor, windows: Tensor) -> dict[str, float | None]:
        """Returns `peak`, `area` and `windows`. Without windows, `peak` and `area` are None."""
        count = int(windows.sum())
        peak, area = peak_and_area(total.sum(0) / count, self.real) if count else (None, None)
        return {"peak": peak, "area": area, "windows": count}


def transition_jerk(window: Tensor) -> Tensor:
    """Computes the jerk (F - 3,) in each frame, in meters per frame^3, from positions (F, J, 3)."""
    return window.double().diff(n=3, dim=0).abs().sum(-1).amax(-1)


def peak_and_area(curve: Tensor, real: float | None) -> tuple[float, float | None]:
    """Returns the maximum and the area of a jerk curve.

    The area is the sum of the absolute differences from the jerk of real motions, or None if this
    jerk is None.
    """
    return curve.max().item(), None if real is None else (curve - real).abs().sum().item()
