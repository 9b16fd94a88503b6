"""Physical faults in motions, such as sliding feet, jumps, penetration, floating or freezing."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_opening

from flame_mdm.formats.motion import Motion

# Height in meters above the floor, y = 0, below which a toe joint is in contact. The foot skating
# metric uses the same height.
LOW = 0.05
# A body in the air floats instead of jumping if its root is slower than this, in m/s. In a jump,
# the root is also slow at the top, but only for 0.04 s.
STANDSTILL = 0.2
LIMITS = {
    "skating": (
        0.5,
        "m/s",
        "a toe below 5 cm moves faster than 0.5 m/s for 0.4 s or more (longer than a step takes)",
    ),
    "pop": (
        200.0,
        "m/s^2",
        "a joint jumps: it accelerates by more than 200 m/s^2 and stops within two frames",
    ),
    "bone length": (
        0.1,
        "of its median",
        "the length of a bone differs from its median by more than 10 % and 1 cm",
    ),
    "penetration": (0.05, "m", "a joint is more than 5 cm below the floor, y = 0"),
    "inside": (
        0.035,
        "m",
        "an elbow, a wrist or the middle of a hand is more than 3.5 cm inside the trunk or a thigh",
    ),
    "floating": (
        LOW,
        "m",
        "no joint is within 5 cm of the floor for 0.8 s (longer than a jump), or for 0.3 s at rest",
    ),
    "limit": (
        15.0,
        "degrees",
        "a knee bends forward by more than 15 degrees, or a knee or elbow is folded to less than 15",
    ),
    "frozen": (0.02, "m/s", "no joint moves faster than 2 cm/s for a second or more"),
}
"""The limit of each fault, the unit of the limit, and a description.

docs/motion-faults.md reports the share of real clips with each fault.
"""
# Distance from the wrist to the middle of the hand, relative to the length of the forearm. The hand
# is assumed to continue in the direction of the forearm.
PALM = 0.3
# Radius of the trunk from front to back, relative to its length from pelvis to neck
TRUNK = 0.18
# Width of the trunk relative to its depth
WIDTH = 1.4
# Radius of a thigh, relative to its length
THIGH = 0.17


class Fault(NamedTuple):
    """A fault of one joint or the whole body, from frame `start` to frame `end` (exclusive).

    `worst` is the most extreme value in these frames, in the same unit as the limit.
    """

    kind: str
    joint: str
    start: int
    end: int
    worst: float

    def __str__(self) -> str:
        unit = LIMITS[self.kind][1]
        where = (
            f"frame {self.start}"
            if self.end - self.start == 1
            else f"frames {self.start} to {self.end - 1}"
        )
        return f"{self.kind}: {self.joint}, {where}, {self.worst:.3g} {unit} (limit {LIMITS[self.kind][0]:g})"


def find_faults(motion: Motion) -> list[Fault]:
    """Returns the faults in a motion, sorted by first frame."""
    joints, skeleton, fps = motion.joints.astype(float), motion.skeleton, motion.fps
    names = skeleton.joints
    step = np.linalg.norm(np.diff(joints, axis=0), axis=-1) * fps
    height, still = joints[..., 1].min(1)[:, None], step.max(1, initial=0.0)[:, None]
    aloft, slow = height > LOW, np.append(step[:, :1], step[-1:, :1], axis=0) < STANDSTILL
    toes, slides = skeleton.feet[1::2], np.zeros(joints.shape[:2])
    low = joints[:, toes, 1] < LOW
    travel = np.linalg.norm(np.diff(joints[:, toes][..., [0, 2]], axis=0), axis=-1) * fps
    slides[:-1, toes] = travel * (low[1:] & low[:-1])
    # The acceleration of a joint is proportional to its distance from the midpoint between its
    # positions in the previous and the next frame.
    jumps = np.zeros(joints.shape[:2])
    jumps[1:-1] = np.linalg.norm(np.diff(joints, n=2, axis=0), axis=-1) * fps**2
    # A morphological opening of a flag over time keeps only runs that are at least as long as the
    # window.
    floats = [
        binary_opening(flag, np.ones((math.ceil(s * fps), 1)))
        for s, flag in ((0.8, aloft), (0.3, aloft & slow))
    ]
    faults = [
        *_runs("skating", names, slides, frames=math.ceil(0.4 * fps)),
        *_runs("pop", names, jumps),
        *_runs("bone length", names, *_stretched(joints, skeleton.edges)),
        *_runs("penetration", names, -joints[..., 1]),
        *_runs("inside", names, _inside(joints, names)),
        *_runs("limit", names, *_bends(joints, names)),
        *_runs("floating", ("body",), height, np.logical_or(*floats)),
        *_runs("frozen", ("body",), still, still < LIMITS["frozen"][0], max(2, round(fps))),
    ]
    return sorted(faults, key=lambda fault: (fault.start, fault.kind, fault.joint))


def _runs(
    kind: str,
    names: Sequence[str],
    values: np.ndarray,
    flags: np.ndarray | None = None,
    frames: int = 1,
) -> list[Fault]:
    """Returns the faults that last for at least `frames` frames.

    A joint is faulty in a frame if its flag is set or, without flags, if its value exceeds the
    limit. Flags and values have the shape (F, J).
    """
    limit, runs = LIMITS[kind][0], []
    flags = values > limit if flags is None else flags
    for joint in np.flatnonzero(flags.any(0)).tolist():
        flag = binary_opening(flags[:, joint], np.ones(frames)) if frames > 1 else flags[:, joint]
        edges = np.flatnonzero(np.diff(np.r_[0, flag.astype(int), 0]))
        for start, end in edges.reshape(-1, 2).tolist():
            span = values[start:end, joint]
            # The more a joint is folded, the smaller is its angle. All other values are worst at
            # their maximum.
            worst = span[np.abs(span - limit).argmax()] if kind == "limit" else span.max()
            runs.append(Fault(kind, names[joint], start, end, float(worst)))
    return runs


def _stretched(
    joints: np.ndarray, edges: Sequence[tuple[int, int]]
) -> tuple[np.ndarray, np.ndarray]:
    change, flags = np.zeros(joints.shape[:2]), np.zeros(joints.shape[:2], bool)
    for parent, joint in edges:
        length = np.linalg.norm(joints[:, joint] - joints[:, parent], axis=-1)
        usual = np.median(length)
        change[:, joint] = np.abs(length - usual) / max(usual, 1e-6)
        flags[:, joint] = (change[:, joint] > LIMITS["bone length"][0]) & (
            np.abs(length - usual) > 0.01
        )
    return change, flags


def _inside(joints: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Returns how deep the elbows and wrists are inside the body.

    The depth of a wrist is the larger of the depths of the wrist and the hand.
    """
    depth = np.zeros(joints.shape[:2])
    for side in ("left", "right"):
        elbow, wrist, hand = depths(joints, names, side)[0].T
        depth[:, names.index(f"{side}_elbow")] = elbow
        depth[:, names.index(f"{side}_wrist")] = np.maximum(wrist, hand)
    return depth


def _bends(joints: np.ndarray, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Finds knees that bend forward, and knees and elbows that bend too far.

    The direction of the foot determines which way is forward.
    """
    limit = LIMITS["limit"][0]
    flags = np.zeros(joints.shape[:2], bool)
    worst = np.zeros(joints.shape[:2])
    for side in ("left", "right"):
        for limb in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist")):
            chain = [f"{side}_{name}" for name in limb]
            upper, middle, lower = (joints[:, names.index(name)] for name in chain)
            a, b = unit(middle - upper), unit(lower - middle)
            bend = np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))
            at = names.index(chain[1])
            flags[:, at], worst[:, at] = 180 - bend < limit, 180 - bend
            if "knee" in chain[1]:
                # The front of the shin is the direction of the foot, made perpendicular to the
                # shin. A knee bends forward if the thigh tilts to this side.
                toes = unit(joints[:, names.index(f"{side}_foot")] - lower)
                front = toes - (toes * b).sum(-1, keepdims=True) * b
                tilt = np.degrees(np.arcsin(np.clip(-(a * unit(front)).sum(-1), -1, 1)))
                # The front is undefined if the foot points straight down, so such frames are
                # ignored.
                forward = (tilt > limit) & (np.linalg.norm(front, axis=-1) > 0.5)
                flags[:, at] |= forward
                worst[:, at] = np.where(forward, tilt, worst[:, at])
    return worst, flags


def depths(joints: np.ndarray, names: Sequence[str], side: str) -> tuple[np.ndarray, np.ndarray]:
    """Measures how deeply an arm penetrates the body.

    The trunk and the thighs are modeled as capsules, whose sizes are derived from the bones.

    Args:
        joints: (F, J, 3), joint positions in meters.
        names: names of the joints.
        side: "left" or "right".

    Returns:
        Two arrays for three points: the elbow, the wrist and the middle of the hand. The first
        array contains the depths (F, 3) of these points in meters. Depths are negative outside the
        body. The second array contains, for each point, a unit vector (F, 3, 3) that points away
        from the axis of the body part in which the point is deepest.
    """
    at = {name: joints[:, number] for number, name in enumerate(names)}
    elbow, wrist = at[f"{side}_elbow"], at[f"{side}_wrist"]
    points = np.stack([elbow, wrist, wrist + PALM * (wrist - elbow)], 1)
    across = unit(at["left_shoulder"] - at["right_shoulder"])
    bones = [
        (joints[:, 0], at["neck"]),
        *((at[f"{leg}_hip"], at[f"{leg}_knee"]) for leg in ("left", "right")),
    ]
    # The trunk is wider than it is deep. Sideways distances from its axis are shortened, so that
    # the same capsule can be used in all directions.
    away = [_away(points, start, end) for start, end in bones]
    lateral = (away[0] * across[:, None]).sum(-1, keepdims=True) * across[:, None]
    away[0] = away[0] - (1 - 1 / WIDTH) * lateral
    lengths = [float(np.median(np.linalg.norm(end - start, axis=-1))) for start, end in bones]
    sizes = np.multiply([TRUNK, THIGH, THIGH], lengths)
    depth = np.stack(
        [size - np.linalg.norm(vector, axis=-1) for size, vector in zip(sizes, away, strict=True)]
    )
    deepest = depth.argmax(0)[None]
    outward = np.take_along_axis(np.stack(away), deepest[..., None], 0)[0]
    return np.take_along_axis(depth, deepest, 0)[0], unit(outward)


def _away(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Returns vectors (F, P, 3) from a segment to points (F, P, 3).

    Each vector begins at the nearest point of the segment. `start` and `end` have the shape (F, 3).
    """
    axis, points = (end - start)[:, None], points - start[:, None]
    share = (points * axis).sum(-1, keepdims=True) / np.maximum(
        (axis**2).sum(-1, keepdims=True), 1e-9
    )
    return points - np.clip(share, 0, 1) * axis


def unit(vectors: np.ndarray) -> np.ndarray:
    """Returns vectors (..., 3) scaled to norm 1. Zero vectors remain 0."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
