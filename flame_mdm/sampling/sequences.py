# pyright: standard
"""Lengths of motions, and the windows that cover sequences of actions."""

from collections.abc import Sequence

import torch

from flame_mdm.errors import UserError
from flame_mdm.generator import MotionGenerator
from flame_mdm.processes.windows import Windows, cover, spans
from flame_mdm.sampling.motion_request import USUAL_SECONDS, Part, SamplingRequest

# Overlap of neighboring windows in seconds; see docs/sequences.md
OVERLAP = 0.5
# Maximum length of a sequence in seconds. All of its windows are denoised at the same time.
MAX_SECONDS = 600


def overlap(model: MotionGenerator) -> int:
    """Returns the number of frames that neighboring windows share.

    The number is always even. For a model that continues frames, it is 0.
    """
    if model.denoiser.context_frames:
        return 0
    return 2 * round(min(OVERLAP * model.representation.fps, model.facts["max_frames"] / 3) / 2)


def part_frames(
    model: MotionGenerator,
    text: str,
    parts: Sequence[Part],
    usual: Sequence[float | None],
    *,
    is_sequence: bool,
    loop: bool,
) -> list[int]:
    """Returns the number of frames in each part of a prompt.

    Args:
        model: the model that samples the motion.
        text: the prompt, as it is quoted in error messages.
        parts: the parts of the prompt, with their durations in seconds if the prompt states them.
        usual: the unrounded length, in frames, of each part without a stated duration. None stands
            for `USUAL_SECONDS` or, if that is too long for one window, for the number of frames
            that fit into the window.
        is_sequence: whether the motion is sampled in windows. If not, the prompt has a single part.
        loop: whether the last frame should lead back to the first one.

    Raises:
        UserError: If a part is too short or too long for the model.
    """
    fps, longest = model.representation.fps, model.facts["max_frames"]
    if is_sequence or model.denoiser.context_frames:
        return _sequence_frames(model, text, parts, usual, loop)

    (frames,) = usual
    length = min(round(USUAL_SECONDS * fps), longest) if frames is None else round(frames)
    shown = f"{length / fps:g} seconds ({length} frames)"
    if length < 2:
        raise UserError(f"{shown} is too short. Use at least {2 / fps:g} seconds")
    if length > longest:
        raise UserError(
            f"{shown} cannot be sampled: the model was trained on motions of up to {longest / fps:g} seconds. "
            "To generate a longer motion in overlapping windows, state the seconds in the text: "
            f"'walks @{length / fps:g}'"
        )
    return [length]


def _sequence_frames(
    model: MotionGenerator,
    text: str,
    parts: Sequence[Part],
    usual: Sequence[float | None],
    loop: bool,
) -> list[int]:
    fps, shared = model.representation.fps, overlap(model)
    window = model.facts["max_frames"] - shared * (loop or len(parts) > 1)
    default = USUAL_SECONDS * fps
    if not model.denoiser.context_frames:
        default = min(default, window)
    lengths = []
    for (_, seconds), frames in zip(parts, usual, strict=True):
        if seconds is not None:
            frames = seconds * fps
        lengths.append(round(default if frames is None else frames))
    for (name, _), length in zip(parts, lengths, strict=True):
        if length < 1:
            raise UserError(
                f"'{name}': {length / fps:g} seconds is too short. Use at least {1 / fps:g} seconds"
            )
        if length < shared:
            raise UserError(
                f"'{name}': a part of {length / fps:g} seconds is too short. Use at least {shared / fps:g} seconds, "
                "the overlap of neighboring windows"
            )
    if sum(lengths) > MAX_SECONDS * fps:
        raise UserError(
            f"'{text}': {sum(lengths) / fps:g} seconds is too long. Use at most {MAX_SECONDS} seconds"
        )
    return lengths


def windows(
    model: MotionGenerator,
    request: SamplingRequest,
    conditions: Sequence[Sequence[str]],
    lengths: Sequence[Sequence[int]],
) -> Windows:
    """Returns the windows of several sequences.

    For each sequence, `conditions` contains the texts or actions of its parts, and `lengths`
    contains the lengths of these parts in frames.
    """
    longest, shared, device = model.facts["max_frames"], overlap(model), model.device
    spans_of = [spans(parts, longest, shared, request.loop) for parts in lengths]
    covering = [(row, *span) for row, parts in enumerate(spans_of) for span in parts]
    names = [conditions[row][part] for row, part, _, _ in covering]
    # A denoiser that attends to padding receives as many frames as in training.
    width = max(size for *_, size in covering) if model.denoiser.mask_padding else longest
    positions = [(row, first, size) for row, _, first, size in covering]
    covered = cover(positions, [sum(parts) for parts in lengths], shared, width, device)
    if request.kind == "action":
        covered.batch.action = torch.tensor(
            [model.facts["actions"].index(name) for name in names], device=device
        )
    else:
        covered.batch.text = names
    return covered
