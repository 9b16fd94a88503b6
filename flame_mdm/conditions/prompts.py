# pyright: standard
"""Prompts as models read them: captions for each part, a summary, changes and unknown words."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from flame_mdm.conditions.language.reading import Reader, Reading
from flame_mdm.conditions.vocabulary import check_known, in_parts, unknown_words, unread_words


@dataclass(frozen=True)
class ReadPrompt:
    """A prompt as a model reads it.

    Attributes:
        parts: for each part, its words and its duration in seconds. The duration is None if the
            prompt does not specify it.
        captions: the caption that the model reads for each part.
        unknown: words that never occur in the training captions, or that the model does not read.
        summary: one line that states how the prompt was understood, or "" if the model's captions
            may describe several actions.
        changes: one line per difference between the prompt and the sampled motion.
        fitting: for each part, a duration in seconds that suits the number of repetitions, or None
            if the part does not specify a number of repetitions. The tuple is empty if the captions
            do not describe single actions.
    """

    parts: Sequence[tuple[str, float | None]]
    captions: tuple[str, ...]
    unknown: tuple[str, ...] = ()
    summary: str = ""
    changes: tuple[str, ...] = ()
    fitting: tuple[float | None, ...] = ()


def read_prompt(
    prompt: str,
    parts: Sequence[tuple[str, float | None]],
    facts: Mapping[str, Any],
    max_words: int | None = None,
    *,
    splits: bool = False,
    check_words: bool = True,
) -> ReadPrompt:
    """Returns a prompt as a model reads it.

    Args:
        prompt: the text as the user typed it.
        parts: for each part of a prompt such as "walks @3 | sits", its words and its duration in
            seconds. The duration is None if the prompt does not specify it.
        facts: facts about the model, such as its "vocabulary", "actions" and "captions".
        max_words: maximum number of words that the model reads in a caption, or None for no limit.
        splits: whether a sentence with several actions is split into one part per action. This
            applies only to prompts with a single part.
        check_words: whether to replace words for actions with the model's own words, and whether to
            reject text if the model knows none of its content words.

    Raises:
        UserError: If the model does not understand a part.

    Example:
        >>> read = read_prompt("walks happily", [("walks happily", None)], {"vocabulary": ["walks"]})
        >>> read.captions, read.unknown
        (('walks happily',), ('happily',))
    """
    if check_words and Reader.fits(facts):
        return _with_actions(Reader(facts), prompt, parts, max_words, splits)

    if splits and len(sentences := in_parts(prompt, facts.get("verbs", ()))) > 1:
        parts = [(sentence, None) for sentence in sentences]
    captions = tuple(words for words, _ in parts)
    unknown: list[str] = []
    for text in captions:
        if check_words:
            check_known(text, facts)
        unknown += unknown_words(text, facts) + unread_words(text, max_words)
    return ReadPrompt(parts, captions, tuple(unknown))


def _with_actions(
    reader: Reader,
    prompt: str,
    parts: Sequence[tuple[str, float | None]],
    max_words: int | None,
    splits: bool,
) -> ReadPrompt:
    """Reads a prompt for a model whose captions describe single actions.

    The prompt keeps its parts unless it is split into one part per action. If a part names several
    actions, its words are passed to the model unchanged.
    """
    readings: list[Reading]
    if splits:
        reading = reader.read(prompt)
        readings, captions = [reading], reading.captions
        fitting = reading.seconds() or (None,)
        if len(reading.texts) > 1:
            parts = [(words, None) for words in reading.texts]
    else:
        readings = [reader.read(words) for words, _ in parts]
        single = [reading if len(reading.captions) == 1 else None for reading in readings]
        captions = tuple(
            words if reading is None else reading.captions[0]
            for (words, _), reading in zip(parts, single, strict=True)
        )
        fitting = tuple(
            reading.seconds()[0] if reading and reading.steps else None for reading in single
        )
        # No change applies to words that are passed to the model unchanged.
        readings = [
            replace(reading, changes=()) if one is None else reading
            for reading, one in zip(readings, single, strict=True)
        ]
    ignored = [word for reading in readings for word in reading.ignored]
    unread = [word for text in captions for word in unread_words(text, max_words)]
    return ReadPrompt(
        parts,
        captions,
        unknown=(*ignored, *unread),
        summary=", then ".join(reading.summary() for reading in readings),
        changes=tuple(line for reading in readings for line in reading.warnings()),
        fitting=fitting,
    )
