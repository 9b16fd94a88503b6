"""Motions in place: arm and head gestures, jumping, kicking, bending, sitting and lying down."""

import numpy as np

from flame_mdm.data.synthetic_motions.body import (
    HIP,
    SHIN,
    SIDES,
    SIGN,
    THIGH,
    Attributes,
    Body,
    ease,
    events,
    pulse,
)

CHAIR = 0.54  # height of the pelvis on a chair whose seat is 45 cm high


def wave(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Raises one or both arms and swings the forearms."""
    start, end = rng.uniform(0.1, 0.3), t[-1]
    weight = pulse(t, start, start + 0.5, end - 0.45, end + 0.05)
    swing = 2 * np.pi * rng.uniform(1.4, 1.7) * (t - start)
    forward, sideways, size = rng.uniform(0.2, 0.5), rng.uniform(1.3, 1.7), rng.uniform(0.45, 0.6)
    for side in SIDES[str(requested["side"])]:
        pose = (
            forward,
            sideways + 0.1 * np.sin(swing),
            np.pi / 2,
            rng.uniform(1.3, 1.5) + size * np.sin(swing),
        )
        body.move_arm(side, weight, pose)
        body.spine[2] -= 0.03 * SIGN[side] * weight


def raise_arms(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Raises one or both arms over the head, either forward or sideways."""
    start = rng.uniform(0.15, 0.5)
    weight = ease(t, start, start + rng.uniform(0.7, 1.0))
    over_front, high = rng.random() < 0.5, rng.uniform(2.7, 3.0)
    for side in SIDES[str(requested["side"])]:
        pose = (high, 0.05, -0.2, 0.15) if over_front else (0.1, high, 1.2, 0.15)
        body.move_arm(side, weight, pose)
        body.spine[2] -= 0.05 * SIGN[side] * weight


def punch(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Punches forward from a guard position, `count` times."""
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
    body.position[:, 2] += 0.2 * ease(t, at[1] - 0.2, at[3]) - 0.06 * pulse(
        t, at[0], at[1], at[1], at[3]
    )
    body.foot_pitch[side] += 0.25 * ease(t, at[2], at[3])


def clap(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Claps in front of the chest, `count` times."""
    claps = events(rng, t, int(requested["count"]), 0.85)
    first, last = claps[0][0], claps[-1][0] + claps[-1][1]
    ready = pulse(t, first - 0.1, first + 0.3, last - 0.2, last + 0.35)
    open_ = (
        ready
        - sum(pulse(t, s + 0.35 * d, s + 0.62 * d, s + 0.7 * d, s + d) for s, d in claps) * ready
    )
    height, ahead, wide = rng.uniform(-0.12, 0.0), rng.uniform(0.28, 0.33), rng.uniform(0.2, 0.26)
    for side, sign in enumerate(SIGN):
        body.move_arm(side, ready, (0.55, 0.3, -0.4, 1.4))
        target = np.stack([sign * (0.055 + wide * open_), height + 0 * t, ahead - 0.04 * open_], 1)
        body.reach(side, ready, target, "chest")


def salute(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Brings a hand to the brow, holds it there and lowers it."""
    (side,) = SIDES[str(requested["side"])]
    start = rng.uniform(0.1, 0.3)
    up = pulse(t, start, start + rng.uniform(0.45, 0.6), t[-1] - 0.6, t[-1])
    body.move_arm(side, up, (0.5, 1.2, 0.3, 2.2))
    body.reach(
        side, up, (SIGN[side] * rng.uniform(0.15, 0.17), rng.uniform(0.02, 0.05), 0.09), "head"
    )
    body.spine[0] -= 0.05 * up


def nod(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Lowers and raises the head, `count` times."""
    deep = rng.uniform(0.8, 0.95)
    for start, seconds in events(rng, t, int(requested["count"]), 0.9):
        down = pulse(t, start, start + 0.4 * seconds, start + 0.5 * seconds, start + 0.9 * seconds)
        body.head[0] += deep * down
        body.spine[0] += 0.12 * down


def stand(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Leaves the body unchanged: it stands and breathes."""


def jump(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Crouches, jumps and lands, `count` times."""
    depth, reach = rng.uniform(0.16, 0.24), rng.uniform(0.8, 1.6)
    for start, seconds in events(rng, t, int(requested["count"]), 1.05):
        up = start + 0.4 * seconds
        air = min(rng.uniform(0.36, 0.44), 0.42 * seconds)
        land = up + air
        crouch = pulse(t, start, start + 0.25 * seconds, start + 0.25 * seconds, up + 0.02)
        absorb = pulse(t, land - 0.03, land + 0.1, land + 0.1, start + seconds)
        s = np.clip((t - up) / air, 0, 1)
        height = 9.81 / 8 * air**2 * 4 * s * (1 - s)
        body.position[:, 1] += height - depth * crouch - 0.6 * depth * absorb
        body.position[:, 2] -= 0.05 * crouch
        body.ankles[..., 1] += height + 0.04 * np.sin(np.pi * s) ** 2
        body.foot_pitch += 0.6 * pulse(t, up - 0.1, up, land - 0.05, land + 0.08)
        body.spine[0] += 0.45 * crouch + 0.25 * absorb
        body.pelvis[0] += 0.2 * crouch + 0.1 * absorb
        body.arms[:, 0] += (
            reach * pulse(t, up - 0.15, up + 0.15, up + 0.15, land + 0.2) - 0.7 * crouch
        )


def leap(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Jumps forward with both feet."""
    length, air = rng.uniform(0.75, 1.1), rng.uniform(0.4, 0.46)
    up = rng.uniform(0.65, max(0.7, t[-1] - 1.3))
    land = up + air
    crouch = pulse(t, up - 0.6, up - 0.25, up - 0.25, up + 0.02)
    absorb = pulse(t, land - 0.04, land + 0.12, land + 0.12, land + 0.75)
    s = np.clip((t - up) / air, 0, 1)
    height = 9.81 / 8 * air**2 * 4 * s * (1 - s)
    body.position[:, 1] += height - 0.24 * crouch - 0.18 * absorb
    body.position[:, 2] += length * ease(t, up - 0.3, land + 0.3) - 0.08 * crouch
    body.ankles[..., 1] += height + 0.06 * np.sin(np.pi * s) ** 2
    body.ankles[..., 2] += length * ease(s, 0, 1)
    body.foot_pitch += 0.9 * pulse(t, up - 0.15, up, up + 0.1, land - 0.05)
    body.foot_pitch -= 0.25 * pulse(t, up + 0.15, land - 0.04, land, land + 0.1)
    body.pelvis[0] += 0.3 * crouch + 0.2 * absorb
    body.spine[0] += 0.5 * crouch + 0.35 * absorb
    body.head[0] -= 0.4 * crouch
    body.arms[:, 0] += 1.5 * pulse(t, up - 0.2, up + 0.12, up + 0.2, land + 0.5) - 0.9 * crouch


def kick(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Kicks forward with one leg while standing on the other, `count` times."""
    (side,) = SIDES[str(requested["side"])]
    high = rng.uniform(1.15, 1.45)
    kicks = events(rng, t, int(requested["count"]), 1.25)
    first, last = kicks[0][0], kicks[-1][0] + kicks[-1][1]
    leaning = pulse(t, first - 0.1, first + 0.2, last - 0.2, last)
    body.position[:, 0] -= 0.07 * SIGN[side] * leaning
    body.spine[2] += 0.06 * SIGN[side] * leaning
    for arm in (0, 1):
        body.move_arm(arm, leaning, (0.5, 0.4, -0.6, 1.3))
    for start, seconds in kicks:
        at = start + seconds * np.array([0.0, 0.18, 0.28, 0.52, 0.58, 0.8, 1.0])
        back = pulse(t, at[0], at[1], at[1], at[3])
        out = pulse(t, at[1], at[3], at[4], at[6])
        hip = high * out - 0.4 * back
        knee = (
            0.2
            + 1.3 * pulse(t, at[0], at[2], at[2], at[3])
            + 0.9 * pulse(t, at[4], at[5], at[5], at[6])
        )
        free = pulse(t, at[0], at[1], at[5], at[6])
        root = body.position + np.array([SIGN[side] * HIP[0], HIP[1], HIP[2]])
        zero = np.zeros_like(hip)
        thigh = np.stack([zero, -np.cos(hip), np.sin(hip)], -1)
        shin = np.stack([zero, -np.cos(hip - knee), np.sin(hip - knee)], -1)
        body.ankles[side] += free[:, None] * (
            root + THIGH * thigh + SHIN * shin - body.ankles[side]
        )
        body.foot_pitch[side] += 0.4 * back + 0.3 * free - 0.8 * out
        body.pelvis[0] -= 0.15 * out
        body.spine[0] += 0.1 * out
        body.spine[1] += 0.25 * SIGN[side] * out
        body.arms[1 - side, 0] += 0.6 * out
        body.arms[side, 0] -= 0.6 * out


def squat(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Squats with the arms stretched forward, `count` times."""
    depth, reach = rng.uniform(0.34, 0.44), rng.uniform(1.0, 1.9)
    for start, seconds in events(rng, t, int(requested["count"]), 1.9):
        down = pulse(t, start, start + 0.45 * seconds, start + 0.5 * seconds, start + seconds)
        body.position[:, 1] -= depth * down
        body.position[:, 2] -= 0.16 * down
        body.pelvis[0] += 0.35 * down
        body.spine[0] += 0.35 * down
        body.head[0] -= 0.4 * down
        body.arms[:, 0] += (reach + 0.3) * down


def bow(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Bends the trunk forward and straightens up again."""
    start, end = rng.uniform(0.15, 0.35), t[-1] - rng.uniform(0.1, 0.25)
    middle, half = (start + end) / 2, rng.uniform(0.1, 0.25)
    down = pulse(t, start, middle - half, middle + half, end)
    deep = rng.uniform(0.9, 1.3)
    body.pelvis[0] += 0.4 * deep * down
    body.spine[0] += 0.6 * deep * down
    body.head[0] += 0.2 * down
    body.position[:, 2] -= 0.13 * deep * down
    body.arms[:, 0] += 0.75 * deep * down


def pick(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Bends down, takes something from the floor and holds it in front of the body."""
    (side,) = SIDES[str(requested["side"])]
    start, end = rng.uniform(0.1, 0.2), t[-1] - rng.uniform(0.15, 0.3)
    low, rise = start + 0.42 * (end - start), start + 0.54 * (end - start)
    down, holds = pulse(t, start, low, rise, end), ease(t, start, low)
    body.position[:, 1] -= rng.uniform(0.4, 0.46) * down
    body.position[:, 2] -= 0.16 * down
    body.pelvis += np.stack([0.6 * down, -0.15 * SIGN[side] * down, 0 * down])
    body.spine += np.stack([0.7 * down, -0.2 * SIGN[side] * down, -0.1 * SIGN[side] * down])
    body.head[0] -= 0.25 * down
    body.move_arm(side, holds, (0.45 + 0.7 * down, 0.2, -0.1, 1.3))
    body.move_arm(1 - side, down, (0.2, 0.6, -0.3, 0.5))
    spot = (SIGN[side] * rng.uniform(0.24, 0.28), rng.uniform(0.11, 0.14), rng.uniform(0.22, 0.28))
    body.reach(side, pulse(t, start + 0.1, low, rise, rise + 0.6 * (end - rise)), spot)


def seat(body: Body, seated: np.ndarray, bent: np.ndarray) -> None:
    """Moves a body down onto a chair that is behind its feet.

    Args:
        body: the body to seat.
        seated: (F,) progress from standing (0) to sitting (1).
        bent: (F,) forward lean of the trunk.
    """
    body.position[:, 1] += seated * (CHAIR - body.position[:, 1])
    body.position[:, 2] -= 0.36 * seated
    body.pelvis[0] += 0.45 * bent - 0.08 * seated
    body.spine[0] += 0.45 * bent + 0.05 * seated
    body.head[0] -= 0.4 * bent
    for side, sign in enumerate(SIGN):
        body.move_arm(side, seated, (0.55, 0.25, -0.7, 0.8))
        body.move_arm(side, bent, (1.4, 0.15, -0.3, 0.5))
        thigh = np.stack(
            [sign * 0.15 + 0 * seated, 0.63 + 0 * seated, -0.18 + body.ankles[side, :, 2]], 1
        )
        body.reach(side, seated**3, thigh)


def sit(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Sits down on an invisible seat."""
    start, seconds = rng.uniform(0.1, 0.25), rng.uniform(1.25, 1.5)
    end = start + seconds
    seat(
        body,
        ease(t, start, end),
        pulse(t, start, start + 0.5 * seconds, start + 0.6 * seconds, end + 0.25),
    )


def rise(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Stands up from an invisible seat."""
    start, seconds = rng.uniform(0.35, 0.5), rng.uniform(1.25, 1.45)
    end = start + seconds
    seat(
        body,
        1 - ease(t, start + 0.1, end),
        pulse(t, start - 0.3, start + 0.4 * seconds, start + 0.5 * seconds, end),
    )
    for path in (body.position, *body.ankles):
        path[:, 2] += 0.36
    body.reaches = [
        (side, weight, goal + np.array([0, 0, 0.36]), frame)
        for side, weight, goal, frame in body.reaches
    ]


def lie(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Sits down on the floor, with the hands behind the hips, and lies down on the back."""
    start, stretch = rng.uniform(0.05, 0.12), (t[-1] - 0.25) / 2.4
    a, b, c, d = start + stretch * np.array([0.0, 1.05, 1.35, 2.2])
    down, back = ease(t, a, b), ease(t, b - 0.2, d)
    bent = pulse(t, a, a + 0.55 * (b - a), a + 0.6 * (b - a), b)
    body.position[:, 1] += down * (0.11 - body.position[:, 1])
    body.position[:, 2] -= 0.42 * down + 0.03 * back
    body.pelvis[0] += 0.5 * bent - 0.15 * down - 1.4 * back
    body.spine[0] += 0.7 * bent + 0.25 * down - 0.25 * back
    body.head[0] += 0.2 * back - 0.2 * bent
    for side, sign in enumerate(SIGN):
        body.move_arm(side, bent * (1 - down), (0.8, 0.2, -0.2, 0.4))
        body.move_arm(side, down, (-0.45 + 0.5 * back, 0.35, -0.4 - back, 0.3))
        hand = np.stack([sign * (0.27 + 0.04 * back), 0.05 - 0.02 * back, -0.64 + 0.18 * back], 1)
        body.reach(side, ease(t, a + 0.6 * (b - a), b + 0.1), hand)
        out = ease(t, c + 0.12 * side, d + 0.12 * side)
        body.ankles[side, :, 2] += rng.uniform(0.38, 0.43) * out
        body.ankles[side, :, 1] += 0.28 * out * (1 - out)
        body.foot_pitch[side] -= 0.9 * ease(t, c + 0.12 * side - 0.3, c + 0.12 * side + 0.2)
        body.foot_yaw[side] += 0.25 * sign * out
