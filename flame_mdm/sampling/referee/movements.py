"""Measurements of travel, turns, gaits, repetitions and strokes. `kinds.py` lists them."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

from flame_mdm.sampling.referee.body import (
    ANKLES,
    CHEST,
    HIPS,
    PELVIS,
    RATE,
    SHOULDERS,
    TOES,
    WRISTS,
    Body,
    rate_of,
)
from flame_mdm.sampling.referee.claims import Claim
from flame_mdm.sampling.referee.postures import MOVING, SIDES, STANDING
from flame_mdm.sampling.referee.readings import (
    Reading,
    counted,
    cycles,
    existence,
    held,
    of_side,
    spans_of,
)

# Cosine of the maximum angle between the direction of travel and a claimed direction
SECTOR = np.cos(np.radians(50))
SEEN = {"left": (1.0, 0.0), "right": (-1.0, 0.0), "forward": (0.0, 1.0), "backward": (0.0, -1.0)}


def travel(body: Body, claim: Claim) -> Reading:
    """Measures the distance traveled, in meters.

    If a direction is claimed, only travel in this direction counts. Directions are relative to the
    body.
    """
    speed = body.speed
    if claim.direction:
        toward = body.velocity @ np.array(SEEN[claim.direction])
        is_toward = (speed > MOVING) & (toward > SECTOR * speed)
    else:
        toward, is_toward = speed, speed > MOVING
    distance = float(toward[is_toward].sum() / RATE)
    unclear = ""
    if claim.direction:
        is_opposite = (speed > MOVING) & (-toward > SECTOR * speed)
        if -toward[is_opposite].sum() / RATE > 0.6 * distance:
            unclear = "it also goes the other way"
    return Reading(distance, distance, "m", "pelvis", spans_of(is_toward, 0.2), unclear)


def veer(body: Body, claim: Claim) -> Reading:
    """Measures the largest displacement to the claimed side, in meters.

    The larger of two displacements is used: the displacement from the start, relative to the
    initial heading, and the sum of all sideways steps, relative to the current heading. The reading
    is unclear if this displacement exceeds 0.2 m and the displacement to the other side is more
    than half as large.
    """
    ground = (body.joints[:, PELVIS] - body.joints[0, PELVIS])[:, [0, 2]]
    sign = 1.0 if claim.direction == "left" else -1.0
    start = body.forward[: max(1, round(0.3 * RATE))].mean(0)
    aside = sign * ground @ np.array([start[1], -start[0]])
    stepped = sign * np.cumsum(body.velocity[:, 0]) / RATE
    far = max(float(aside.max()), float(stepped.max()))
    opposite = max(float(-aside.min()), float(-stepped.min()))
    unclear = "it goes to both sides" if far > 0.2 and opposite > 0.5 * far else ""
    return Reading(
        far,
        far,
        f"m to the {claim.direction}",
        "pelvis",
        spans_of(aside > 0.5 * max(far, 1e-6)),
        unclear,
    )


def turn(body: Body, claim: Claim) -> Reading:
    """Measures the largest turn in degrees.

    If a direction is claimed, only turns in this direction count. The reading is then unclear if
    the largest turn in the other direction exceeds 60 % of the largest turn in the claimed
    direction.
    """
    left, right = _turn(body.yaw, "left"), _turn(-body.yaw, "right")
    if not claim.direction:
        return max(left, right, key=lambda reading: reading.score)
    is_left = claim.direction in ("left", "counterclockwise")
    chosen, other = (left, right) if is_left else (right, left)
    if other.score > 0.6 * chosen.score:
        return replace(chosen, unclear="it also turns to the other side")
    return chosen


def turn_amount(body: Body, claim: Claim) -> Reading:
    """Measures the relative error between the largest turn and the claimed angle."""
    reading = turn(body, claim)
    claimed = claim.amount or 180
    score = -abs(reading.number - claimed) / claimed
    return Reading(score, reading.number, "degrees", reading.joint, reading.spans)


def _turn(yaw: np.ndarray, direction: str) -> Reading:
    """Measures the largest rise of an angle (F,) in degrees.

    The span of the reading covers the time from 10 % to 90 % of this rise.
    """
    lowest = np.minimum.accumulate(yaw)
    end = int((yaw - lowest).argmax())
    start = int(yaw[: end + 1].argmin())
    angle = float(yaw[end] - yaw[start])
    inner = yaw[start : end + 1] - yaw[start]
    begun = start + int((inner >= 0.1 * angle).argmax())
    done = start + int((inner >= 0.9 * angle).argmax())
    spans = ((begun / RATE, max(done, begun + 1) / RATE),)
    return Reading(angle, angle, f"degrees to the {direction}", "body", spans)


def circle(body: Body, claim: Claim) -> Reading:
    """Measures by how many degrees the direction of travel turns while the body is moving."""
    moving = body.speed > MOVING
    if moving.sum() < 0.5 * RATE:
        return Reading(0.0, 0.0, "degrees", "path")
    ground = gaussian_filter1d(
        body.joints[:, PELVIS][:, [0, 2]], 0.2 * RATE, axis=0, mode="nearest"
    )
    step = rate_of(ground)[moving]
    course = np.degrees(np.unwrap(np.arctan2(step[:, 0], step[:, 1])))
    total = float(course[-1] - course[0])
    if claim.direction in ("right", "clockwise"):
        total = -total
    elif not claim.direction:
        total = abs(total)
    return Reading(total, total, "degrees", "path", spans_of(moving, 0.3))


def gait_speed(body: Body) -> float:
    """Returns the highest mean speed of the pelvis, in m/s, over any period of 0.8 seconds."""
    window = min(len(body), round(0.8 * RATE))
    return float(uniform_filter1d(body.speed, window, mode="nearest").max())


def run(body: Body, claim: Claim) -> Reading:
    """Measures the highest speed of travel."""
    return existence(body.speed, "m/s", "pelvis", 0.3)


def walk(body: Body, claim: Claim) -> Reading:
    """Measures the distance traveled at less than running speed (2.2 m/s)."""
    is_walk = (body.speed > MOVING) & (body.speed < 2.2)
    distance = float(body.speed[is_walk].sum() / RATE)
    spans = spans_of(is_walk, 0.3)
    signal = np.where(is_walk, body.speed, 0.0)
    return Reading(distance, distance, "m", "pelvis", spans, signal=signal, level=MOVING)


def pace(body: Body, claim: Claim) -> Reading:
    """Compares the median speed of travel with 1.1 m/s. A lower speed supports "slow"."""
    moving = body.speed[body.speed > MOVING]
    if len(moving) < 0.4 * RATE:
        return Reading(np.nan, 0.0, "m/s", "pelvis", (), "it hardly travels")
    speed = float(np.median(moving))
    sign = 1.0 if claim.speed == "fast" else -1.0
    return Reading(sign * (speed - 1.1), speed, "m/s", "pelvis", spans_of(body.speed > MOVING, 0.3))


def stop(body: Body, claim: Claim) -> Reading:
    """Measures by what fraction the last 0.3 seconds are slower than the fastest 0.3 seconds."""
    last = float(body.speed[-max(1, round(0.3 * RATE)) :].mean())
    fastest = held(body.speed, 0.3)
    share = 1 - last / fastest if fastest > 0.3 else np.nan
    return Reading(share, last, "m/s at the end", "pelvis", ((body.seconds - 0.3, body.seconds),))


def steps(body: Body, claim: Claim) -> Reading:
    """Counts steps.

    A step is counted when the offset between the ankles along the heading changes its sign and then
    grows to 15 cm.
    """
    ahead = body.seen[:, ANKLES, 2]
    stride = ahead[:, 0] - ahead[:, 1]
    loose = len(cycles(stride, 0.2)) + len(cycles(-stride, 0.2))
    strict = len(cycles(stride, 0.4)) + len(cycles(-stride, 0.4))
    few, many = min(strict, loose) - 1, loose + 2
    claimed = claim.amount or 1
    if strict == loose == claimed:
        score = 0.0
    elif few <= claimed <= many:
        score = -0.5
    else:
        score = -float(max(few - claimed, claimed - many))
    return Reading(score, float(loose), "steps", "feet", spans_of(body.speed > MOVING, 0.2))


def flight(body: Body) -> np.ndarray:
    """Returns the height (F,) of the lower foot above the floor."""
    feet = np.minimum(body.joints[:, TOES, 1], body.joints[:, ANKLES, 1] - 0.06)
    return feet.min(1) - body.floor


def jump(body: Body, claim: Claim) -> Reading:
    """Measures the height of the lower foot above the floor."""
    return existence(flight(body), "m off the floor", "feet", 0.06, share=0.4)


def count_jumps(body: Body, claim: Claim) -> Reading:
    return counted(flight(body), (0.05, 0.09), claim.amount, "feet", "jumps")


def count_squats(body: Body, claim: Claim) -> Reading:
    lowered = STANDING - body.height[:, PELVIS]
    return counted(lowered, (0.12, 0.2), claim.amount, "pelvis", "times down")


def count_bends(body: Body, claim: Claim) -> Reading:
    return counted(body.tilt, (18.0, 28.0), claim.amount, "trunk", "times bent")


def count_claps(body: Body, claim: Claim) -> Reading:
    away = np.linalg.norm(body.joints[:, WRISTS[0]] - body.joints[:, WRISTS[1]], axis=-1)
    return counted(-away, (0.08, 0.14), claim.amount, "wrists", "claps")


def count_jacks(body: Body, claim: Claim) -> Reading:
    apart = np.linalg.norm(
        (body.joints[:, ANKLES[0]] - body.joints[:, ANKLES[1]])[:, [0, 2]], axis=-1
    )
    return counted(apart, (0.2, 0.32), claim.amount, "ankles", "jumping jacks")


def jacks(body: Body, claim: Claim) -> Reading:
    """Measures the height of the hands above the shoulders while the feet are apart."""
    apart = np.linalg.norm(
        (body.joints[:, ANKLES[0]] - body.joints[:, ANKLES[1]])[:, [0, 2]], axis=-1
    )
    hands = (body.joints[:, WRISTS, 1] - body.joints[:, SHOULDERS, 1]).min(1)
    return existence(np.where(apart > 0.4, hands, -0.5), "m above the shoulders", "wrists", 0.06)


def count_push_ups(body: Body, claim: Claim) -> Reading:
    depth = -(body.joints[:, CHEST, 1] - body.joints[:, WRISTS, 1].mean(1))
    return counted(depth, (0.08, 0.14), claim.amount, "chest", "push-ups")


def count_kicks(body: Body, claim: Claim) -> Reading:
    """Counts how often one ankle is far above the other."""
    height = np.abs(body.joints[:, ANKLES[0], 1] - body.joints[:, ANKLES[1], 1])
    if claim.side in SIDES:
        side = SIDES.index(claim.side)
        height = body.joints[:, ANKLES[side], 1] - body.joints[:, ANKLES[1 - side], 1]
    return counted(height, (0.2, 0.32), claim.amount, "foot", "kicks")


def count_punches(body: Body, claim: Claim) -> Reading:
    """Counts how often a wrist moves away from its shoulder, measured in body coordinates."""
    away = np.linalg.norm(body.seen[:, WRISTS] - body.seen[:, SHOULDERS], axis=-1) / body.reach
    if claim.side in SIDES:
        signal = away[:, SIDES.index(claim.side)]
        return counted(signal, (0.22, 0.38), claim.amount, f"{claim.side} wrist", "punches")
    many, few = (
        sum(len(cycles(away[:, side], depth)) for side in (0, 1)) for depth in (0.22, 0.38)
    )
    claimed = claim.amount or 1
    score = -0.5
    if few == many == claimed:
        score = 0.0
    elif not few - 1 <= claimed <= many + 1:
        score = -1.0
    return Reading(score, float(many), "punches", "wrists")


def count_raises(body: Body, claim: Claim) -> Reading:
    """Counts how often a wrist rises by at least half an arm length."""
    above = (body.joints[:, WRISTS, 1] - body.joints[:, SHOULDERS, 1]) / body.reach
    signal = above.max(1)
    if claim.side in SIDES:
        signal = above[:, SIDES.index(claim.side)]
    elif claim.side == "both":
        signal = above.min(1)
    return counted(signal, (0.4, 0.7), claim.amount, "wrist", "times raised")


def count_spins(body: Body, claim: Claim) -> Reading:
    """Measures the largest turn of the body in either direction, as a number of full turns."""
    reading = turn(body, claim)
    turns = reading.number / 360
    claimed = claim.amount or 1
    return Reading(-abs(turns - claimed), turns, "full turns", "body", reading.spans)


def kick(body: Body, claim: Claim) -> Reading:
    """Measures the ankle speed relative to the pelvis while the foot is the higher of the two."""
    higher = body.joints[:, ANKLES, 1] - body.joints[:, ANKLES[::-1], 1]
    speed = np.where(higher > 0.12, body.foot_speed, 0.0)
    readings = [existence(speed[:, side], "m/s", f"{SIDES[side]} foot", 0.06) for side in (0, 1)]
    return of_side(readings, claim.side, 0.8)


def strike(body: Body, claim: Claim) -> Reading:
    """Measures the speed of a wrist relative to the chest."""
    readings = [
        existence(body.hand_speed[:, side], "m/s", f"{SIDES[side]} wrist", 0.06) for side in (0, 1)
    ]
    return of_side(readings, claim.side, 0.5)


def _dominance(activity: np.ndarray, claim: Claim, limb: str, least: float) -> Reading:
    """Compares the movements of a limb and its counterpart on the other side.

    The score is the binary logarithm of the ratio of the two movements.
    """
    total = activity.mean(0)
    chosen = SIDES.index(claim.side)
    ratio = float(np.log2((total[chosen] + 0.02) / (total[1 - chosen] + 0.02)))
    if total.max() < least:
        return Reading(
            np.nan, float(total[chosen]), "m/s", f"{claim.side} {limb}", (), "it hardly moves"
        )
    busy = spans_of(activity[:, chosen] > max(2 * least, 0.5 * activity[:, chosen].max()), 0.1)
    number = float(total[chosen])
    return Reading(ratio, number, "m/s", f"{claim.side} {limb}", busy)


def use_hand(body: Body, claim: Claim) -> Reading:
    """Compares the mean speeds of the wrists relative to the chest.

    Raised hands are given more weight.
    """
    raised = body.joints[:, WRISTS, 1] - body.joints[:, [PELVIS], 1]
    weight = np.clip(raised / 0.3, 0.1, 1.0)
    return _dominance(body.hand_speed * weight, claim, "hand", 0.05)


def use_foot(body: Body, claim: Claim) -> Reading:
    """Compares the mean speeds of the raised ankles relative to the pelvis."""
    weight = np.clip((body.height[:, ANKLES] - 0.12) / 0.2, 0.02, 1.0)
    return _dominance(body.foot_speed * weight, claim, "foot", 0.05)


def lean(body: Body, claim: Claim) -> Reading:
    """Measures how far the midpoint of the shoulders is to the left or right of the hips."""
    aside = body.seen[:, SHOULDERS, 0].mean(1) - body.seen[:, HIPS, 0].mean(1)
    signal = aside if claim.direction == "left" else -aside
    return existence(signal, f"m to the {claim.direction}", "trunk", 0.2)
