"""Gestures of arms and head, on planted feet."""

import numpy as np

from flame_mdm.data.synthetic_motions.body import SIDES, SIGN, Attributes, Body, ease, events, pulse


def wave(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    start, end = rng.uniform(0.1, 0.3), t[-1]
    weight = pulse(t, start, start + 0.5, end - 0.45, end + 0.05)
    swing = 2 * np.pi * rng.uniform(1.4, 1.7) * (t - start)
    forward, sideways, size = rng.uniform(0.2, 0.5), rng.uniform(1.3, 1.7), rng.uniform(0.45, 0.6)
    for side in SIDES[str(requested["side"])]:
        pose = (forward, sideways + 0.1 * np.sin(swing), np.pi / 2, rng.uniform(1.3, 1.5) + size * np.sin(swing))
        body.move_arm(side, weight, pose)
        body.spine[2] -= 0.03 * SIGN[side] * weight


def raise_arms(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    start = rng.uniform(0.15, 0.5)
    weight = ease(t, start, start + rng.uniform(0.7, 1.0))
    over_front, high = rng.random() < 0.5, rng.uniform(2.7, 3.0)
    for side in SIDES[str(requested["side"])]:
        pose = (high, 0.05, -0.2, 0.15) if over_front else (0.1, high, 1.2, 0.15)
        body.move_arm(side, weight, pose)
        body.spine[2] -= 0.05 * SIGN[side] * weight


def punch(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    (side,) = SIDES[str(requested["side"])]
    body.ankles[..., 2] += rng.uniform(0.04, 0.1) * rng.choice([-1, 1]) * SIGN[:, None]
    body.position[:, 1] -= 0.03
    punches = events(rng, t, int(requested["count"]), 0.8)
    first, last = punches[0][0], punches[-1][0] + punches[-1][1]
    guard = pulse(t, first - 0.1, first + 0.2, last, last + 0.4)
    for arm in (0, 1):
        body.move_arm(arm, guard, (0.6, 0.3, -0.35, 2.2))
    for start, seconds in punches:
        at = start + seconds * np.array([0.15, 0.45, 0.55, 1.0])
        out = pulse(t, *at)
        body.move_arm(side, out, (1.6, -0.1, -0.5, 0.08))
        body.spine[1] -= 0.65 * SIGN[side] * out
        body.spine[0] += 0.12 * out
        body.pelvis[1] -= 0.25 * SIGN[side] * out
        body.head[1] += 0.7 * SIGN[side] * out
        body.position[:, 2] += 0.1 * out


def throw(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Draws the arm back above the shoulder, steps forward with the opposite foot, and throws."""
    (side,) = SIDES[str(requested["side"])]
    other, sign, stretch = 1 - side, SIGN[side], min(1.15, t[-1] / 2.2)
    at = rng.uniform(0.1, 0.2) + stretch * np.array([0.0, 0.75, 0.9, 1.08, 1.2, 1.75])
    back, out = pulse(t, at[0], at[1], at[2], at[3]), pulse(t, at[2], at[3], at[4], at[5])
    body.move_arm(side, ease(t, at[0], at[1]) - ease(t, at[4], at[5]), (0.1, 1.5, 1.7, 1.7))
    body.move_arm(side, ease(t, at[2], at[3]) - ease(t, at[4], at[5]), (1.75, 0.1, 0.2, 0.15))
    body.move_arm(other, back, (1.0, 0.5, -0.3, 0.5))
    twist = 0.9 * out - 0.75 * back
    body.spine += np.stack([0.35 * out - 0.2 * back, sign * twist * 0.7, 0.1 * sign * out])
    body.pelvis[1] += 0.3 * sign * twist
    body.head[1] -= 0.6 * sign * twist
    step = ease(t, at[1] - 0.3, at[2] + 0.05)
    body.ankles[other, :, 2] += rng.uniform(0.25, 0.32) * step
    body.ankles[other, :, 1] += 0.4 * step * (1 - step)
    body.position[:, 2] += 0.2 * ease(t, at[1] - 0.2, at[3]) - 0.06 * pulse(t, at[0], at[1], at[1], at[3])
    body.foot_pitch[side] += 0.25 * ease(t, at[2], at[3])


def clap(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    claps = events(rng, t, int(requested["count"]), 0.85)
    first, last = claps[0][0], claps[-1][0] + claps[-1][1]
    ready = pulse(t, first - 0.1, first + 0.3, last - 0.2, last + 0.35)
    open_ = ready - sum(pulse(t, s + 0.35 * d, s + 0.62 * d, s + 0.7 * d, s + d) for s, d in claps) * ready
    height, ahead, wide = rng.uniform(-0.12, 0.0), rng.uniform(0.28, 0.33), rng.uniform(0.2, 0.26)
    for side, sign in enumerate(SIGN):
        body.move_arm(side, ready, (0.55, 0.3, -0.4, 1.4))
        target = np.stack([sign * (0.055 + wide * open_), height + 0 * t, ahead - 0.04 * open_], 1)
        body.reach(side, ready, target, "chest")


def salute(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Brings a hand to the brow, holds it and lowers it."""
    (side,) = SIDES[str(requested["side"])]
    start = rng.uniform(0.1, 0.3)
    up = pulse(t, start, start + rng.uniform(0.45, 0.6), t[-1] - 0.6, t[-1])
    body.move_arm(side, up, (0.5, 1.2, 0.3, 2.2))
    body.reach(side, up, (SIGN[side] * rng.uniform(0.15, 0.17), rng.uniform(0.02, 0.05), 0.09), "head")
    body.spine[0] -= 0.05 * up


def nod(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    deep = rng.uniform(0.8, 0.95)
    for start, seconds in events(rng, t, int(requested["count"]), 0.9):
        down = pulse(t, start, start + 0.4 * seconds, start + 0.5 * seconds, start + 0.9 * seconds)
        body.head[0] += deep * down
        body.spine[0] += 0.12 * down


def stand(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Leaves the body as it is: it stands and breathes."""
