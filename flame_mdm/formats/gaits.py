"""Clips for game engines, cut from longer motions: loops, starts, stops and turns.

The ends of the clips match each other. A gait is cut at two frames that are one cycle apart. The
start clip ends at the first of these frames, the loop lies between them, and the stop clip begins
at the second one. Then the ends of the clips are adjusted to shared poses: the first pose of the
loop, and the standing pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.ndimage import gaussian_filter1d

from flame_mdm.formats.grounding import (
    FEET,
    GroundedMotion,
    anchored,
    planted,
    planted_loop,
    repeated,
    runs,
    with_lengths,
)

Kind = Literal["loop", "start", "stop", "turn"]
# Minimum and maximum duration of a gait cycle in seconds
CYCLE = (0.5, 1.8)
# A gait is steady above this fraction of its full speed
STEADY = 0.85
# Seconds over which the speed is averaged, because a body stops briefly between side steps
EVEN = 0.2
# Minimum speed of a gait in m/s
SLOWEST = 0.2
# Maximum angle in degrees between the gait and the requested direction
ASIDE = 35.0
# Weight of velocities relative to positions, in seconds, when poses are compared
VELOCITY = 0.1
# A body is standing if no joint moves faster than this, in m/s, relative to the root
SETTLED = 0.12
# Seconds of standing still that are kept before a start and after a stop
MARGIN = 0.15
# Seconds over which the first or last pose of a clip is blended into the motion
FADE = 0.5
# Minimum and maximum angle of a turn, as a fraction of the requested angle
OVERSHOOT = (0.6, 1.6)
# Minimum length of a start or stop in seconds
PART = 0.5
# Minimum movement, in meters and degrees, from one repetition of a loop to the next. A loop that
# moves less stays in place.
STILL = (
    0.1,
    10.0,
)
TALL = 0.15  # maximum mean distance in meters per joint between the end poses of a cycle


@dataclass(frozen=True, eq=False)
class Clip:
    """A clip for a game engine.

    Attributes:
        name: name of the clip, without the name of the set.
        kind: "loop" (the last pose equals the first pose), "start", "stop" or "turn".
        motion: the joints and the root trajectory.
        text: the text from which the motion was generated.
    """

    name: str
    kind: Kind
    motion: GroundedMotion
    text: str


@dataclass(frozen=True)
class Cycle:
    """One cycle of a gait within a motion.

    The fields are the first frame, the frame with the same pose one cycle later, and the difference
    between the two poses.
    """

    first: int
    last: int
    difference: float  # mean distance between the joints in meters


def direction(degrees: float) -> np.ndarray:
    """Returns the x and z components of a direction, with shape (2,).

    0 degrees is straight ahead, and 90 degrees is to the left.
    """
    return np.array([np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])


def progress(motion: GroundedMotion, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the root's velocities (F,) along a direction and 90 degrees to the left of it.

    The direction is relative to the heading of the root.
    """
    cosine, sine = np.cos(motion.heading), np.sin(motion.heading)
    dx, dz = (
        np.gradient(motion.path, axis=0).T * motion.fps
        if len(motion) > 1
        else np.zeros((2, len(motion)))
    )
    x, z = cosine * dx - sine * dz, sine * dx + cosine * dz
    along = direction(degrees)
    aside = direction(degrees + 90)
    return x * along[0] + z * along[1], x * aside[0] + z * aside[1]


def find_cycle(motion: GroundedMotion, degrees: float) -> Cycle | None:
    """Returns the cycle whose first and last poses differ least, for a gait in a given direction.

    Returns None if no cycle is found. Cycles that begin with a landing of the left foot are
    preferred, so that the loops of a set begin with the same foot.
    """
    # The cycle lies in the longest part that has a steady speed in the requested direction. All
    # pairs of frames that are a plausible cycle length apart are compared, by the differences
    # between joints and between velocities.
    along, aside = progress(motion, degrees)
    even = gaussian_filter1d(along, EVEN * motion.fps, mode="nearest")
    full = np.percentile(even, 90)
    if full < SLOWEST:
        return None
    begin, end = max(runs(even > STEADY * full), key=lambda run: run[1] - run[0])
    first, last = moving(motion)
    part = round(PART * motion.fps)
    begin, end = max(begin, first + part), min(end, last - part)
    if end <= begin:
        return None
    steady = slice(begin, end + 1)
    off = np.degrees(np.arctan2(aside[steady].mean(), along[steady].mean()))
    if abs(off) > ASIDE:
        return None

    poses = motion.local
    speeds = np.gradient(poses, axis=0) * motion.fps
    landed = [first for first, _ in runs(motion.contacts[:, 0]) if begin <= first <= end]
    shortest, longest = (round(seconds * motion.fps) for seconds in CYCLE)
    for starts in (landed, range(begin, end + 1)):
        cycles = []
        for first in starts:
            for last in range(first + shortest, min(first + longest, end) + 1):
                apart = np.linalg.norm(poses[first] - poses[last], axis=-1).mean()
                changed = np.linalg.norm(speeds[first] - speeds[last], axis=-1).mean()
                changed += abs(even[first] - even[last])
                cycles.append(Cycle(first, last, float(apart + VELOCITY * changed)))
        best = min(cycles, key=lambda cycle: cycle.difference, default=None)
        if best is not None and best.difference < TALL:
            return best
    return None


def gait(
    motion: GroundedMotion, cycle: Cycle, degrees: float, stand: np.ndarray
) -> list[GroundedMotion]:
    """Returns the start, loop and stop clips of a gait on a straight path.

    Args:
        motion: a motion in which a person stands, moves in one direction, and stands again.
        cycle: the cycle that becomes the loop clip.
        degrees: the direction, relative to the heading of the person.
        stand: (22, 3), the first pose of the start clip and the last pose of the stop clip.
    """
    # All three parts come from one motion, so they nearly fit. The loop is closed first. Then the
    # ends of the start and the stop are changed to the loop's first pose and to the standing pose,
    # and the toes are planted again.
    straight = straightened(motion, degrees)
    loop = closed(straight.cut(cycle.first, cycle.last))
    along = direction(degrees)
    distance = float((loop.path[-1] - loop.path[0]) @ along)
    loop = replace(loop, path=np.linspace(0, distance, len(loop))[:, None] * along)
    loop = planted_loop(loop)

    begin, end = moving(motion)
    start = straight.cut(begin, cycle.first)
    start = anchored(start, loop.local[0], FADE, at_end=True)
    start = anchored(start, stand, FADE, at_end=False)
    stop = straight.cut(cycle.last, end)
    stop = anchored(stop, loop.local[0], FADE, at_end=False)
    stop = anchored(stop, stand, FADE, at_end=True)
    start, stop = (planted(clip, fixed_start=True, fixed_end=True) for clip in (start, stop))
    return [start, loop, stop]


def straightened(motion: GroundedMotion, degrees: float) -> GroundedMotion:
    """Returns a copy of the motion in which the root faces +z and moves along a straight line."""
    along, _ = progress(motion, degrees)
    distance = np.concatenate([[0], np.cumsum((along[1:] + along[:-1]) / 2) / motion.fps])
    return replace(
        motion, path=distance[:, None] * direction(degrees), heading=np.zeros(len(motion))
    )


def closed(motion: GroundedMotion) -> GroundedMotion:
    """Returns a copy of a cycle in which the first and last poses are equal.

    The difference between these poses is distributed evenly over the cycle.
    """
    # The first half of the cycle takes one half of the difference, and the second half takes the
    # other, so the pose in the middle does not change.
    share = np.linspace(-0.5, 0.5, len(motion))[:, None, None]
    change = motion.local[0] - motion.local[-1]
    local = with_lengths(motion.local + share * change, motion.local[0])
    contacts = motion.contacts.copy()
    contacts[-1] = contacts[0]
    return replace(motion, local=local, contacts=contacts)


def moving(motion: GroundedMotion) -> tuple[int, int]:
    """Returns the first and last frames of the movement, extended by `MARGIN` at both ends."""
    speed = np.linalg.norm(np.gradient(motion.world(), axis=0), axis=-1).max(1) * motion.fps
    speed = gaussian_filter1d(speed, 0.05 * motion.fps, mode="nearest")
    fast = np.flatnonzero(speed > SETTLED)
    if not len(fast):
        return 0, len(motion) - 1
    margin = round(MARGIN * motion.fps)
    return max(0, fast[0] - margin), min(len(motion) - 1, fast[-1] + margin)


def turn(motion: GroundedMotion, degrees: float, stand: np.ndarray) -> GroundedMotion | None:
    """Returns a turn in place that begins and ends with the pose `stand` (22, 3).

    Returns None if the motion turns in the other direction, or by an angle that is very different
    from `degrees`.
    """
    # The model turns by about the requested angle. The root is turned by exactly this angle, and
    # the pose turns with it.
    begin, end = moving(motion)
    part = motion.cut(begin, end)
    angle = part.heading[-1] - part.heading[0]
    ratio = np.degrees(angle) / degrees
    if not OVERSHOOT[0] <= ratio <= OVERSHOOT[1]:
        return None
    part = replace(part, path=np.zeros_like(part.path), heading=part.heading / ratio)
    part = anchored(part, stand, FADE, at_end=False)
    part = anchored(part, stand, FADE, at_end=True)
    return planted(part, fixed_start=True, fixed_end=True)


def loop(motion: GroundedMotion) -> GroundedMotion:
    """Returns the middle repetition of a loop that was generated with three repetitions.

    If the person moves or turns during the loop, the root moves along a straight line and turns,
    both at a constant speed. Otherwise, the root stays in place.
    """
    count = (len(motion) - 1) // 3
    cycle = closed(motion.cut(count, 2 * count))
    distance, angle = np.linalg.norm(cycle.path[-1]), np.degrees(abs(cycle.heading[-1]))
    leaves = distance > STILL[0] or angle > STILL[1]
    share = np.linspace(0, 1, len(cycle)) if leaves else np.zeros(len(cycle))
    cycle = replace(cycle, path=share[:, None] * cycle.path[-1], heading=share * cycle.heading[-1])
    return planted_loop(cycle)


def passing(motion: GroundedMotion) -> list[float | None]:
    """Returns the times in seconds at which the planted left and right toes pass the root of a loop.

    A time is None if the toes never pass the root. Two gaits are best blended at these times,
    because the foot is then at the same place in both.
    """
    travel = motion.path[-1] - motion.path[0]
    distance = np.linalg.norm(travel)
    times: list[float | None] = []
    for foot, leg in enumerate(FEET):
        ahead = motion.local[:, leg[-1]][:, [0, 2]] @ travel / max(float(distance), 1e-9)
        stands = motion.contacts[:-1, foot] & motion.contacts[1:, foot]
        crossed = np.flatnonzero(stands & (ahead[:-1] >= 0) & (ahead[1:] < 0))
        if distance < STILL[0] or not len(crossed):
            times.append(None)
            continue
        frame = int(crossed[0])
        share = ahead[frame] / (ahead[frame] - ahead[frame + 1])
        times.append(float((frame + share) / motion.fps))
    return times


def with_neighbors(clips: Sequence[Clip], frames: int) -> tuple[np.ndarray, list[slice]]:
    """Returns the joints of all clips in one array, and the frames of each clip.

    The joint positions are relative to the root. Each clip is padded with `frames` frames on both
    sides, so that filters over time do not mix the clips. A loop is padded with repetitions of
    itself, and all other clips are padded with their first and last poses.
    """
    parts, slices, position = [], [], 0
    for clip in clips:
        local = clip.motion.local
        if clip.kind == "loop":
            copies = 1 + 2 * (frames // (len(local) - 1) + 1)
            several = repeated(clip.motion, copies).local
            begin = (len(several) - len(local)) // 2
            part = several[begin - frames : begin + len(local) + frames]
        else:
            part = np.concatenate(
                [np.repeat(local[:1], frames, 0), local, np.repeat(local[-1:], frames, 0)]
            )
        parts.append(part)
        slices.append(slice(position + frames, position + frames + len(local)))
        position += len(part)
    return np.concatenate(parts), slices
