# pyright: standard
"""Resolves requests before sampling: determines everything that depends on the model."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from flame_mdm.batch import Edit
from flame_mdm.conditions.prompts import ReadPrompt, read_prompt
from flame_mdm.conditions.vocabulary import advice
from flame_mdm.errors import UserError, shortened
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator
from flame_mdm.sampling.motion_request import (
    TRAINED_ON,
    USUAL_SECONDS,
    SamplingRequest,
    is_timed,
    path_targets,
    read_parts,
    read_path,
)
from flame_mdm.sampling.reading import read_motion, with_features
from flame_mdm.sampling.sequences import overlap, part_frames
from flame_mdm.sampling.streams import check_streams
from flame_mdm.sampling.targets import Targets, read_targets


@dataclass(frozen=True)
class ResolvedPrompt:
    """A text or an action that was resolved for a model.

    Attributes:
        text: the prompt. A sentence with several actions becomes a sequence, "walks | sits".
        is_split: whether the original prompt was a sentence with several actions.
        conditions: caption or action of each part, as the model reads it.
        texts: the words of the prompt that belong to each part.
        frames: number of frames in each part. If the motion continues another one, the first part
            includes the frames in which the two motions overlap.
        unknown: words of the text that do not occur in the training captions or that the model does
            not read.
        summary: one line that states how the text was understood, or "" if the model's captions may
            describe several actions.
        changes: lines that report differences between the text and the sampled prompt.
    """

    text: str
    is_split: bool
    conditions: tuple[str, ...]
    frames: tuple[int, ...]
    texts: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    summary: str = ""
    changes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ResolvedRequest:
    """A request resolved for a model: sentences are split, files read, and lengths given in frames.

    Attributes:
        request: the original request.
        prompts: the texts or actions of the request in order, without refused prompts.
        is_sequence: whether the motions are sampled in overlapping windows.
        before: unnormalized features (F, D) of the motion that all sampled motions continue.
        targets: positions and poses to reach.
        edit: an edit that keeps part of a motion in all sampled motions. `known` and `keep` have
            the shape (1, F, D).
        warnings: warnings for the user. The warnings concern the motion to continue (what was
            omitted from its file or looks wrong), differences between a text and what is sampled,
            and words that the model does not know or does not read.
    """

    request: SamplingRequest
    prompts: tuple[ResolvedPrompt, ...]
    is_sequence: bool
    before: Tensor | None = None
    targets: Targets | None = None
    edit: Edit | None = None
    warnings: tuple[str, ...] = ()


def resolve(
    request: SamplingRequest,
    model: MotionGenerator,
    refused: dict[int, UserError] | None = None,
    *,
    check_words: bool = True,
) -> ResolvedRequest:
    """Resolves a request for a model.

    Args:
        request: the request.
        model: the model that samples the motions.
        refused: mapping from prompt indices to errors. Prompts that the model cannot sample are
            added to this mapping; all other prompts are resolved. By default, the first error is
            raised.
        check_words: whether to reject a text if the model knows none of its content words.

    Raises:
        UserError: If the model cannot do what is requested. The sampler and its options are
            checked later, by `Process.sample`.
    """
    _check_model(request, model)
    read: dict[int, ReadPrompt] = {}
    for number, prompt in enumerate(request.prompts):
        with _collected(refused, number):
            read[number] = _read(request, model, prompt, check_words)

    is_timed_prompt = any(is_timed(prompt.parts) for prompt in read.values())
    is_sequence = request.loop or request.after is not None or is_timed_prompt
    before, edit, notes = _continued(request, model)
    shared = 0 if before is None else overlap(model)
    usual_lengths = request.lengths(model.representation.fps)
    resolved: dict[int, ResolvedPrompt] = {}
    for number, prompt in read.items():
        with _collected(refused, number):
            texts = tuple(words for words, _ in prompt.parts)
            is_split = len(prompt.parts) > len(request.parts[number])
            text = " | ".join(texts) if is_split else request.prompts[number]
            first, *others = part_frames(
                model,
                text,
                prompt.parts,
                _usual_frames(prompt, usual_lengths[number], model),
                is_sequence=is_sequence,
                loop=request.loop,
            )
            frames = (shared + first, *others)
            resolved[number] = ResolvedPrompt(
                text,
                is_split,
                prompt.captions,
                frames,
                texts,
                prompt.unknown,
                prompt.summary,
                prompt.changes,
            )

    targets = _targets(request, model, list(resolved.values()))
    for number, prompt in resolved.items():
        with _collected(refused, number):
            if targets is not None:
                targets.check_end(sum(prompt.frames), model.representation.fps)
    prompts = [prompt for number, prompt in resolved.items() if number not in (refused or {})]
    warnings = [f"after={request.after}: {note}" for note in notes] + _warnings(prompts, model)
    return ResolvedRequest(
        request, tuple(prompts), is_sequence, before, targets, edit, tuple(warnings)
    )


def _usual_frames(
    prompt: ReadPrompt, requested: float | None, model: MotionGenerator
) -> list[float | None]:
    """Returns the length, in frames, of each part without a stated duration.

    The result has one entry per part; None stands for the default length. The requested number of
    frames, if any, applies to all parts. Otherwise, a part that states a number of repetitions
    lasts as long as these repetitions take, because a longer motion would repeat the action more
    often.
    """
    parts = len(prompt.parts)
    if requested is not None or not prompt.fitting:
        return [requested] * parts
    longest = min(USUAL_SECONDS * model.representation.fps, model.facts["max_frames"])
    return [
        None if seconds is None else min(seconds * model.representation.fps, longest)
        for seconds in prompt.fitting
    ]


@contextmanager
def _collected(refused: dict[int, UserError] | None, number: int) -> Iterator[None]:
    """Catches a `UserError` about a prompt and stores it in `refused`, unless `refused` is None."""
    try:
        yield
    except UserError as error:
        if refused is None:
            raise
        refused[number] = error


def _check_model(request: SamplingRequest, model: MotionGenerator) -> None:
    """Checks that the model supports the request: its kind of condition, streams and windows."""
    if model.denoiser.context_frames:
        check_streams(model)
        if request.loop:
            raise UserError(
                "loop=true: this model only extends a motion and cannot return to its first frame. Omit loop"
            )
    if request.kind not in ("none", model.conditioned_on):
        trained, instead = TRAINED_ON[model.conditioned_on]
        raise UserError(
            f"{request.kind}={shortened(request.prompts[0], 60)}: this model {trained}. Use {instead}"
        )
    if request.loop or request.after is not None:
        _check_windows(model)


def _check_windows(model: MotionGenerator) -> None:
    if not model.representation.relative:
        name = model.representation.name
        raise UserError(
            f"representation {name} contains world positions, so the windows of a "
            "sequence do not fit together. "
            "Use a model with humanml3d features"
        )


def _read(
    request: SamplingRequest, model: MotionGenerator, prompt: str, check_words: bool
) -> ReadPrompt:
    """Returns a prompt as the model reads it, with one part for each action of a sentence."""
    if request.kind == "none":
        return ReadPrompt([(prompt, None)], (prompt,))
    parts = read_parts(prompt)
    if request.kind == "action":
        for name, _ in parts:
            if name not in (actions := model.facts["actions"]):
                raise UserError(
                    f"unknown action '{name}'; this model knows: {', '.join(actions) or 'none'}"
                )
        read = ReadPrompt(parts, tuple(name for name, _ in parts))
    else:
        is_plain = "|" not in prompt and "@" not in prompt
        read = read_prompt(
            prompt,
            parts,
            model.facts,
            model.condition.max_words,
            splits=request.split and model.representation.relative and is_plain,
            check_words=check_words,
        )
    if is_timed(read.parts):
        _check_windows(model)
    return read


def _warnings(prompts: Sequence[ResolvedPrompt], model: MotionGenerator) -> list[str]:
    """Returns warnings about prompts.

    The warnings report differences between a text and what is sampled, and words that the model
    does not know or does not read.
    """
    lines = []
    for prompt in prompts:
        about = f"'{shortened(prompt.text, 60)}': " if len(prompts) > 1 else ""
        lines += [f"{about}{line}" for line in prompt.changes]

    read_as_typed = (prompt for prompt in prompts if prompt.unknown and not prompt.summary)
    for text in dict.fromkeys(text for prompt in read_as_typed for text in prompt.conditions):
        is_only_text = len(prompts) == 1 and text == prompts[0].text
        about = "" if is_only_text else f"'{shortened(text, 60)}': "
        lines += [f"{about}{line}" for line in advice(text, model.facts, model.condition.max_words)]
    return lines


def _continued(
    request: SamplingRequest, model: MotionGenerator
) -> tuple[Tensor | None, Edit | None, tuple[str, ...]]:
    """Returns the features (F, D) of the motion to continue, the edit, and the motion's notes.

    The edit keeps the end of the motion, whose last frames are generated again so that they connect
    to the new frames. A model that continues frames needs no edit: it reads the end of the motion.
    The notes of a motion in memory are omitted, because they were shown when the motion was read.
    """
    if request.after is None:
        return None, None, ()
    representation, shared = model.representation, overlap(model)
    if isinstance(request.after, Motion):
        motion, notes = request.after, ()
    else:
        motion = read_motion(representation, request.after)
        notes = motion.notes
    motion = with_features(representation, motion)
    before = torch.from_numpy(motion.features)
    least = shared or model.denoiser.context_frames
    if len(before) < least:
        raise UserError(
            f"after={motion.id}: the motion has {len(before)} frames. Use a motion of at least {least} frames"
        )
    if not shared:
        return before, None, notes
    ending = representation.normalize(before[-shared:].to(model.device))[None]
    return before, Edit(ending, torch.ones_like(ending, dtype=torch.bool)), notes


def _targets(
    request: SamplingRequest, model: MotionGenerator, prompts: Sequence[ResolvedPrompt]
) -> Targets | None:
    """Reads the targets of a request.

    A path becomes targets that are reached at a constant speed.
    """
    if request.path is not None and prompts:
        lengths = {sum(prompt.frames) for prompt in prompts}
        if len(lengths) > 1:
            raise UserError(
                f"path={request.path}: motions of different lengths cannot share a path. Use one length"
            )
        seconds = lengths.pop() / model.representation.fps
        return read_targets(model.representation, path_targets(read_path(request.path), seconds))
    return None if request.targets is None else read_targets(model.representation, request.targets)
