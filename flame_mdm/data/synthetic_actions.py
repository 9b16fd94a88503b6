"""The actions of the synthetic data set: motions, frequencies and attributes.

`CORE` contains the actions of the data set `synthetic`. `MORE` contains the actions that
`Synthetic(actions="all")` adds. `CYCLES` contains the actions whose clips may begin and end in the
middle of the action. Clips with two simultaneous actions combine an action from `BASES` with one
from `GESTURES`.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from flame_mdm.data.synthetic_motions import (
    combat,
    everyday,
    exercise,
    gestures,
    locomotion,
    travel,
)
from flame_mdm.data.synthetic_motions.body import Attributes, Body


class Action(NamedTuple):
    """An action: its motion, its frequency, and the attributes of its clips."""

    # Moves a body at times (F,) in seconds, according to the attributes
    motion: Callable[[Body, np.random.Generator, np.ndarray, Attributes], None]
    # Frequency of the action, relative to the other actions
    share: float = 1
    # Possible values of each attribute: either a list of equally likely values, or a mapping from
    # values to probabilities. Attributes are drawn in this order. `speed` is drawn only for the
    # direction forward.
    values: Mapping[str, Sequence[str | int] | Mapping[str, float]] = {}
    # Minimum duration in seconds
    seconds: float = 0.0
    # Whether the motion is played backwards
    reverse: bool = False

    def draw(self, rng: np.random.Generator, name: str) -> Attributes:
        """Draws the attributes of a clip."""
        drawn: Attributes = {"action": name}
        for attribute, values in self.values.items():
            if attribute != "speed" or drawn.get("direction", "forward") == "forward":
                shares = list(values.values()) if isinstance(values, Mapping) else None
                drawn[attribute] = rng.choice(list(values), p=shares).item()
        return drawn


SIDE, ANY_SIDE = {"side": ("left", "right")}, {"side": ("left", "right", "both")}
ONCE_OR_TWICE, UP_TO_THREE = {"count": (1, 2)}, {"count": (1, 2, 3)}
FORWARD = {"direction": ("forward",)}
WAYS = {
    "forward": 0.3,
    **dict.fromkeys(("backward", "left", "right", "clockwise", "counterclockwise"), 0.14),
}
CORE = {
    "walk": Action(locomotion.walk, 6, {"direction": WAYS, "speed": ("slow", "normal", "fast")}),
    "run": Action(locomotion.run, 1, FORWARD),
    "turn": Action(
        locomotion.turn, 3, {"direction": ("left", "right"), "amount": ("quarter", "half")}
    ),
    "jump": Action(gestures.jump, 2, UP_TO_THREE),
    "wave": Action(gestures.wave, 2, ANY_SIDE),
    "raise": Action(gestures.raise_arms, 2, ANY_SIDE),
    "kick": Action(gestures.kick, 2, SIDE | ONCE_OR_TWICE),
    "punch": Action(gestures.punch, 2, SIDE | UP_TO_THREE),
    "squat": Action(gestures.squat, 1, ONCE_OR_TWICE),
    "bow": Action(gestures.bow),
    "stand": Action(gestures.stand),
    "sit": Action(gestures.sit),
    "rise": Action(gestures.rise),
    "dance": Action(locomotion.dance),
    "leap": Action(gestures.leap),
    "pick": Action(gestures.pick, 2, SIDE),
    "throw": Action(gestures.throw, 2, SIDE),
    "crawl": Action(locomotion.crawl, 1, FORWARD),
    "lie": Action(gestures.lie, seconds=2.6),
    "clap": Action(gestures.clap, 2, UP_TO_THREE),
    "salute": Action(gestures.salute, 2, SIDE),
    "nod": Action(gestures.nod, 2, UP_TO_THREE),
}

SIDEWAYS = {"direction": ("left", "right")}
MORE = {
    "idle": Action(everyday.idle, 3),
    "look around": Action(everyday.look_around, 1),
    "stretch": Action(exercise.stretch, 1),
    "stretch sideways": Action(exercise.stretch, 1, SIDEWAYS),
    "lean": Action(exercise.lean, 1, SIDEWAYS),
    "point": Action(everyday.point, 2, SIDE),
    "beckon": Action(everyday.beckon, 1, SIDE),
    "shrug": Action(everyday.shrug),
    "celebrate": Action(everyday.celebrate),
    "pray": Action(everyday.pray),
    "cry": Action(everyday.cry),
    "laugh": Action(everyday.laugh),
    "drink": Action(everyday.drink, 2, SIDE),
    "phone": Action(everyday.phone, 2, SIDE),
    "type": Action(everyday.type_keys),
    "wipe": Action(everyday.wipe, 1, SIDE),
    "knock": Action(everyday.knock, 2, SIDE | UP_TO_THREE),
    "guitar": Action(everyday.guitar),
    "cross arms": Action(everyday.cross_arms),
    "hands on hips": Action(everyday.hands_on_hips),
    "touch head": Action(everyday.touch_head, 1, SIDE),
    "touch face": Action(everyday.touch_face, 1, SIDE),
    "talk": Action(everyday.talk, 1),
    "seated": Action(everyday.stay_seated, 1),
    "lift": Action(everyday.lift_box, 1, seconds=2.3),
    "kneel": Action(exercise.kneel),
    "jumping jacks": Action(exercise.jumping_jacks, 2, UP_TO_THREE),
    "push-ups": Action(exercise.push_ups, 1, ONCE_OR_TWICE, 2.4),
    "hop": Action(exercise.hop, 2, SIDE | UP_TO_THREE),
    "sneak": Action(travel.sneak, 2),
    "crouch walk": Action(travel.crouch_walk, 2),
    "limp": Action(travel.limp, 2, SIDE),
    "stagger": Action(travel.stagger),
    "march": Action(travel.march),
    "march in place": Action(travel.march_in_place),
    "run in place": Action(travel.run_in_place, 2),
    "carry": Action(travel.carry),
    "push": Action(travel.push),
    "pull": Action(travel.pull),
    "climb ladder": Action(travel.climb_ladder, seconds=2.4),
    "climb stairs": Action(travel.climb_stairs, 2, seconds=2.4),
    "stumble": Action(travel.stumble, seconds=2.5),
    "strafe": Action(locomotion.walk, 1, SIDEWAYS),
    "skip": Action(travel.skip),
    "spin": Action(travel.spin, 1, SIDEWAYS, 2.4),
    "waltz": Action(travel.waltz, seconds=2.8),
    "dodge": Action(combat.dodge, 2, {"direction": ("left", "right", "backward")}),
    "fighting stance": Action(combat.stance),
    "duck": Action(combat.duck),
    "hit": Action(combat.hit),
    "block": Action(combat.block),
    "slash": Action(combat.slash, 2, SIDE),
    "fall": Action(combat.fall, seconds=2.2),
    "get up": Action(gestures.lie, seconds=2.6, reverse=True),
}
ACTIONS = CORE | MORE


def _forward(body: Body, rng: np.random.Generator, t: np.ndarray, requested: Attributes) -> None:
    locomotion.walk(body, rng, t, requested | {"direction": "forward"})


SPEEDS = {"speed": ("slow", "normal", "fast")}
CYCLES = {
    "walk": Action(_forward, 3, SPEEDS),
    "run": Action(locomotion.run, 2),
    "run in place": Action(travel.run_in_place),
    "sneak": Action(travel.sneak),
    "crouch walk": Action(travel.crouch_walk),
}
BASES = {
    "walk": Action(locomotion.walk, 4, FORWARD | SPEEDS),
    "run": Action(locomotion.run, 1, FORWARD),
    "turn": Action(
        locomotion.turn, 1, {"direction": ("left", "right"), "amount": ("quarter", "half")}
    ),
    "sneak": Action(travel.sneak),
    "seated": Action(everyday.stay_seated, 2),
}
GESTURES = {
    "wave": Action(gestures.wave, 3, ANY_SIDE),
    "raise": Action(gestures.raise_arms, 2, ANY_SIDE),
    "clap": Action(everyday.applaud),
    "point": Action(everyday.point, 2, SIDE),
    "salute": Action(gestures.salute, 1, SIDE),
    "phone": Action(everyday.phone, 2, SIDE),
    "drink": Action(everyday.drink, 2, SIDE),
    "carry": Action(travel.carry_box),
}


def drawn_from(rng: np.random.Generator, actions: Mapping[str, Action]) -> str:
    """Draws the name of an action, with probabilities proportional to `share`."""
    shares = np.array([action.share for action in actions.values()], float)
    return str(rng.choice(list(actions), p=shares / shares.sum()))


def move(body: Body, rng: np.random.Generator, t: np.ndarray, attributes: Attributes) -> None:
    """Animates a body with one action or two simultaneous actions, as the attributes specify."""
    name, cyclic = str(attributes["action"]), attributes.get("ends") == "cycle"
    action = CYCLES[name] if cyclic else ACTIONS[name]
    action.motion(body, rng, t, attributes)
    if "while" in attributes:
        if name == "seated":
            body.reaches.clear()  # the hands leave the thighs
        GESTURES[str(attributes["while"])].motion(body, rng, t, attributes)
