"""Physics metrics of published benchmarks, each with its own units, thresholds, frame rate and floor.

Values of different benchmarks are not comparable with one another, nor with those of `evaluators.metrics.physics`. The
floor is y = 0 in all of them: motions are not moved.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from scipy.signal import find_peaks
from torch import Tensor

from evaluators.metrics.samples import SampleMetric

FEET = (7, 10, 8, 11)  # left ankle or heel, left toe, right ankle or heel and right toe of the 22 SMPL joints
JERK_OF_REAL_MOTIONS: dict[float, float] = {20: 0.033031363, 30: 0.016383045}
"""Mean jerk of FlowMDM by frame rate: of HumanML3D at 20 frames per second, and of BABEL at 30."""

Values = Mapping[str, Tensor | float]


class MeanOverMotions(SampleMetric):
    """Means over motions of values that each motion has, or does not have if they are undefined for it.

    `measured` is the fraction of motions that have all values.
    """

    higher_is_better = False
    states = ("values", "defined")
    NAMES: tuple[str, ...]  # names of the values of a motion
    DIRECTIONS: Mapping[str, bool | None] = {}  # values for which higher is better (True), or neither (None)
    required_fps: float | None = None  # the only frame rate at which the values are defined; None = any

    def __init__(self, fps: float, feet: Sequence[int] = FEET):
        super().__init__()
        self.fps, self.feet, self.names = fps, list(feet), (*self.NAMES, "measured")

    def update(self, joints: Tensor, mask: Tensor, keys: Tensor) -> None:
        self.keep_values(keys, [self.measure(motion) for motion in self.real_frames(joints, mask)])

    def measure(self, motion: Tensor) -> Values:
        """Computes the values of a motion (F, J, 3); NaN = undefined."""
        raise NotImplementedError

    def keep_values(self, keys: Tensor, motions: Sequence[Values]) -> None:
        """Adds the values of motions; NaN = undefined."""
        if motions:
            values = torch.tensor([[float(m[name]) for name in self.NAMES] for m in motions], dtype=torch.float64)
            super().update(keys=keys, values=values.nan_to_num(), defined=~values.isnan())

    def value(self, values: Tensor, defined: Tensor) -> dict[str, float | None]:
        """Returns the mean of each value, and `measured`; raises `UserError` at any but the required frame rate."""
        if self.required_fps and self.fps != self.required_fps:
            raise self.error(f"defined at {self.required_fps:g} frames per second, but the motions have {self.fps:g}")
        sums = zip(values.sum(0).tolist(), defined.sum(0).tolist(), strict=True)
        means = [total / count if count else None for total, count in sums]
        return dict(zip(self.names, (*means, defined.all(1).double().mean().item()), strict=True))


class MBenchQuality(MeanOverMotions):
    """Motion quality of MBench (ViMoGen, bf891de), in meters per frame, only at 20 frames per second.

    `jitter_degree`: mean length of the second difference of joint positions, plus the same relative to the root;
    `dynamic_degree`: the same of the first difference, higher = more motion; `ground_penetration`: mean depth of the
    toes that are deeper than 5 mm, 0 if there are none; `foot_sliding`: mean step over the ground of toes in contact;
    `foot_floating`: frames in which the body moves without a foot that carries it, per frame; it can exceed 1. A toe is
    in contact if it moves less than 1 cm per frame or is lower than 2 cm, so a foot held still in the air is, too.

    The code takes z as height. Its published pipeline passes motions in which y is height; here, the height is that
    which the functions are meant to read. `toes` are the indices of the left and the right toe.
    """

    NAMES = ("jitter_degree", "dynamic_degree", "ground_penetration", "foot_sliding", "foot_floating")
    DIRECTIONS: Mapping[str, bool | None] = {"dynamic_degree": None}
    required_fps = 20

    def __init__(self, fps: float, toes: Sequence[int] = (10, 11)):
        super().__init__(fps, toes)

    def measure(self, motion: Tensor) -> Values:
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
            "foot_floating": (carried + 0.5 * lagging + swinging) / len(motion) if len(motion) > 1 else math.nan,
        }


def mbench_contact(feet: Tensor) -> Tensor:
    """Returns whether feet (F, 2, 3) are in contact, (F, 2) bool; (0, 2) for a single frame."""
    speed = _speed(feet)
    return (speed < 0.01) | (feet[: len(speed), :, 1] < 0.02)


def _speed(points: Tensor) -> Tensor:
    """(F, ..., 3) -> (F, ...), meters to the next frame; the last one is repeated. One frame has none."""
    speed = points.diff(dim=0).norm(dim=-1)
    return torch.cat([speed, speed[-1:]])


def mbench_floating(motion: Tensor, feet: Tensor, contact: Tensor) -> tuple[int, int, int]:
    """Counts the frames of `foot_floating` of a motion (F, J, 3) with two feet (F, 2, 3) in contact or not (F, 2).

    Returns:
        Frames in which the feet on the ground move unlike the body; frames of feet in the air that move much less than
        the body, which count half; and frames in which both feet swing to and fro in the air.
    """
    root = _speed(motion[:, 0])
    rate = _speed(feet - motion[:, :1]) / (root[:, None] + 1e-6)
    bad = (_speed(feet) > 1.2e-4) & ((rate < 0.6) | ((rate > 1.75) & (root[:, None] > 1.2e-4)))
    resting = root < 0.001
    carried = (contact.any(1) & (bad | ~contact).all(1) & ~resting).sum()
    runs = [_runs(~contact[:, foot]) for foot in range(contact.shape[1])]
    lagging = 0
    for foot, in_the_air in enumerate(runs):
        for begin, end in in_the_air:
            part = slice(begin, end)
            if end - begin >= 4 and 2 * int(resting[part].sum()) <= end - begin:
                lagging += int((rate[part, foot] < 0.4).sum())
    swinging = 0
    for begin, end in ((max(a, c), min(b, d)) for a, b in runs[0] for c, d in runs[1]):
        if end - begin >= 4:
            path = feet[begin + 1 : end, 0] - feet[begin, 0]
            path = path / (path.norm(dim=-1, keepdim=True) + 1e-6)
            angles = torch.rad2deg(torch.acos((path @ path[-1]).clamp(-1, 1)))
            swinging += end - begin if len(find_peaks(angles.numpy())[0]) > 2 else 0
    return int(carried), lagging, swinging


def _runs(true: Tensor) -> list[tuple[int, int]]:
    """Returns begin and end (exclusive) of the maximal runs of True in (F,)."""
    edges = torch.nn.functional.pad(true.int(), (1, 1)).diff().nonzero()[:, 0].tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


class KimodoQuality(MeanOverMotions):
    """Foot skating of Kimodo (7330e7e), in m/s, from joints and from the contacts that the model predicts.

    `skate_from_height`: mean speed of toes that are lower than 5 cm; `skate_ratio`: fraction of their steps with more
    than 0.2 m/s, among steps that begin and end lower than 5 cm; `low`: mean fraction of steps that begin there,
    without which the two say nothing, since a motion that never touches the floor gets 0, the best value. If the
    representation has contacts: `skate_from_contacts` and `skate_max` are mean and largest speed of heels and toes in
    contact; `contact_consistency` is the fraction of contacts that agree with a heuristic (slower than 0.15 m/s and
    lower than 10 cm), higher is better.

    All speeds are in three dimensions. A motion of one frame has no values. `feet` are the indices of left heel, left
    toe, right heel and right toe.
    """

    NAMES = ("skate_from_height", "skate_ratio", "low", "skate_from_contacts", "skate_max", "contact_consistency")
    DIRECTIONS: Mapping[str, bool | None] = {"low": None, "contact_consistency": True}

    def update(self, joints: Tensor, mask: Tensor, keys: Tensor, contacts: Tensor | None = None) -> None:
        motions = self.real_frames(joints, mask)
        labels = [None] * len(motions) if contacts is None else contacts[mask].split(mask.sum(1).tolist())
        self.keep_values(keys, [self.measure(*pair) for pair in zip(motions, labels, strict=True)])

    def measure(self, motion: Tensor, contacts: Tensor | None = None) -> Values:
        """Computes the values of a motion (F, J, 3) with contacts (F, 4) bool of its feet; NaN = undefined."""
        values: dict[str, Tensor | float] = dict.fromkeys(self.NAMES, math.nan)
        if len(motion) < 2:
            return values
        feet = motion[:, self.feet]
        speed = feet.double().diff(dim=0).norm(dim=-1) * self.fps
        low, toes = feet[:, 1::2, 1] < 0.05, speed[:, 1::2]
        first, both = low[:-1], low[:-1] & low[1:]
        values["skate_from_height"] = (toes * first).sum() / (first.sum() + 1e-6)
        values["skate_ratio"] = ((toes > 0.2) & both).sum() / (both.sum() + 1e-6)
        values["low"] = first.double().mean()
        if contacts is not None:
            on = contacts[:-1]
            values["skate_from_contacts"] = (speed * on).sum() / (on.sum() + 1e-6)
            values["skate_max"] = (speed * on).max()
            heuristic = (speed < 0.15) & (feet[:-1, :, 1] < 0.10)
            values["contact_consistency"] = (heuristic == on).double().mean()
        return values


class KimodoConstraints(MeanOverMotions):
    """Constraint errors of Kimodo (7330e7e), for edits: distance of kept parts from the real motion, in meters.

    `root2d_err`: over the ground, of the root in frames that keep it, with its 95th percentile over motions,
    `root2d_err_p95`; `root2d_acc`: fraction of those frames with at most 10 cm; `fullbody_keyframe`: of all joints in
    frames that keep all; `end_effector`: of the kept joints in other frames. The code compares the root with a smoothed
    trajectory that the user draws; here, it is that of the real motion.
    """

    NAMES = ("root2d_err", "root2d_acc", "fullbody_keyframe", "end_effector")

    def __init__(self):
        super().__init__(fps=0)
        self.names = (*self.NAMES, "root2d_err_p95")

    def update(self, joints: Tensor, real_joints: Tensor, mask: Tensor, kept: Tensor, keys: Tensor) -> None:
        motions = self.real_frames(joints, mask)
        parts = kept[mask].split(mask.sum(1).tolist())
        errors = []
        for motion, real, part in zip(motions, real_joints, parts, strict=True):
            off, full = motion.double() - real[: len(motion)], part.all(1)
            errors.append(constraint_errors(off[part[:, 0], 0][:, [0, 2]], off[full], off[part & ~full[:, None]]))
        self.keep_values(keys, errors)

    def value(self, values: Tensor, defined: Tensor) -> dict[str, float | None]:
        """Returns the means and the percentile; few edits have all kinds of constraints, so there is no `measured`."""
        means = list(super().value(values, defined).values())[:-1]
        roots = values[defined[:, 0], 0]
        percentile = roots.quantile(0.95).item() if len(roots) else None
        return dict(zip(self.names, (*means, percentile), strict=True))


def constraint_errors(root: Tensor, full: Tensor, parts: Tensor) -> dict[str, Tensor]:
    """Computes the values of `KimodoConstraints` from offsets of a motion, (N, 2) or (..., 3); NaN without any."""
    root, full, parts = (offset.norm(dim=-1) for offset in (root, full, parts))
    near = (root <= 0.1).double().mean()
    return dict(zip(KimodoConstraints.NAMES, (root.mean(), near, full.mean(), parts.mean()), strict=True))


class PhysicalFootContact(MeanOverMotions):
    """Physical foot contact score (PFC) of EDGE (17c3428), x 10^4: acceleration of the root without a planted foot.

    Mean over frames of the product of both feet's steps over the ground and the root's acceleration, which is divided
    by its largest value; downward accelerations count as 0. A foot's step is that of its ankle or toe, whichever is
    smaller. It has no value for motions without acceleration, which the code averages as NaN, and none at other rates
    than 30 frames per second: steps are in meters per frame, so that half the rate would give about four times the
    score. `feet` are the indices of left ankle, left toe, right ankle and right toe.
    """

    NAMES = ("pfc",)
    required_fps = 30

    def measure(self, motion: Tensor) -> Values:
        """Computes the score of a motion (F, J, 3); NaN if the root does not accelerate or frames are fewer than 3."""
        motion = motion.double()
        # The code divides by the frame duration first, which decides whether rounding errors of a steady root are 0.
        acceleration = (motion[:, 0].diff(dim=0) * self.fps).diff(dim=0) * self.fps
        acceleration[:, 1].clamp_(min=0)
        acceleration = acceleration.norm(dim=-1)
        if not len(acceleration) or not acceleration.max():
            return {"pfc": math.nan}
        steps = motion[1:, self.feet][..., [0, 2]].diff(dim=0).norm(dim=-1)
        left, right = steps[:, :2].amin(1), steps[:, 2:].amin(1)
        return {"pfc": 1e4 * (left * right * acceleration / acceleration.max()).mean()}


class TransitionJerk(SampleMetric):
    """Peak jerk and area under the jerk of transitions between kept and generated frames, of FlowMDM (e81c67f).

    The jerk of a frame is the largest L1 norm of the third difference of a joint's position, in meters per frame^3.
    Windows of `window` frames are centered at the first frame after each change from kept to generated frames or back;
    windows that the motion does not contain are left out. The published windows have 60 frames at 20 frames per second
    and 30 at 30. `peak` is the maximum of the mean over windows, frame by frame; `area` is the sum of its distances
    from the jerk of real motions, which is also large for motions smoother than those, and grows with the window;
    `windows` is the number of windows. The published jerk of real motions is of HumanML3D at 20 frames per second and
    of BABEL at 30; at other rates there is no area.
    """

    higher_is_better = False
    states = ("total", "windows")
    names = ("peak", "area", "windows")

    def __init__(self, fps: float, window: int):
        super().__init__()
        self.real, self.window = JERK_OF_REAL_MOTIONS.get(round(fps, 6)), window

    def update(self, joints: Tensor, mask: Tensor, kept: Tensor, keys: Tensor) -> None:
        parts = kept[mask].split(mask.sum(1).tolist())
        totals, counts = [], []
        for motion, part in zip(self.real_frames(joints, mask), parts, strict=True):
            seams = (part[1:] != part[:-1]).any(1).nonzero()[:, 0] + 1
            starts = [int(seam) - self.window // 2 for seam in seams]
            windows = [motion[s : s + self.window] for s in starts if 0 <= s <= len(motion) - self.window]
            totals.append(sum(map(transition_jerk, windows), torch.zeros(self.window - 3, dtype=torch.float64)))
            counts.append([len(windows)])
        if totals:
            super().update(keys=keys, total=torch.stack(totals), windows=torch.tensor(counts))

    def value(self, total: Tensor, windows: Tensor) -> dict[str, float | None]:
        count = int(windows.sum())
        peak, area = peak_and_area(total.sum(0) / count, self.real) if count else (None, None)
        return {"peak": peak, "area": area, "windows": count}


def transition_jerk(window: Tensor) -> Tensor:
    """Returns the jerk of each frame: positions (F, J, 3) -> (F - 3,), meters per frame^3."""
    return window.double().diff(n=3, dim=0).abs().sum(-1).amax(-1)


def peak_and_area(curve: Tensor, real: float | None) -> tuple[float, float | None]:
    """Returns the maximum of a jerk curve, and the sum of its distances from the jerk of real motions."""
    return curve.max().item(), None if real is None else (curve - real).abs().sum().item()
