"""The synthetic data set: procedural motions with captions and exact attributes; needs no download.

`docs/synthetic.md` describes the grammar of the captions and the limits of the data set. To add an action, write its
motion in `synthetic_motions`, a line in `ACTIONS`, and its captions in `synthetic.yaml`.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np

from flame_mdm.data import Clip, MotionSource, hashed_split
from flame_mdm.data.grammar import content, draw_captions
from flame_mdm.data.parallel import in_order
from flame_mdm.data.synthetic_motions import gestures, locomotion, postures
from flame_mdm.data.synthetic_motions.body import Attributes, Body
from flame_mdm.errors import UserError

WAYS = {"forward": 0.3, **dict.fromkeys(("backward", "left", "right", "clockwise", "counterclockwise"), 0.14)}
MIN_EVENT_SECONDS = 0.8  # minimum duration of a repetition in seconds; it limits how many fit into a clip
AT_ONCE = 32  # number of clips that a process makes at a time
CAPTIONS = 8  # captions per clip
PARTIAL = 0.25
"""Share of the training clips whose captions leave out some attributes; those of val and test state all of them."""


class Action(NamedTuple):
    """An action and the attributes that its clips have besides its name, drawn in this order."""

    # makes the body's curves over times (F,) in seconds, for the attributes
    motion: Callable[[np.random.Generator, np.ndarray, Attributes], Body]
    share: int = 1  # how often the action occurs, relative to the others
    sides: tuple[str, ...] = ()  # sides that move, equally often
    max_count: int = 0  # maximum number of repetitions; 0 = the action is not repeated
    directions: tuple[str, ...] | Mapping[str, float] = ()  # directions, equally often, or with their probabilities
    speeds: tuple[str, ...] = ()  # speeds of the direction forward, equally often
    amounts: tuple[str, ...] = ()  # how far the body turns, equally often
    seconds: float = 0.0  # minimum duration

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
        if self.amounts:
            drawn["amount"] = str(rng.choice(self.amounts))
        return drawn


ACTIONS = {
    "walk": Action(locomotion.walk, 6, directions=WAYS, speeds=("slow", "normal", "fast")),
    "run": Action(locomotion.run, directions=("forward",)),
    "turn": Action(locomotion.turn, 3, directions=("left", "right"), amounts=("quarter", "half")),
    "jump": Action(postures.jump, 2, max_count=3),
    "wave": Action(gestures.wave, 2, ("left", "right", "both")),
    "raise": Action(gestures.raise_arms, 2, ("left", "right", "both")),
    "kick": Action(postures.kick, 2, ("left", "right"), max_count=2),
    "punch": Action(gestures.punch, 2, ("left", "right"), max_count=3),
    "squat": Action(postures.squat, max_count=2),
    "bow": Action(postures.bow),
    "stand": Action(gestures.stand),
    "sit": Action(postures.sit),
    "rise": Action(postures.rise),
    "dance": Action(locomotion.dance),
    "leap": Action(postures.leap),
    "pick": Action(postures.pick, 2, ("left", "right")),
    "throw": Action(gestures.throw, 2, ("left", "right")),
    "crawl": Action(locomotion.crawl, directions=("forward",)),
    "lie": Action(postures.lie, seconds=2.6),
    "clap": Action(gestures.clap, 2, max_count=3),
    "salute": Action(gestures.salute, 2, ("left", "right")),
    "nod": Action(gestures.nod, 2, max_count=3),
}


class Synthetic(MotionSource):
    """Clips of the 22 SMPL joints, y up, that start at the origin facing +z; each shows one action.

    Clip number n is a function of the seed and n.
    """

    name = "synthetic"
    captions_may_be_shared = True
    actions = tuple(ACTIONS)
    verbs = tuple(sorted({form for forms in content()["verbs"].values() for form in forms}))

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
        repeating = 0.35 + MIN_EVENT_SECONDS * int(attributes.get("count", 0))
        shortest = max(self.min_seconds, repeating, ACTIONS[action].seconds)
        seconds = rng.uniform(min(shortest, self.max_seconds), self.max_seconds)
        name = f"synthetic_{self.seed}_{index:06d}"
        split = hashed_split(name, val=5, test=10)
        words = np.random.default_rng((self.seed, index, 1))  # so that motions do not depend on the grammar
        incomplete = split == "train" and words.random() < PARTIAL
        texts, stated = draw_captions(words, attributes, CAPTIONS, incomplete)
        t = np.arange(round(seconds * fps) + 1) / fps
        return Clip(
            id=name,
            motion=ACTIONS[action].motion(rng, t, attributes).joints().astype(np.float32),
            captions=texts,
            split=split,
            source=name,
            action=self.actions.index(action),
            attributes=stated,
        )


def prompts() -> list[tuple[str, Attributes]]:
    """Returns fixed prompts with their attributes, for dashboard samples and `evaluators.metrics.attributes`."""
    return [(row["text"], {name: row[name] for name in row if name != "text"}) for row in content()["prompts"]]


def example(attributes: Attributes, fps: float = 20.0) -> np.ndarray:
    """Returns the joints (F, 22, 3) of a motion of three seconds with at least these attributes, such as a prompt's."""
    action, name = ACTIONS[str(attributes["action"])], str(attributes["action"])
    draws = (action.draw(np.random.default_rng(seed), name, 3.0) for seed in range(1000))
    drawn = next(drawn for drawn in draws if attributes.items() <= drawn.items())
    return action.motion(np.random.default_rng(0), np.arange(0, 3, 1 / fps), drawn).joints().astype(np.float32)
