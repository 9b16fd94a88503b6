"""Actions for games: dodging, ducking, blocking, being hit, and striking with a sword."""

import numpy as np

from flame_mdm.data.synthetic_motions.body import (
    SIDES,
    SIGN,
    Attributes,
    Body,
    beat,
    ease,
    follow_feet,
    pulse,
    step,
)
from flame_mdm.data.synthetic_motions.gestures import lie


def guard(body: Body, weight: np.ndarray) -> None:
    """Raises both fists in front of the chest, with bent knees."""
    body.position[:, 1] -= 0.05 * weight
    for side in (0, 1):
        body.move_arm(side, weight, (0.6, 0.3, -0.35, 2.1))


def stance(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Waits with raised fists and one foot forward, bouncing on bent knees."""
    sign, bounce = rng.choice(SIGN), beat(t, rng.uniform(1.2, 1.7), rng.random())
    guard(body, np.ones_like(t))
    body.ankles[..., 2] += 0.13 * sign * SIGN[:, None]
    body.position[:, 1] -= 0.05 - 0.012 * bounce
    body.position[:, 2] += 0.02 * beat(t, rng.uniform(0.4, 0.7), rng.random())
    body.pelvis[1] -= 0.25 * sign
    body.spine[0] += 0.12 + 0.02 * bounce
    body.head[1] += 0.25 * sign
    body.arms[:, 3] += 0.1 * bounce


def dodge(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Dodges to the side or back in a fraction of a second, then stands upright again."""
    start = rng.uniform(0.3, 0.7)
    quick = pulse(t, start, start + 0.28, start + 0.5, start + 1.1)
    guard(body, pulse(t, 0.05, 0.35, start + 0.7, t[-1]))
    if requested["direction"] == "backward":
        far = rng.uniform(0.35, 0.45)
        first, by = rng.integers(2), (0.0, 0.0, -far)
        body.spine[0] -= 0.35 * quick
        body.pelvis[0] -= 0.1 * quick
    else:
        first = 0 if requested["direction"] == "left" else 1
        by = (SIGN[first] * rng.uniform(0.35, 0.5), 0.0, 0.0)
        body.spine[2] += 0.45 * SIGN[first] * quick
        body.pelvis[2] += 0.12 * SIGN[first] * quick
        body.spine[1] += 0.2 * SIGN[first] * quick
    step(body, int(first), start, start + 0.26, by, 0.07, 0.2)
    step(body, 1 - int(first), start + 0.2, start + 0.5, by, 0.07, 0.2)
    follow_feet(body)
    body.position[:, 1] -= 0.14 * quick


def duck(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Drops into a crouch with the hands over the head, and rises again."""
    start = rng.uniform(0.25, 0.55)
    down = pulse(
        t, start, start + rng.uniform(0.3, 0.4), start + rng.uniform(0.7, 0.9), t[-1] - 0.1
    )
    body.position[:, 1] -= rng.uniform(0.36, 0.44) * down
    body.position[:, 2] -= 0.12 * down
    body.pelvis[0] += 0.4 * down
    body.spine[0] += 0.65 * down
    body.head[0] += 0.35 * down
    for side, sign in enumerate(SIGN):
        body.move_arm(side, down, (1.6, 0.7, 0.0, 2.3))
        body.reach(side, down, (0.1 * sign, 0.15, 0.03), "head")


def hit(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Reacts to a blow from the front: the head and trunk snap back, and one foot steps back."""
    start, side = rng.uniform(0.3, 0.6), int(rng.integers(2))
    sign, snap = SIGN[side], rng.uniform(0.8, 1.1)
    jerk = pulse(t, start, start + 0.14, start + 0.2, start + 0.8)
    bent = pulse(t, start + 0.3, start + 0.75, start + 1.0, t[-1])
    body.spine[0] += snap * (0.4 * bent - 0.4 * jerk)
    body.pelvis[0] -= 0.15 * jerk
    body.head[0] -= 0.5 * snap * jerk - 0.2 * bent
    body.head[1] += 0.4 * sign * jerk
    body.spine[1] += 0.45 * sign * snap * jerk
    for arm in (0, 1):
        body.move_arm(arm, jerk, (0.5, 0.75, -0.2, 1.0))
    body.move_arm(side, bent, (0.4, 0.3, -0.5, 1.7))
    body.reach(side, bent, (0.04 * sign, -0.12, 0.15), "chest")
    step(body, side, start + 0.08, start + 0.42, (0.0, 0.0, -rng.uniform(0.28, 0.36)), 0.06, 0.1)
    follow_feet(body)
    body.position[:, 2] -= 0.06 * jerk
    body.position[:, 1] -= 0.06 * pulse(t, start + 0.1, start + 0.45, start + 0.6, t[-1])


def block(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Crosses the forearms in front of the face and bends the knees."""
    start = rng.uniform(0.15, 0.45)
    up = pulse(t, start, start + rng.uniform(0.25, 0.35), t[-1] - 0.6, t[-1])
    for side, sign in enumerate(SIGN):
        body.move_arm(side, up, (1.2, 0.25, -0.3, 2.0))
        body.reach(side, up, (-0.05 * sign, 0.24 + 0.02 * side, 0.27 + 0.06 * side), "chest")
    body.spine[0] += 0.18 * up
    body.head[0] += 0.12 * up
    body.position[:, 1] -= 0.12 * up
    step(body, int(rng.integers(2)), start - 0.1, start + 0.25, (0.0, 0.0, -0.25), 0.06, 0.2)
    follow_feet(body)


def slash(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Raises a sword beside the head, steps forward, and cuts down across the body."""
    (side,) = SIDES[str(requested["side"])]
    sign, stretch = SIGN[side], min(1.1, t[-1] / 2.3)
    a, b, c, d, e, f = rng.uniform(0.05, 0.15) + stretch * np.array(
        [0.0, 0.65, 0.8, 1.08, 1.3, 1.95]
    )
    back, cut = pulse(t, a, b, c, d), pulse(t, c, d, e, f)
    ready = pulse(t, a, b, e, f)
    swing = ease(t, c, d)
    high = np.array([0.27 * sign, 0.42, 0.02])
    low = np.array([-0.16 * sign, -0.22, 0.33])
    over = np.array([0.08 * sign, 0.2, 0.26]) * (4 * swing * (1 - swing))[:, None]
    body.move_arm(side, ready, (1.3, 0.6 - 0.5 * swing, -0.2, 1.2 - 0.4 * swing))
    body.reach(side, ready, high + swing[:, None] * (low - high) + over, "chest")
    body.move_arm(1 - side, ready, (0.5, 0.5, -0.3, 1.1))
    body.spine += np.stack([0.35 * cut - 0.12 * back, sign * (0.3 * back - 0.55 * cut), 0 * t])
    body.pelvis[1] += sign * (0.1 * back - 0.2 * cut)
    body.head[1] += sign * (0.5 * cut - 0.25 * back)
    step(body, side, b - 0.1, d, (0.0, 0.0, rng.uniform(0.25, 0.32)), 0.06, 0.2)
    follow_feet(body)
    body.position[:, 1] -= 0.08 * pulse(t, c, d, e, f)


def fall(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Loses balance, falls backward to the floor, and stays on the back.

    This motion is faster than lying down.
    """
    start, end = rng.uniform(0.15, 0.3), rng.uniform(1.35, 1.5)
    lie(
        body,
        rng,
        t[-1] * np.interp(t, [0, start, start + 0.5, end, t[-1]], [0, 0.03, 0.4, 0.97, 1]),
        requested,
    )
    flail = pulse(t, 0.05, start + 0.2, start + 0.3, start + 0.6)
    for side in (0, 1):
        body.move_arm(side, flail, (1.2, 0.8, 0.0, 0.4))
