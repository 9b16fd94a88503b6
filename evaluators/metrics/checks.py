"""Checks whether a motion shows a given action, and with which side, count or direction.

`evaluators.metrics.attributes` recognizes 22 actions. Rules cannot tell the other actions apart: a
hand at the head for half a second may mean drinking, phoning or scratching. Therefore, a check only
verifies that a motion shows the requested action. Thresholds are stated next to the rules.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

PELVIS, NECK, HEAD = 0, 12, 15
HIPS, ANKLES, TOES, COLLARS = (1, 2), (7, 8), (10, 11), (13, 14)
SHOULDERS, ELBOWS, WRISTS = (16, 17), (18, 19), (20, 21)
SIDES = ("left", "right")


def heading_of(smooth: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns the forward and left directions on the ground, each (F, 2), and the left turn in degrees."""
    across = (
        smooth[:, HIPS[0]] - smooth[:, HIPS[1]] + smooth[:, SHOULDERS[0]] - smooth[:, SHOULDERS[1]]
    )[:, [0, 2]]
    left = across / np.linalg.norm(across, axis=-1, keepdims=True)
    forward = np.stack([-left[:, 1], left[:, 0]], -1)
    yaw = np.unwrap(np.arctan2(forward[:, 0], forward[:, 1]))
    return forward, left, float(np.degrees(yaw[-3:].mean() - yaw[:3].mean()))


def tilt_of(smooth: np.ndarray) -> np.ndarray:
    """Returns the angles (F,) between the trunk and the vertical, in degrees."""
    trunk = smooth[:, NECK] - smooth[:, PELVIS]
    return np.degrees(np.arctan2(np.linalg.norm(trunk[:, [0, 2]], axis=-1), trunk[:, 1]))


def count_rises(signal: np.ndarray, high: float, low: float) -> int:
    """Counts how often a signal rises above `high` after having been below `low`."""
    count, armed = 0, False
    for value in signal:
        if armed and value > high:
            count, armed = count + 1, False
        elif value < low:
            armed = True
    return count


@dataclass(frozen=True)
class View:
    """A smoothed motion, and quantities that several checks need.

    Attributes:
        smooth: smoothed joint positions (F, 22, 3) in meters.
        fps: frames per second.
        forward: direction (F, 2) that the body faces, on the ground.
        left: direction (F, 2) to the left of the body, on the ground.
        turned: turn to the left over the clip, in degrees.
        floor: height of the floor in meters, taken from the lowest toe positions.
    """

    smooth: np.ndarray
    fps: float
    forward: np.ndarray
    left: np.ndarray
    turned: float
    floor: float

    @classmethod
    def of(cls, smooth: np.ndarray, fps: float) -> "View":
        """Creates the view from smoothed joint positions (F, 22, 3) in meters, with y up."""
        forward, left, turned = heading_of(smooth)
        return cls(smooth, fps, forward, left, turned, float(np.percentile(smooth[:, TOES, 1], 10)))

    def ahead(self, joints: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """Returns how far joints (F, N, 3) are in front of other joints (F, N, 3)."""
        return ((joints - origin)[..., [0, 2]] * self.forward[:, None]).sum(-1)

    def aside(self, joints: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """Returns how far joints (F, N, 3) are to the left of other joints (F, N, 3)."""
        return ((joints - origin)[..., [0, 2]] * self.left[:, None]).sum(-1)

    def path(self) -> np.ndarray:
        """Returns the pelvis's distances (F, 2) from its starting point, to the left and forward.

        The directions are relative to the heading in the first frame.
        """
        moved = (self.smooth[:, PELVIS] - self.smooth[0, PELVIS])[:, [0, 2]]
        return np.stack([moved @ self.left[0], moved @ self.forward[0]], -1)


Shown = dict[str, str | int]


def _raised_hand(view: View) -> int:
    """Returns the side of the hand that rises higher, relative to its shoulder."""
    return int((view.smooth[:, WRISTS, 1] - view.smooth[:, SHOULDERS, 1]).max(0).argmax())


def _to_head(view: View) -> Shown:
    """Detects a hand within 27 cm of the head for more than 0.35 seconds."""
    away = np.linalg.norm(view.smooth[:, WRISTS] - view.smooth[:, [HEAD]], axis=-1)
    side = int(np.percentile(away, 30, axis=0).argmin())
    return {"side": SIDES[side]} if (away[:, side] < 0.27).sum() > 0.35 * view.fps else {}


def _to_front(view: View) -> Shown:
    """Detects a hand that is more than 15 cm in front of its shoulder for 0.4 seconds.

    The hand must also be higher than the elbow would be if the arm were hanging.
    """
    side = _raised_hand(view)
    hand, shoulder = view.smooth[:, [WRISTS[side]]], view.smooth[:, [SHOULDERS[side]]]
    out = (view.ahead(hand, shoulder) > 0.15) & (hand[..., 1] - shoulder[..., 1] > -0.3)
    return {"side": SIDES[side]} if out.sum() > 0.4 * view.fps else {}


def _point(view: View) -> Shown:
    """Detects an arm that points for 0.4 seconds.

    The arm must be stretched to 90 % of its length and within 35 degrees of the horizontal.
    """
    side = _raised_hand(view)
    shoulder, elbow, wrist = (view.smooth[:, joint[side]] for joint in (SHOULDERS, ELBOWS, WRISTS))
    length = np.median(
        np.linalg.norm(elbow - shoulder, axis=-1) + np.linalg.norm(wrist - elbow, axis=-1)
    )
    arm = wrist - shoulder
    straight = np.linalg.norm(arm, axis=-1) / length > 0.9
    level = np.abs(arm[:, 1]) / length < 0.57
    return {"side": SIDES[side]} if (straight & level).sum() > 0.4 * view.fps else {}


def _knock(view: View) -> Shown:
    """Counts how often a hand in front of the body moves 4 cm beyond the middle of its strokes."""
    shown = _to_front(view)
    if not shown:
        return {}
    side = SIDES.index(str(shown["side"]))
    out = view.ahead(view.smooth[:, [WRISTS[side]]], view.smooth[:, [SHOULDERS[side]]])[:, 0]
    strokes = count_rises(out, out.max() - 0.05, out.max() - 0.09)
    return shown | {"count": strokes}


def _slash(view: View) -> Shown:
    """Detects a hand that moves downward past the shoulder and inward within 0.5 seconds.

    The hand must move from 20 cm above the shoulder to below it, and 15 cm inward.
    """
    side = _raised_hand(view)
    hand, shoulder = view.smooth[:, [WRISTS[side]]], view.smooth[:, [SHOULDERS[side]]]
    above = (hand - shoulder)[:, 0, 1]
    inward = view.aside(hand, shoulder)[:, 0] * (-1 if side == 0 else 1)
    window = round(0.5 * view.fps)
    for frame in np.flatnonzero(above > 0.2):
        after = slice(frame, frame + window)
        if ((above[after] < 0) & (inward[after] > 0.15)).any():
            return {"side": SIDES[side]}
    return {}


def _hop(view: View) -> Shown:
    """Detects hops on one foot and counts how often this foot leaves the floor.

    The other foot must be 12 cm higher for 0.4 seconds.
    """
    toes = view.smooth[:, TOES, 1] - view.floor
    side = int(toes.mean(0).argmin())
    if (toes[:, 1 - side] - toes[:, side] > 0.12).sum() < 0.4 * view.fps:
        return {}
    return {"side": SIDES[side], "count": count_rises(toes[:, side], 0.05, 0.025)}


def _jumping_jacks(view: View) -> Shown:
    """Counts how often the feet are more than 45 cm apart, if the hands rise above the shoulders."""
    apart = np.linalg.norm(
        (view.smooth[:, ANKLES[0]] - view.smooth[:, ANKLES[1]])[:, [0, 2]], axis=-1
    )
    if (view.smooth[:, WRISTS, 1] - view.smooth[:, SHOULDERS, 1]).max(0).min() < 0.1:
        return {}
    jumps = count_rises(apart, 0.45, 0.35)
    return {"count": jumps} if jumps else {}


def _push_ups(view: View) -> Shown:
    """Counts how often the neck sinks by 13 cm while the body is roughly horizontal."""
    neck = view.smooth[:, NECK, 1]
    downs = count_rises(np.percentile(neck, 95) - neck, 0.13, 0.07)
    return {"count": downs} if downs and np.median(tilt_of(view.smooth)) > 50 else {}


def _lean(view: View) -> Shown:
    """Detects a head that is more than 13 cm to one side of the pelvis."""
    aside = view.aside(view.smooth[:, [HEAD]], view.smooth[:, [PELVIS]])[:, 0]
    farthest = aside[np.abs(aside).argmax()]
    return {"direction": "left" if farthest > 0 else "right"} if abs(farthest) > 0.13 else {}


def _stretch_sideways(view: View) -> Shown:
    """Detects a lean with both hands above the head."""
    high = (view.smooth[:, WRISTS, 1] - view.smooth[:, [HEAD], 1]).min(1).max() > 0
    return _lean(view) if high else {}


def _spin(view: View) -> Shown:
    """Detects a turn of more than 270 degrees."""
    return {"direction": "left" if view.turned > 0 else "right"} if abs(view.turned) > 270 else {}


def _dodge(view: View) -> Shown:
    """Detects a sideways or backward path of more than 25 cm with a peak speed above 0.6 m/s."""
    path = view.path()
    speed = np.linalg.norm(np.gradient(path, 1 / view.fps, axis=0), axis=-1)
    aside, ahead = path[-3:].mean(0)
    if np.hypot(aside, ahead) < 0.25 or speed.max() < 0.6:
        return {}
    if abs(aside) > abs(ahead):
        return {"direction": "left" if aside > 0 else "right"}
    return {"direction": "backward"} if ahead < 0 else {}


def _strafe(view: View) -> Shown:
    """Detects a path that leads mostly to one side, by more than 33 cm.

    The sideways distance must be at least twice the distance forward or backward.
    """
    aside, ahead = view.path()[-3:].mean(0)
    if abs(aside) < max(0.33, 2 * abs(ahead)):
        return {}
    return {"direction": "left" if aside > 0 else "right"}


def _limp(view: View) -> Shown:
    """Determines on which leg a walking person sinks while the other foot is in the air.

    The correlation between the height of the pelvis and the difference between the feet's heights
    must exceed 0.35. For an even gait, this correlation is about 0.
    """
    right_up = view.smooth[:, ANKLES[1], 1] - view.smooth[:, ANKLES[0], 1]
    low = -view.smooth[:, PELVIS, 1]
    if np.linalg.norm(view.path()[-1]) < 0.33 or min(np.ptp(right_up), np.ptp(low)) < 0.02:
        return {}
    sinks = float(np.corrcoef(right_up, low)[0, 1])
    return {"side": "left" if sinks > 0 else "right"} if abs(sinks) > 0.35 else {}


CHECKED: dict[str, Callable[[View], Shown]] = {
    "point": _point,
    "beckon": _to_front,
    "wipe": _to_front,
    "knock": _knock,
    "drink": _to_head,
    "phone": _to_head,
    "touch head": _to_head,
    "touch face": _to_head,
    "slash": _slash,
    "limp": _limp,
    "hop": _hop,
    "jumping jacks": _jumping_jacks,
    "push-ups": _push_ups,
    "stretch sideways": _stretch_sideways,
    "lean": _lean,
    "spin": _spin,
    "dodge": _dodge,
    "strafe": _strafe,
}


def check(action: str, view: View) -> Shown:
    """Returns a motion's attributes if it shows an action (one of `CHECKED`), and {} otherwise."""
    shown = CHECKED[action](view)
    return {"action": action, **shown} if shown else {}
