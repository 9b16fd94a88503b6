"""Synthetic clips for models that continue a motion: each one shows two successive motions."""

from collections.abc import Sequence

import numpy as np

from flame_mdm.data import Clip
from flame_mdm.data.synthetic import Synthetic, content, entry
from flame_mdm.data.synthetic_actions import ACTIONS, move
from flame_mdm.data.synthetic_motions.body import Attributes, Body
from flame_mdm.data.synthetic_motions.joining import frames_of, join

# Shortest and longest duration, in seconds, of the motion that the captions describe
SECONDS = 1.8, 2.4
# Shortest and longest duration, in seconds, of the end of the previous motion that a clip shows.
# The shortest duration covers just the frames from which a model continues, so that the model
# learns to follow a new text at once.
EARLIER_SECONDS = 1.0, 1.2
# Fraction of clips in which the previous motion shows the same action
AGAIN = 0.25
# Fraction of clips in which the person stands still before the motion
RESTING = 0.25
# Fraction of clips in which the person stands up before a motion that begins in a standing posture
FROM_THE_FLOOR = 0.15
# Maximum duration, in seconds, of the overlap between the two motions
OVERLAP = 0.45
# Motions that have no natural end. Clips show up to 6 seconds of such a motion without its end, so
# that a stream keeps moving until its text changes.
ENDLESS = (
    *("walk", "run", "sneak", "crouch walk", "limp", "march", "march in place", "run in place"),
    *("carry", "push", "pull", "strafe", "skip", "dance", "waltz", "crawl", "idle", "stand"),
    *("look around", "talk", "laugh", "cry", "guitar", "phone", "seated", "type"),
    "fighting stance",
)
# Maximum duration of an endless motion, in seconds
LONGEST = 6.0
# Duration, in seconds, of the part that is cut off at the end of an endless motion, in which the
# body comes to rest
STOPPING = 0.9
# Initial posture of the actions that do not begin in a standing posture, and final posture of the
# actions that do not end in one
STARTS = {
    **dict.fromkeys(("rise", "seated", "type"), "seated"),
    **{"get up": "lying", "crawl": "on all fours", "push-ups": "a plank"},
}
ENDS = {
    **dict.fromkeys(("sit", "seated", "type"), "seated"),
    **dict.fromkeys(("lie", "fall"), "lying"),
    **{"kneel": "kneeling", "crawl": "on all fours", "push-ups": "a plank"},
}
# Action with which a standing person gets into each posture. When the action is played backwards,
# the person stands up.
WAYS_DOWN = {"seated": "sit", "lying": "lie", "kneeling": "kneel"}
HIGHER = ("climb stairs", "climb ladder")  # they end above the floor, so nothing follows them


class SyntheticSequences(Synthetic):
    """Clips that show the end of a previous motion and then the motion that the captions describe.

    The previous motion is a different action, the same action, or standing still. The described
    motion begins before the body comes to rest. A person who is sitting, lying or kneeling stands
    up first. Motions such as walking continue until the end of the clip.

    Args:
        clips: number of clips.
        seed: seed for generating the clips; must be 0 or more.
        workers: number of processes that generate clips; 0 = one per core.
        often: see `Synthetic`.
        often_share: see `Synthetic`.
    """

    name = "synthetic_sequences"

    def __init__(
        self,
        clips: int = 5000,
        seed: int = 0,
        workers: int = 0,
        often: Sequence[str] = (),
        often_share: float = 0.0,
    ):
        super().__init__(clips, seed, workers, actions="all", often=often, often_share=often_share)

    def clip(self, index: int, fps: float) -> Clip:
        """Returns clip number `index`."""
        rng = np.random.default_rng((self.seed, index, 2))
        attributes = self._attributes(rng)
        joints = _joined(rng, attributes, fps).joints()
        joints -= joints[0, 0] * np.array([1, 0, 1])
        name = f"{self.name}_{self.seed}_{index:06d}"
        words = np.random.default_rng((self.seed, index, 3))
        return self.described(name, joints.astype(np.float32), attributes, words)

    def _attributes(self, rng: np.random.Generator) -> Attributes:
        """Draws the attributes of a clip that shows a whole motion rather than part of a cycle."""
        attributes = self.attributes(rng)
        while attributes.get("ends"):
            attributes = self.attributes(rng)
        return attributes


def _joined(rng: np.random.Generator, attributes: Attributes, fps: float) -> Body:
    """Returns a body that performs the motion of an entire clip.

    The clip consists of the end of a previous motion, a transition to the required posture, and the
    motion itself.
    """
    action = str(attributes["action"])
    start = STARTS.get(action, "standing")
    again = rng.random() < AGAIN and action not in HIGHER
    earlier = attributes if again else _earlier(rng, start)
    posture = ENDS.get(str(earlier["action"]), "standing")
    before = _moved(rng, earlier, fps)
    frames = np.arange(len(before.t))
    overlap = rng.uniform(0, OVERLAP)
    tail = frames[-round((rng.uniform(*EARLIER_SECONDS) + overlap) * fps) :]

    if posture != start and posture == ENDS.get(action):
        # A person who is already sitting stays seated.
        hold = round(rng.uniform(*SECONDS) * fps)
        return frames_of(before, np.concatenate([tail, np.repeat(tail[-1], hold)]))
    before = frames_of(before, tail)
    if posture != start and posture in WAYS_DOWN:
        before, posture = join(before, _way(rng, posture, fps, up=True)), "standing"
    if posture != start and start in WAYS_DOWN:
        before, posture = join(before, _way(rng, start, fps)), start

    motion = _moved(rng, attributes, fps, whole=False)
    if posture != start:
        return join(before, motion, blend=0.9)
    return join(before, motion, overlap=overlap)


def _earlier(rng: np.random.Generator, start: str) -> Attributes:
    """Draws the attributes of the previous motion in a clip.

    `start` is the initial posture of the motion that follows it.
    """
    if start == "standing":
        if rng.random() < RESTING:
            return {"action": "stand"}
        ends = set(ENDS.values()) if rng.random() < FROM_THE_FLOOR else {"standing"}
    else:
        ends = {start} if rng.random() < 0.6 else {"standing"}
    names = [
        name
        for name, action in ACTIONS.items()
        if ENDS.get(name, "standing") in ends and name not in HIGHER and not action.reverse
    ]
    shares = np.array([ACTIONS[name].share for name in names], float)
    name = str(rng.choice(names, p=shares / shares.sum()))
    return ACTIONS[name].draw(rng, name)


def _way(rng: np.random.Generator, posture: str, fps: float, up: bool = False) -> Body:
    """Returns a body that moves from standing to a posture, or back to standing if `up` is True."""
    name = WAYS_DOWN[posture]
    body = _moved(rng, ACTIONS[name].draw(rng, name), fps)
    frames = np.arange(len(body.t))
    return frames_of(body, frames[::-1]) if up else body


def _moved(
    rng: np.random.Generator, attributes: Attributes, fps: float, whole: bool = True
) -> Body:
    """Returns a body that performs an action.

    If the action can continue indefinitely and `whole` is False, its end is cut off.
    """
    action = ACTIONS[str(attributes["action"])]
    shortest = max(SECONDS[0], 0.35 + 0.8 * int(attributes.get("count", 0)), action.seconds)
    seconds = rng.uniform(shortest, max(shortest, SECONDS[1]))
    # A walk along a circle covers a fixed angle, so a longer walk would widen the circle.
    circle = attributes.get("direction") in ("clockwise", "counterclockwise")
    endless = attributes["action"] in ENDLESS and not whole and not circle
    if endless:
        seconds = rng.uniform(SECONDS[1], LONGEST)
    t = np.arange(round(seconds * fps) + 1) / fps
    body = Body(rng, t, entry(content()["widths"], attributes))
    move(body, rng, t, attributes)

    frames = np.arange(len(t))
    if action.reverse:
        frames = frames[::-1]
    if endless:
        frames = frames[: -round(STOPPING * fps)]
    return frames_of(body, frames)
