"""Measurements of postures and of contacts between body parts. `kinds.py` lists them."""

from dataclasses import replace

import numpy as np

from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.sampling.referee.body import (
    ANKLES,
    HEAD,
    HIPS,
    KNEES,
    NECK,
    PELVIS,
    RATE,
    SHOULDERS,
    TOES,
    WRISTS,
    Body,
)
from flame_mdm.sampling.referee.claims import Claim
from flame_mdm.sampling.referee.readings import Reading, existence, of_side, spans_of

SIDES = ("left", "right")
# Speed of the pelvis, in m/s, above which the body counts as traveling
MOVING = 0.25
# Pelvis height of a standing body of normal size, in meters
STANDING = 0.9
# Smallest change in height, in meters, that undoubtedly counts as standing up or getting down
RISE = 0.25
# Distance in meters below `STANDING` beyond which the pelvis counts as low at the beginning
LOW = 0.1
# Minimum change in the angle of the trunk, in degrees, when a person straightens up
STRAIGHTENED = 30


def thighs(body: Body) -> np.ndarray:
    """Returns the angles (F, 2) between the thighs and the vertical, in degrees; 90 = level."""
    thigh = body.joints[:, KNEES] - body.joints[:, HIPS]
    return np.degrees(np.arctan2(np.linalg.norm(thigh[..., [0, 2]], axis=-1), -thigh[..., 1]))


def upright(body: Body, claim: Claim) -> Reading:
    """Measures the height of the pelvis while the trunk is upright."""
    height = np.where(body.tilt < 45, body.height[:, PELVIS], 0.0)
    return existence(height, "m high", "pelvis", 0.2)


def sit(body: Body, claim: Claim) -> Reading:
    """Measures how far the pelvis is below its standing height.

    Only frames with raised thighs and an upright trunk are considered.
    """
    lowered = STANDING - body.height[:, PELVIS]
    is_folded = (thighs(body).min(1) > 40) & (body.tilt < 60)
    return existence(np.where(is_folded, lowered, 0.0), "m lower", "pelvis", 0.3)


def kneel(body: Body, claim: Claim) -> Reading:
    """Measures the distance between a knee and the floor while the pelvis is off the floor."""
    is_up = body.height[:, PELVIS] > 0.25
    knee = body.height[:, KNEES].min(1)
    return existence(np.where(is_up, -knee, -0.5), "m above the floor", "knee", 0.2)


def lie(body: Body, claim: Claim) -> Reading:
    """Measures the height above the floor of the pelvis or the neck, whichever is higher."""
    top = np.maximum(body.height[:, PELVIS], body.height[:, NECK])
    return existence(-top, "m above the floor", "trunk", 0.2)


def all_fours(body: Body, claim: Claim) -> Reading:
    """Measures the height of the hands while the trunk is level and the pelvis is off the floor."""
    is_level = (body.tilt > 40) & (body.height[:, PELVIS] > 0.2)
    hands = body.height[:, WRISTS].max(1)
    return existence(np.where(is_level, -hands, -1.0), "m above the floor", "hands", 0.2)


def crouch(body: Body, claim: Claim) -> Reading:
    """Measures how far the pelvis is below its standing height."""
    return existence(STANDING - body.height[:, PELVIS], "m lower", "pelvis", 0.15)


def bend(body: Body, claim: Claim) -> Reading:
    """Measures the angle between the trunk and the vertical."""
    return existence(body.tilt, "degrees", "trunk", 0.15)


def head_down(body: Body, claim: Claim) -> Reading:
    """Measures how far the head is lowered by bending the trunk or the knees."""
    top = np.percentile(body.height[:, HEAD], 95)
    return existence(max(top, 1.3) - body.height[:, HEAD], "m lower", "head", 0.15)


def hand_down(body: Body, claim: Claim) -> Reading:
    """Measures the height of a hand above the floor."""
    hands = body.height[:, WRISTS]
    readings = [
        existence(-hands[:, side], "m above the floor", f"{SIDES[side]} hand", 0.1)
        for side in (0, 1)
    ]
    return of_side(readings, claim.side, 0.2)


def stand_up(body: Body, claim: Claim) -> Reading:
    """Measures the largest rise of the pelvis.

    A person who only straightens up after a bow also "stands up"; the claim is then left undecided.
    """
    reading = _change(body.height[:, PELVIS])
    straightened = _change(-body.tilt)
    if reading.score < RISE and straightened.score > STRAIGHTENED:
        return replace(reading, score=np.nan)
    return reading


def get_down(body: Body, claim: Claim) -> Reading:
    """Measures the largest descent of the pelvis.

    If the body is low from the beginning, the claim is left undecided.
    """
    reading = _change(-body.height[:, PELVIS])
    if reading.score < RISE and STANDING - body.height[0, PELVIS] > LOW:
        return replace(reading, score=np.nan)
    return reading


def _change(signal: np.ndarray) -> Reading:
    """Returns a reading of the largest rise of a signal (F,), in meters.

    The span of the reading covers the rise.
    """
    lowest = np.minimum.accumulate(signal)
    end = int((signal - lowest).argmax())
    start = int(signal[: end + 1].argmin())
    rise = float(signal[end] - signal[start])
    return Reading(rise, rise, "m", "pelvis", ((start / RATE, end / RATE),))


def stand_still(body: Body, claim: Claim) -> Reading:
    """Measures how far the pelvis moves horizontally from its median position."""
    ground = body.joints[:, PELVIS][:, [0, 2]]
    away = np.linalg.norm(ground - np.median(ground, axis=0), axis=-1)
    farthest = float(np.percentile(away, 98))
    spans = ((0.0, body.seconds),)
    signal, level = -body.speed, -MOVING
    return Reading(
        -farthest, farthest, "m from its place", "pelvis", spans, signal=signal, level=level
    )


def return_pose(body: Body, claim: Claim) -> Reading:
    """Measures the distance of each joint between the first and the last pose.

    Distances are measured in body coordinates, and the largest one is used.
    """
    ends = max(1, round(0.2 * RATE))
    first, last = body.seen[:ends].mean(0), body.seen[-ends:].mean(0)
    away = np.linalg.norm(last - first, axis=-1)
    farthest = float(away.max())
    joint = SMPL22.joints[int(away.argmax())].replace("_", " ")
    unit = "m from its place at the start"
    return Reading(-farthest, farthest, unit, joint, (last_part(body),))


def return_place(body: Body, claim: Claim) -> Reading:
    """Measures the final distance from the starting point, relative to the largest distance."""
    ground = body.joints[:, PELVIS][:, [0, 2]]
    away = np.linalg.norm(ground - ground[0], axis=-1)
    farthest, last = float(away.max()), float(away[-1])
    if farthest < 0.5:
        reason = "it hardly leaves its place"
        return Reading(np.nan, last, "m from the start", "pelvis", (), reason)
    return Reading(-last / farthest, last, "m from the start", "pelvis", (last_part(body),))


def last_part(body: Body) -> tuple[float, float]:
    """Returns the times in seconds at which the last part of a motion begins and ends."""
    return max(0.0, body.seconds - 0.3), body.seconds


def raise_hand(body: Body, claim: Claim) -> Reading:
    """Measures the height of a wrist above its shoulder."""
    above = body.joints[:, WRISTS, 1] - body.joints[:, SHOULDERS, 1]
    readings = [
        existence(above[:, side], "m above the shoulder", f"{SIDES[side]} wrist") for side in (0, 1)
    ]
    return of_side(readings, claim.side, 0.2)


def hand_above_head(body: Body, claim: Claim) -> Reading:
    """Measures the height of a wrist above the head."""
    above = body.joints[:, WRISTS, 1] - body.joints[:, [HEAD], 1]
    readings = [
        existence(above[:, side], "m above the head", f"{SIDES[side]} wrist") for side in (0, 1)
    ]
    return of_side(readings, claim.side, 0.2)


def hand_to_head(body: Body, claim: Claim) -> Reading:
    """Measures the distance between a wrist and the head."""
    away = np.linalg.norm(body.joints[:, WRISTS] - body.joints[:, [HEAD]], axis=-1)
    readings = [
        existence(-away[:, side], "m from the head", f"{SIDES[side]} wrist", 0.15)
        for side in (0, 1)
    ]
    return of_side(readings, claim.side, 0.12)


def hands_together(body: Body, claim: Claim) -> Reading:
    """Measures the distance between the wrists."""
    away = np.linalg.norm(body.joints[:, WRISTS[0]] - body.joints[:, WRISTS[1]], axis=-1)
    return existence(-away, "m apart", "wrists", 0.1)


def hand_on_hip(body: Body, claim: Claim) -> Reading:
    """Measures the distance between a wrist and a point beside the waist."""
    waist = body.joints[:, HIPS] + 0.6 * (body.joints[:, [PELVIS]] - body.joints[:, HIPS])
    waist = waist + np.array([0.0, 0.1, 0.0])
    outward = (body.joints[:, HIPS] - body.joints[:, HIPS[::-1]]) * 0.9
    away = np.linalg.norm(body.joints[:, WRISTS] - waist - outward, axis=-1)
    readings = [
        existence(-away[:, side], "m from the hip", f"{SIDES[side]} wrist", 0.3) for side in (0, 1)
    ]
    return of_side(readings, claim.side, 0.1)


def arms_out(body: Body, claim: Claim) -> Reading:
    """Measures how far both wrists reach to the sides of the shoulders, in arm lengths."""
    aside = body.seen[:, WRISTS, 0] - body.seen[:, SHOULDERS, 0]
    outward = np.minimum(aside[:, 0], -aside[:, 1]) / body.reach
    is_up = (body.joints[:, WRISTS, 1] - body.joints[:, SHOULDERS, 1]).min(1) > -0.35
    return existence(np.where(is_up, outward, 0.0), "of an arm", "both wrists", 0.15)


def arms_crossed(body: Body, claim: Claim) -> Reading:
    """Measures how far each wrist reaches across the trunk to the other side."""
    aside = body.seen[:, WRISTS, 0]
    crossed = aside[:, 1] - aside[:, 0]
    is_front = body.seen[:, WRISTS, 2].min(1) > 0.05
    is_high = (body.joints[:, WRISTS, 1] - body.joints[:, [PELVIS], 1]).min(1) > 0.05
    return existence(np.where(is_front & is_high, crossed, -0.5), "m", "wrists", 0.2)


def raise_foot(body: Body, claim: Claim) -> Reading:
    """Measures how much higher one ankle is than the other."""
    higher = body.joints[:, ANKLES, 1] - body.joints[:, ANKLES[::-1], 1]
    readings = [
        existence(higher[:, side], "m above the other", f"{SIDES[side]} ankle", 0.1)
        for side in (0, 1)
    ]
    return of_side(readings, claim.side, 0.12)


def one_leg(body: Body, claim: Claim) -> Reading:
    """Measures for how many seconds one foot is on the floor while the other is in the air."""
    toes = body.height[:, TOES]
    readings = []
    for side in (0, 1):
        is_on = (toes[:, side] < 0.08) & (toes[:, 1 - side] > 0.15)
        spans = spans_of(is_on, 0.2)
        longest = max((end - start for start, end in spans), default=0.0)
        readings.append(Reading(longest, longest, "s", f"{SIDES[side]} leg", spans))
    return of_side(readings, claim.side, 0.3)
