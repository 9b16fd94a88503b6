"""The synthetic data set: procedural motions with captions and exact attributes; needs no download.

`docs/synthetic.md` describes the grammar of the captions and the limits of the data set. To add an action, write its
motion in `synthetic_motions.py`, a line in `ACTIONS`, and its captions in `synthetic.yaml`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flame_mdm.data import Clip, MotionSource, hashed_split
from flame_mdm.data import synthetic_motions as motions
from flame_mdm.data.parallel import in_order
from flame_mdm.data.synthetic_motions import Attributes, Body
from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_yaml

TIMES = ("", "once", "twice", "three times")
NUMBERS = ("", "one", "two", "three")
WAYS = {"forward": 0.3, **dict.fromkeys(("backward", "left", "right", "clockwise", "counterclockwise"), 0.14)}
MIN_EVENT_SECONDS = 0.8
"""Minimum duration of a repetition in seconds; it limits how many fit into a clip."""
AT_ONCE = 32
"""Number of clips that a process makes at a time."""


class Action(NamedTuple):
    """An action and the attributes that its clips have besides its name, drawn in this order.

    Attributes:
        motion: makes the body's curves over times (F,) in seconds, for the attributes.
        share: how often the action occurs, relative to the others.
        sides: sides that move, equally often.
        max_count: maximum number of repetitions; 0 = the action is not repeated.
        directions: directions, equally often, or with their probabilities.
        speeds: speeds of the direction forward, equally often.
    """

    motion: Callable[[np.random.Generator, np.ndarray, Attributes], Body]
    share: int = 1
    sides: tuple[str, ...] = ()
    max_count: int = 0
    directions: tuple[str, ...] | Mapping[str, float] = ()
    speeds: tuple[str, ...] = ()

    def draw(self, rng: np.random.Generator, name: str, max_seconds: float) -> Attributes:
        """Draws the attributes of a clip of at most `max_seconds`."""
        drawn: Attributes = {"action": name}
        if self.sides:
            drawn["side"] = str(rng.choice(self.sides))
        if self.max_count:
            most = min(self.max_count, int((max_seconds - 0.35) / MIN_EVENT_SECONDS))
            drawn["count"] = int(rng.integers(1, most + 1))
        if isinstance(self.directions, Mapping):
            drawn["direction"] = str(rng.choice(list(self.directions), p=list(self.directions.values())))
        elif self.directions:
            one = len(self.directions) == 1
            drawn["direction"] = self.directions[0] if one else str(rng.choice(self.directions))
        if self.speeds and drawn["direction"] == "forward":
            drawn["speed"] = str(rng.choice(self.speeds))
        return drawn


ACTIONS = {
    "walk": Action(motions.walk, 6, directions=WAYS, speeds=("slow", "normal", "fast")),
    "run": Action(motions.run, directions=("forward",)),
    "turn": Action(motions.turn, 2, directions=("left", "right")),
    "jump": Action(motions.jump, 2, max_count=3),
    "wave": Action(motions.wave, 2, ("left", "right", "both")),
    "raise": Action(motions.raise_arms, 2, ("left", "right", "both")),
    "kick": Action(motions.kick, 2, ("left", "right"), max_count=2),
    "punch": Action(motions.punch, 2, ("left", "right"), max_count=3),
    "squat": Action(motions.squat, max_count=2),
    "bow": Action(motions.bow),
    "stand": Action(motions.stand),
}


@cache
def _words() -> dict[str, Any]:
    return read_yaml(Path(__file__).with_suffix(".yaml"))


def captions(attributes: Attributes) -> list[str]:
    """Returns four predicates that state exactly the attributes: "walks forward slowly", "kicks twice with ...", ..."""
    side, count = attributes.get("side", attributes.get("direction")), int(attributes.get("count", 0))
    named = [str(attributes.get(name, "")) for name in ("action", "side", "direction", "speed")]
    kind = " ".join(word for word in named if word not in ("", "normal"))
    endings = {"s": "s", "es": "es"} if count > 1 else {"s": "", "es": ""}
    return [
        phrase.format(side=side, times=TIMES[count], number=NUMBERS[count], **endings)
        for phrase in _words()["captions"][re.sub("left|right", "{side}", kind)]
    ]


class Synthetic(MotionSource):
    """Clips of the 22 SMPL joints, y up, that start at the origin facing +z; each shows one action.

    Clip number n is a function of the seed and n.
    """

    name = "synthetic"
    captions_may_be_shared = True
    actions = tuple(ACTIONS)

    def __init__(
        self, clips: int = 5000, seed: int = 0, min_seconds: float = 2.0, max_seconds: float = 3.0, workers: int = 0
    ):
        """Defines `clips` motions of `min_seconds` to `max_seconds`, made by `workers` processes (0 = one per core)."""
        if clips < 1 or seed < 0:
            raise UserError(f"synthetic: clips={clips}, seed={seed}: give at least one clip and a seed from 0 on")
        if not 2 <= min_seconds <= max_seconds:
            raise UserError(
                f"synthetic: min_seconds={min_seconds}, max_seconds={max_seconds}: give 2 <= min_seconds <= max_seconds"
            )
        self.size, self.seed, self.min_seconds, self.max_seconds = clips, seed, min_seconds, max_seconds
        self.workers = workers
        self.options = {"clips": clips, "seed": seed, "min_seconds": min_seconds, "max_seconds": max_seconds}

    def count(self) -> int:
        return self.size

    def clips(self, fps: float) -> Iterator[Clip]:
        tasks = (range(begin, min(begin + AT_ONCE, self.size)) for begin in range(0, self.size, AT_ONCE))
        for clips in in_order(partial(self._several, fps), tasks, self.workers):
            yield from clips

    def _several(self, fps: float, indices: range) -> list[Clip]:
        return [self.clip(index, fps) for index in indices]

    def clip(self, index: int, fps: float) -> Clip:
        """Returns clip number `index` with `round(seconds * fps) + 1` frames."""
        rng = np.random.default_rng((self.seed, index))
        shares = np.array([action.share for action in ACTIONS.values()], float)
        action = str(rng.choice(list(ACTIONS), p=shares / shares.sum()))
        attributes = ACTIONS[action].draw(rng, action, self.max_seconds)
        shortest = max(self.min_seconds, 0.35 + MIN_EVENT_SECONDS * int(attributes.get("count", 0)))
        seconds = rng.uniform(shortest, self.max_seconds)
        subjects = rng.permutation(["a person", "someone", "the person", "a human"])
        texts = [f"{subject} {predicate}" for subject, predicate in zip(subjects, captions(attributes), strict=True)]
        name = f"synthetic_{self.seed}_{index:06d}"
        t = np.arange(round(seconds * fps) + 1) / fps
        return Clip(
            id=name,
            motion=ACTIONS[action].motion(rng, t, attributes).joints().astype(np.float32),
            captions=texts,
            split=hashed_split(name, val=5, test=10),
            source=name,
            action=self.actions.index(action),
            attributes=attributes,
        )


def prompts() -> list[tuple[str, Attributes]]:
    """Returns fixed prompts with their attributes, for dashboard samples and `evaluators.metrics.attributes`."""
    return [(f"a person {captions(attributes)[0]}", dict(attributes)) for attributes in _words()["prompts"]]
