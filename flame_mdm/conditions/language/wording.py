"""Wording of captions for actions and their attributes, in the form that a model reads."""

from collections.abc import Mapping, Sequence

from flame_mdm.conditions.language.morphology import base_forms, inflections
from flame_mdm.conditions.language.tables import Value, actions
from flame_mdm.conditions.language.understanding import Mention

WHO = "a person"
DIRECTIONS = {
    "forward": "forward",
    "backward": "backward",
    "left": "to the left",
    "right": "to the right",
    "up": "up",
    "down": "down",
    "clockwise": "clockwise",
    "counterclockwise": "counterclockwise",
    "circle": "in a circle",
}
SPEEDS = {"slow": "slowly", "fast": "quickly", "normal": ""}
TIMES = {1: "once", 2: "twice", 3: "three times", 4: "four times", 5: "five times", 6: "six times"}
PLURALS = {"hand": "hands", "arm": "arms", "leg": "legs"}


def predicate(mention: Mention) -> str:
    """Returns the words for an action and its attributes, such as "walks sideways to the left"."""
    entry, stated = actions()[mention.action], mention.attributes
    words = [entry.say]
    if "{side}" in entry.say:
        words = [entry.say.format(side=_limb(entry.part, stated.get("side")))]
    if stated.get("amount") == "half":
        words.append("around")
    if "direction" in stated:
        direction = str(stated["direction"])
        words.append(entry.ways.get(direction, DIRECTIONS[direction]))
    elif entry.usual and "amount" not in stated:
        words.append(entry.usual)
    words.append(SPEEDS[str(stated.get("speed", "normal"))])
    if "count" in stated:
        words.append(times(int(stated["count"])))
    if "side" in stated and "{side}" not in entry.say:
        words.append(f"{entry.before_side} {_limb(entry.part, stated['side'])}")
    return " ".join(word for word in words if word)


def times(count: int) -> str:
    """Returns the words for a number of repetitions, such as "twice"."""
    return TIMES.get(count, f"{count} times")


def caption(step: Sequence[Mention]) -> str:
    """Returns the caption for simultaneous actions, such as "a person walks while waving"."""
    first, *others = (predicate(mention) for mention in step)
    return " while ".join([f"{WHO} {first}", *(_participle(other) for other in others)])


def attribute_words(name: str, value: Value) -> str:
    """Returns the words for an attribute, such as "right", "twice" or "to the left"."""
    if name == "count":
        return times(int(value))
    if name == "amount":
        return "halfway around" if value == "half" else "a quarter"
    tables: Mapping[str, Mapping[str, str]] = {"direction": DIRECTIONS, "speed": SPEEDS}
    return tables.get(name, {}).get(str(value), str(value)) or str(value)


def _limb(part: str, side: Value | None) -> str:
    if side is None:
        return "a hand"
    return f"both {PLURALS.get(part, part)}" if side == "both" else f"the {side} {part}"


def _participle(words: str) -> str:
    """Returns a predicate with its verb as a participle: "waves twice" -> "waving twice"."""
    verb, _, rest = words.partition(" ")
    base = base_forms(verb)[-1]
    forms = [form for form in inflections(base) if form.endswith("ing")]
    return f"{forms[-1]} {rest}".strip()
