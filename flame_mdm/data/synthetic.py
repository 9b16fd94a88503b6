"""The synthetic data set: procedural motions with captions and exact attributes; needs no download.

`docs/synthetic.md` describes the grammar of the captions and the limits of the data set. To add an action, write its
motion in `synthetic_motions`, a line in `ACTIONS`, and its captions in `synthetic.yaml`.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flame_mdm.data import Clip, MotionSource, hashed_split
from flame_mdm.data.parallel import in_order
from flame_mdm.data.synthetic_motions import gestures, locomotion
from flame_mdm.data.synthetic_motions.body import Attributes, Body
from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_yaml

MIN_SECONDS, MAX_SECONDS = 2.0, 3.0  # durations of clips
CAPTIONS = 8  # captions per clip
PARTIAL = 0.25  # share of the training clips whose captions leave out attributes; those of val and test state all
UNSAID = {"speed": "normal", "amount": "quarter"}  # values that a caption need not state
CHOICE = re.compile(r"\[([^\[\]]*)\]")
SLOT = re.compile(r"\{(\w+)(?:\.(\w+))?\}")
VERB = re.compile(r"((?:\w+ly )?)<([^>]*)>")  # with an adverb before it: "is slowly walking"


@cache
def content() -> dict[str, Any]:
    """Returns the content of `synthetic.yaml`; the captions by single keys, the forms of verbs by their infinitive."""
    grammar = read_yaml(Path(__file__).with_name("synthetic.yaml"))
    grammar["captions"] = {key: value for keys, value in grammar["captions"].items() for key in keys.split(", ")}
    grammar["verbs"] = {line.split()[0]: line.split() for line in grammar["verbs"]}
    grammar["subjects"] = [group for group in grammar["subjects"] for _ in range(group["share"])]
    return grammar


def draw_captions(
    rng: np.random.Generator, attributes: Attributes, count: int, incomplete: bool = False
) -> tuple[list[str], Attributes]:
    """Draws `count` different captions of a clip with these attributes, and returns them with those that they state.

    If `incomplete`, they leave out some attributes, all of them the same ones, if the grammar has such captions.
    """
    everything = {name for name, value in attributes.items() if name != "action" and UNSAID.get(name) != value}
    captions: list[str] = []
    stated = everything
    for _ in range(30 if incomplete else 0):  # the first caption that leaves something out decides what is left out
        caption, said = _sentence(rng, attributes)
        if said != everything:
            captions, stated = [caption], said
            break
    while len(captions) < count:
        caption, said = _sentence(rng, attributes)
        if said == stated and caption not in captions:
            captions.append(caption)
    if stated == everything:
        return captions, dict(attributes)
    return captions, {name: value for name, value in attributes.items() if name == "action" or name in stated}


def _sentence(rng: np.random.Generator, attributes: Attributes) -> tuple[str, set[str]]:
    """Returns a sentence and the names of the attributes that it states."""
    grammar = content()
    template = _one(rng, _entry(grammar["captions"], attributes))
    subject = _one(rng, grammar["subjects"])
    who = "" if template.startswith("=") else _one(rng, subject["who"])
    text = template.lstrip("= ") if template.startswith("=") or "{who}" in template else f"{{who}} {template}"
    said: set[str] = set()

    def fill(slot: re.Match[str]) -> str:
        name, kind = slot.groups()
        if kind is None:
            return {"who": who, "whose": subject["whose"]}.get(name) or grammar["phrases"].get(name, "")
        said.add(name)
        return f"[{grammar['stated'][f'{name}.{kind}'][attributes[name]]}]"

    while CHOICE.search(text) or SLOT.search(text):
        while CHOICE.search(text):
            text = CHOICE.sub(lambda choice: _one(rng, choice[1].split("|")), text)
        text = SLOT.sub(fill, text)
    text = _conjugated(rng, text, grammar["tenses"][subject["verbs"] if who else "bare"])
    return " ".join(text.split()), {name for name in said if UNSAID.get(name) != attributes[name]}


def _conjugated(rng: np.random.Generator, text: str, tenses: Sequence[tuple[str, int]]) -> str:
    """Returns the text with its verbs in one of the tenses."""
    auxiliary, column = _one(rng, tenses)

    def form(verb: re.Match[str]) -> str:
        nonlocal auxiliary
        before, auxiliary = auxiliary, ""
        return before + verb[1] + content()["verbs"][_one(rng, verb[2].split("/"))][column]

    return re.sub(r"\ba (?=[aeio])", "an ", VERB.sub(form, text))


def _entry(table: Mapping[str, Any], attributes: Attributes) -> Any:
    """Returns the entry for the action and one of its attributes, such as "walk left", or for the action, or None."""
    action = str(attributes["action"])
    keys = [f"{action} {value}" for value in attributes.values()] + [action]
    return next((table[key] for key in keys if key in table), None)


def _one(rng: np.random.Generator, choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]


class Action(NamedTuple):
    """An action and the attributes that its clips have besides its name."""

    # moves a body at times (F,) in seconds, for the attributes
    motion: Callable[[Body, np.random.Generator, np.ndarray, Attributes], None]
    share: int = 1  # how often the action occurs, relative to the others
    # attribute -> values, equally often, or with their probabilities; drawn in this order, `speed` for forward only
    values: Mapping[str, Sequence[str | int] | Mapping[str, float]] = {}
    seconds: float = 0.0  # minimum duration

    def draw(self, rng: np.random.Generator, name: str) -> Attributes:
        """Draws the attributes of a clip."""
        drawn: Attributes = {"action": name}
        for attribute, values in self.values.items():
            if attribute != "speed" or drawn["direction"] == "forward":
                shares = list(values.values()) if isinstance(values, Mapping) else None
                drawn[attribute] = rng.choice(list(values), p=shares).item()
        return drawn


SIDE, ANY_SIDE = {"side": ("left", "right")}, {"side": ("left", "right", "both")}
ONCE_OR_TWICE, UP_TO_THREE = {"count": (1, 2)}, {"count": (1, 2, 3)}
FORWARD = {"direction": ("forward",)}
WAYS = {"forward": 0.3, **dict.fromkeys(("backward", "left", "right", "clockwise", "counterclockwise"), 0.14)}
ACTIONS = {
    "walk": Action(locomotion.walk, 6, {"direction": WAYS, "speed": ("slow", "normal", "fast")}),
    "run": Action(locomotion.run, 1, FORWARD),
    "turn": Action(locomotion.turn, 3, {"direction": ("left", "right"), "amount": ("quarter", "half")}),
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


def _joints(rng: np.random.Generator, t: np.ndarray, attributes: Attributes) -> np.ndarray:
    """Returns the joints (F, 22, 3) of a motion with these attributes at times (F,) in seconds."""
    body = Body(rng, t, _entry(content()["widths"], attributes))
    ACTIONS[str(attributes["action"])].motion(body, rng, t, attributes)
    return body.joints().astype(np.float32)


class Synthetic(MotionSource):
    """Clips of the 22 SMPL joints, y up, that start at the origin facing +z; each shows one action.

    Clip number n is a function of the seed and n.
    """

    name = "synthetic"
    license = "MIT"
    captions_may_be_shared = True
    actions = tuple(ACTIONS)
    verbs = tuple(sorted({form for forms in content()["verbs"].values() for form in forms}))

    def __init__(self, clips: int = 5000, seed: int = 0, workers: int = 0):
        if clips < 1 or seed < 0:
            raise UserError(f"synthetic: clips={clips}, seed={seed}: give at least one clip and a seed from 0 on")
        self.size, self.seed, self.workers = clips, seed, workers
        self.options = {"clips": clips, "seed": seed}

    def count(self) -> int:
        return self.size

    def clips(self, fps: float) -> Iterator[Clip]:
        return in_order(partial(self.clip, fps=fps), range(self.size), self.workers)

    def clip(self, index: int, fps: float) -> Clip:
        """Returns clip number `index` with `round(seconds * fps) + 1` frames."""
        rng = np.random.default_rng((self.seed, index))
        shares = np.array([action.share for action in ACTIONS.values()], float)
        action = str(rng.choice(list(ACTIONS), p=shares / shares.sum()))
        attributes = ACTIONS[action].draw(rng, action)
        repeating = 0.35 + 0.8 * int(attributes.get("count", 0))
        seconds = rng.uniform(max(MIN_SECONDS, repeating, ACTIONS[action].seconds), MAX_SECONDS)
        name = f"synthetic_{self.seed}_{index:06d}"
        split = hashed_split(name, val=5, test=10)
        words = np.random.default_rng((self.seed, index, 1))  # so that motions do not depend on the grammar
        incomplete = split == "train" and words.random() < PARTIAL
        texts, stated = draw_captions(words, attributes, CAPTIONS, incomplete)
        return Clip(
            id=name,
            motion=_joints(rng, np.arange(round(seconds * fps) + 1) / fps, attributes),
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
    name = str(attributes["action"])
    draws = (ACTIONS[name].draw(np.random.default_rng(seed), name) for seed in range(1000))
    drawn = next(drawn for drawn in draws if attributes.items() <= drawn.items())
    return _joints(np.random.default_rng(0), np.arange(0, 3, 1 / fps), drawn)
