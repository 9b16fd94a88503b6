"""Motions of the synthetic data set: a body whose curves each action sets, and its kinematics.

Joint angles move the upper body by forward kinematics. The legs follow planned footprints by two-bone inverse
kinematics, so that a foot on the ground does not move at all. Bone lengths are close to HumanML3D's reference
skeleton (Guo et al. 2022).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

# Offsets from the parent in meters, standing with hanging arms, facing +z; x for the left side, mirrored on the right.
HIP, SPINE1, SPINE2, SPINE3 = (0.075, -0.075, 0.0), (0.0, 0.131, -0.015), (0.0, 0.142, 0.0), (0.0, 0.057, 0.01)
NECK, HEAD, COLLAR, SHOULDER = (0.0, 0.217, -0.02), (0.0, 0.085, 0.058), (0.072, 0.119, -0.01), (0.125, -0.02, -0.01)
THIGH, SHIN, UPPER_ARM, FOREARM = 0.393, 0.429, 0.260, 0.268
ANKLE_HEIGHT, FOOT = 0.06, (0.0, -0.06, 0.134)  # a flat foot: the ankle at 6 cm, the toe joint on the floor
STAND = 0.97  # target height of the pelvis in meters, which standing legs just do not reach

LEFT, RIGHT = 0, 1
SIDES = {"left": (LEFT,), "right": (RIGHT,), "both": (LEFT, RIGHT)}
SIGN = np.array([1.0, -1.0])  # left is +x

Attributes = dict[str, str | int | float]


def _ease(t: np.ndarray, start: float, end: float) -> np.ndarray:
    """Returns 0 before `start`, 1 after `end`, and a minimum-jerk transition between (Flash & Hogan 1985)."""
    s = np.clip((t - start) / (end - start), 0, 1)
    return s * s * s * (10 + s * (6 * s - 15))


def _pulse(t: np.ndarray, start: float, top: float, leave: float, end: float) -> np.ndarray:
    """Returns a curve that rises from 0 to 1 between `start` and `top` and falls back between `leave` and `end`."""
    return _ease(t, start, top) - _ease(t, leave, end)


def _rotation(axis: int, angle: np.ndarray) -> np.ndarray:
    """Returns rotations (..., 3, 3) about x, y or z (0, 1, 2) by angles (...) in radians."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((*np.shape(angle), 3, 3))
    matrix[..., axis, axis] = 1
    matrix[..., i, i] = matrix[..., j, j] = np.cos(angle)
    matrix[..., j, i] = np.sin(angle)
    matrix[..., i, j] = -matrix[..., j, i]
    return matrix


class Body:
    """Curves over the frames that an action controls, initialized to a person who stands and breathes.

    Angles are in radians. The first axis of feet and arms is the side: 0 = left, 1 = right.
    """

    def __init__(self, rng: np.random.Generator, t: np.ndarray, width: float | None = None):
        self.t = t
        self.position = np.zeros((len(t), 3))
        self.heading = np.zeros(len(t))
        self.pelvis = self._drift(rng, 0.015, 3)  # pitch forward, yaw to the left, roll to the left
        self.spine = self._drift(rng, 0.025, 3)
        self.spine[0] += 0.012 * np.sin(2 * np.pi * (rng.uniform(0.22, 0.32) * t + rng.random())) + rng.normal(0, 0.03)
        self.head = self._drift(rng, 0.05, 3)
        self.arms = self._drift(rng, 0.03, 2, 4)  # forward, sideways, turned outward, elbow
        self.arms += np.array([rng.normal(0.03, 0.05), rng.uniform(0.1, 0.22), -0.5, rng.uniform(0.2, 0.4)])[:, None]

        half = rng.uniform(0.085, 0.12) if width is None else width
        self.ankles = np.zeros((2, len(t), 3))
        self.ankles[..., 0] = half * SIGN[:, None]
        self.ankles[..., 1] = ANKLE_HEIGHT
        self.ankles[..., 2] = -0.03 + rng.normal(0, 0.012, (2, 1))
        self.foot_yaw = np.repeat((rng.uniform(0.05, 0.2, 2) * SIGN)[:, None], len(t), 1)
        self.foot_pitch = np.zeros((2, len(t)))  # heel up

        self.position[:, 1] = STAND - rng.uniform(0, 0.015)
        self.position[:, [0, 2]] += self._drift(rng, 0.008, 2).T
        self.position[:, [0, 2]] -= self.position[0, [0, 2]]

    def _drift(self, rng: np.random.Generator, size: float, *shape: int) -> np.ndarray:
        """Returns slow smooth noise (*shape, F): two waves of 0.1 to 0.7 Hz."""
        frequency, phase = rng.uniform(0.1, 0.7, (2, *shape, 1)), rng.random((2, *shape, 1))
        weight = rng.normal(0, size, (2, *shape, 1))
        return (weight * np.sin(2 * np.pi * (frequency * self.t + phase))).sum(0)

    def move_arm(self, side: int, weight: np.ndarray, pose: Sequence[float | np.ndarray]) -> None:
        """Blends one arm by `weight` (F,) into a pose: forward, sideways, turned outward, elbow."""
        for angle, target in enumerate(pose):
            self.arms[side, angle] += weight * (target - self.arms[side, angle])

    def joints(self) -> np.ndarray:
        """Returns joint positions (F, 22, 3) in meters, y up."""
        out = np.empty((len(self.t), 22, 3))
        yaw, (pitch, twist, roll) = self.heading, self.pelvis
        pelvis = _rotation(1, yaw) @ _rotation(1, twist) @ _rotation(0, pitch) @ _rotation(2, -roll)
        hips = np.stack([pelvis @ np.array([SIGN[side] * HIP[0], *HIP[1:]]) for side in (0, 1)])

        # A raised heel rotates about the toes, raised toes about the ankle: the part on the floor does not move.
        foot = _rotation(1, self.foot_yaw) @ _rotation(0, self.foot_pitch)
        toe_offset = foot @ np.array(FOOT)
        heel_up = (self.foot_pitch > 0)[..., None]
        ankles = self.ankles + heel_up * (_rotation(1, self.foot_yaw) @ np.array(FOOT) - toe_offset)

        # The pelvis sinks if a leg would not reach its footprint, which produces the bobbing of a walk.
        reach = 0.998 * (THIGH + SHIN)
        out[:, 0] = self.position
        apart = np.sum((ankles - hips - self.position)[..., [0, 2]] ** 2, -1)
        limits = ankles[..., 1] + np.sqrt(np.maximum(reach**2 - apart, 0.04)) - hips[..., 1]
        heights = np.stack([self.position[:, 1], *limits])
        out[:, 0, 1] = -np.log(np.exp(-120 * heights).sum(0)) / 120  # a smooth minimum

        for side in (0, 1):
            hip, ankle = out[:, 0] + hips[side], ankles[side]
            leg = ankle - hip
            length = np.linalg.norm(leg, axis=-1, keepdims=True)
            along = (THIGH**2 - SHIN**2 + length**2) / (2 * length)
            yaw = (self.heading + self.foot_yaw[side]) / 2
            forward = np.cross(leg / length, np.stack([np.cos(yaw), 0 * yaw, -np.sin(yaw)], -1))
            forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
            bend = np.sqrt(THIGH**2 - along**2)
            out[:, 1 + side] = hip
            out[:, 4 + side] = hip + along * leg / length + bend * forward
            out[:, 7 + side] = ankle
            out[:, 10 + side] = ankle + toe_offset[side]

        bone = pelvis
        pitch, twist, roll = self.spine / 3
        step = _rotation(1, twist) @ _rotation(0, pitch) @ _rotation(2, -roll)
        for joint, parent, offset in ((3, 0, SPINE1), (6, 3, SPINE2), (9, 6, SPINE3)):
            out[:, joint] = out[:, parent] + bone @ np.array(offset)
            bone = bone @ step
        out[:, 12] = out[:, 9] + bone @ np.array(NECK)
        head = bone @ _rotation(1, self.head[1]) @ _rotation(0, self.head[0]) @ _rotation(2, -self.head[2])
        out[:, 15] = out[:, 12] + head @ np.array(HEAD)

        down = np.array([0.0, -1.0, 0.0])
        for side, sign in enumerate(SIGN):
            forward, sideways, outward, elbow = self.arms[side]
            arm = _rotation(2, sign * sideways) @ _rotation(0, -forward) @ _rotation(1, sign * outward)
            lift = 0.2 * (1 + (arm @ down)[:, 1])  # the shoulder girdle rises with the arm
            collar = bone @ _rotation(2, sign * lift)
            out[:, 13 + side] = out[:, 9] + bone @ np.array([sign * COLLAR[0], *COLLAR[1:]])
            out[:, 16 + side] = out[:, 13 + side] + collar @ np.array([sign * SHOULDER[0], *SHOULDER[1:]])
            arm = bone @ arm
            out[:, 18 + side] = out[:, 16 + side] + arm @ down * UPPER_ARM
            out[:, 20 + side] = out[:, 18 + side] + arm @ _rotation(0, -elbow) @ down * FOREARM
        return out


@dataclass
class Gait:
    """Parameters of steps, in seconds, meters and radians."""

    step: float  # time from one footprint to the next
    swing: float  # time of a foot in the air; if longer than `step`, both feet leave the ground in between
    lift: float  # height of the foot in mid-swing
    heel_off: float  # angle of the heel when the foot leaves the floor
    toe_up: float  # angle of the toes when the foot comes down; negative: the toes come down first
    width: float  # half the distance between the tracks of the feet
    sink: float = 0.03  # lowering of the pelvis while moving
    bounce: float = 0.0  # amplitude of the pelvis, highest with both feet in the air
    behind: float = 0.0  # how much farther back the feet come down than they stand


def _walk_along(
    body: Body,
    rng: np.random.Generator,
    gait: Gait,
    speed: float,
    path: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]],
    first: int,
    stops: bool = False,
) -> np.ndarray:
    """Moves the pelvis along a path and places the feet on either side of it.

    Args:
        body: a standing body; its pelvis, heading and feet are replaced.
        rng: draws the time of the first step.
        gait: parameters of the steps.
        speed: speed along the path after acceleration, meters per second (radians per second when turning).
        path: distance along it (N,) -> x (N,), z (N,) and heading (N,).
        first: the side that steps first.
        stops: stop before the clip ends.

    Returns:
        (F,) how far the right foot is in front of the left one, in meters, relative to the heading of the pelvis.
    """
    t, end = body.t, body.t[-1]
    start = rng.uniform(0.1, 0.2)
    fine = np.arange(0, end + 3, 0.01)
    halt = end - 0.05 - 1.5 * gait.step if stops else end + 2
    pace = speed * _pulse(fine, start - 0.1, start + 0.55, halt - 0.5, halt)
    way = np.concatenate([[0.0], np.cumsum(pace)[:-1] * 0.01])

    def at(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return path(np.interp(time, fine, way))

    x, z, heading = at(t)
    sway, yaw0 = body.position[:, [0, 2]].copy(), body.foot_yaw[:, 0].copy()
    back = body.ankles[0, 0, 2]
    body.position[:, 0], body.position[:, 2] = x + sway[:, 0], z + sway[:, 1]
    body.heading = heading
    prints = np.array([[gait.width * SIGN[side], back, yaw0[side]] for side in (0, 1)])
    body.ankles[..., 0], body.ankles[..., 2] = prints[:, :1], prints[:, 1:2]
    raised = np.zeros((2, len(t)))

    moving = np.interp(t, fine, pace) / speed
    flight = (t - start) / gait.step - (gait.swing / gait.step - 1) / 2
    body.position[:, 1] += moving * (gait.bounce * np.cos(2 * np.pi * flight) - gait.sink)
    side, lift_off = first, start
    while lift_off < min(end, halt + gait.step):
        down = lift_off + gait.swing
        stance = 2 * gait.step - gait.swing
        px, pz, yaw = (float(v[0]) for v in at(np.array([down + stance / 2])))
        across, along = gait.width * SIGN[side], back - gait.behind
        sin, cos = np.sin(yaw), np.cos(yaw)
        goal = np.array([px + across * cos + along * sin, pz - across * sin + along * cos, yaw + yaw0[side]])
        s = np.clip((t - lift_off) / gait.swing, 0, 1)
        share = _ease(s, 0.08, 0.96)
        length = np.hypot(*(goal - prints[side])[:2])
        size = np.clip(length / 0.5 + abs(goal[2] - prints[side][2]) / 1.0, 0.25, 1.0)
        body.ankles[side, :, 0] += share * (goal[0] - prints[side][0])
        body.ankles[side, :, 2] += share * (goal[1] - prints[side][1])
        body.foot_yaw[side] += share * (goal[2] - prints[side][2])
        rise = np.sin(np.pi * s) ** 1.5 * (1 + 0.4 * np.cos(np.pi * s))
        body.ankles[side, :, 1] += size * gait.lift * rise
        raised[side] += np.sin(np.pi * s) ** 2
        peel = min(0.45 * stance, 0.22)
        heel_up = _pulse(t, lift_off - peel, lift_off + 0.03, lift_off + 0.03, down - 0.03)
        toe_up = _pulse(t, lift_off + 0.5 * gait.swing, down - 0.02, down, down + 0.1)
        body.foot_pitch[side] += size * (gait.heel_off * heel_up - gait.toe_up * toe_up)
        prints[side] = goal
        side, lift_off = 1 - side, lift_off + gait.step

    forward, left = np.array([np.sin(heading), np.cos(heading)]), np.array([np.cos(heading), -np.sin(heading)])
    body.position[:, [0, 2]] += (0.025 * (raised[1] - raised[0]) * left).T
    apart = body.ankles[1][:, [0, 2]] - body.ankles[0][:, [0, 2]]
    return (apart.T * forward).sum(0)


def walk(rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> Body:
    direction = requested["direction"]
    sign = 1 if direction in ("left", "counterclockwise") else -1
    sideways = direction in ("left", "right")
    body = Body(rng, t, 0.15 if sideways else None)
    if sideways:
        speed, first = rng.uniform(0.45, 0.6), LEFT if sign > 0 else RIGHT
        gait = Gait(0.46, 0.38, 0.15, 0.25, 0.05, 0.16)
        _walk_along(body, rng, gait, speed, lambda s: (sign * s, 0 * s, 0 * s), first)
        return body
    if direction == "backward":
        speed = rng.uniform(0.6, 0.9)
        gait = Gait(0.54, 0.42, 0.12, -0.2, -0.4, rng.uniform(0.08, 0.1))
        apart = _walk_along(body, rng, gait, speed, lambda s: (0 * s, -s, 0 * s), RIGHT)
    elif direction == "forward":
        low, high = {"slow": (0.5, 0.7), "normal": (1.0, 1.25), "fast": (1.55, 1.8)}[str(requested["speed"])]
        speed = rng.uniform(low, high)
        step = np.interp(speed, [0.5, 1.2, 1.8], [0.66, 0.52, 0.42]) * rng.uniform(0.95, 1.05)
        lift, sink = rng.uniform(0.1, 0.13), 0.02 + 0.01 * speed
        gait = Gait(step, 0.82 * step, lift, 0.25 + 0.4 * speed, 0.15 + 0.12 * speed, 0.085, sink)
        body.spine[0] += 0.03 * speed
        apart = _walk_along(body, rng, gait, speed, lambda s: (0 * s, s, 0 * s), RIGHT)
    else:
        speed = rng.uniform(1.0, 1.2)
        radius = speed * (t[-1] - 0.45) / rng.uniform(np.radians(180), np.radians(220))
        gait = Gait(0.5, 0.41, 0.11, 0.6, 0.25, 0.085)
        body.spine[2] += 0.06 * sign
        body.head[1] += 0.2 * sign

        def circle(s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            angle = s / radius
            return sign * radius * (1 - np.cos(angle)), radius * np.sin(angle), sign * angle

        apart = _walk_along(body, rng, gait, speed, circle, LEFT if sign > 0 else RIGHT)
    _swing_arms(body, apart, rng.uniform(0.5, 0.75))
    return body


def run(rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> Body:
    body = Body(rng, t)
    body.spine[0] += 0.12
    body.pelvis[0] += 0.06
    step = rng.uniform(0.34, 0.38)
    gait = Gait(step, 1.3 * step, rng.uniform(0.2, 0.26), 1.1, 0.15, 0.07, sink=0.06, bounce=0.035, behind=0.12)
    apart = _walk_along(body, rng, gait, rng.uniform(2.4, 3.0), lambda s: (0 * s, s, 0 * s), RIGHT)
    for side in (0, 1):
        body.move_arm(side, _ease(t, 0, 0.5), (-0.1, 0.2, -0.6, rng.uniform(1.4, 1.7)))
    _swing_arms(body, apart, rng.uniform(0.7, 0.9))
    return body


def _swing_arms(body: Body, apart: np.ndarray, size: float) -> None:
    """Swings the arms opposite to the legs, and the shoulders opposite to the hips."""
    body.pelvis[1] += 0.15 * apart
    body.spine[1] -= 0.3 * apart
    for side in (0, 1):
        body.arms[side, 0] += size * SIGN[side] * apart
        body.arms[side, 3] += 0.35 * np.maximum(SIGN[side] * apart, 0)


def turn(rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> Body:
    body, sign = Body(rng, t), 1 if requested["direction"] == "left" else -1
    speed = rng.uniform(np.radians(85), np.radians(140)) / (t[-1] - 1.2)
    gait = Gait(0.36, 0.3, 0.07, 0.3, 0.0, 0.1)
    _walk_along(body, rng, gait, speed, lambda s: (0 * s, 0 * s, sign * s), LEFT if sign > 0 else RIGHT, stops=True)
    ahead = np.gradient(body.heading, t)
    body.head[1] += 0.2 * ahead  # the head looks in the direction of the turn
    body.spine[1] += 0.08 * ahead
    return body


def _events(rng: np.random.Generator, t: np.ndarray, count: int, slowest: float) -> list[tuple[float, float]]:
    """Returns (start, seconds) of `count` repetitions of equal duration at a random time inside the clip."""
    seconds = min(rng.uniform(0.85, 1.0) * slowest, (t[-1] - 0.3) / count)
    start = rng.uniform(0.1, max(0.15, min(0.4, t[-1] - 0.15 - seconds * count)))
    return [(start + n * seconds, seconds) for n in range(count)]


def jump(rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> Body:
    body = Body(rng, t)
    depth, reach = rng.uniform(0.16, 0.24), rng.uniform(0.8, 1.6)
    for start, seconds in _events(rng, t, int(requested["count"]), 1.05):
        up = start + 0.4 * seconds
        air = min(rng.uniform(0.36, 0.44), 0.42 * seconds)
        land = up + air
        crouch = _pulse(t, start, start + 0.25 * seconds, start + 0.25 * seconds, up + 0.02)
        absorb = _pulse(t, land - 0.03, land + 0.1, land + 0.1, start + seconds)
        s = np.clip((t - up) / air, 0, 1)
        height = 9.81 / 8 * air**2 * 4 * s * (1 - s)
        body.position[:, 1] += height - depth * crouch - 0.6 * depth * absorb
        body.position[:, 2] -= 0.05 * crouch
        body.ankles[..., 1] += height + 0.04 * np.sin(np.pi * s) ** 2
        body.foot_pitch += 0.6 * _pulse(t, up - 0.1, up, land - 0.05, land + 0.08)
        body.spine[0] += 0.45 * crouch + 0.25 * absorb
        body.pelvis[0] += 0.2 * crouch + 0.1 * absorb
        body.arms[:, 0] += reach * _pulse(t, up - 0.15, up + 0.15, up + 0.15, land + 0.2) - 0.7 * crouch
    return body


def wave(rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> Body:
    body = Body(rng, t)
    start, end = rng.uniform(0.1, 0.3), t[-1]
    weight = _pulse(t, start, start + 0.5, end - 0.45, end + 0.05)
    swing = 2 * np.pi * rng.uniform(1.4, 1.7) * (t - start)
    forward, sideways, size = rng.uniform(0.2, 0.5), rng.uniform(1.3, 1.7), rng.uniform(0.45, 0.6)
    for side in SIDES[str(requested["side"])]:
        pose = (forward, sideways + 0.1 * np.sin(swing), np.pi / 2, rng.uniform(1.3, 1.5) + size * np.sin(swing))
        body.move_arm(side, weight, pose)
        body.spine[2] -= 0.03 * SIGN[side] * weight
    return body


def raise_arms(rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> Body:
    body = Body(rng, t)
    start = rng.uniform(0.15, 0.5)
    weight = _ease(t, start, start + rng.uniform(0.7, 1.0))
    over_front, high = rng.random() < 0.5, rng.uniform(2.7, 3.0)
    for side in SIDES[str(requested["side"])]:
        pose = (high, 0.05, -0.2, 0.15) if over_front else (0.1, high, 1.2, 0.15)
        body.move_arm(side, weight, pose)
        body.spine[2] -= 0.05 * SIGN[side] * weight
    return body


def kick(rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> Body:
    body = Body(rng, t)
    (side,) = SIDES[str(requested["side"])]
    high = rng.uniform(1.15, 1.45)
    events = _events(rng, t, int(requested["count"]), 1.25)
    first, last = events[0][0], events[-1][0] + events[-1][1]
    leaning = _pulse(t, first - 0.1, first + 0.2, last - 0.2, last)
    body.position[:, 0] -= 0.07 * SIGN[side] * leaning
    body.spine[2] += 0.06 * SIGN[side] * leaning
    for arm in (0, 1):
        body.move_arm(arm, leaning, (0.5, 0.4, -0.6, 1.3))
    for start, seconds in events:
        at = start + seconds * np.array([0.0, 0.18, 0.28, 0.52, 0.58, 0.8, 1.0])
        back = _pulse(t, at[0], at[1], at[1], at[3])
        out = _pulse(t, at[1], at[3], at[4], at[6])
        hip = high * out - 0.4 * back
        knee = 0.2 + 1.3 * _pulse(t, at[0], at[2], at[2], at[3]) + 0.9 * _pulse(t, at[4], at[5], at[5], at[6])
        free = _pulse(t, at[0], at[1], at[5], at[6])
        root = body.position + np.array([SIGN[side] * HIP[0], HIP[1], HIP[2]])
        zero = np.zeros_like(hip)
        thigh = np.stack([zero, -np.cos(hip), np.sin(hip)], -1)
        shin = np.stack([zero, -np.cos(hip - knee), np.sin(hip - knee)], -1)
        body.ankles[side] += free[:, None] * (root + THIGH * thigh + SHIN * shin - body.ankles[side])
        body.foot_pitch[side] += 0.4 * back + 0.3 * free - 0.8 * out
        body.pelvis[0] -= 0.15 * out
        body.spine[0] += 0.1 * out
        body.spine[1] += 0.25 * SIGN[side] * out
        body.arms[1 - side, 0] += 0.6 * out
        body.arms[side, 0] -= 0.6 * out
    return body


def punch(rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> Body:
    body = Body(rng, t, 0.13)
    (side,) = SIDES[str(requested["side"])]
    body.ankles[..., 2] += rng.uniform(0.04, 0.1) * rng.choice([-1, 1]) * SIGN[:, None]
    body.position[:, 1] -= 0.03
    events = _events(rng, t, int(requested["count"]), 0.8)
    first, last = events[0][0], events[-1][0] + events[-1][1]
    guard = _pulse(t, first - 0.1, first + 0.2, last, last + 0.4)
    for arm in (0, 1):
        body.move_arm(arm, guard, (0.6, 0.2, -0.5, 2.2))
    for start, seconds in events:
        at = start + seconds * np.array([0.15, 0.45, 0.55, 1.0])
        out = _pulse(t, *at)
        body.move_arm(side, out, (1.55, 0.1, -0.5, 0.12))
        body.spine[1] -= 0.5 * SIGN[side] * out
        body.pelvis[1] -= 0.15 * SIGN[side] * out
        body.head[1] += 0.5 * SIGN[side] * out
        body.position[:, 2] += 0.05 * out
    return body


def squat(rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> Body:
    body = Body(rng, t, rng.uniform(0.12, 0.15))
    depth, reach = rng.uniform(0.34, 0.44), rng.uniform(1.0, 1.5)
    for start, seconds in _events(rng, t, int(requested["count"]), 1.5):
        down = _pulse(t, start, start + 0.45 * seconds, start + 0.5 * seconds, start + seconds)
        body.position[:, 1] -= depth * down
        body.position[:, 2] -= 0.16 * down
        body.pelvis[0] += 0.35 * down
        body.spine[0] += 0.35 * down
        body.head[0] -= 0.4 * down
        body.arms[:, 0] += (reach + 0.3) * down
    return body


def bow(rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> Body:
    body = Body(rng, t)
    start, end = rng.uniform(0.15, 0.35), t[-1] - rng.uniform(0.1, 0.25)
    middle, half = (start + end) / 2, rng.uniform(0.1, 0.25)
    down = _pulse(t, start, middle - half, middle + half, end)
    deep = rng.uniform(0.9, 1.3)
    body.pelvis[0] += 0.4 * deep * down
    body.spine[0] += 0.6 * deep * down
    body.head[0] += 0.2 * down
    body.position[:, 2] -= 0.13 * deep * down
    body.arms[:, 0] += 0.75 * deep * down
    return body


def stand(rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> Body:
    return Body(rng, t)
