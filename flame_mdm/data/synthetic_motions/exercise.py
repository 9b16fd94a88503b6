"""Exercises: stretching, leaning, jumping jacks, push-ups, hopping on one leg, and kneeling."""

import numpy as np

from flame_mdm.data.synthetic_motions.body import (
    FOOT,
    SIDES,
    SIGN,
    Attributes,
    Body,
    ease,
    events,
    flight,
    pulse,
)

LYING_HEEL = 1.35  # angle of a foot that rests on its toes behind a lying body, in radians


def stretch(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Reaches up with both arms while on tiptoe, or bends to one side with the arms overhead."""
    start = rng.uniform(0.05, 0.2)
    up = pulse(t, start, start + rng.uniform(0.7, 0.9), t[-1] - 0.7, t[-1])
    for side in (0, 1):
        body.move_arm(side, up, (rng.uniform(2.8, 2.95), 0.02, -0.2, rng.uniform(0.1, 0.3)))
    if "direction" not in requested:
        tall = pulse(t, start + 0.4, start + 0.95, t[-1] - 0.85, t[-1] - 0.35)
        body.position[:, 1] += 0.07 * tall
        body.foot_pitch += 0.5 * tall
        body.spine[0] -= 0.18 * up
        body.head[0] -= 0.2 * up
        return
    sign = 1 if requested["direction"] == "left" else -1
    aside = pulse(t, start + 0.3, start + 1.05, t[-1] - 0.8, t[-1] - 0.1)
    body.spine[2] += sign * rng.uniform(0.5, 0.65) * aside
    body.pelvis[2] += 0.12 * sign * aside
    body.position[:, 0] -= 0.05 * sign * aside


def lean(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Leans the trunk to one side and straightens up again."""
    sign = 1 if requested["direction"] == "left" else -1
    start = rng.uniform(0.05, 0.25)
    aside = pulse(t, start, start + rng.uniform(0.7, 0.9), t[-1] - 0.75, t[-1])
    body.spine[2] += sign * rng.uniform(0.42, 0.55) * aside
    body.pelvis[2] += sign * 0.14 * aside
    body.position[:, 0] += 0.02 * sign * aside
    side = 0 if sign > 0 else 1
    body.arms[side, :2] += np.array([[0.05], [0.4]]) * aside
    body.arms[1 - side, 1] -= 0.3 * aside
    body.head[2] += 0.1 * sign * aside


def jumping_jacks(
    body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes
) -> None:
    """Jumps into a wide stance while the arms swing overhead, and then jumps back."""
    wide = rng.uniform(0.2, 0.26)
    for start, seconds in events(rng, t, int(requested["count"]), 1.05):
        air = min(0.26, 0.3 * seconds)
        out, back = start + 0.12 * seconds, start + 0.6 * seconds
        apart = ease(t, out, out + air) - ease(t, back, back + air)
        height = flight(t, out, air) + flight(t, back, air)
        dip = sum(pulse(t, at - 0.12, at, at, at + 0.02) for at in (out, back))
        land = sum(
            pulse(t, at + air - 0.02, at + air + 0.06, at + air + 0.06, at + air + 0.18)
            for at in (out, back)
        )
        body.position[:, 1] += height - 0.06 * dip - 0.05 * land
        body.ankles[..., 1] += height
        body.ankles[..., 0] += wide * SIGN[:, None] * apart
        for at in (out, back):
            body.foot_pitch += 0.4 * pulse(t, at - 0.08, at, at + air - 0.04, at + air + 0.06)
        arms = pulse(t, out - 0.05, out + air + 0.1, back - 0.05, back + air + 0.1)
        for side in (0, 1):
            body.move_arm(side, arms, (0.15, 2.75, 1.2, 0.2))


def push_ups(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Lowers the straight body between the hands and pushes it up again.

    The motion begins and ends in a plank.
    """
    down = sum(
        pulse(t, s, s + 0.42 * d, s + 0.5 * d, s + d)
        for s, d in events(rng, t, int(requested["count"]), 1.2)
    )
    # Slope of the line from the feet to the shoulders
    slope = 0.27 - rng.uniform(0.17, 0.2) * down
    body.foot_pitch += LYING_HEEL
    body.foot_yaw *= 0.2
    body.ankles[..., 0] = 0.09 * SIGN[:, None]
    toes_ahead, toes_below = _toes(LYING_HEEL)
    back = -0.8
    body.ankles[..., 2] = back + toes_ahead - FOOT[2]
    legs = 0.888  # distance from the ankles to the pelvis
    body.position[:, 2] = back + legs * np.cos(slope)
    body.position[:, 1] = toes_below + legs * np.sin(slope)
    body.position[:, 0] *= 0.3
    body.pelvis *= 0.3
    body.pelvis[0] += np.pi / 2 - slope
    body.spine *= 0.3
    body.head[0] -= rng.uniform(0.25, 0.4)
    wide = rng.uniform(0.24, 0.3)
    for side, sign in enumerate(SIGN):
        body.move_arm(side, np.ones_like(t), (1.2, 0.5, -0.3, 0.6))
        hand = (sign * wide, 0.03, back + legs * np.cos(0.27) + 0.42)
        body.reach(side, np.ones_like(t), hand)


def _toes(heel: float) -> tuple[float, float]:
    """Returns the position of the toes, in meters, of a foot with a raised heel.

    The two numbers are the distances by which the toes are in front of the ankle and below it.
    """
    _, low, ahead = FOOT
    return ahead * np.cos(heel) + low * np.sin(heel), ahead * np.sin(heel) - low * np.cos(heel)


def hop(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Hops on one leg while holding the other foot up behind the body."""
    (side,) = SIDES[str(requested["side"])]
    sign, hops = SIGN[side], events(rng, t, int(requested["count"]), 0.75)
    first, last = hops[0][0], hops[-1][0] + hops[-1][1]
    start = max(0.0, first - 0.3)
    free = pulse(t, start, first + 0.12, last - 0.1, last + 0.3)
    body.position[:, 0] += 0.075 * sign * free
    body.ankles[1 - side] += free[:, None] * np.array([0.0, 0.3, -0.22])
    body.foot_pitch[1 - side] += 0.7 * free
    for arm in (0, 1):
        body.move_arm(arm, free, (0.35, 0.55, -0.3, 1.1))
    for begin, seconds in hops:
        air = min(0.3, 0.42 * seconds)
        up = begin + 0.38 * seconds
        land = up + air
        dip = pulse(t, begin, begin + 0.26 * seconds, begin + 0.26 * seconds, up + 0.02)
        absorb = pulse(t, land - 0.02, land + 0.07, land + 0.07, begin + seconds)
        height = flight(t, up, air)
        body.position[:, 1] += height - 0.1 * dip - 0.07 * absorb
        body.ankles[..., 1] += height
        body.foot_pitch[side] += 0.5 * pulse(t, up - 0.08, up, land - 0.05, land + 0.07)
        body.spine[0] += 0.18 * dip
        body.arms[:, 0] += 0.5 * pulse(t, up - 0.1, up + 0.12, up + 0.12, land + 0.15)


def kneel(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Steps back with one foot and goes down on that knee."""
    side, start = int(rng.integers(2)), rng.uniform(0.05, 0.2)
    low = start + rng.uniform(1.2, 1.5)
    down, swing = ease(t, start + 0.2, low), ease(t, start, start + 0.7)
    body.position[:, 1] += down * (0.525 - body.position[:, 1])
    body.position[:, 2] -= 0.1 * down
    heel = 1.2
    body.foot_pitch[side] += heel * ease(t, start + 0.4, low)
    toes_ahead, _ = _toes(heel)
    back = -0.52 + toes_ahead - FOOT[2] - body.ankles[side, 0, 2]
    body.ankles[side, :, 2] += back * swing
    body.ankles[side, :, 1] += 0.3 * swing * (1 - swing)
    other = ease(t, start + 0.5, low - 0.3)
    body.ankles[1 - side, :, 2] += 0.24 * other
    body.ankles[1 - side, :, 1] += 0.2 * other * (1 - other)
    bent = pulse(t, start, start + 0.7, start + 0.9, low + 0.1)
    body.spine[0] += 0.3 * bent
    body.pelvis[0] += 0.1 * bent
    body.move_arm(1 - side, down, (0.75, 0.15, -0.4, 1.0))
