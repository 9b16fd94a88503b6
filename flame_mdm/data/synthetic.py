"""The synthetic data set: procedural motions with captions and exact attributes.

It requires no download. `docs/synthetic.md` describes the grammar of the captions and the
limitations of the data set. To add an action, add its motion to `synthetic_motions`, a line to
`MORE` in `synthetic_actions`, and its captions to `synthetic_more.yaml`.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flame_mdm.data import Clip, MotionSource, hashed_split
from flame_mdm.data.parallel import in_order
from flame_mdm.data.synthetic_actions import (
    ACTIONS,
    BASES,
    CORE,
    CYCLES,
    GESTURES,
    MORE,
    Action,
    drawn_from,
    move,
)
from flame_mdm.data.synthetic_motions.body import Attributes, Body
from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.safe_io import read_package_yaml

# Durations of clips
MIN_SECONDS, MAX_SECONDS = 2.0, 3.0
# Captions per clip
CAPTIONS = 8
# With actions="all", the fraction of clips that show two simultaneous actions
SIMULTANEOUS = 0.08
# Fraction of clips that show only a part of a cycle, such as two steps of a walk
CYCLIC = 0.04
# Seconds of motion that are generated before and after such a part, so that the body can start and
# stop, and are then cut off
MARGIN = 1.0
# Fraction of the training clips whose captions omit attributes. Captions of validation and test
# clips state all attributes, so that every attribute can be evaluated.
PARTIAL = 0.25
# Attributes that every caption states
ALWAYS = ("action", "while")
# Values that a caption may omit
UNSAID = {"speed": "normal", "amount": "quarter"}
CHOICE = re.compile(r"\[([^\[\]]*)\]")
SLOT = re.compile(r"\{(\w+)(?:\.(\w+))?\}")
# A verb, which may follow an adverb: "is slowly walking"
VERB = re.compile(r"((?:\w+ly )?)<([^>]*)>")


@cache
def content() -> dict[str, Any]:
    """Returns the grammars of both groups of actions as one grammar.

    Caption entries that list several keys are split into one entry per key. The forms of each verb
    are stored under its infinitive. `core_verbs` contains the infinitives of the core actions.
    """
    grammar = read_package_yaml(Path(__file__).with_name("synthetic.yaml"))
    more = read_package_yaml(Path(__file__).with_name("synthetic_more.yaml"))
    grammar["captions"] = {
        key: value for keys, value in grammar["captions"].items() for key in keys.split(", ")
    }
    for name in ("captions", "phrases", "stated", "widths"):
        if both := grammar[name].keys() & more[name].keys():
            raise ValueError(
                f"synthetic_more.yaml: {name}: {sorted(both)} are also in synthetic.yaml"
            )
        grammar[name] |= more[name]

    grammar |= {name: more[name] for name in ("simultaneous", "mains", "gestures")}
    grammar["core_verbs"] = {line.split()[0] for line in grammar["verbs"]}
    grammar["verbs"] = {
        line.split()[0]: line.split() for line in (*grammar["verbs"], *more["verbs"])
    }
    grammar["subjects"] = [group for group in grammar["subjects"] for _ in range(group["share"])]
    return grammar


def draw_captions(
    rng: np.random.Generator, attributes: Attributes, count: int, incomplete: bool = False
) -> tuple[list[str], Attributes]:
    """Draws `count` different captions for a clip; returns them and the attributes they state.

    If `incomplete` is True and the grammar contains captions that omit attributes, all captions
    omit the same attributes.
    """
    everything = {
        name
        for name, value in attributes.items()
        if name not in ALWAYS and UNSAID.get(name) != value
    }
    captions: list[str] = []
    stated = everything
    # The first caption that omits attributes determines which attributes all captions of the clip
    # omit.
    for _ in range(30 if incomplete else 0):
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
    return captions, {
        name: value for name, value in attributes.items() if name in stated or name in ALWAYS
    }


def _sentence(rng: np.random.Generator, attributes: Attributes) -> tuple[str, set[str]]:
    """Returns a sentence and the names of the attributes that it states."""
    grammar = content()
    template = _template(rng, attributes)
    subject = _one(rng, grammar["subjects"])
    who = "" if template.startswith("=") else _one(rng, subject["who"])
    text = (
        template.lstrip("= ")
        if template.startswith("=") or "{who}" in template
        else f"{{who}} {template}"
    )
    said: set[str] = set()

    def fill(slot: re.Match[str]) -> str:
        name, kind = slot.groups()
        if kind is None:
            return {"who": who, "whose": subject["whose"]}.get(name) or grammar["phrases"].get(
                name, ""
            )
        said.add(name)
        return f"[{grammar['stated'][f'{name}.{kind}'][attributes[name]]}]"

    while CHOICE.search(text) or SLOT.search(text):
        while CHOICE.search(text):
            text = CHOICE.sub(lambda choice: _one(rng, choice[1].split("|")), text)
        text = SLOT.sub(fill, text)
    text = _conjugated(rng, text, grammar["tenses"][subject["verbs"] if who else "bare"])
    return " ".join(text.split()), {name for name in said if UNSAID.get(name) != attributes[name]}


def _template(rng: np.random.Generator, attributes: Attributes) -> str:
    """Returns a template for captions.

    For simultaneous actions, the result combines the templates of both actions.
    """
    grammar = content()
    if "while" not in attributes:
        return _one(rng, entry(grammar["captions"], attributes))
    parts = {"main": _one(rng, entry(grammar["mains"], attributes))}
    parts["gesture"] = _one(rng, grammar["gestures"][attributes["while"]])
    template = _one(rng, grammar["simultaneous"])
    for name, part in parts.items():
        template = template.replace(f"{{{name}}}", part).replace(
            f"{{{name}.ing}}", part.replace("<", "<-")
        )
    return template


def _conjugated(rng: np.random.Generator, text: str, tenses: Sequence[tuple[str, int]]) -> str:
    """Conjugates all verbs in the text in one tense, which is drawn from `tenses`."""
    auxiliary, column = _one(rng, tenses)

    def form(verb: re.Match[str]) -> str:
        nonlocal auxiliary
        if verb[2].startswith("-"):
            return verb[1] + content()["verbs"][_one(rng, verb[2][1:].split("/"))][2]
        before, auxiliary = auxiliary, ""
        return before + verb[1] + content()["verbs"][_one(rng, verb[2].split("/"))][column]

    return re.sub(r"\ba (?=[aeio])", "an ", VERB.sub(form, text))


def entry(table: Mapping[str, Any], attributes: Attributes) -> Any:
    """Returns the table entry for the action and one of its attributes, such as "walk left".

    If there is no such entry, returns the entry for the action alone, or None if this entry is
    missing as well.
    """
    action = str(attributes["action"])
    keys = [f"{action} {value}" for value in attributes.values()] + [action]
    return next((table[key] for key in keys if key in table), None)


def _one(rng: np.random.Generator, choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]


def _joints(rng: np.random.Generator, t: np.ndarray, attributes: Attributes) -> np.ndarray:
    """Returns the joint positions (F, 22, 3) of a motion with the given attributes.

    The times `t` (F,) are in seconds.
    """
    margin = round(MARGIN / (t[1] - t[0])) if attributes.get("ends") == "cycle" else 0
    times = np.arange(len(t) + 2 * margin) * (t[1] - t[0]) if margin else t
    body = Body(rng, times, entry(content()["widths"], attributes))
    move(body, rng, times, attributes)
    joints = body.joints()[margin : margin + len(t)]

    name = str(attributes["action"])
    if ACTIONS[name].reverse:
        joints = joints[::-1]
    if name in MORE or attributes.keys() & {"while", "ends"}:
        joints = joints - joints[0, 0] * np.array([1, 0, 1])
    return joints.astype(np.float32)


class Synthetic(MotionSource):
    """Procedural motions of SMPL's 22 joints (y up), with captions and exact attributes.

    Each clip shows one action or, with `actions="all"`, sometimes two actions at once. The body
    starts at the origin and faces +z. Clip number n depends only on n, the seed, and the options
    that select actions.

    Args:
        clips: number of clips.
        seed: seed for the clips, 0 or more.
        workers: number of processes that generate clips; 0 = one per core.
        actions: "core" for 22 actions, or "all" to add 54 actions, clips with two simultaneous
            actions, and parts of cycles.
        core_share: if `actions` is "all", the fraction of clips whose action is drawn from the 22
            core actions, as with "core". The actions of the other clips are drawn from all actions.
        often: names of actions to show more often, each with the same probability. This helps with
            quick, small and rare motions, which models learn last.
        often_share: fraction of the clips whose action is drawn from `often`.
    """

    name = "synthetic"
    license = "MIT"
    captions_may_be_shared = True
    actions = tuple(CORE)
    verbs = tuple(
        sorted({form for name in content()["core_verbs"] for form in content()["verbs"][name]})
    )

    def __init__(
        self,
        clips: int = 5000,
        seed: int = 0,
        workers: int = 0,
        actions: Literal["core", "all"] = "core",
        core_share: float = 0.0,
        often: Sequence[str] = (),
        often_share: float = 0.0,
    ):
        if clips < 1 or seed < 0:
            raise UserError(
                f"synthetic: clips={clips}, seed={seed}: expected at least one clip, and a seed of 0 or more"
            )
        if actions not in ("core", "all"):
            raise UserError(f'synthetic: actions={actions!r}: choose "core" or "all"')
        if not 0 <= core_share <= 1 or (core_share and actions == "core"):
            raise UserError(
                f"synthetic: core_share={core_share}: expected a number from 0 to 1. Values above 0 require actions=all"
            )
        self.size, self.seed, self.workers, self.everything = clips, seed, workers, actions == "all"
        self.core_share = core_share
        self.often, self.often_share = tuple(often), often_share
        self.options = {"clips": clips, "seed": seed}
        if often or often_share:
            _check_often(self.often, often_share, ACTIONS if self.everything else CORE)
            self.options |= {"often": list(self.often), "often_share": often_share}
        if self.everything:
            self.options["actions"] = actions
            if core_share:
                self.options["core_share"] = core_share
            self.actions = tuple(ACTIONS)
            self.verbs = tuple(
                sorted({form for forms in content()["verbs"].values() for form in forms})
            )

    def count(self) -> int:
        """Returns the requested number of clips."""
        return self.size

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields clips 0, 1, 2, ... at `fps` frames per second."""
        return in_order(partial(self.clip, fps=fps), range(self.size), self.workers)

    def clip(self, index: int, fps: float) -> Clip:
        """Returns clip number `index`, which has `round(seconds * fps) + 1` frames."""
        rng = np.random.default_rng((self.seed, index))
        attributes = self.attributes(rng)
        action = str(attributes["action"])
        repeating = 0.35 + 0.8 * int(attributes.get("count", 0))
        seconds = rng.uniform(max(MIN_SECONDS, repeating, ACTIONS[action].seconds), MAX_SECONDS)
        name = f"synthetic_{'all_' if self.everything else ''}{self.seed}_{index:06d}"
        motion = _joints(rng, np.arange(round(seconds * fps) + 1) / fps, attributes)
        # Captions are drawn with a separate generator, so that changes to the grammar do not change
        # the motions.
        return self.described(
            name, motion, attributes, np.random.default_rng((self.seed, index, 1))
        )

    def described(
        self, name: str, motion: np.ndarray, attributes: Attributes, words: np.random.Generator
    ) -> Clip:
        """Returns a clip with the given motion (F, 22, 3) and with captions.

        The captions are drawn with the generator `words`. The split depends on the name of the
        clip.
        """
        split = hashed_split(name, val=5, test=10)
        incomplete = split == "train" and words.random() < PARTIAL
        texts, stated = draw_captions(words, attributes, CAPTIONS, incomplete)
        return Clip(
            id=name,
            motion=motion,
            captions=texts,
            split=split,
            source=name,
            action=self.actions.index(str(attributes["action"])),
            attributes=stated,
        )

    def attributes(self, rng: np.random.Generator) -> Attributes:
        """Draws the attributes of a clip."""
        if self.often_share and rng.random() < self.often_share:
            action = str(rng.choice(self.often))
            return ACTIONS[action].draw(rng, action)
        if self.core_share and rng.random() < self.core_share:
            action = drawn_from(rng, CORE)
            return CORE[action].draw(rng, action)
        kind = rng.random() if self.everything else 1.0
        if kind < SIMULTANEOUS:
            base, gesture = drawn_from(rng, BASES), drawn_from(rng, GESTURES)
            added = GESTURES[gesture].draw(rng, gesture)
            added["while"] = added.pop("action")
            return BASES[base].draw(rng, base) | added
        if kind < SIMULTANEOUS + CYCLIC:
            cycle = drawn_from(rng, CYCLES)
            drawn = CYCLES[cycle].draw(rng, cycle)
            return {"action": cycle, "ends": "cycle"} | drawn
        actions = ACTIONS if self.everything else CORE
        action = drawn_from(rng, actions)
        return actions[action].draw(rng, action)


def _check_often(often: Sequence[str], share: float, actions: Mapping[str, Action]) -> None:
    for name in often:
        if name in ACTIONS.keys() - actions.keys():
            raise UserError(f"synthetic: often={name}: this action requires actions=all")
        if name not in actions:
            raise UserError(
                f"synthetic: often={name}: unknown action.{did_you_mean(name, list(actions))}"
            )
    if not often or not 0 < share <= 1:
        raise UserError(
            f"synthetic: often={list(often)}, often_share={share}: expected names of actions, and a "
            "number above 0 and at most 1"
        )


def prompts(count: int | None = None) -> list[tuple[str, Attributes]]:
    """Returns fixed prompts and their attributes.

    The prompts are used for samples on dashboards and for `evaluators.metrics.attributes`.

    Args:
        count: number of prompts to return, starting with the first. Default: all.
    """
    return [
        (row["text"], {name: row[name] for name in row if name != "text"})
        for row in content()["prompts"][:count]
    ]


def example(attributes: Attributes, fps: float = 20.0) -> np.ndarray:
    """Returns joint positions (F, 22, 3) of a three-second motion with the given attributes.

    The attributes may be incomplete, like the attributes of a prompt. Missing attributes are drawn
    at random.
    """
    name = str(attributes["action"])
    drawn = attributes
    if not attributes.keys() & {"while", "ends"}:
        draws = (ACTIONS[name].draw(np.random.default_rng(seed), name) for seed in range(1000))
        drawn = next(drawn for drawn in draws if attributes.items() <= drawn.items())
    return _joints(np.random.default_rng(0), np.arange(0, 3, 1 / fps), drawn)
