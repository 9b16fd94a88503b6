"""Walking, running, turning, dancing and crawling: the pelvis follows a path of footprints."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from flame_mdm.data.synthetic_motions.body import (
    FOOT,
    LEFT,
    RIGHT,
    SIGN,
    Attributes,
    Body,
    ease,
    pulse,
)

Path = Callable[[np.ndarray, float], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Signature of a path.

It maps fractions (N,) of the path and its length in meters to x (N,), z (N,) and heading (N,).
"""


@dataclass(frozen=True)
class Gait:
    """Parameters of footsteps, in seconds, meters and radians."""

    # Approximate time from one footprint to the next
    step: float
    # Time that a foot spends in the air, as a multiple of the time per step. Above 1, both feet are
    # in the air between two steps, as in a run.
    swing: float
    # Height of the foot in the middle of its swing
    lift: float
    # Angle of the heel when the foot leaves the floor
    heel_off: float
    # Angle of the toes when the foot lands. If it is negative, the toes land first.
    toe_up: float
    # Half the distance between the tracks of the feet
    width: float
    # Distance by which the pelvis is lowered while the body moves
    sink: float = 0.03
    # Amplitude of the vertical motion of the pelvis, which is highest when both feet are in the air
    bounce: float = 0.0
    # Distance by which footprints are shifted backward, relative to the pelvis
    behind: float = 0.0


def walk_along(
    body: Body, rng: np.random.Generator, gait: Gait, speed: float, path: Path, first: int
) -> np.ndarray:
    """Moves the pelvis along a path at `speed` m/s, with footprints on both sides of the path.

    The foot `first` takes the first step. Returns how far (F,) the right foot is in front of the
    left foot, in meters along the heading of the pelvis.
    """
    # The pelvis accelerates, keeps its speed and stops. Each footprint is at the position of the
    # pelvis in the middle of the foot's next stance, shifted sideways by the width of the gait. On
    # average, the feet are therefore below the body.
    t, start = body.t, rng.uniform(0.08, 0.18)
    # Time until the last foot is on the floor
    seconds = t[-1] - rng.uniform(0.06, 0.16) - start
    # A run ends with walking steps, in which the feet never leave the ground at the same time.
    landing = min(gait.swing, 0.82)
    count = max(1, round(seconds / gait.step - landing))
    gait = replace(gait, step=seconds / (count + landing))
    halt = start + (count + 0.5 * landing) * gait.step
    fine = np.arange(0, t[-1] + 3, 0.01)
    ramp = min(0.2 + 0.17 * speed, (halt - start + 0.1) / 2)
    pace = pulse(fine, start - 0.1, start - 0.1 + ramp, halt - ramp, halt)
    progress = np.cumsum(pace) - pace
    length = speed * 0.01 * progress[-1]

    def at(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return path(np.interp(time, fine, progress / progress[-1]), length)

    x, z, heading = at(t)
    sway, yaw0 = body.position[:, [0, 2]].copy(), body.foot_yaw[:, 0].copy()
    back = body.ankles[0, 0, 2]
    body.position[:, 0], body.position[:, 2] = x + sway[:, 0], z + sway[:, 1]
    body.heading = heading
    prints = np.array([[gait.width * SIGN[side], back, yaw0[side]] for side in (0, 1)])
    body.ankles[..., 0], body.ankles[..., 2] = prints[:, :1], prints[:, 1:2]
    raised = np.zeros((2, len(t)))

    moving = np.interp(t, fine, pace)
    flight = (t - start) / gait.step - (gait.swing - 1) / 2
    body.position[:, 1] += moving * (gait.bounce * np.cos(2 * np.pi * flight) - gait.sink)
    for number in range(count + 1):
        side, lift_off = (first + number) % 2, start + number * gait.step
        run = float(np.interp(lift_off + 0.5 * gait.step, fine, pace)) if gait.swing > 1 else 0.0
        swing = gait.step * (landing + run * (gait.swing - landing))
        down, stance = lift_off + swing, 2 * gait.step - swing
        px, pz, yaw = (float(v[0]) for v in at(np.array([down + stance / 2])))
        across, along = gait.width * SIGN[side], back - run * gait.behind
        sin, cos = np.sin(yaw), np.cos(yaw)
        goal = np.array(
            [px + across * cos + along * sin, pz - across * sin + along * cos, yaw + yaw0[side]]
        )
        # In the air, the foot moves smoothly from footprint to footprint. Its highest point is
        # early in the swing, because it has just been lifted. Smaller steps are lower.
        s = np.clip((t - lift_off) / swing, 0, 1)
        share = ease(s, 0.08, 0.96)
        distance = np.hypot(*(goal - prints[side])[:2])
        size = np.clip(distance / 0.5 + abs(goal[2] - prints[side][2]) / 1.0, 0.4, 1.0)
        body.ankles[side, :, 0] += share * (goal[0] - prints[side][0])
        body.ankles[side, :, 2] += share * (goal[1] - prints[side][1])
        body.foot_yaw[side] += share * (goal[2] - prints[side][2])
        rise = np.sin(np.pi * s) ** 1.5 * (1 + 0.4 * np.cos(np.pi * s))
        body.ankles[side, :, 1] += size * gait.lift * rise
        raised[side] += np.sin(np.pi * s) ** 2
        peel = min(0.45 * stance, 0.22)
        heel_up = pulse(t, lift_off - peel, lift_off + 0.03, lift_off + 0.03, down - 0.03)
        toe_up = pulse(t, lift_off + 0.5 * swing, down - 0.02, down, down + 0.1)
        body.foot_pitch[side] += size * (gait.heel_off * heel_up - gait.toe_up * toe_up)
        prints[side] = goal

    forward = np.array([np.sin(heading), np.cos(heading)])
    left = np.array([np.cos(heading), -np.sin(heading)])
    body.position[:, [0, 2]] += (0.025 * (raised[1] - raised[0]) * left).T
    apart = body.ankles[1][:, [0, 2]] - body.ankles[0][:, [0, 2]]
    return (apart.T * forward).sum(0)


def straight(x: float, z: float) -> Path:
    """Returns a straight path along the vector (x, z), which also scales the path's length."""
    return lambda share, length: (x * share * length, z * share * length, 0 * share)


def walk(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Walks straight ahead, backward, sideways or along a circle."""
    direction = requested["direction"]
    sign = 1 if direction in ("left", "counterclockwise") else -1
    if direction in ("left", "right"):
        speed, first = rng.uniform(0.45, 0.6), LEFT if sign > 0 else RIGHT
        walk_along(
            body, rng, Gait(0.46, 0.82, 0.15, 0.25, 0.05, 0.16), speed, straight(sign, 0), first
        )
        return
    if direction == "backward":
        speed = rng.uniform(0.6, 0.9)
        gait = Gait(0.54, 0.78, 0.12, -0.2, -0.4, rng.uniform(0.08, 0.1))
        apart = walk_along(body, rng, gait, speed, straight(0, -1), RIGHT)
    elif direction == "forward":
        low, high = {"slow": (0.5, 0.7), "normal": (1.0, 1.25), "fast": (1.55, 1.8)}[
            str(requested["speed"])
        ]
        speed = rng.uniform(low, high)
        step = np.interp(speed, [0.5, 1.2, 1.8], [0.66, 0.52, 0.42]) * rng.uniform(0.95, 1.05)
        lift, sink = rng.uniform(0.1, 0.13), 0.02 + 0.01 * speed
        gait = Gait(step, 0.82, lift, 0.25 + 0.4 * speed, 0.15 + 0.12 * speed, 0.085, sink)
        body.spine[0] += 0.03 * speed
        apart = walk_along(body, rng, gait, speed, straight(0, 1), RIGHT)
    else:
        arc = sign * rng.uniform(np.radians(180), np.radians(220))
        body.spine[2] += 0.06 * sign
        body.head[1] += 0.2 * sign

        def circle(share: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            radius, angle = length / arc, share * arc
            return radius * (1 - np.cos(angle)), radius * np.sin(angle), angle

        gait = Gait(0.5, 0.82, 0.11, 0.6, 0.25, 0.085)
        apart = walk_along(
            body, rng, gait, rng.uniform(1.0, 1.2), circle, LEFT if sign > 0 else RIGHT
        )
    swing_arms(body, apart, rng.uniform(0.5, 0.75))


def run(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Runs straight ahead."""
    gait = Gait(
        rng.uniform(0.34, 0.38),
        1.3,
        rng.uniform(0.2, 0.26),
        1.1,
        0.15,
        0.07,
        0.06,
        0.035,
        behind=0.12,
    )
    apart = walk_along(body, rng, gait, rng.uniform(2.4, 3.0), straight(0, 1), RIGHT)
    speed = np.gradient(body.position[:, 2], t)
    # The body leans forward to accelerate, and backward to stop.
    body.pelvis[0] += 0.025 * speed + 0.015 * np.gradient(speed, t)
    body.spine[0] += 0.05 * speed
    for side in (0, 1):
        body.move_arm(side, np.clip(speed / 1.5, 0, 1), (-0.1, 0.3, -0.15, rng.uniform(1.4, 1.7)))
    swing_arms(body, apart, rng.uniform(0.7, 0.9))


def swing_arms(body: Body, apart: np.ndarray, size: float) -> None:
    """Swings the arms opposite to the legs, and the shoulders opposite to the hips."""
    body.pelvis[1] += 0.15 * apart
    body.spine[1] -= 0.3 * apart
    for side in (0, 1):
        body.arms[side, 0] += size * SIGN[side] * apart
        body.arms[side, 3] += 0.35 * np.maximum(SIGN[side] * apart, 0)


def turn(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Turns in place by a quarter or half turn, with small steps."""
    sign = 1 if requested["direction"] == "left" else -1
    low, high = (160, 195) if requested["amount"] == "half" else (75, 110)
    angle = sign * np.radians(rng.uniform(low, high))
    gait = Gait(0.36, 0.82, 0.09, 0.3, 0.0, 0.1)
    walk_along(
        body, rng, gait, 1.0, lambda s, _: (0 * s, 0 * s, angle * s), LEFT if sign > 0 else RIGHT
    )
    ahead = np.gradient(body.heading, t)
    body.head[1] += 0.2 * ahead  # the head looks in the direction of the turn
    body.spine[1] += 0.08 * ahead


def dance(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Steps from side to side on the beat, with swinging hips and arms."""
    beat, start, first = rng.uniform(0.44, 0.54), rng.uniform(0.1, 0.2), rng.choice(SIGN)
    going = pulse(t, start - 0.1, start + 0.4, t[-1] - 0.45, t[-1])
    phase = np.pi * (t - start) / beat
    swing, bounce = first * going * np.sin(phase), going * np.sin(phase) ** 2
    body.position[:, 0] += rng.uniform(0.09, 0.11) * swing
    body.position[:, 1] += -0.05 * going + 0.03 * bounce
    body.pelvis += np.stack([0.05 * going, 0.25 * swing, -0.12 * swing])
    body.spine += np.stack([0.08 * bounce, -0.5 * swing, 0.2 * swing])
    body.head += np.stack([0.15 * bounce, 0.2 * swing, 0.05 * swing])
    high = rng.uniform(0.2, 0.7)
    for side, sign in enumerate(SIGN):
        light = np.maximum(-sign * swing, 0) ** 1.5  # the foot that carries no weight
        body.ankles[side, :, 1] += 0.1 * light
        body.ankles[side, :, 2] += 0.08 * light
        body.foot_pitch[side] += 0.35 * light
        body.move_arm(
            side,
            going,
            (high + 0.6 * sign * swing, 0.35 + 0.25 * bounce, -0.1, 1.5 + 0.4 * sign * swing),
        )


def crawl(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Crawls on hands and knees; each hand moves with the opposite knee."""
    body.pelvis[0] += rng.uniform(1.32, 1.4)
    body.head[0] -= rng.uniform(0.5, 0.8)
    body.position[:, 1] = rng.uniform(0.465, 0.48)
    body.foot_pitch += 2.4
    body.foot_yaw *= 0.3
    body.ankles[..., 2] = -0.58 - FOOT[2]  # the toes point backward
    gait = Gait(rng.uniform(0.5, 0.58), 0.82, 0.13, 0.0, 0.0, rng.uniform(0.09, 0.11), sink=0.0)
    walk_along(body, rng, gait, rng.uniform(0.45, 0.6), straight(0, 1), RIGHT)
    apart, ahead = SIGN * rng.uniform(0.17, 0.2), rng.uniform(1.12, 1.18)
    for side in (0, 1):
        foot = body.ankles[1 - side]
        hand = np.stack([0 * t + apart[side], foot[:, 1] + 0.03, foot[:, 2] + ahead], 1)
        body.move_arm(side, np.ones_like(t), (1.3, 0.1, -0.9, 0.4))
        body.reach(side, np.ones_like(t), hand)
