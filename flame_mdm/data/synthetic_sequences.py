"""Synthetic clips for models that continue frames: the end of a motion, and the one of the captions after it."""

import numpy as np

from flame_mdm.data import Clip
from flame_mdm.data.synthetic import Synthetic, content, entry
from flame_mdm.data.synthetic_actions import ACTIONS, move
from flame_mdm.data.synthetic_motions.body import Attributes, Body
from flame_mdm.data.synthetic_motions.joining import frames_of, join

SECONDS = 2.0, 3.0  # durations of the motion of the captions
EARLIER_SECONDS = 1.4, 2.0  # durations of what is left of the motion before it
AGAIN = 0.25  # share of the clips in which a motion is followed by the same one
RESTING = 0.25  # share of the clips in which the person only stands before
FROM_THE_FLOOR = 0.15  # share of the clips that stand up before a motion that begins standing
OVERLAP = 0.45  # seconds, at most, in which both motions are seen
# Motions without an end of their own. Clips show up to 6 seconds of them and leave the end out,
# so that a stream keeps moving until its text changes.
ENDLESS = (
    *("walk", "run", "sneak", "crouch walk", "limp", "march", "march in place", "run in place"),
    *("carry", "push", "pull", "strafe", "skip", "dance", "waltz", "crawl", "idle", "stand"),
    *("look around", "talk", "laugh", "cry", "guitar", "phone", "seated", "type"),
    "fighting stance",
)
LONGEST = 6.0  # seconds of a motion without an end
STOPPING = 0.9  # seconds at its end that are left out
# Posture at the beginning or the end of the actions that do not stand there
STARTS = {
    **dict.fromkeys(("rise", "seated", "type"), "seated"),
    **{"get up": "lying", "crawl": "on all fours", "push-ups": "a plank"},
}
ENDS = {
    **dict.fromkeys(("sit", "seated", "type"), "seated"),
    **dict.fromkeys(("lie", "fall"), "lying"),
    **{"kneel": "kneeling", "crawl": "on all fours", "push-ups": "a plank"},
}
# How a person who stands gets into these postures; backward, how a person stands up again
WAYS_DOWN = {"seated": "sit", "lying": "lie", "kneeling": "kneel"}
HIGHER = ("climb stairs", "climb ladder")  # end above the floor, so that nothing follows


class SyntheticSequences(Synthetic):
    """Clips that begin in an earlier motion, which goes over into the motion of the captions.

    The earlier motion is any other action, the same action once more, or standing. Its end
    precedes the motion of the captions, which begins before the body is back at rest. Sitting,
    lying and kneeling people stand up first. Motions such as walking go on to the end of the
    clip.

    Args:
        clips: number of clips.
        seed: seed of the clips; from 0 on.
        workers: processes that generate clips; 0 = one per core.
    """

    name = "synthetic_sequences"

    def __init__(self, clips: int = 5000, seed: int = 0, workers: int = 0):
        super().__init__(clips, seed, workers, actions="all")

    def clip(self, index: int, fps: float) -> Clip:
        """Returns clip number `index`."""
        rng = np.random.default_rng((self.seed, index, 2))
        attributes = self.attributes(rng)
        while attributes.get("ends"):
            attributes = self.attributes(rng)
        joints = _joined(rng, attributes, fps).joints()
        joints -= joints[0, 0] * np.array([1, 0, 1])
        name = f"{self.name}_{self.seed}_{index:06d}"
        words = np.random.default_rng((self.seed, index, 3))
        return self.described(name, joints.astype(np.float32), attributes, words)


def _joined(rng: np.random.Generator, attributes: Attributes, fps: float) -> Body:
    """Returns the body of a clip: the end of an earlier motion, a way to the posture needed, and the motion."""
    action = str(attributes["action"])
    start = STARTS.get(action, "standing")
    again = rng.random() < AGAIN and action not in HIGHER
    earlier = attributes if again else _earlier(rng, start)
    posture = ENDS.get(str(earlier["action"]), "standing")
    before = _moved(rng, earlier, fps)
    frames = np.arange(len(before.t))
    tail = frames[-round(rng.uniform(*EARLIER_SECONDS) * fps) :]

    if posture != start and posture == ENDS.get(action):
        # A person who already sits stays seated.
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
    return join(before, motion, overlap=rng.uniform(0, OVERLAP))


def _earlier(rng: np.random.Generator, start: str) -> Attributes:
    """Draws the attributes of the motion before one that begins in the posture `start`."""
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
    """Returns a body that gets from standing into a posture, or `up` again."""
    name = WAYS_DOWN[posture]
    body = _moved(rng, ACTIONS[name].draw(rng, name), fps)
    frames = np.arange(len(body.t))
    return frames_of(body, frames[::-1]) if up else body


def _moved(
    rng: np.random.Generator, attributes: Attributes, fps: float, whole: bool = True
) -> Body:
    """Returns a body that has moved through the action; not to its end if it is endless and not `whole`."""
    action = ACTIONS[str(attributes["action"])]
    shortest = max(SECONDS[0], 0.35 + 0.8 * int(attributes.get("count", 0)), action.seconds)
    seconds = rng.uniform(shortest, SECONDS[1])
    # A circle would become wider with more time, as it has a given angle.
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
