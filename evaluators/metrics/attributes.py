# pyright: standard
"""Attributes of a motion, read from its joints by geometric rules.

The attributes are action, side, count, direction, speed and amount. The rules are made for clips of
a few seconds that show one action of the synthetic set. They detect what a person would see. Each
threshold is explained next to its rule. The joints are SMPL's 22 joints.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from evaluators.metrics.checks import (
    ANKLES,
    CHECKED,
    COLLARS,
    ELBOWS,
    HEAD,
    NECK,
    PELVIS,
    SHOULDERS,
    SIDES,
    TOES,
    WRISTS,
    View,
    check,
    count_rises,
    heading_of,
    tilt_of,
)
from evaluators.metrics.samples import MotionMean, Rows, Timed
from flame_mdm.data.synthetic_actions import MORE

# Thighs, shins, arms
BONES = [
    (1, 4),
    (2, 5),
    (4, 7),
    (5, 8),
    (16, 18),
    (17, 19),
    (18, 20),
    (19, 21),
]
ATTRIBUTES = ("action", "side", "count", "direction", "speed", "amount")
# No rule reads these attributes of synthetic clips, so clips with such an attribute are not scored.
UNREAD = (
    "while",
    "ends",
)
# No rule reads these actions, so clips that show them are not scored.
UNDECIDED = MORE.keys() - CHECKED.keys()


def read_attributes(joints: np.ndarray, fps: float) -> dict[str, str | int]:
    """Reads the attributes of one clip.

    The rules are tried in this order: motions that lower the body, jumps, walking and running,
    whole-body actions, and gestures of the arms and the head.

    Args:
        joints: (F, 22, 3) positions of SMPL's joints in meters, with y up. The body may have any
            position and heading.
        fps: frames per second.

    Returns:
        "action" and the other `ATTRIBUTES` of the motion, or {} if no action of the set is
        recognized (for example, in noise) or if the joints do not form a body.

    Example:
        >>> read_attributes(np.random.default_rng(0).normal(size=(40, 22, 3)), fps=20)  # noise
        {}
    """
    joints = np.asarray(joints, np.float64)
    if len(joints) < fps or not np.isfinite(joints).all():
        return {}
    smooth = gaussian_filter1d(joints, 0.05 * fps, axis=0, mode="nearest")
    if not _is_a_body(joints, smooth):
        return {}
    floor = np.percentile(smooth[:, TOES, 1], 10)
    forward, left, turned = heading_of(smooth)

    # The body stands if, in half of the frames, the neck is 25 cm above the pelvis and the pelvis
    # is 50 cm above the toes.
    pelvis = smooth[:, PELVIS, 1]
    stands = (
        np.median(smooth[:, NECK, 1] - pelvis) > 0.25
        and np.median(pelvis - smooth[:, TOES, 1].min(1)) > 0.5
    )
    lowered = _lowered(smooth, floor, forward, fps)
    if lowered or not stands:
        return lowered
    jumps = count_rises((smooth[:, TOES, 1] - floor).min(1), 0.07, 0.035)
    # A leap covers more than 45 cm with both feet side by side. In a dance, the body sways at least
    # three times by more than 3.5 cm from side to side. A hand that picks something up comes within
    # 42 cm of the floor.
    stride = ((smooth[:, TOES[0]] - smooth[:, TOES[1]])[:, [0, 2]] * forward).sum(-1)
    if (
        jumps
        and np.abs(stride).max() < 0.25
        and np.linalg.norm((smooth[-1] - smooth[0])[PELVIS, [0, 2]]) > 0.45
    ):
        return {"action": "leap"}
    if walked := _locomotion(smooth, forward, left, turned, fps):
        return walked
    if jumps:
        return {"action": "jump", "count": jumps}
    sway = (smooth[:, PELVIS][:, [0, 2]] * left.mean(0)).sum(-1)
    sway -= gaussian_filter1d(sway, 0.5 * fps, mode="nearest")
    if count_rises(sway, 0.035, -0.035) + count_rises(-sway, 0.035, -0.035) >= 3:
        return {"action": "dance"}
    if kicked := _kick(smooth, floor, forward):
        return kicked
    hands = smooth[:, WRISTS, 1] - floor
    side = int(hands.min(0).argmin())
    if hands[:, side].min() < 0.42 and np.ptp(hands[:, side]) > 0.3:
        return {"action": "pick", "side": SIDES[side]}
    if squats := count_rises(np.percentile(pelvis, 95) - pelvis, 0.18, 0.1):
        return {"action": "squat", "count": squats}
    if tilt_of(smooth).max() > 28:
        return {"action": "bow"}
    if abs(turned) > 45:
        amount = "half" if abs(turned) > 135 else "quarter"
        return {"action": "turn", "direction": "left" if turned > 0 else "right", "amount": amount}
    gesture = _arms(smooth, forward, fps)
    nods = _nods(smooth, forward) if gesture.get("action") == "stand" else 0
    return {"action": "nod", "count": nods} if nods else gesture


def read_all(joints: np.ndarray, fps: float) -> dict[str, Any]:
    """Returns the attributes of one clip (F, 22, 3) and, under "checks", the results of all checks.

    `CHECKED` lists the checks.
    """
    seen: dict[str, Any] = dict(read_attributes(joints, fps))
    joints = np.asarray(joints, np.float64)
    if len(joints) < fps or not np.isfinite(joints).all():
        return seen
    smooth = gaussian_filter1d(joints, 0.05 * fps, axis=0, mode="nearest")
    if not _is_a_body(joints, smooth):
        return seen
    view = View.of(smooth, fps)
    return seen | {"checks": {name: shown for name in CHECKED if (shown := check(name, view))}}


def _is_a_body(joints: np.ndarray, smooth: np.ndarray) -> bool:
    """Returns whether the joints form a body, that is, whether limbs and movements are plausible.

    Limbs must be 15 to 60 cm long, and their lengths must vary by less than 25 %. Joints must move
    smoothly, within 2 cm of a smooth curve.
    """
    bones = np.stack([np.linalg.norm(smooth[:, a] - smooth[:, b], axis=-1) for a, b in BONES])
    length = np.median(bones, 1, keepdims=True)
    steady = (np.abs(bones / np.maximum(length, 1e-6) - 1) < 0.25).mean() > 0.9
    calm = np.median(np.linalg.norm(joints - smooth, axis=-1)) < 0.02
    return bool(steady and calm and length.min() > 0.15 and length.max() < 0.6)


def _lowered(
    smooth: np.ndarray, floor: float, forward: np.ndarray, fps: float
) -> dict[str, str | int]:
    """Detects crawling, lying down, sitting down and standing up.

    The pelvis of a standing person is above 78 cm, the pelvis of a sitting person is between 35 and
    72 cm, and the pelvis of a lying person is below 35 cm. The trunk of a lying or crawling person
    is tilted by more than 55 degrees.
    """
    pelvis, tilt = smooth[:, PELVIS, 1] - floor, tilt_of(smooth)
    first, last = (slice(0, max(1, round(0.1 * fps))), slice(-max(1, round(0.1 * fps)), None))
    ends = [pelvis[part].mean() for part in (first, last)]
    moved = ((smooth[-1] - smooth[0])[PELVIS, [0, 2]] * forward.mean(0)).sum()
    if np.median(tilt) > 55 and 0.35 < np.median(pelvis) < 0.65 and abs(moved) > 0.33:
        return {"action": "crawl", "direction": "forward" if moved > 0 else "backward"}
    if ends[1] < 0.35 and tilt[last].mean() > 55 and ends[0] > 0.78:
        return {"action": "lie"}
    if (
        max(tilt[first].mean(), tilt[last].mean()) < 35
        and 0.35 < min(ends) < 0.72
        and max(ends) > 0.78
    ):
        return {"action": "sit" if ends[1] < ends[0] else "rise"}
    return {}


def _locomotion(
    smooth: np.ndarray, forward: np.ndarray, left: np.ndarray, turned: float, fps: float
) -> dict[str, str | int]:
    """Detects walking and running: the body moves by over 33 cm, and both ankles rise by 4 cm."""
    ground = gaussian_filter1d(smooth[:, PELVIS][:, [0, 2]], 0.15 * fps, axis=0, mode="nearest")
    if np.linalg.norm(ground - ground[0], axis=-1).max() < 0.33:
        return {}
    if np.ptp(np.percentile(smooth[:, ANKLES, 1], (5, 95), axis=0), axis=0).min() < 0.04:
        return {}
    velocity = np.gradient(ground, 1 / fps, axis=0)
    # The speed in the middle counts, because walks start and end in a standing pose.
    speed = np.percentile(np.linalg.norm(velocity, axis=-1), 90)
    ahead, aside = (velocity * forward).sum(-1).mean(), (velocity * left).sum(-1).mean()
    if abs(turned) > 90:
        direction = "counterclockwise" if turned > 0 else "clockwise"
    elif abs(ahead) > abs(aside):
        direction = "forward" if ahead > 0 else "backward"
    else:
        direction = "left" if aside > 0 else "right"
    if speed > 2.1:
        return {"action": "run", "direction": direction}
    pace = "slow" if speed < 0.85 else "fast" if speed > 1.4 else "normal"
    return {"action": "walk", "direction": direction, "speed": pace}


def _kick(smooth: np.ndarray, floor: float, forward: np.ndarray) -> dict[str, str | int]:
    """Detects kicks.

    In a kick, a foot is more than 35 cm in front of the pelvis and more than 25 cm higher than when
    the person stands.
    """
    out = smooth[:, ANKLES] - smooth[:, [PELVIS]]
    ahead = (out[..., [0, 2]] * forward[:, None]).sum(-1)
    high = smooth[:, ANKLES, 1] - floor - 0.06
    reach = np.where(high > 0.25, ahead, 0).max(0)
    side = int(reach.argmax())
    kicks = count_rises(np.where(high[:, side] > 0.15, ahead[:, side], 0), 0.35, 0.2)
    return (
        {"action": "kick", "side": SIDES[side], "count": kicks}
        if kicks and reach[side] > 0.35
        else {}
    )


def _arms(smooth: np.ndarray, forward: np.ndarray, fps: float) -> dict[str, str | int]:
    """Detects throws, salutes, raised arms, waves, punches and claps or, if there are none, standing."""
    upper = smooth[:, ELBOWS] - smooth[:, SHOULDERS]
    fore = smooth[:, WRISTS] - smooth[:, ELBOWS]
    arm = smooth[:, WRISTS] - smooth[:, SHOULDERS]
    length = np.median(np.linalg.norm(upper, axis=-1) + np.linalg.norm(fore, axis=-1), 0)
    straight = np.linalg.norm(arm, axis=-1) / length
    above = arm[..., 1] / length

    ahead = (arm[..., [0, 2]] * forward[:, None]).sum(-1)
    from_head = smooth[:, WRISTS] - smooth[:, [HEAD]]
    near = (np.linalg.norm(from_head, axis=-1) < 0.225) & (from_head[..., 1] > -0.08)
    for side, name in enumerate(SIDES):
        # In a throw, the hand moves from above the shoulder far to the front within half a second.
        drawn = np.flatnonzero((above[:, side] > 0) & (ahead[:, side] < 0.1))
        if any((ahead[i : i + round(0.5 * fps), side] > 0.38).any() for i in drawn):
            return {"action": "throw", "side": name}
        if near[:, side].sum() > 0.4 * fps and np.ptp(above[:, side]) > 0.5:
            return {"action": "salute", "side": name}
    raised, waving = [], []
    for side, name in enumerate(SIDES):
        up = (fore[:, side, 1] > 0.2 * length[side]) & (above[:, side] > 0.1)
        if up.sum() < 0.35 * fps:
            continue
        # In a wave, the forearm swings about the elbow. A raised arm stays still.
        swing = straight[up, side] - gaussian_filter1d(
            straight[up, side], 0.25 * fps, mode="nearest"
        )
        height = np.percentile(above[up, side], 70)
        if np.percentile(straight[up, side], 20) < 0.85 and swing.std() > 0.04 and height > 0.25:
            waving.append(name)
        elif height > 0.75 and above[:3, side].mean() < 0:
            raised.append(name)
    for action, sides in (("wave", waving), ("raise", raised)):
        if sides:
            return {"action": action, "side": "both" if len(sides) == 2 else sides[0]}

    reach = np.linalg.norm(arm[..., [0, 2]], axis=-1) / length
    side = int(reach.max(0).argmax())
    if punches := count_rises(reach[:, side], 0.8, 0.6):
        return {"action": "punch", "side": SIDES[side], "count": punches}
    apart = np.linalg.norm(smooth[:, WRISTS[0]] - smooth[:, WRISTS[1]], axis=-1)
    if claps := count_rises(-apart, -0.175, -0.28):
        return {"action": "clap", "count": claps}
    moved = np.ptp(smooth[:, [*WRISTS, *ANKLES, HEAD]], axis=0)
    return {"action": "stand"} if np.linalg.norm(moved, axis=-1).max() < 0.35 else {}


def _nods(smooth: np.ndarray, forward: np.ndarray) -> int:
    """Counts how often the head tilts forward by more than 32 degrees and back again.

    The angle is relative to the shoulders.
    """
    base = smooth[:, [NECK, *COLLARS, *SHOULDERS]].mean(1)
    head = smooth[:, HEAD] - base - (smooth[:, NECK] - base).mean(0)
    nod = np.degrees(np.arctan2((head[:, [0, 2]] * forward).sum(-1), head[:, 1]))
    return count_rises(nod - np.percentile(nod, 30), 32, 22)


def right_attributes(seen: Mapping[str, Any], requested: Mapping[str, Any]) -> dict[str, bool]:
    """Returns whether each requested attribute or combination of attributes was found in a motion.

    Actions in `CHECKED` have their own checks. Returns {} for actions without a rule.

    Args:
        seen: the attributes that `read_all` or `read_attributes` returned.
        requested: the attributes of the request.

    Returns:
        Whether each attribute is correct, keyed by name. `action_and_side` states whether both are
        correct or, if no side was requested, whether the action is correct. `all` states whether
        every requested attribute is correct.
    """
    if requested["action"] in UNDECIDED or requested.keys() & set(UNREAD):
        return {}
    if requested["action"] in CHECKED:
        seen = seen.get("checks", {}).get(requested["action"], {})
    right = {name: seen.get(name) == value for name, value in requested.items()}
    return right | {
        "action_and_side": right["action"] and right.get("side", True),
        "all": all(right.values()),
    }


class AttributeAccuracy(Timed, MotionMean):
    """Fraction of motions that show the requested value of each attribute.

    This metric was introduced in this project. It has one value in [0, 1] for each of the
    `ATTRIBUTES`, for `action_and_side` and for `all`. Higher is better. The attributes are read
    from the joints by rules, without a network; see `right_attributes`.

    Args:
        fps: frames per second of the motions.

    Example:
        >>> metric, joints = AttributeAccuracy(fps=20), torch.zeros(1, 40, 22, 3)
        >>> mask, requested = torch.ones(1, 40, dtype=torch.bool), [{"action": "walk"}]
        >>> metric.update(joints, mask, requested, keys=torch.tensor([0]))
        >>> metric.compute()["action"]  # 22 joints at one point are not a walk
        0.0
    """

    higher_is_better = True
    summary = exact = "all"
    names = (*ATTRIBUTES, "action_and_side", "all")

    def readings(self, motions: Rows) -> dict[str, np.ndarray]:
        """Returns `seen` (N,): the attributes that `read_all` finds in each motion, as JSON."""
        seen = [json.dumps(read_all(joints.numpy(), self.fps)) for joints in motions["joints"]]
        return {"seen": np.array(seen)}

    def per_sample(self, rows: Rows) -> dict[str, Tensor]:
        """Returns whether motions show the requested value and whether they count, by attribute.

        A motion counts if a value of the attribute was requested.
        """
        pairs = zip(rows["seen"], rows["requested"], strict=True)
        shown = [right_attributes(json.loads(str(seen)), requested) for seen, requested in pairs]
        weighted: dict[str, Tensor] = {}
        for name in self.names:
            if any(name in right for right in shown):
                values = [[right.get(name, False), name in right] for right in shown]
                weighted[name] = torch.tensor(values, dtype=torch.float64)
        return weighted

    def update(
        self, joints: Tensor, mask: Tensor, requested: Sequence[Mapping[str, Any]], keys: Tensor
    ) -> None:
        """Adds B motions.

        Args:
            joints: (B, F, 22, 3) positions of SMPL's joints in meters, with y up.
            mask: (B, F) bool, True for real frames.
            requested: B mappings from names of `ATTRIBUTES` to values, such as {"action": "walk",
                "speed": "slow"}. Requests for which there is no rule are not counted.
            keys: (B,) int64, unique keys of the motions.
        """
        rows = []
        for motion, real, attributes in zip(
            joints.detach().cpu(), mask.cpu(), requested, strict=True
        ):
            rows.append(right_attributes(read_all(motion[real].numpy(), self.fps), attributes))
        self.add(keys, rows)


def read_side(joints: np.ndarray, content: str, fps: float) -> str:
    """Determines which side, left or right, a motion from the Bandai set shows.

    For walk-turn-left and walk-turn-right, the turn of the body determines the side; for walk-left
    and walk-right, the direction of travel does. For all other contents, the hand that rises higher
    above its shoulder determines the side. The side in the content's name is not used.

    Args:
        joints: (F, 22, 3) positions of SMPL's joints in meters, with y up.
        content: content of the motion, such as "walk-turn-left" or "wave-left-hand".
        fps: frames per second.
    """
    smooth = gaussian_filter1d(np.asarray(joints, np.float64), 0.05 * fps, axis=0, mode="nearest")
    if content.startswith("walk"):
        _, left, turned = heading_of(smooth)
        travel = (np.diff(smooth[:, PELVIS][:, [0, 2]], axis=0) * left[1:]).sum()
        toward = turned if content.startswith("walk-turn") else travel
    else:
        heights = (smooth[:, WRISTS, 1] - smooth[:, SHOULDERS, 1]).max(0)
        toward = heights[0] - heights[1]
    return "left" if toward > 0 else "right"


class SideAccuracy(Timed, MotionMean):
    """Fraction of motions from the Bandai set that show the requested side, left or right.

    This metric was introduced in this project. `hand` covers gestures, `path` covers turns and
    sideways walks, and `hand_or_path` covers both. Chance level is 0.5; higher is better. The sides
    are read from the joints by rules, without a network; see `read_side`.

    Args:
        fps: frames per second of the motions.

    Example:
        >>> metric, joints = SideAccuracy(fps=20), torch.zeros(1, 40, 22, 3)
        >>> joints[:, :, 20, 1] = 1.0  # the left wrist is above the left shoulder
        >>> mask, sides = torch.ones(1, 40, dtype=torch.bool), [("wave-left-hand", "left")]
        >>> metric.update(joints, mask, sides, keys=torch.tensor([0]))
        >>> metric.compute()
        {'hand': 1.0, 'path': None, 'hand_or_path': 1.0}
    """

    higher_is_better = True
    summary = "hand_or_path"
    names = ("hand", "path", "hand_or_path")

    def update(
        self, joints: Tensor, mask: Tensor, sides: Sequence[tuple[str, str]], keys: Tensor
    ) -> None:
        """Adds B motions.

        Args:
            joints: (B, F, 22, 3) positions of SMPL's joints in meters, with y up.
            mask: (B, F) bool, True for real frames.
            sides: B pairs of requested content and side. Only requests for the left or right side
                are counted.
            keys: (B,) int64, unique keys of the motions.
        """
        rows = []
        for motion, real, (content, side) in zip(
            joints.detach().cpu(), mask.cpu(), sides, strict=True
        ):
            right = read_side(motion[real].numpy(), content, self.fps) == side
            kind = "path" if content.startswith("walk") else "hand"
            rows.append({kind: right, "hand_or_path": right} if side in SIDES else {})
        self.add(keys, rows)
