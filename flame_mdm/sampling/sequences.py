"""Sequences of actions: texts with parts, and the windows that cover them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from flame_mdm.batch import MotionBatch
from flame_mdm.errors import UserError
from flame_mdm.processes.windows import Windows, place, spans
from flame_mdm.task import MotionGeneration

OVERLAP = 0.5
"""Seconds that neighboring windows share; see docs/sequences.md."""
MAX_SECONDS = 600
"""Maximum length of a sequence; all its windows are denoised at the same time."""

Part = tuple[str, float | None]
"""Text of a part, and its seconds if the text gives them."""


def read_parts(text: str) -> list[Part]:
    """Splits "walks @3 | sits down" into parts: [("walks", 3.0), ("sits down", None)].

    Raises:
        UserError: a part is empty, or its length is not a number above 0.
    """
    parts: list[Part] = []
    for part in text.split("|"):
        words, at, number = (piece.strip() for piece in part.rpartition("@"))
        if not at:
            words, number = number, ""
        try:
            seconds = float(number.removesuffix("s")) if at else None
        except ValueError:
            seconds = math.nan
        if seconds is not None and not 0 < seconds < math.inf:
            raise UserError(f"'{part.strip()}': the seconds of a part are a number above 0, as in 'walks forward @3'")
        if not words:
            raise UserError(f"'{text}': part {len(parts) + 1} is empty. Say what happens in each: 'walks | sits'")
        parts.append((words, seconds))
    return parts


def check_sequence(model: MotionGeneration) -> None:
    """Checks that features of frames do not depend on where the motion began.

    Raises:
        UserError: they are positions in the world.
    """
    if not model.representation.relative:
        raise UserError(
            f"representation {model.representation.name} has positions in the world, so that windows of a sequence do "
            "not fit together. Use a model of humanml3d features"
        )


def overlap(model: MotionGeneration) -> int:
    """Returns the number of frames that neighboring windows share, which is even."""
    return 2 * round(min(OVERLAP * model.representation.fps, model.facts["max_frames"] / 3) / 2)


def part_frames(
    model: MotionGeneration, text: str, parts: Sequence[Part], default: float | None, loop: bool
) -> list[int]:
    """Returns the number of frames of each part.

    Args:
        model: the model.
        text: all parts, for messages.
        parts: of the text.
        default: seconds of parts that give none; None = 3 seconds, or what fits into one window if that is shorter.
        loop: whether the sequence is a loop.

    Raises:
        UserError: a part is shorter than an overlap, or all of them are too long.
    """
    fps, shared = model.representation.fps, overlap(model)
    several = loop or len(parts) > 1
    usual = min(3.0, (model.facts["max_frames"] - shared * several) / fps) if default is None else default
    found = [round((usual if seconds is None else seconds) * fps) for _, seconds in parts]
    for (name, _), frames in zip(parts, found, strict=True):
        if frames < shared:
            raise UserError(
                f"'{name}': a part of {frames / fps:g} seconds is too short. Give at least {shared / fps:g} seconds, "
                "which it shares with its neighbors"
            )
    if sum(found) > MAX_SECONDS * fps:
        raise UserError(f"'{text}': {sum(found) / fps:g} seconds are too long. Give at most {MAX_SECONDS}")
    return found


def windows(
    model: MotionGeneration,
    conditions: Sequence[Sequence[str]],
    lengths: Sequence[Sequence[int]],
    actions: Sequence[str] | None,
    loop: bool,
) -> Windows:
    """Returns the windows of several sequences.

    Args:
        model: the model.
        conditions: text or action of each part of each sequence.
        lengths: frames of the parts.
        actions: all names of actions if the conditions are actions.
        loop: whether the end of each sequence leads to its start.
    """
    longest, shared, device = model.facts["max_frames"], overlap(model), model.device
    found = [(row, *span) for row, each in enumerate(lengths) for span in spans(each, longest, shared, loop)]
    named = [conditions[row][part] for row, part, _, _ in found]
    # A denoiser that attends to its padding sees as many frames as in training.
    width = max(size for *_, size in found) if getattr(model.denoiser, "mask_padding", True) else longest
    placed = [(row, first, size) for row, _, first, size in found]
    rows, frames, mask, weights = place(placed, [sum(each) for each in lengths], shared, width, device)
    batch = MotionBatch(
        x=torch.zeros(*mask.shape, 0, device=device),
        mask=mask,
        ids=named,
        text=named if actions is None else None,
        action=None if actions is None else torch.tensor([actions.index(name) for name in named], device=device),
    )
    return Windows(batch, rows, frames, weights)
