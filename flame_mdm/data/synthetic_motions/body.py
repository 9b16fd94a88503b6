"""The body of the synthetic motions: its kinematics, and the curves that actions set.

The upper body is computed from joint angles with forward kinematics. Two-bone inverse kinematics
makes the legs follow planned footprints, so that a foot on the ground does not move at all. Hands
that reach for something also use inverse kinematics. HumanML3D's reference skeleton (Guo et al.
2022) has similar bone lengths.
"""

from collections.abc import Sequence

import numpy as np

# Offset of each joint from its parent in meters, for a standing body that faces +z, with its arms
# hanging down. x applies to the left side; the right side is mirrored.
HIP = (0.075, -0.075, 0.0)
SPINE1 = (0.0, 0.131, -0.015)
SPINE2 = (0.0, 0.142, 0.0)
SPINE3 = (0.0, 0.057, 0.01)
NECK = (0.0, 0.217, -0.02)
HEAD = (0.0, 0.085, 0.058)
COLLAR = (0.072, 0.119, -0.01)
SHOULDER = (0.125, -0.02, -0.01)
THIGH, SHIN, UPPER_ARM, FOREARM = 0.393, 0.429, 0.260, 0.268
# Height of the ankle when the foot is flat and its toe joint is on the floor
ANKLE_HEIGHT = 0.06
FOOT = (0.0, -0.06, 0.134)
STAND = 0.97  # target height of the pelvis in meters, just out of reach of standing legs

LEFT, RIGHT = 0, 1
SIDES = {"left": (LEFT,), "right": (RIGHT,), "both": (LEFT, RIGHT)}
SIGN = np.array([1.0, -1.0])  # left is +x

Attributes = dict[str, str | int | float]


def ease(t: np.ndarray, start: float, end: float) -> np.ndarray:
    """Returns a minimum-jerk transition from 0 before `start` to 1 after `end`.

    Source: Flash & Hogan 1985.
    """
    s = np.clip((t - start) / (end - start), 0, 1)
    return s * s * s * (10 + s * (6 * s - 15))


def pulse(t: np.ndarray, start: float, top: float, leave: float, end: float) -> np.ndarray:
    """Returns a curve that rises from 0 to 1 and falls back to 0.

    The curve rises between `start` and `top`, and falls between `leave` and `end`.
    """
    return ease(t, start, top) - ease(t, leave, end)


def rotation(axis: int, angle: np.ndarray) -> np.ndarray:
    """Returns rotations (..., 3, 3) about x, y or z (0, 1, 2) by angles (...) in radians."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((*np.shape(angle), 3, 3))
    matrix[..., axis, axis] = 1
    matrix[..., i, i] = matrix[..., j, j] = np.cos(angle)
    matrix[..., j, i] = np.sin(angle)
    matrix[..., i, j] = -matrix[..., j, i]
    return matrix


class Body:
    """Curves over time that describe a body. Actions change them.

    Initially, the body stands still and breathes. Angles are in radians. The first axis of the
    arrays for feet and arms is the side: 0 = left, 1 = right.
    """

    def __init__(
        self, rng: np.random.Generator, t: np.ndarray, width: float | Sequence[float] | None = None
    ):
        """`width` is half the distance between the feet, in meters, or a range for this value.

        If `width` is a range, the value is drawn from it. If None, the value of a relaxed stance
        is used.
        """
        self.t = t
        half = rng.uniform(width[0], width[1]) if isinstance(width, Sequence) else width
        self.position = np.zeros((len(t), 3))
        self.heading = np.zeros(len(t))
        self.pelvis = self._drift(rng, 0.015, 3)  # pitch forward, yaw to the left, roll to the left
        self.spine = self._drift(rng, 0.025, 3)
        self.spine[0] += 0.018 * np.sin(
            2 * np.pi * (rng.uniform(0.22, 0.32) * t + rng.random())
        ) + rng.normal(0, 0.03)
        self.head = self._drift(rng, 0.08, 3) * np.array([[0.5], [1], [1]])
        self.arms = self._drift(rng, 0.05, 2, 4)  # forward, sideways, turned outward, elbow
        self.arms += np.array(
            [rng.normal(0.03, 0.05), rng.uniform(0.14, 0.24), -0.4, rng.uniform(0.2, 0.4)]
        )[:, None]
        # Rise of the shoulders in addition to the rise that raised arms cause
        self.shoulders = np.zeros((2, len(t)))
        # Whether a foot that is too far away is pulled toward its hip, instead of lengthening the
        # shin
        self.keeps_legs = False
        self.reaches: list[tuple[int, np.ndarray, np.ndarray, str]] = []

        self.ankles = np.zeros((2, len(t), 3))
        self.ankles[..., 0] = (rng.uniform(0.085, 0.12) if half is None else half) * SIGN[:, None]
        self.ankles[..., 1] = ANKLE_HEIGHT
        self.ankles[..., 2] = -0.03 + rng.normal(0, 0.012, (2, 1))
        self.foot_yaw = np.repeat((rng.uniform(0.05, 0.2, 2) * SIGN)[:, None], len(t), 1)
        self.foot_pitch = np.zeros((2, len(t)))  # positive: the heel is up

        self.position[:, 1] = STAND - rng.uniform(0, 0.015)
        self.position[:, [0, 2]] += self._drift(rng, 0.018, 2).T
        self.position[:, [0, 2]] -= self.position[0, [0, 2]]

    def _drift(self, rng: np.random.Generator, size: float, *shape: int) -> np.ndarray:
        """Returns slow, smooth noise (*shape, F): the sum of two waves of 0.1 to 0.7 Hz."""
        frequency, phase = rng.uniform(0.1, 0.7, (2, *shape, 1)), rng.random((2, *shape, 1))
        weight = rng.normal(0, size, (2, *shape, 1))
        return (weight * np.sin(2 * np.pi * (frequency * self.t + phase))).sum(0)

    def move_arm(self, side: int, weight: np.ndarray, pose: Sequence[float | np.ndarray]) -> None:
        """Blends the current pose of an arm with another pose, weighted by `weight` (F,).

        The other pose consists of four angles: forward, sideways, outward rotation and elbow bend.
        """
        for angle, target in enumerate(pose):
            self.arms[side, angle] += weight * (target - self.arms[side, angle])

    def reach(
        self,
        side: int,
        weight: np.ndarray,
        target: Sequence[float | np.ndarray] | np.ndarray,
        frame: str = "world",
    ) -> None:
        """Moves a wrist toward a point (3,) or (F, 3), in meters, by the fraction `weight` (F,).

        If the weight is 0, the angles of the arm determine the position of the wrist. `frame` is
        "world", "chest" or "head". With "chest" or "head", the point is given in the coordinates of
        this joint: x points to the left, and z points ahead.
        """
        self.reaches.append((side, weight[:, None], np.asarray(target, float), frame))

    def joints(self) -> np.ndarray:
        """Returns joint positions (F, 22, 3) in meters, with y up."""
        # Footprints are determined first, so that feet never slide. The pelvis is placed above
        # them. Inverse kinematics connects the hips to the feet. Spine, head and arms are computed
        # from angles.
        out = np.empty((len(self.t), 22, 3))
        yaw, (pitch, twist, roll) = self.heading, self.pelvis
        pelvis = rotation(1, yaw) @ rotation(1, twist) @ rotation(0, pitch) @ rotation(2, -roll)
        hips = np.stack([pelvis @ np.array([SIGN[side] * HIP[0], *HIP[1:]]) for side in (0, 1)])

        # A raised heel rotates about the toes, and raised toes rotate about the ankle, so that the
        # part of the foot on the floor does not move.
        foot = rotation(1, self.foot_yaw) @ rotation(0, self.foot_pitch)
        toe_offset = foot @ np.array(FOOT)
        heel_up = (self.foot_pitch > 0)[..., None]
        ankles = self.ankles + heel_up * (rotation(1, self.foot_yaw) @ np.array(FOOT) - toe_offset)

        # The pelvis is lowered where a leg could not reach its footprint otherwise. This makes the
        # pelvis bob in a walk.
        reach = 0.998 * (THIGH + SHIN)
        out[:, 0] = self.position
        apart = np.sum((ankles - hips - self.position)[..., [0, 2]] ** 2, -1)
        limits = ankles[..., 1] + np.sqrt(np.maximum(reach**2 - apart, 0.04)) - hips[..., 1]
        heights = np.stack([self.position[:, 1], *limits])
        out[:, 0, 1] = -np.log(np.exp(-120 * heights).sum(0)) / 120  # a smooth minimum

        for side in (0, 1):
            hip, ankle = out[:, 0] + hips[side], ankles[side]
            yaw = (self.heading + self.foot_yaw[side]) / 2
            forward = np.cross(ankle - hip, np.stack([np.cos(yaw), 0 * yaw, -np.sin(yaw)], -1))
            out[:, 1 + side] = hip
            out[:, 4 + side], reached = bent(hip, ankle, THIGH, SHIN, forward)
            ankle = reached if self.keeps_legs else ankle
            out[:, 7 + side] = ankle
            out[:, 10 + side] = ankle + toe_offset[side]

        bone = pelvis
        pitch, twist, roll = self.spine / 3
        step = rotation(1, twist) @ rotation(0, pitch) @ rotation(2, -roll)
        for joint, parent, offset in ((3, 0, SPINE1), (6, 3, SPINE2), (9, 6, SPINE3)):
            out[:, joint] = out[:, parent] + bone @ np.array(offset)
            bone = bone @ step
        out[:, 12] = out[:, 9] + bone @ np.array(NECK)
        head = (
            bone
            @ rotation(1, self.head[1])
            @ rotation(0, self.head[0])
            @ rotation(2, -self.head[2])
        )
        out[:, 15] = out[:, 12] + head @ np.array(HEAD)

        down = np.array([0.0, -1.0, 0.0])
        for side, sign in enumerate(SIGN):
            forward, sideways, outward, elbow = self.arms[side]
            arm = rotation(2, sign * sideways) @ rotation(0, -forward) @ rotation(1, sign * outward)
            # As in people, the shoulder girdle rises with the arm
            lift = 0.2 * (1 + (arm @ down)[:, 1]) + self.shoulders[side]
            collar = bone @ rotation(2, sign * lift)
            out[:, 13 + side] = out[:, 9] + bone @ np.array([sign * COLLAR[0], *COLLAR[1:]])
            out[:, 16 + side] = out[:, 13 + side] + collar @ np.array(
                [sign * SHOULDER[0], *SHOULDER[1:]]
            )
            arm = bone @ arm
            out[:, 18 + side] = out[:, 16 + side] + arm @ down * UPPER_ARM
            out[:, 20 + side] = out[:, 18 + side] + arm @ rotation(0, -elbow) @ down * FOREARM
        frames = {"world": (0.0, np.eye(3)), "chest": (out[:, 9], bone), "head": (out[:, 15], head)}
        for side, weight, target, frame in self.reaches:
            shoulder, elbow, wrist = (out[:, joint + side] for joint in (16, 18, 20))
            origin, axes = frames[frame]
            goal = wrist + weight * (origin + (axes @ target[..., None])[..., 0] - wrist)
            # Elbows point outward. In an upright body, they point backward, not forward.
            toward = (
                elbow
                - shoulder
                + 0.1 * SIGN[side] * bone[..., 0]
                - 0.25 * bone[:, 1, 1:2] * bone[..., 2]
            )
            out[:, 18 + side], out[:, 20 + side] = bent(shoulder, goal, UPPER_ARM, FOREARM, toward)
        return out


def bent(
    start: np.ndarray, end: np.ndarray, upper: float, lower: float, toward: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the middle joint and the end (F, 3) of a two-bone limb that reaches for `end`.

    The limb bends in the direction `toward` (F, 3).
    """
    # The bones and the line from start to end form a triangle. A limb is never completely straight
    # or folded, so that the direction in which it bends is always defined.
    line = end - start
    length = np.linalg.norm(line, axis=-1, keepdims=True)
    line /= length
    length = np.clip(length, abs(upper - lower) + 0.07, 0.999 * (upper + lower))
    along = (upper**2 - lower**2 + length**2) / (2 * length)
    across = toward - (toward * line).sum(-1, keepdims=True) * line
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    return start + along * line + np.sqrt(upper**2 - along**2) * across, start + length * line


def beat(t: np.ndarray, frequency: float, phase: float = 0.0) -> np.ndarray:
    """Returns a sine wave with a frequency in hertz and a phase in cycles."""
    return np.sin(2 * np.pi * (frequency * t + phase))


def step(
    body: Body,
    side: int,
    start: float,
    end: float,
    by: Sequence[float],
    lift: float = 0.09,
    heel: float = 0.3,
) -> None:
    """Moves a foot by (x, y, z) meters between two points in time.

    The heel leaves the floor first; `heel` is its angle in radians. If the foot lands at another
    height (y is not 0), its horizontal motion begins later.
    """
    s = np.clip((body.t - start) / (end - start), 0, 1)
    across, up = ease(s, 0.25 if by[1] else 0.08, 0.96), ease(s, 0.02, 0.7)
    foot = body.ankles[side]
    foot += np.stack(
        [across * by[0], up * by[1] + lift * np.sin(np.pi * s) ** 1.5, across * by[2]], 1
    )
    body.foot_pitch[side] += heel * pulse(
        body.t, start - 0.15, start + 0.03, start + 0.03, end - 0.03
    )


def follow_feet(body: Body) -> None:
    """Moves the pelvis horizontally, together with the midpoint between the feet."""
    middle = body.ankles.mean(0)[:, [0, 2]]
    body.position[:, [0, 2]] += middle - middle[0]


def flight(t: np.ndarray, start: float, seconds: float) -> np.ndarray:
    """Returns the height (F,) in meters of a body in free fall.

    The body lands `seconds` after `start`.
    """
    s = np.clip((t - start) / seconds, 0, 1)
    return 9.81 / 8 * seconds**2 * 4 * s * (1 - s)


def events(
    rng: np.random.Generator, t: np.ndarray, count: int, slowest: float
) -> list[tuple[float, float]]:
    """Draws the times of `count` repetitions of equal length.

    Returns the start and the duration of each repetition, in seconds.
    """
    seconds = min(rng.uniform(0.85, 1.0) * slowest, (t[-1] - 0.3) / count)
    start = rng.uniform(0.1, max(0.15, min(0.4, t[-1] - 0.15 - seconds * count)))
    return [(start + n * seconds, seconds) for n in range(count)]
