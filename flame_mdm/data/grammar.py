"""Captions drawn from the grammar of the synthetic data set, which `synthetic.yaml` contains and describes."""

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from flame_mdm.safe_io import read_yaml

Attributes = Mapping[str, Any]

UNSAID = {"speed": "normal", "amount": "quarter"}  # values that a caption need not state
TENSES = ("present",) * 5 + ("progressive",) * 3 + ("past", "past", "future")
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
    rng: np.random.Generator, attributes: Attributes, count: int, partial: bool = False
) -> tuple[list[str], dict[str, Any]]:
    """Draws `count` different captions of a clip with these attributes, and returns them with those that they state.

    With `partial`, they leave out some attributes, all of them the same ones, if the grammar has such captions.
    """
    everything = {name for name, value in attributes.items() if name != "action" and UNSAID.get(name) != value}
    captions: list[str] = []
    stated = everything
    for _ in range(30 if partial else 0):  # the first caption that leaves something out decides what is left out
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
    action = attributes["action"]
    keys = (key for value in attributes.values() if (key := f"{action} {value}") in grammar["captions"])
    template = _one(rng, grammar["captions"][next(keys, action)])
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
    text = _conjugated(rng, text, who, bool(subject.get("plural")))
    return " ".join(text.split()), {name for name in said if UNSAID.get(name) != attributes[name]}


def _conjugated(rng: np.random.Generator, text: str, who: str, plural: bool) -> str:
    """Returns the text with its verbs in one tense; without a subject, as imperatives or participles."""
    tense = _one(rng, TENSES if who else ("present", "present", "progressive"))
    words = {"present": 0 if plural or not who else 1, "progressive": 2, "past": 3, "future": 0}
    auxiliaries = {"progressive": "are " if plural else "is ", "future": "will "}
    auxiliary = auxiliaries.get(tense, "") if who else ""

    def form(verb: re.Match[str]) -> str:
        nonlocal auxiliary
        before, auxiliary = auxiliary, ""
        return before + verb[1] + content()["verbs"][_one(rng, verb[2].split("/"))][words[tense]]

    return re.sub(r"\ba (?=[aeio])", "an ", VERB.sub(form, text))


def _one(rng: np.random.Generator, choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]
