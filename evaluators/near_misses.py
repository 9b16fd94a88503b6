# pyright: standard
"""Finds near misses in a data set: captions that are wrong for a clip in exactly one attribute."""

from collections.abc import Sequence

from flame_mdm.data.store import Entry

# Names of the attribute that states the action. Clips that lack it have no near misses.
ACTION = (
    "action",
    "content",
)
# Value that a caption need not mention. A caption that omits it is less exact, but not wrong.
UNSAID = "normal"

_Stated = frozenset[tuple[str, str | int | float]]


def near_misses(clips: Sequence[Entry]) -> list[dict[str, list[str]]]:
    """Returns the sorted near misses of each clip, keyed by the attribute that differs.

    A caption of another clip is a near miss if both clips show the same action but differ in
    exactly one of the attributes (side, style, count, ...) that they both have. For example,
    "walks backward" is a near miss for a clip of a slow forward walk.
    """
    stated = [_stated(clip) for clip in clips]
    captions: dict[_Stated, set[str]] = {}
    for attributes, clip in zip(stated, clips, strict=True):
        captions.setdefault(attributes, set()).update(clip.captions)
    contradicting = {attributes: _contradicting(attributes, captions) for attributes in captions}
    return [contradicting[attributes] for attributes in stated]


def _stated(clip: Entry) -> _Stated:
    """Returns the attributes of a clip, with placeholders for their values in the action's name.

    For example, "wave-left-hand" becomes "wave-{side}-hand".
    """
    stated = {
        name: value
        for name, value in clip.attributes.items()
        if isinstance(value, str | int | float)
    }
    action = next((str(stated.pop(name)) for name in ACTION if name in stated), "")
    names = {str(value): f"{{{name}}}" for name, value in stated.items()}
    if action:
        stated["action"] = "-".join(
            names.get(word, word.removesuffix("s")) for word in action.split("-")
        )
    return frozenset(stated.items())


def _contradicting(clip: _Stated, captions: dict[_Stated, set[str]]) -> dict[str, list[str]]:
    mine = dict(clip)
    wrong: dict[str, set[str]] = {}
    for attributes, texts in captions.items():
        other = dict(attributes)
        if "action" not in mine or mine["action"] != other.get("action"):
            continue
        differing = [name for name in mine.keys() & other.keys() if mine[name] != other[name]]
        if len(differing) == 1 and other[differing[0]] != UNSAID:
            wrong.setdefault(differing[0], set()).update(texts - captions[clip])
    return {name: sorted(texts) for name, texts in sorted(wrong.items()) if texts}
