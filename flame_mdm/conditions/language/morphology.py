"""Base forms of English words, derived from rules and a list of irregular forms."""

from collections.abc import Iterator
from functools import cache

from flame_mdm.conditions.language.tables import phrases

VOWELS = "aeiou"


@cache
def base_forms(word: str) -> tuple[str, ...]:
    """Returns the possible base forms of a word, beginning with the word itself.

    For "waving", these are waving, wav and wave. Not all of them are words, so callers must select
    the forms that they know.
    """
    return tuple(dict.fromkeys([word, *_irregular().get(word, ()), *_stems(word)]))


def _stems(word: str) -> Iterator[str]:
    """Yields the possible spellings of a word without its regular ending."""
    if word.endswith(("ies", "ied")) and len(word) > 4:
        yield f"{word[:-3]}y"
    for ending in ("ing", "ed", "es", "s", "in"):
        stem = word.removesuffix(ending)
        if stem == word or len(stem) < 2:
            continue
        if ending == "s":
            if not stem.endswith("s"):
                yield stem
            continue
        yield stem
        if ending == "es":
            continue
        if len(stem) > 2:
            yield f"{stem}e"
        if len(stem) > 3 and stem[-1] == stem[-2]:
            yield stem[:-1]


@cache
def inflections(verb: str) -> tuple[str, ...]:
    """Returns the forms of a verb or noun, such as wave, waves, waving and waved for "wave"."""
    irregular = [form for form, bases in _irregular().items() if verb in bases]
    sibilant = verb.endswith(("s", "sh", "ch", "x", "z"))
    stem = verb[:-1] if verb.endswith("e") and not verb.endswith("ee") else verb
    forms = [verb, f"{verb}es" if sibilant else f"{verb}s", f"{stem}ing", f"{stem}ed"]
    if verb.endswith("y") and len(verb) > 2 and verb[-2] not in VOWELS:
        forms += [f"{verb[:-1]}ies", f"{verb[:-1]}ied"]
    if _doubles(verb):
        forms += [f"{verb}{verb[-1]}ing", f"{verb}{verb[-1]}ed"]
    return tuple(dict.fromkeys(forms + irregular))


def _doubles(verb: str) -> bool:
    """Returns whether the last consonant of a verb may be doubled, as in "hopping"."""
    return (
        len(verb) > 2
        and verb[-1] not in f"{VOWELS}wxy"
        and verb[-2] in VOWELS
        and verb[-3] not in VOWELS
    )


@cache
def _irregular() -> dict[str, tuple[str, ...]]:
    """Returns the base forms of irregular words."""
    bases: dict[str, tuple[str, ...]] = {}
    for base, forms in phrases()["irregular"].items():
        for form in forms.split():
            bases[form] = (*bases.get(form, ()), base)
    return bases
