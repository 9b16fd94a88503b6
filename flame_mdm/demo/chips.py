"""The demo's interpretation of the text, as HTML.

Each action and each attribute is shown as a chip, which can be changed with one click.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from html import escape

from flame_mdm.conditions.language.abilities import Abilities
from flame_mdm.conditions.language.reading import Reading
from flame_mdm.conditions.language.tables import Value, actions
from flame_mdm.conditions.language.understanding import Mention, Step
from flame_mdm.conditions.language.wording import attribute_words, caption, predicate
from flame_mdm.errors import one_line
from flame_mdm.sampling.motion_request import Part

SHOWN = ("direction", "speed", "count", "side")  # attributes that are shown as chips


def chips(abilities: Abilities, parts: Sequence[Part], readings: Sequence[Reading]) -> str:
    """Returns the chips for a text: its actions in order, their attributes, and ignored words.

    The value of each option is the entire text, with a different word for the action or attribute.
    The option that the user chooses replaces the text in the form.

    Args:
        abilities: the actions and attributes that the model knows, which become the options of the
            chips.
        parts: the words and the duration in seconds of each part of the text.
        readings: the meaning of each part.
    """
    rows = []
    for number, reading in enumerate(readings):
        can_change = len(reading.steps) == 1
        for step in reading.steps:
            shown = " + ".join(_step(abilities, parts, number, step, can_change))
            rows.append(shown if not rows else f"then {shown}")
    ignored = dict.fromkeys(word for reading in readings for word in reading.ignored)
    crossed = "".join(f" <del>{escape(one_line(word))}</del>" for word in ignored)
    return f'<p class="chips">{" ".join(rows)}{crossed}</p>' if rows else ""


def _step(
    abilities: Abilities, parts: Sequence[Part], number: int, step: Step, can_change: bool
) -> Iterator[str]:
    """Yields the chips for each action in a step."""
    for position, mention in enumerate(step):
        if not can_change:
            yield f"<span>{escape(predicate(mention))}</span>"
            continue

        def text(changed: Mention, position: int = position) -> str:
            """Returns the form's text with `changed` in place of this action."""
            words = caption((*step[:position], changed, *step[position + 1 :]))
            rows = [
                (words if row == number else phrase, seconds)
                for row, (phrase, seconds) in enumerate(parts)
            ]
            return " | ".join(
                phrase if seconds is None else f"{phrase} @{seconds:g}" for phrase, seconds in rows
            )

        others = [mention.action, *(name for name in abilities.actions if name != mention.action)]
        named = [(_with_action(mention, name), _action_label(name)) for name in others]
        selects = [_select("Action", [(text(changed), label) for changed, label in named], 0)]
        for name, values in abilities.choices(mention.action).items():
            stated = mention.attributes.get(name)
            options: list[tuple[str, str]] = [(text(_with(mention, name, None)), f"any {name}")]
            options += [
                (text(_with(mention, name, value)), attribute_words(name, value))
                for value in values
            ]
            chosen = 0 if stated not in values else 1 + values.index(stated)
            selects.append(_select(name.capitalize(), options, chosen))
        yield " ".join(selects)


def _action_label(action: str) -> str:
    """Returns the words for an action, without the action's usual direction.

    The direction is omitted, because another chip may contradict it.
    """
    return predicate(Mention(action)).removesuffix(f" {actions()[action].usual}")


def _select(label: str, options: Sequence[tuple[str, str]], chosen: int) -> str:
    rows = "".join(
        f'<option value="{escape(text)}"{" selected" if number == chosen else ""}>{escape(shown)}</option>'
        for number, (text, shown) in enumerate(options)
    )
    stated = "" if chosen or label == "Action" else ' class="open"'
    return f'<select aria-label="{escape(label)}"{stated}>{rows}</select>'


def _with(mention: Mention, name: str, value: Value | None) -> Mention:
    rest = {key: stated for key, stated in mention.attributes.items() if key != name}
    return replace(mention, attributes=rest if value is None else {**rest, name: value})


def _with_action(mention: Mention, action: str) -> Mention:
    takes = actions()[action].takes
    kept = {
        name: value for name, value in mention.attributes.items() if name in takes and name in SHOWN
    }
    return replace(mention, action=action, attributes=kept)
