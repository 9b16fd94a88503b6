"""Physics metrics of published benchmarks, each with its own units, thresholds, frame rate and floor.

Values of different benchmarks are not comparable with one another, nor with those of `evaluators.metrics.physics`. The
floor is y = 0 in all of them: motions are not moved.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from scipy.signal import find_peaks
from torch import Tensor

from evaluators.metrics.samples import SampleMetric, real_frames

MBENCH_FPS, PFC_FPS = 20, 30
JERK_OF_REAL_MOTIONS: dict[float, float] = {20: 0.033031363, 30: 0.016383045}
"""Mean jerk of FlowMDM by frame rate: of HumanML3D at 20 frames per second, and of BABEL at 30."""


class MeanOverMotions(SampleMetric):
    """Means over motions of values that each motion has, or does not have if they are undefined for it.

    Args:
        names: of the values.
        fps: frames per second of the motions.
        required_fps: the only frame rate at which the values are defined; None = any.
        kwargs: options of `torchmetrics.Metric`.
    """

    higher_is_better = False
    DIRECTIONS: Mapping[str, bool | None] = {}
    """Values for which higher is better (True), or neither (None)."""

    def __init__(self, names: Sequence[str], fps: float, required_fps: float | None = None, **kwargs: Any):
        super().__init__(("keys", "values", "defined"), **kwargs)
        self.names, self.fps, self.required_fps = tuple(names), fps, required_fps

    def keep_values(self, keys: Tensor, found: Sequence[Mapping[str, Tensor | float]]) -> None:
        """Adds the values of motions by name; NaN = undefined."""
        if found:
            values = torch.tensor([[float(each[name]) for name in self.names] for each in found], dtype=torch.float64)
            self.keep(keys=keys, values=values.nan_to_num(), defined=~values.isnan())

    def compute(self) -> dict[str, float | None]:
        """Returns the mean of each value, and `measured`, the fraction of motions that have all of them.

        Raises:
            ValueError: If the values are not defined at the frame rate of the motions.
        """
        rows = self.rows("keys", "values", "defined")
        if rows is None:
            return dict.fromkeys((*self.names, "measured"))
        if self.required_fps and self.fps != self.required_fps:
            raise ValueError(
                f"{type(self).__name__}: defined at {self.required_fps:g} frames per second, but the motions have "
                f"{self.fps:g}"
            )
        values, defined = rows
        counts = defined.sum(0).tolist()
        means = [total / count if count else None for total, count in zip(values.sum(0).tolist(), counts, strict=True)]
        return dict(zip(self.names, means, strict=True)) | {"measured": defined.all(1).double().mean().item()}


class MBenchQuality(MeanOverMotions):
    """Motion quality of MBench (ViMoGen, bf891de), in meters per frame at 20 frames per second.

    `jitter_degree`: mean length of the second difference of joint positions, plus the same relative to the root;
    `dynamic_degree`: the same of the first difference, higher = more motion; `ground_penetration`: mean depth of the
    toes that are deeper than 5 mm, 0 if there are none; `foot_sliding`: mean step over the ground of toes in contact;
    `foot_floating`: frames in which the body moves without a foot that carries it, per frame; it can exceed 1. A toe is
    in contact if it moves less than 1 cm per frame or is lower than 2 cm, so a foot held still in the air is, too.

    The code takes z as height. Its published pipeline passes motions in which y is height; here, the height is that
    which the functions are meant to read.

    Args:
        fps: frames per second of the motions; at other rates than 20 there is no value.
        toes: indices of the left and the right toe.
        kwargs: options of `torchmetrics.Metric`.
    """

    NAMES = ("jitter_degree", "dynamic_degree", "ground_penetration", "foot_sliding", "foot_floating")

    DIRECTIONS: Mapping[str, bool | None] = {"dynamic_degree": None}

    def __init__(self, fps: float, toes: Sequence[int] = (10, 11), **kwargs: Any):
        super().__init__(self.NAMES, fps, MBENCH_FPS, **kwargs)
        self.toes = list(toes)

    def update(self, joints: Tensor, mask: Tensor, keys: Tensor) -> None:
        """Adds motions (B, F, J, 3) in meters, y up, with masks (B, F) and keys (B,)."""
        self.keep_values(keys, [mbench_quality(x, self.toes) for x in real_frames("MBenchQuality", joints, mask)])


def mbench_quality(motion: Tensor, toes: Sequence[int]) -> dict[str, Tensor | float]:
    """Computes the values of `MBenchQuality` of one motion (F, J, 3); undefined ones are NaN."""
    motion = motion.double()
    local, feet = motion - motion[:, :1], motion[:, list(toes)]
    height, contact = feet[..., 1], mbench_contact(feet)
    sliding = (_speed(feet[..., [0, 2]]) * contact).sum(0) / (contact.sum(0) + 1e-6)
    deep = height[height < -0.005]
    floating = sum(w * n for w, n in zip((1, 0.5, 1), mbench_floating(motion, feet, contact), strict=True))
    return {
        "jitter_degree": sum(x.diff(n=2, dim=0).norm(dim=-1).mean() for x in (motion, local)),
        "dynamic_degree": sum(x.diff(dim=0).norm(dim=-1).mean() for x in (motion, local)),
        "ground_penetration": -deep.mean() if len(deep) else 0.0,
        "foot_sliding": sliding.mean(),
        "foot_floating": floating / len(motion) if len(motion) > 1 else math.nan,
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
    """Counts the frames of `foot_floating`.

    Args:
        motion: (F, J, 3).
        feet: (F, 2, 3), left and right.
        contact: (F, 2) bool.

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
    for foot, found in enumerate(runs):
        for begin, end in found:
            part = slice(begin, end)
            if end - begin >= 4 and 2 * int(resting[part].sum()) <= end - begin:
                lagging += int((rate[part, foot] < 0.4).sum())
    swinging = 0
    for begin, end in ((max(a, c), min(b, d)) for a, b in runs[0] for c, d in runs[1]):
        if end - begin >= 4:
            way = feet[begin + 1 : end, 0] - feet[begin, 0]
            way = way / (way.norm(dim=-1, keepdim=True) + 1e-6)
            angles = torch.rad2deg(torch.acos((way @ way[-1]).clamp(-1, 1)))
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

    All speeds are in three dimensions. A motion of one frame has no values.

    Args:
        fps: frames per second of the motions.
        feet: indices of left heel, left toe, right heel and right toe.
        kwargs: options of `torchmetrics.Metric`.
    """

    JOINTS, CONTACTS = ("skate_from_height", "skate_ratio", "low"), ("skate_from_contacts", "skate_max")
    NAMES = (*JOINTS, *CONTACTS, "contact_consistency")
    DIRECTIONS: Mapping[str, bool | None] = {"low": None, "contact_consistency": True}

    def __init__(self, fps: float, feet: Sequence[int] = (7, 10, 8, 11), **kwargs: Any):
        super().__init__(self.NAMES, fps, **kwargs)
        self.feet = list(feet)

    def update(self, joints: Tensor, mask: Tensor, keys: Tensor, contacts: Tensor | None = None) -> None:
        """Adds motions (B, F, J, 3) in meters, y up, with masks (B, F), keys (B,) and contacts (B, F, 4) bool."""
        motions = real_frames("KimodoQuality", joints, mask)
        labels = [None] * len(motions) if contacts is None else contacts[mask].split(mask.sum(1).tolist())
        pairs = zip(motions, labels, strict=True)
        self.keep_values(keys, [kimodo_quality(x[:, self.feet], labels, self.fps) for x, labels in pairs])


def kimodo_quality(feet: Tensor, contacts: Tensor | None, fps: float) -> dict[str, Tensor | float]:
    """Computes the values of `KimodoQuality` from feet (F, 4, 3) and contacts (F, 4) bool; undefined ones are NaN."""
    found: dict[str, Tensor | float] = dict.fromkeys(KimodoQuality.NAMES, math.nan)
    if len(feet) < 2:
        return found
    speed = feet.double().diff(dim=0).norm(dim=-1) * fps
    low, toes = feet[:, 1::2, 1] < 0.05, speed[:, 1::2]
    first, both = low[:-1], low[:-1] & low[1:]
    found["skate_from_height"] = (toes * first).sum() / (first.sum() + 1e-6)
    found["skate_ratio"] = ((toes > 0.2) & both).sum() / (both.sum() + 1e-6)
    found["low"] = first.double().mean()
    if contacts is not None:
        on = contacts[:-1]
        found["skate_from_contacts"] = (speed * on).sum() / (on.sum() + 1e-6)
        found["skate_max"] = (speed * on).max()
        heuristic = (speed < 0.15) & (feet[:-1, :, 1] < 0.10)
        found["contact_consistency"] = (heuristic == on).double().mean()
    return found


class KimodoConstraints(MeanOverMotions):
    """Constraint errors of Kimodo (7330e7e), for edits: distance of kept parts from the real motion, in meters.

    `root2d_err`: over the ground, of the root in frames that keep it, with its 95th percentile over motions,
    `root2d_err_p95`; `root2d_acc`: fraction of those frames with at most 10 cm; `fullbody_keyframe`: of all joints in
    frames that keep all; `end_effector`: of the kept joints in other frames. The code compares the root with a smoothed
    trajectory that the user draws; here, it is that of the real motion.

    Args:
        kwargs: options of `torchmetrics.Metric`.
    """

    NAMES = ("root2d_err", "root2d_acc", "fullbody_keyframe", "end_effector")

    def __init__(self, **kwargs: Any):
        super().__init__(self.NAMES, 0, **kwargs)

    def update(self, joints: Tensor, real_joints: Tensor, mask: Tensor, kept: Tensor, keys: Tensor) -> None:
        """Adds motions and their real ones (B, F, J, 3), mask (B, F), kept parts (B, F, J) bool, and keys (B,)."""
        motions = real_frames("KimodoConstraints", joints, mask)
        parts = kept[mask].split(mask.sum(1).tolist())
        found = []
        for motion, real, part in zip(motions, real_joints, parts, strict=True):
            off, full = motion.double() - real[: len(motion)], part.all(1)
            found.append(constraint_errors(off[part[:, 0], 0][:, [0, 2]], off[full], off[part & ~full[:, None]]))
        self.keep_values(keys, found)

    def compute(self) -> dict[str, float | None]:
        """Returns the means and the percentile."""
        values, rows = super().compute(), self.rows("keys", "values", "defined")
        del values["measured"]  # few edits have all kinds of constraints
        roots = None if rows is None else rows[0][rows[1][:, 0], 0]
        return values | {"root2d_err_p95": None if roots is None or not len(roots) else roots.quantile(0.95).item()}


def constraint_errors(root: Tensor, full: Tensor, parts: Tensor) -> dict[str, Tensor]:
    """Computes the values of `KimodoConstraints` from offsets of a motion, (N, 2) or (..., 3); NaN without any."""
    root, full, parts = (offset.norm(dim=-1) for offset in (root, full, parts))
    near = (root <= 0.1).double().mean()
    return dict(zip(KimodoConstraints.NAMES, (root.mean(), near, full.mean(), parts.mean()), strict=True))


class PhysicalFootContact(MeanOverMotions):
    """Physical foot contact score (PFC) of EDGE (17c3428), x 10^4: acceleration of the root without a planted foot.

    Mean over frames of the product of both feet's steps over the ground and the root's acceleration, which is divided
    by its largest value; downward accelerations count as 0. A foot's step is that of its ankle or toe, whichever is
    smaller. It has no value for motions without acceleration, which the code averages as NaN.

    Args:
        fps: frames per second of the motions; at other rates than 30 there is no value. Steps are in meters per frame,
            so that half the rate would give about four times the score.
        feet: indices of left ankle, left toe, right ankle and right toe.
        kwargs: options of `torchmetrics.Metric`.
    """

    def __init__(self, fps: float, feet: Sequence[int] = (7, 10, 8, 11), **kwargs: Any):
        super().__init__(("pfc",), fps, PFC_FPS, **kwargs)
        self.feet = list(feet)

    def update(self, joints: Tensor, mask: Tensor, keys: Tensor) -> None:
        """Adds motions (B, F, J, 3) in meters, y up, with masks (B, F) and keys (B,)."""
        motions = real_frames("PhysicalFootContact", joints, mask)
        self.keep_values(keys, [{"pfc": physical_foot_contact(x, self.feet)} for x in motions])


def physical_foot_contact(motion: Tensor, feet: Sequence[int]) -> float:
    """Returns the score of a motion (F, J, 3); NaN if the root does not accelerate or frames are fewer than 3."""
    motion = motion.double()
    # The code divides by the frame duration first, which decides whether rounding errors of a steady root are 0.
    acceleration = (motion[:, 0].diff(dim=0) * PFC_FPS).diff(dim=0) * PFC_FPS
    acceleration[:, 1].clamp_(min=0)
    acceleration = acceleration.norm(dim=-1)
    if not len(acceleration) or not acceleration.max():
        return math.nan
    steps = motion[1:, list(feet)][..., [0, 2]].diff(dim=0).norm(dim=-1)
    left, right = steps[:, :2].amin(1), steps[:, 2:].amin(1)
    return 1e4 * (left * right * acceleration / acceleration.max()).mean().item()


class TransitionJerk(SampleMetric):
    """Peak jerk and area under the jerk of transitions between kept and generated frames, of FlowMDM (e81c67f).

    The jerk of a frame is the largest L1 norm of the third difference of a joint's position, in meters per frame^3.
    Windows of `window` frames are centered at the first frame after each change from kept to generated frames or back;
    windows that the motion does not contain are left out. `peak` is the maximum of the mean over windows, frame by
    frame; `area` is the sum of its distances from the jerk of real motions, which is also large for motions smoother
    than those, and grows with the window; `windows` is the number of windows.

    Args:
        fps: frames per second of the motions. The published jerk of real motions is of HumanML3D at 20 frames per
            second and of BABEL at 30; at other rates there is no area.
        window: frames of a window; None = as published, 60 at 20 frames per second and otherwise 30.
        kwargs: options of `torchmetrics.Metric`.
    """

    higher_is_better = False

    def __init__(self, fps: float, window: int | None = None, **kwargs: Any):
        super().__init__(("keys", "total", "windows"), **kwargs)
        self.real, self.window = JERK_OF_REAL_MOTIONS.get(round(fps, 6)), window or (60 if fps == 20 else 30)

    def update(self, joints: Tensor, mask: Tensor, kept: Tensor, keys: Tensor) -> None:
        """Adds motions (B, F, J, 3) in meters, masks (B, F), kept parts (B, F, J) bool, and keys (B,)."""
        lengths = mask.sum(1).tolist()
        totals, counts = [], []
        for motion, part in zip(real_frames("TransitionJerk", joints, mask), kept[mask].split(lengths), strict=True):
            seams = (part[1:] != part[:-1]).any(1).nonzero()[:, 0] + 1
            starts = [int(seam) - self.window // 2 for seam in seams]
            windows = [motion[s : s + self.window] for s in starts if 0 <= s <= len(motion) - self.window]
            totals.append(sum(map(transition_jerk, windows), torch.zeros(self.window - 3, dtype=torch.float64)))
            counts.append([len(windows)])
        if totals:
            self.keep(keys=keys, total=torch.stack(totals), windows=torch.tensor(counts))

    def compute(self) -> dict[str, float | None]:
        """Returns `peak`, `area` and `windows`."""
        rows = self.rows("keys", "total", "windows")
        count = 0 if rows is None else int(rows[1].sum())
        if rows is None or not count:
            return {"peak": None, "area": None, "windows": None if rows is None else 0}
        peak, area = peak_and_area(rows[0].sum(0) / count, self.real)
        return {"peak": peak, "area": area, "windows": count}


def transition_jerk(window: Tensor) -> Tensor:
    """Returns the jerk of each frame: positions (F, J, 3) -> (F - 3,), meters per frame^3."""
    return window.double().diff(n=3, dim=0).abs().sum(-1).amax(-1)


def peak_and_area(curve: Tensor, real: float | None) -> tuple[float, float | None]:
    """Returns the maximum of a jerk curve, and the sum of its distances from the jerk of real motions."""
    return curve.max().item(), None if real is None else (curve - real).abs().sum().item()
