"""All kinds of claims: their measurements, groups and thresholds.

A kind consists of a function in `postures.py` or `movements.py`, a row in `KINDS` and a pattern in
`sentences.yaml`. The thresholds of a kind, which `tools/referee.py` calibrates on captioned
motions, are in `thresholds.yaml`. If the thresholds are missing or were calibrated on too few
motions, the `no` and `yes` values in the row are used.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from flame_mdm.safe_io import read_package_yaml
from flame_mdm.sampling.referee import movements, postures
from flame_mdm.sampling.referee.body import Body
from flame_mdm.sampling.referee.claims import Claim
from flame_mdm.sampling.referee.readings import Reading

FILE = Path(__file__).with_name("thresholds.yaml")
GROUPS = (
    "movement",
    "direction",
    "side",
    "count",
    "speed",
    "posture",
    "contact",
    "order",
    "duration",
    "start",
    "end",
)
ORDER = "order"
# Scores of a duration, the negated error in binary logarithms: a duration is false if it is off by
# at least 0.7, and true if it is off by at most 0.4
DURATION = (-0.7, -0.4)


@dataclass(frozen=True)
class Kind:
    """A kind of claim.

    Attributes:
        group: subject of the claims, one of `GROUPS`. A claim that states a start, an end, a
            duration, a side, a direction or a speed belongs to the group for that attribute
            instead.
        measure: function that measures a claim on a body.
        no, yes: thresholds that were set by hand. A claim is false for scores up to `no`, true for
            scores from `yes` on, and undecided in between.
        is_timed: whether the spans of the reading show when the claimed event happens. Only such
            events can be part of a claim about order.
    """

    group: str
    measure: Callable[[Body, Claim], Reading]
    no: float
    yes: float
    is_timed: bool = True


# fmt: off
KINDS: dict[str, Kind] = {
    # movements
    "travel": Kind("movement", movements.travel, 0.2, 0.6),
    "step": Kind("movement", movements.travel, 0.05, 0.2),
    "walk": Kind("movement", movements.walk, 0.25, 0.7),
    "run": Kind("movement", movements.run, 1.3, 1.9),
    "jump": Kind("movement", movements.jump, 0.04, 0.1),
    "hop": Kind("movement", movements.jump, 0.02, 0.06),
    "kick": Kind("movement", movements.kick, 1.3, 2.5),
    "strike": Kind("movement", movements.strike, 0.8, 2.0),
    "jumping jack": Kind("movement", movements.jacks, -0.2, 0.05),
    "turn": Kind("movement", movements.turn, 25, 50),
    "turn around": Kind("movement", movements.turn, 70, 120),
    "turn angle": Kind("direction", movements.turn_amount, -0.6, -0.35, is_timed=False),
    "circle": Kind("movement", movements.circle, 90, 200, is_timed=False),
    "veer": Kind("direction", movements.veer, 0.1, 0.35, is_timed=False),
    "lean": Kind("direction", movements.lean, 0.02, 0.1),
    "stop": Kind("movement", movements.stop, 0.25, 0.6, is_timed=False),
    "pace": Kind("speed", movements.pace, -0.12, 0.08, is_timed=False),
    # postures
    "sit": Kind("posture", postures.sit, 0.15, 0.3),
    "kneel": Kind("posture", postures.kneel, -0.35, -0.2),
    "lie": Kind("posture", postures.lie, -0.55, -0.35),
    "all fours": Kind("posture", postures.all_fours, -0.5, -0.3),
    "crouch": Kind("posture", postures.crouch, 0.07, 0.18),
    "bend": Kind("posture", postures.bend, 15, 32),
    "head down": Kind("posture", postures.head_down, 0.08, 0.25),
    "stand up": Kind("posture", postures.stand_up, 0.1, 0.25),
    "get down": Kind("posture", postures.get_down, 0.1, 0.25),
    "stand still": Kind("posture", postures.stand_still, -0.8, -0.35, is_timed=False),
    "upright": Kind("posture", postures.upright, 0.66, 0.76),
    "return pose": Kind("end", postures.return_pose, -0.45, -0.2, is_timed=False),
    "return place": Kind("end", postures.return_place, -0.6, -0.3, is_timed=False),
    # contact and height
    "raise hand": Kind("contact", postures.raise_hand, -0.3, 0.0),
    "hand above head": Kind("contact", postures.hand_above_head, -0.3, -0.05),
    "hand to head": Kind("contact", postures.hand_to_head, -0.42, -0.3),
    "hand down": Kind("contact", postures.hand_down, -0.65, -0.4),
    "hands together": Kind("contact", postures.hands_together, -0.35, -0.18),
    "hand on hip": Kind("contact", postures.hand_on_hip, -0.3, -0.18),
    "arms out": Kind("contact", postures.arms_out, 0.45, 0.7),
    "arms crossed": Kind("contact", postures.arms_crossed, -0.1, 0.05),
    "raise foot": Kind("contact", postures.raise_foot, 0.08, 0.2),
    "one leg": Kind("contact", postures.one_leg, 0.2, 0.6),
    # which limb
    "use hand": Kind("side", movements.use_hand, -0.4, 0.4),
    "use foot": Kind("side", movements.use_foot, -0.4, 0.4),
    # counts
    "count jumps": Kind("count", movements.count_jumps, -0.75, -0.25, is_timed=False),
    "count squats": Kind("count", movements.count_squats, -0.75, -0.25, is_timed=False),
    "count bends": Kind("count", movements.count_bends, -0.75, -0.25, is_timed=False),
    "count claps": Kind("count", movements.count_claps, -0.75, -0.25, is_timed=False),
    "count jumping jacks": Kind("count", movements.count_jacks, -0.75, -0.25, is_timed=False),
    "count push-ups": Kind("count", movements.count_push_ups, -0.75, -0.25, is_timed=False),
    "count kicks": Kind("count", movements.count_kicks, -0.75, -0.25, is_timed=False),
    "count punches": Kind("count", movements.count_punches, -0.75, -0.25, is_timed=False),
    "count raises": Kind("count", movements.count_raises, -0.75, -0.25, is_timed=False),
    "count spins": Kind("count", movements.count_spins, -0.75, -0.3, is_timed=False),
    "count steps": Kind("count", movements.steps, -1.5, -0.25, is_timed=False),
}
# fmt: on
"""Measurements and thresholds by kind of claim."""


def group_of(claim: Claim) -> str:
    """Returns the subject of a claim, one of `GROUPS`."""
    if claim.parts:
        return ORDER
    if claim.seconds is not None:
        return "duration"
    if claim.when:
        return claim.when
    kind = KINDS[claim.kind]
    if kind.group == "count":
        return "count"
    if claim.speed:
        return "speed"
    if claim.direction:
        return "direction"
    return "side" if claim.side in ("left", "right") else kind.group


def threshold_key(claim: Claim) -> str:
    """Returns the name under which the thresholds for a claim are stored.

    The name consists of the kind and the speed that the claim states. If the claim states no speed,
    the name indicates whether the claim has a side or a direction.
    """
    if claim.parts:
        return ORDER
    if claim.speed:
        return f"{claim.speed} {claim.kind}"
    if claim.side in ("left", "right"):
        return f"{claim.kind} of a side"
    return f"{claim.kind} in a direction" if claim.direction else claim.kind


@cache
def thresholds() -> dict[str, Any]:
    """Returns the calibrated thresholds and their numbers of motions, keyed by `threshold_key`."""
    return read_package_yaml(FILE)["thresholds"] if FILE.exists() else {}


def band(claim: Claim) -> tuple[float, float]:
    """Returns the two thresholds of a claim; for scores between them, the claim is undecided.

    The thresholds do not depend on whether the claim is about the start, the end or any time.
    """
    if claim.seconds is not None:
        return DURATION
    calibrated = thresholds().get(threshold_key(claim))
    if calibrated is not None:
        return calibrated["no"], calibrated["yes"]
    if claim.parts:
        return -0.3, 0.3
    kind = KINDS[claim.kind]
    return kind.no, kind.yes
