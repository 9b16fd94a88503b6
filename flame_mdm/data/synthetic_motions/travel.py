"""More kinds of locomotion, such as sneaking, limping, marching, climbing and carrying."""

import numpy as np

from flame_mdm.data.synthetic_motions.body import (
    ANKLE_HEIGHT,
    FOOT,
    LEFT,
    RIGHT,
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
from flame_mdm.data.synthetic_motions.locomotion import Gait, straight, swing_arms, walk_along

# Distance between rungs, and distance from the pelvis to the ladder, in meters
RUNG = 0.3
LADDER = 0.36
RISE, TREAD = 0.17, 0.29  # height and depth of a stair in meters


def sneak(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Walks slowly and bent over, with the hands in front.

    Feet are lifted high and land on the toes.
    """
    gait = Gait(rng.uniform(0.66, 0.78), 0.8, rng.uniform(0.15, 0.19), 0.35, -0.3, 0.09, 0.0)
    body.position[:, 1] -= rng.uniform(0.1, 0.15)
    walk_along(body, rng, gait, rng.uniform(0.4, 0.55), straight(0, 1), RIGHT)
    body.pelvis[0] += 0.2
    body.spine[0] += rng.uniform(0.38, 0.5)
    body.head[0] -= 0.45
    body.head[1] += 0.4 * beat(t, rng.uniform(0.35, 0.5), rng.random())
    for side in (0, 1):
        bob = 0.12 * beat(t, 0.7, 0.5 * side)
        body.move_arm(side, np.ones_like(t), (0.55 + bob, 0.3, -0.3, 1.6 + bob))


def crouch_walk(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Walks with deeply bent knees."""
    gait = Gait(rng.uniform(0.46, 0.54), 0.8, 0.1, 0.4, 0.0, 0.11, 0.0)
    body.position[:, 1] -= rng.uniform(0.27, 0.33)
    apart = walk_along(body, rng, gait, rng.uniform(0.65, 0.9), straight(0, 1), RIGHT)
    body.pelvis[0] += 0.35
    body.spine[0] += rng.uniform(0.4, 0.5)
    body.head[0] -= 0.55
    for side in (0, 1):
        body.move_arm(side, np.ones_like(t), (0.5, 0.25, -0.3, 1.2))
    swing_arms(body, apart, 0.3)


def limp(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Walks with a stiff, sore leg: the trunk leans over the leg, and its foot is barely lifted."""
    (side,) = SIDES[str(requested["side"])]
    sign = SIGN[side]
    gait = Gait(rng.uniform(0.52, 0.6), 0.82, 0.12, 0.35, 0.1, 0.09)
    apart = walk_along(body, rng, gait, rng.uniform(0.5, 0.7), straight(0, 1), 1 - side)
    # The weight is on the sore leg while the other foot is in the air
    loaded = np.clip((body.ankles[1 - side, :, 1] - ANKLE_HEIGHT) / 0.12, 0, 1)
    sore = body.ankles[side, :, 1]
    sore += 0.6 * (ANKLE_HEIGHT - sore)
    body.foot_pitch[side] *= 0.4
    body.foot_yaw[side] += 0.2 * sign
    body.position[:, 1] -= rng.uniform(0.075, 0.095) * loaded + 0.01
    body.position[:, 0] += 0.03 * sign * loaded
    body.spine[2] += 0.28 * sign * loaded
    body.spine[0] += 0.12 + 0.12 * loaded
    body.head[2] -= 0.15 * sign * loaded
    swing_arms(body, apart, 0.35)
    body.move_arm(side, ease(t, 0.0, 0.5), (0.15, 0.25, -0.5, 0.7))
    body.arms[1 - side, 1] += 0.3 * loaded


def stagger(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Walks like a drunk person: in a wavy line, with a swaying trunk and dangling arms."""
    size, turns, sign = rng.uniform(0.13, 0.18), rng.uniform(0.9, 1.3), rng.choice(SIGN)

    def wavy(share: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        wave = sign * np.sin(2 * np.pi * turns * share)
        return size * wave, length * share, 0.3 * sign * np.sin(2 * np.pi * turns * share)

    gait = Gait(rng.uniform(0.5, 0.6), 0.82, 0.1, 0.35, 0.1, 0.1)
    apart = walk_along(body, rng, gait, rng.uniform(0.55, 0.75), wavy, RIGHT)
    sway = ease(t, 0.0, 0.5) * sign
    body.spine[2] += 0.32 * sway * beat(t, rng.uniform(0.6, 0.8))
    body.pelvis[2] += 0.1 * sway * beat(t, 0.7, 0.1)
    body.spine[0] += 0.15 + 0.22 * sway * beat(t, rng.uniform(0.45, 0.6), 0.2)
    body.head += np.stack([0.25 + 0.2 * beat(t, 0.6, 0.6), 0 * t, 0.25 * sway * beat(t, 0.7, 0.2)])
    for side in (0, 1):
        body.arms[side, 1] += 0.25 + 0.25 * beat(t, 0.7, 0.3 * side)
    swing_arms(body, apart, 0.5)


def march(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Walks upright like a soldier, with high knees and straight arms."""
    gait = Gait(rng.uniform(0.46, 0.54), 0.8, rng.uniform(0.3, 0.36), 0.2, 0.0, 0.08, 0.0)
    apart = walk_along(body, rng, gait, rng.uniform(0.75, 0.95), straight(0, 1), LEFT)
    body.spine[0] -= 0.08
    body.arms[:, 3] *= 0.3
    for side, sign in enumerate(SIGN):
        body.arms[side, 0] += 1.3 * sign * apart


def march_in_place(
    body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes
) -> None:
    """Marches in place with high knees and swinging arms."""
    wave, going = _tread(body, rng.uniform(0.95, 1.1), 0.3, 0.05)
    body.spine[0] -= 0.06
    for side, sign in enumerate(SIGN):
        body.arms[side, 0] -= 0.65 * sign * going * wave
        body.arms[side, 3] += 0.3 * going


def run_in_place(
    body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes
) -> None:
    """Runs in place, with both feet in the air between steps."""
    frequency = rng.uniform(1.45, 1.65)
    wave, going = _tread(body, frequency, rng.uniform(0.24, 0.3), -0.1)
    body.position[:, 1] += going * 0.035 * np.sin(2 * np.pi * frequency * t) ** 2
    body.spine[0] += 0.1 * going
    for side, sign in enumerate(SIGN):
        body.move_arm(side, going, (0.1 - 0.65 * sign * wave, 0.25, -0.2, 1.6 - 0.25 * sign * wave))


def _tread(
    body: Body, frequency: float, lift: float, ahead: float
) -> tuple[np.ndarray, np.ndarray]:
    """Lifts the feet alternately in place, the left foot first.

    Each foot is lifted by `lift` meters, and moves forward by `ahead` meters while it is in the
    air. Returns two curves (F,). The first curve is a wave that is 1 when the left foot is up and
    -1 when the right foot is up. The second curve indicates whether the body is moving.
    """
    t = body.t
    phases = max(2, round((t[-1] - 0.2) * 2 * frequency))
    half = (t[-1] - 0.2) / phases  # half a period, from one foot to the other
    going = pulse(t, 0.0, 0.3, t[-1] - 0.3, t[-1])
    wave = np.where((t > 0.1) & (t < t[-1] - 0.1), np.sin(np.pi * (t - 0.1) / half), 0)
    for side, sign in enumerate(SIGN):
        up = np.maximum(sign * wave, 0) ** 1.3
        body.ankles[side, :, 1] += lift * up
        body.ankles[side, :, 2] += ahead * up
        body.foot_pitch[side] += 0.55 * np.sqrt(up)
    body.position[:, 1] -= 0.03 * going
    body.position[:, 0] -= 0.025 * going * wave
    return wave, going


def carry(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Walks with a box in both arms."""
    gait = Gait(rng.uniform(0.52, 0.6), 0.82, 0.1, 0.45, 0.2, 0.09)
    apart = walk_along(body, rng, gait, rng.uniform(0.7, 0.95), straight(0, 1), RIGHT)
    body.pelvis[1] += 0.1 * apart
    body.spine[1] -= 0.1 * apart
    carry_box(body, rng, t, requested)


def carry_box(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Holds a box in front of the belly with both hands, leaning back a little."""
    weight = np.ones_like(t)
    wide, low = rng.uniform(0.14, 0.19), rng.uniform(-0.24, -0.18)
    for side, sign in enumerate(SIGN):
        body.move_arm(side, weight, (0.4, 0.2, -0.3, 1.5))
        body.reach(side, weight, (sign * wide, low, 0.34), "chest")
    body.spine[0] -= 0.1 * weight


def push(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Leans against something heavy and pushes it forward in short steps."""
    gait = Gait(rng.uniform(0.56, 0.66), 0.8, 0.07, 0.6, 0.0, 0.1, 0.0)
    walk_along(body, rng, gait, rng.uniform(0.4, 0.55), straight(0, 1), RIGHT)
    effort = ease(t, -0.1, 0.4)
    body.position[:, 1] -= 0.12 * effort
    body.position[:, 2] += 0.1 * effort
    body.pelvis[0] += 0.3 * effort
    body.spine[0] += 0.22 * effort
    body.head[0] -= 0.25 * effort
    for side, sign in enumerate(SIGN):
        body.move_arm(side, effort, (1.5, 0.2, -0.3, 0.5))
        body.reach(side, effort, (0.17 * sign, 0.24, 0.4), "chest")


def pull(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Holds something heavy with both hands, leans back, and drags it backward in short steps."""
    gait = Gait(rng.uniform(0.56, 0.66), 0.8, 0.07, -0.1, -0.2, 0.11, 0.0)
    walk_along(body, rng, gait, rng.uniform(0.35, 0.5), straight(0, -1), RIGHT)
    effort = ease(t, -0.1, 0.4)
    tug = effort * beat(t, rng.uniform(0.8, 1.0))
    body.position[:, 1] -= 0.14 * effort
    body.position[:, 2] -= 0.1 * effort
    body.pelvis[0] -= 0.12 * effort
    body.spine[0] -= (0.15 + 0.05 * beat(t, 0.9)) * effort
    body.head[0] += 0.25 * effort
    for side, sign in enumerate(SIGN):
        body.move_arm(side, effort, (1.1, 0.1, -0.4, 0.5))
        hand = np.stack([0.05 * sign + 0 * t, -0.08 - 0.04 * side + 0 * t, 0.41 + 0.03 * tug], 1)
        body.reach(side, effort, hand, "chest")


def climb_ladder(
    body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes
) -> None:
    """Climbs a ladder. Each hand moves up two rungs together with the opposite foot."""
    seconds, start = rng.uniform(0.5, 0.6), rng.uniform(0.05, 0.15)
    steps = int((t[-1] - 0.1 - start) / seconds)
    seconds = (t[-1] - 0.1 - start) / steps
    onto = LADDER - FOOT[2] - 0.02 - body.ankles[:, 0, 2]  # toes on the rung
    hands = np.array([1.42, 1.42 + RUNG])
    paths = [
        np.repeat([[0.17 * sign, hands[side], LADDER]], len(t), 0) for side, sign in enumerate(SIGN)
    ]
    for number in range(steps):
        side, begin = number % 2, start + number * seconds
        rungs = RUNG if number == 0 else 2 * RUNG
        by = (0.0, rungs, onto[side] if number < 2 else 0.0)
        step(body, side, begin, begin + 0.85 * seconds, by, 0.02, 0.25)
        moving = ease(t, begin, begin + 0.85 * seconds)
        height = RUNG * (1 if number == 0 else 2)
        out = np.sin(np.pi * np.clip((t - begin) / (0.85 * seconds), 0, 1)) ** 2
        paths[side] += np.stack([0 * t, height * moving, -0.06 * out], 1)
    climbed = np.clip((t - start) / seconds, 0, steps)
    body.position[:, 1] += RUNG * _smooth(climbed) - 0.1
    body.position[:, 2] += 0.06 * ease(t, start, start + seconds)
    body.spine[0] += 0.08
    body.head[0] -= 0.3
    for side in (0, 1):
        body.move_arm(side, np.ones_like(t), (1.4, 0.3, -0.3, 1.0))
        body.reach(side, np.ones_like(t), paths[side])


def climb_stairs(
    body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes
) -> None:
    """Climbs stairs, placing one foot on each stair. The last step brings the feet side by side."""
    start, seconds = rng.uniform(0.05, 0.15), rng.uniform(0.5, 0.6)
    steps = int((t[-1] - 0.1 - start) / seconds)
    seconds = (t[-1] - 0.1 - start) / steps
    for number in range(steps):
        side, begin = (1 + number) % 2, start + number * seconds
        stairs = 1 if number in (0, steps - 1) else 2
        by = (0.0, stairs * RISE, stairs * TREAD)
        step(body, side, begin, begin + 0.82 * seconds, by, 0.07, 0.45)
    up = _smooth(np.clip((t - start - 0.25 * seconds) / seconds, 0, steps - 1))
    body.position[:, 1] += RISE * up - 0.03
    body.position[:, 2] += TREAD * up
    lean = pulse(t, 0.0, 0.4, t[-1] - 0.4, t[-1])
    body.pelvis[0] += 0.08 * lean
    body.spine[0] += 0.15 * lean
    swing_arms(body, body.ankles[1, :, 2] - body.ankles[0, :, 2], rng.uniform(0.5, 0.7))


def _smooth(count: np.ndarray) -> np.ndarray:
    """Returns a step count (F,) that grows almost evenly, but more slowly between two steps."""
    return count - 0.05 * np.sin(2 * np.pi * count)


def stumble(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Walks, trips over something, and catches the fall with the arms and quick steps."""
    gait = Gait(rng.uniform(0.42, 0.48), 0.82, 0.12, 0.5, 0.1, 0.09)
    apart = walk_along(body, rng, gait, rng.uniform(0.95, 1.2), straight(0, 1), RIGHT)
    swing_arms(body, apart, 0.5)
    trip = rng.uniform(0.35, 0.45) * t[-1]
    falls = pulse(t, trip, trip + 0.28, trip + 0.4, trip + 1.1)
    body.position[:, 1] -= 0.15 * falls
    body.position[:, 2] += 0.12 * falls
    body.pelvis[0] += 0.35 * falls
    body.spine[0] += 0.55 * falls
    body.head[0] -= 0.35 * falls
    for side in (0, 1):
        body.move_arm(
            side,
            pulse(t, trip, trip + 0.22 + 0.08 * side, trip + 0.45, trip + 1.0),
            (1.7, 0.6, 0.0, 0.5),
        )


def skip(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Skips along happily, with springy steps, raised knees and large arm swings."""
    gait = Gait(rng.uniform(0.42, 0.48), 1.12, rng.uniform(0.3, 0.36), 0.7, -0.2, 0.08, 0.03, 0.055)
    apart = walk_along(body, rng, gait, rng.uniform(1.3, 1.6), straight(0, 1), RIGHT)
    swing_arms(body, apart, rng.uniform(1.0, 1.2))
    body.arms[:, 3] += 0.3
    body.spine[0] -= 0.03


def spin(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Turns once all the way around in small steps, with the arms stretched out to the sides."""
    sign = 1 if requested["direction"] == "left" else -1
    angle = sign * np.radians(rng.uniform(340, 375))
    gait = Gait(rng.uniform(0.26, 0.3), 0.82, 0.07, 0.3, 0.0, 0.1)
    walk_along(
        body, rng, gait, 1.0, lambda s, _: (0 * s, 0 * s, angle * s), LEFT if sign > 0 else RIGHT
    )
    out = pulse(t, 0.05, 0.5, t[-1] - 0.6, t[-1])
    for side in (0, 1):
        body.move_arm(side, out, (0.3, rng.uniform(0.9, 1.3), 0.2, 0.5))
    body.head[1] += 0.12 * np.gradient(body.heading, t)


def waltz(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Dances the box step of a waltz, with the arms around a partner."""
    pulse_length, start = rng.uniform(0.42, 0.48), rng.uniform(0.1, 0.2)
    wide, deep = 0.28, 0.3
    box = [
        (0, (0.0, 0.0, deep)),
        (1, (-wide, 0.0, deep)),
        (0, (-wide, 0.0, 0.0)),
        (1, (0.0, 0.0, -deep)),
        (0, (wide, 0.0, -deep)),
        (1, (wide, 0.0, 0.0)),
    ]
    beats = min(6, int((t[-1] - start) / pulse_length))
    for number, (side, by) in enumerate(box[:beats]):
        begin = start + number * pulse_length
        step(body, side, begin, begin + 0.85 * pulse_length, by, 0.04, 0.35)
    follow_feet(body)
    danced = np.clip((t - start) / pulse_length, 0, beats)
    body.position[:, 1] -= 0.03 * np.cos(2 * np.pi * danced / 3) + 0.01
    body.spine[2] += 0.06 * np.sin(2 * np.pi * danced / 3)
    on = ease(t, -0.2, 0.25)
    body.move_arm(0, on, (0.5, 1.2, 0.1, 0.8))
    body.reach(0, on, (0.47, 0.12, 0.2), "chest")
    body.move_arm(1, on, (0.7, 0.8, -0.5, 1.2))
    body.reach(1, on, (-0.12, 0.02, 0.34), "chest")
    body.head[1] += 0.3 * on
