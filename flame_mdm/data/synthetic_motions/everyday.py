"""Everyday gestures of a standing person, such as idling, talking, crying or drinking."""

import numpy as np

from flame_mdm.data.synthetic_motions.body import SIDES, SIGN, Attributes, Body, beat, ease, pulse
from flame_mdm.data.synthetic_motions.gestures import seat


def hold(rng: np.random.Generator, t: np.ndarray, seconds: float = 0.5) -> np.ndarray:
    """Returns the weight (F,) of a pose that begins early in the clip and lasts until its end."""
    start = rng.uniform(0.05, 0.2)
    return pulse(t, start, start + rng.uniform(0.9, 1.15) * seconds, t[-1] - seconds, t[-1])


def idle(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Breathes visibly, shifts the weight from one leg to the other and glances to one side."""
    breath = beat(t, rng.uniform(0.3, 0.4), rng.random())
    body.spine[0] += 0.04 * breath
    body.shoulders += 0.06 * breath
    body.arms[:, 1] += 0.03 * breath
    body.arms[:, 3] += rng.uniform(0.05, 0.25)

    shift = rng.choice(SIGN) * rng.uniform(0.025, 0.05) * np.sin(np.pi * rng.uniform(0.35, 0.5) * t)
    body.position[:, 0] += shift
    body.position[:, 1] -= 0.012
    body.pelvis[2] -= 1.2 * shift
    body.spine[2] += 1.5 * shift

    look = rng.uniform(0.3, 0.5) * t[-1]
    glance = pulse(t, look, look + 0.45, look + 0.8, look + 1.3)
    body.head[1] += rng.choice(SIGN) * rng.uniform(0, 0.45) * glance


def look_around(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Turns the head to one side, then to the other."""
    first, a = rng.choice(SIGN), rng.uniform(0.05, 0.15)
    b, c, d = a + (t[-1] - a) * np.array([0.25, 0.62, 0.98])
    one = pulse(t, a, b, b + 0.15, b + 0.55)
    other = pulse(t, b + 0.2, c, c + 0.15, d)
    turn = first * (one - other)
    body.head[1] += rng.uniform(0.85, 1.05) * turn
    body.head[0] -= rng.uniform(0, 0.15) * (one + other)
    body.spine[1] += rng.uniform(0.35, 0.5) * turn
    body.pelvis[1] += 0.12 * turn


def point(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Points forward with a straight arm."""
    (side,) = SIDES[str(requested["side"])]
    start = rng.uniform(0.1, 0.3)
    out = pulse(t, start, start + rng.uniform(0.45, 0.6), t[-1] - 0.55, t[-1])
    aside = rng.uniform(-0.1, 0.35)
    # The lean of the trunk is subtracted from the arm, so that the arm points ahead and not down.
    bent = body.pelvis[0] + body.spine[0]
    body.move_arm(side, out, (rng.uniform(1.4, 1.6) + bent, aside, -0.4, 0.06))
    body.spine[1] -= 0.2 * SIGN[side] * out
    body.head[1] += (0.2 + 0.5 * aside) * SIGN[side] * out


def beckon(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Holds out a forearm and bends it toward the body repeatedly."""
    (side,) = SIDES[str(requested["side"])]
    out = hold(rng, t)
    pull = beat(t, rng.uniform(1.1, 1.4), rng.random())
    body.move_arm(side, out, (0.9 + 0.12 * pull, 0.15, 0.35, 1.25 + 0.75 * pull))
    body.spine[0] += 0.04 * out * pull


def shrug(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Raises both shoulders with bent, open forearms, and tilts the head."""
    start, seconds = rng.uniform(0.2, 0.5), rng.uniform(0.35, 0.5)
    up = pulse(t, start, start + seconds, start + seconds + rng.uniform(0.3, 0.6), t[-1] - 0.2)
    body.shoulders += 0.55 * up
    for side in (0, 1):
        body.move_arm(side, up, (0.15, 0.35, 0.75, rng.uniform(1.2, 1.45)))
    body.head[2] += rng.choice(SIGN) * 0.25 * up
    body.head[0] += 0.08 * up


def celebrate(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Throws both fists up and pumps them while the knees bounce."""
    up, frequency = hold(rng, t, 0.4), rng.uniform(1.6, 2.0)
    pump = beat(t, frequency, rng.random())
    for side in (0, 1):
        body.move_arm(side, up, (0.2, 2.1 + 0.2 * pump, 1.4, 0.9 - 0.55 * pump))
    body.position[:, 1] -= up * (0.05 - 0.04 * pump)
    body.spine[0] -= 0.12 * up
    body.head[0] -= 0.25 * up


def pray(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Joins the hands in front of the chest and bows the head."""
    together = ease(t, rng.uniform(0.05, 0.2), rng.uniform(0.7, 0.9))
    height = rng.uniform(-0.06, 0.02)
    for side, sign in enumerate(SIGN):
        body.move_arm(side, together, (0.6, 0.35, -0.4, 2.0))
        body.reach(side, together, (0.03 * sign, height, 0.23), "chest")
    body.head[0] += rng.uniform(0.4, 0.65) * together
    body.spine[0] += 0.12 * together


def cry(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Bends over and hides the face in the hands while the shoulders shake."""
    down = ease(t, rng.uniform(0.05, 0.2), rng.uniform(0.7, 0.9))
    sob = down * beat(t, rng.uniform(2.2, 2.8))
    for side, sign in enumerate(SIGN):
        body.move_arm(side, down, (0.9, 0.25, -0.3, 2.2))
        body.reach(side, down, (0.06 * sign, -0.03, 0.15), "head")
    body.spine[0] += 0.4 * down + 0.035 * sob
    body.head[0] += 0.35 * down + 0.05 * sob
    body.shoulders += 0.1 * down + 0.12 * sob
    body.position[:, 1] -= 0.02 * down


def laugh(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Holds the belly, leans back and then forward, and shakes."""
    start = rng.uniform(0.05, 0.2)
    on = pulse(t, start, start + 0.45, t[-1] - 0.4, t[-1])
    back = pulse(t, start, start + 0.5, 0.4 * t[-1], 0.6 * t[-1])
    bent = pulse(t, 0.4 * t[-1], 0.65 * t[-1], 0.8 * t[-1], t[-1])
    shake = on * beat(t, rng.uniform(3.6, 4.4))
    for side, sign in enumerate(SIGN):
        body.move_arm(side, on, (0.35, 0.35, -0.5, 1.7))
        body.reach(side, on, (0.07 * sign, -0.23 - 0.03 * side, 0.15 + 0.02 * side), "chest")
    body.spine[0] += 0.5 * bent - 0.22 * back + 0.035 * shake
    body.head[0] += 0.15 * bent - 0.4 * back + 0.05 * shake
    body.shoulders += 0.12 * on + 0.1 * shake
    body.position[:, 1] -= 0.05 * bent + 0.006 * (on - shake)


def drink(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Moves a hand to the mouth and tips the head back."""
    (side,) = SIDES[str(requested["side"])]
    start = rng.uniform(0.05, 0.2)
    up = pulse(t, start, start + rng.uniform(0.65, 0.8), t[-1] - 0.75, t[-1] - 0.05)
    tip = pulse(t, start + 0.5, start + 1.0, t[-1] - 0.85, t[-1] - 0.5)
    body.move_arm(side, up, (0.8, 0.35 + 0.3 * tip, -0.4, 2.1))
    mouth = np.stack([0.07 * SIGN[side] + 0 * t, -0.07 + 0.05 * tip, 0.17 - 0.01 * tip], 1)
    body.reach(side, up, mouth, "head")
    body.head[0] -= rng.uniform(0.3, 0.45) * tip
    body.spine[0] -= 0.08 * tip


def phone(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Holds a phone to the ear and talks."""
    (side,) = SIDES[str(requested["side"])]
    sign, start = SIGN[side], rng.uniform(0.05, 0.2)
    up = ease(t, start, start + rng.uniform(0.6, 0.8))
    body.move_arm(side, up, (0.75, 0.55, -0.3, 2.4))
    body.reach(side, up, (0.11 * sign, -0.04, 0.05), "head")
    body.head[2] += 0.12 * sign * up
    body.head[0] += up * 0.06 * beat(t, rng.uniform(0.7, 1.1))


def type_keys(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Sits at a desk and alternately moves the hands up and down over a keyboard."""
    still = np.ones_like(t)
    seat(body, still, 0 * still)
    body.reaches.clear()
    body.head[0] += rng.uniform(0.2, 0.35)
    body.spine[0] += 0.1
    frequency, aside = rng.uniform(2.6, 3.4), rng.uniform(0.09, 0.12)
    for side, sign in enumerate(SIGN):
        body.move_arm(side, still, (0.4, 0.2, -0.5, 1.4))
        tap, drift = beat(t, frequency, 0.5 * side), beat(t, 0.6, rng.random())
        hand = np.stack([sign * aside + 0.02 * drift, -0.2 + 0.018 * tap, 0.33 + 0.01 * drift], 1)
        body.reach(side, still, hand, "chest")


def wipe(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Wipes a window or a wall with circular movements."""
    (side,) = SIDES[str(requested["side"])]
    sign, frequency = SIGN[side], rng.uniform(0.8, 1.1)
    on = hold(rng, t)
    turn = 2 * np.pi * frequency * t
    body.move_arm(side, on, (1.3, 0.25, -0.3, 0.9))
    hand = np.stack(
        [sign * 0.12 + 0.15 * np.sin(turn), 0.16 + 0.13 * np.cos(turn), 0.39 + 0 * t], 1
    )
    body.reach(side, on, hand, "chest")
    body.spine[1] += 0.08 * on * np.sin(turn) - 0.1 * sign * on
    body.spine[0] += 0.06 * on


def knock(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Raises a fist in front of the shoulder and knocks on a door."""
    (side,) = SIDES[str(requested["side"])]
    sign, count = SIGN[side], int(requested["count"])
    period, first = rng.uniform(0.38, 0.44), rng.uniform(0.55, 0.65)
    ready = pulse(t, 0.08, first, first + period * count, first + period * count + 0.5)
    strike = sum(
        pulse(t, s, s + 0.17, s + 0.19, s + 0.36) for s in first + period * np.arange(count)
    )
    body.move_arm(side, ready, (0.9, 0.2, -0.2, 1.9))
    hand = np.stack([sign * 0.13 + 0 * t, 0.13 - 0.01 * strike, 0.24 + 0.15 * strike], 1)
    body.reach(side, ready, hand, "chest")
    body.spine[1] -= 0.1 * sign * strike


def guitar(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Strums with the right hand while the left hand moves along the neck."""
    on = ease(t, 0.0, 0.6)
    rhythm = rng.uniform(1.6, 2.1)
    strum, slide = beat(t, rhythm), beat(t, rng.uniform(0.4, 0.6), rng.random())
    body.move_arm(0, on, (0.6, 0.5, -0.1, 1.6))
    body.move_arm(1, on, (0.2, 0.4, -0.5, 1.5))
    neck = np.stack([0.42 + 0.03 * slide, -0.03 + 0.01 * slide, 0.2 + 0 * t], 1)
    body.reach(0, on, neck, "chest")
    body.reach(1, on, np.stack([-0.06 + 0 * t, -0.2 + 0.08 * strum, 0.17 + 0 * t], 1), "chest")
    body.head[0] += on * (0.15 + 0.08 * beat(t, rhythm / 2))
    body.head[1] += 0.2 * on
    body.position[:, 1] -= on * (0.02 + 0.01 * beat(t, rhythm / 2))


def cross_arms(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Crosses the forearms in front of the chest."""
    on = ease(t, rng.uniform(0.05, 0.2), rng.uniform(0.75, 0.95))
    for side, sign in enumerate(SIGN):
        body.move_arm(side, on, (0.35, 0.3, -0.6, 1.8))
        body.reach(side, on, (-0.1 * sign, -0.06 - 0.06 * side, 0.18 + 0.045 * side), "chest")
    body.spine[0] -= 0.04 * on


def hands_on_hips(
    body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes
) -> None:
    """Rests both hands on the hips, with the elbows out."""
    on = ease(t, rng.uniform(0.05, 0.2), rng.uniform(0.7, 0.9))
    for side, sign in enumerate(SIGN):
        body.move_arm(side, on, (-0.35, 0.75, -0.6, 1.6))
        body.reach(side, on, (0.17 * sign, -0.29, 0.02), "chest")
    body.spine[0] -= 0.03 * on


def touch_head(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Brings a hand to the top of the head and scratches it."""
    (side,) = SIDES[str(requested["side"])]
    sign, on = SIGN[side], hold(rng, t, 0.65)
    scratch = beat(t, rng.uniform(2.5, 3.2))
    body.move_arm(side, on, (1.2, 0.9, -0.1, 2.3))
    hand = np.stack([sign * (0.1 + 0.012 * scratch), 0.13 + 0.012 * scratch, 0.05 + 0 * t], 1)
    body.reach(side, on, hand, "head")
    body.head[2] -= 0.12 * sign * on
    body.head[0] += 0.12 * on


def touch_face(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Moves a hand to the cheek and holds it there."""
    (side,) = SIDES[str(requested["side"])]
    sign, on = SIGN[side], hold(rng, t, 0.65)
    body.move_arm(side, on, (0.8, 0.25, -0.4, 2.2))
    body.reach(side, on, (0.06 * sign, -0.06, 0.14), "head")
    body.head[0] += 0.15 * on


def talk(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Gestures with both hands in front of the body, as people do when they speak."""
    on = hold(rng, t)
    for side, sign in enumerate(SIGN):
        slow = beat(t, rng.uniform(0.5, 0.8), rng.random())
        quick = beat(t, rng.uniform(1.2, 1.7), rng.random())
        body.move_arm(side, on, (0.35, 0.3, 0.0, 1.5))
        hand = np.stack([sign * (0.2 + 0.06 * slow), -0.14 + 0.06 * quick, 0.27 + 0.04 * slow], 1)
        body.reach(side, on, hand, "chest")
    body.head[0] += 0.1 * on * beat(t, rng.uniform(0.8, 1.2), rng.random())
    body.spine[1] += 0.08 * on * beat(t, 0.5, rng.random())


def stay_seated(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Sits throughout the clip and looks to the side once."""
    seat(body, np.ones_like(t), np.zeros_like(t))
    body.head[1] += rng.uniform(-0.4, 0.4) * pulse(t, 0.3, 0.9, 1.4, 2.0)


def lift_box(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Squats, takes a heavy box from the floor with both hands, and stands up with it."""
    start, end = rng.uniform(0.05, 0.15), t[-1] - rng.uniform(0.1, 0.2)
    low, up = start + 0.42 * (end - start), start + 0.52 * (end - start)
    down, holds = pulse(t, start, low, up, end), ease(t, low, end)
    body.position[:, 1] -= rng.uniform(0.4, 0.44) * down
    body.position[:, 2] -= 0.16 * down
    body.pelvis[0] += 0.5 * down
    body.spine[0] += 0.65 * down - 0.08 * holds
    body.head[0] -= 0.3 * down
    wide, tall = rng.uniform(0.15, 0.19), rng.uniform(0.14, 0.2)
    box = np.stack([0 * t, tall + 0.85 * ease(t, up, end), 0.34 + 0 * t], 1)
    for side, sign in enumerate(SIGN):
        body.move_arm(side, ease(t, start, low), (0.5 + 0.5 * down, 0.15, -0.1, 0.9))
        body.reach(side, ease(t, start + 0.1, low), box + np.array([sign * wide, 0, 0]))


def applaud(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    """Claps quickly and repeatedly."""
    on, open_ = hold(rng, t), 0.5 + 0.5 * beat(t, rng.uniform(2.2, 2.8), rng.random())
    height = rng.uniform(-0.08, 0.02)
    for side, sign in enumerate(SIGN):
        body.move_arm(side, on, (0.55, 0.3, -0.4, 1.5))
        hand = np.stack([sign * (0.05 + 0.12 * open_), height + 0 * t, 0.3 + 0 * t], 1)
        body.reach(side, on, hand, "chest")
