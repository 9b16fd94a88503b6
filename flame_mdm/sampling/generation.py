# pyright: standard
"""Sampling of motions from text, from actions, or without a condition."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np
import torch
from torch import Tensor

from flame_mdm.batch import Edit, MotionBatch, length_mask, pad_to, sent
from flame_mdm.errors import UserError
from flame_mdm.formats.cleanup import cleaned
from flame_mdm.formats.faults import find_faults
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator
from flame_mdm.sampling.keywords import SamplingKeywords
from flame_mdm.sampling.motion_request import SamplingRequest
from flame_mdm.sampling.reading import decoded
from flame_mdm.sampling.resolution import ResolvedPrompt, ResolvedRequest, resolve
from flame_mdm.sampling.sequences import overlap, windows
from flame_mdm.sampling.streams import Schedule, Streams, starting_point

BATCH = 32
STAGES = 10  # clean estimates to show per sampling run, as in MFM's figure 5
Score = Callable[[Sequence[Motion]], Sequence[float]]
"""A function that scores motions, such as the candidates for a text. Higher scores are better."""


def generate(
    model: MotionGenerator,
    texts: str | Sequence[str] | None = None,
    *,
    score: Score | None = None,
    edit: Edit | None = None,
    stages: list[Motion] | None = None,
    **keywords: Unpack[SamplingKeywords],
) -> list[Motion]:
    """Generates motions for texts or actions, or unconditioned motions if neither is given.

    A motion depends only on its text, its length, its sample number and the seed, not on the other
    texts. If a text is given several times, its sample numbers continue from one occurrence to the
    next, so all of its samples differ. "A man walks, then sits down" becomes the sequence "A man
    walks | sits down", unless `split=False`.

    Args:
        model: the model, from `flame_mdm.load`.
        texts: what the person does, as one string or several.
        score: function that scores those `candidates` that have no faults. The candidate with the
            highest score is kept. By default, the candidate with the fewest faulty frames is kept.
        edit: an edit that keeps part of a motion in every sample. The motion is as long as the
            samples; `known` and `keep` have the shape (1, F, D).
        stages: list that receives clean estimates of the first motion, taken at equal intervals
            during sampling, followed by the motion itself (MFM, figure 5).
        keywords: fields of `flame_mdm.sampling.motion_request.SamplingRequest` (see its
            description): `actions` (instead of texts), `seconds` or `frames` (default: 3 seconds,
            or less for one or two repetitions, as in "kicks twice"), `samples` per text (1),
            `candidates` per sample (1), `seed` (0), `after`, `split` (True), `loop` (False),
            `targets` or `path`, `shared_noise` (False) and `cleanup` (False). The sampler options
            `guidance_scale`, `sampler`, `num_inference_steps`, `eta` and `spacing` (default: the
            model's) are described in `flame_mdm.sampler_options.SamplerOptions`.

    Returns:
        The motions, with `samples` motions for each text: all samples of the first text come first,
        then all samples of the second text, and so on.

    Raises:
        UserError: If the request is invalid, if the model cannot fulfill it, or if the model knows
            none of the content words of a text.

    Example:
        >>> import flame_mdm
        >>> model = flame_mdm.load("quickstart")
        >>> texts = ["a person walks", "a person waves"]
        >>> motions = flame_mdm.generate(model, texts, frames=20, samples=2, num_inference_steps=2)
        >>> [motion.text for motion in motions]
        ['a person walks', 'a person walks', 'a person waves', 'a person waves']
        >>> motions[0].joints.shape  # frames, joints, (x, y, z) in meters; y is up
        (20, 22, 3)
    """
    request = SamplingRequest.of("generate", {"texts": texts, **keywords})
    if edit is not None:
        request.check_edit(edit.strength is not None and not bool(edit.keep.any()))
    resolved = resolve(request, model)
    resolved = resolved if edit is None else replace(resolved, edit=edit)
    return sample(model, resolved, score=score, stages=stages)


def sample(
    model: MotionGenerator,
    resolved: ResolvedRequest,
    *,
    score: Score | None = None,
    stages: list[Motion] | None = None,
) -> list[Motion]:
    """Samples the motions of a resolved request in batches; see `generate`."""
    request = resolved.request
    if model.denoiser.context_frames and (stages is not None or resolved.edit is not None):
        keyword = "edit" if stages is None else "trajectory"
        raise UserError(
            f"{keyword}: not supported by models that continue motions block by block. Omit {keyword}"
        )
    if stages is not None and request.candidates > 1:
        raise UserError(
            "trajectory shows the estimates of a single motion and cannot be combined with candidates. "
            "Omit one of the two"
        )
    rows = _rows(resolved)
    motions: list[Motion] = []
    for begin in range(0, len(rows), BATCH):
        trajectory = _First() if stages is not None and not begin else None
        motions += _sample(model, resolved, rows[begin : begin + BATCH], trajectory)
        if stages is not None and trajectory:
            stages += _stages(model, trajectory, motions[0])

    if request.candidates > 1:
        groups = range(0, len(motions), request.candidates)
        motions = [best(motions[first : first + request.candidates], score) for first in groups]
    if request.cleanup:
        motions = [
            cleaned(motion, model.representation.contacts(motion.features)) for motion in motions
        ]
    return motions


def best(candidates: Sequence[Motion], score: Score | None = None) -> Motion:
    """Returns the faultless candidate with the highest score.

    If all candidates have faults, all of them are scored. Without `score`, the candidate with the
    fewest faulty frames is returned.
    """
    faulty = [_faulty_frames(motion) for motion in candidates]
    if score is None:
        return candidates[faulty.index(min(faulty))]
    faultless = [motion for motion, frames in zip(candidates, faulty, strict=True) if not frames]
    scored = faultless or candidates
    scores = list(score(scored))
    return scored[scores.index(max(scores))]


def _faulty_frames(motion: Motion) -> int:
    frames = {frame for fault in find_faults(motion) for frame in range(fault.start, fault.end)}
    return len(frames)


@dataclass(frozen=True)
class _Row:
    """A motion to sample: its prompt and the name that seeds its noise."""

    prompt: ResolvedPrompt
    id: str


def _rows(resolved: ResolvedRequest) -> list[_Row]:
    """Returns the motions to sample, in the order of the prompts."""
    copies = resolved.request.samples * resolved.request.candidates
    counts: Counter[str] = Counter()
    rows = []
    for prompt in resolved.prompts:
        for _ in range(copies):
            rows.append(_Row(prompt, f"{prompt.text}#{counts[prompt.text]}"))
            counts[prompt.text] += 1
    return rows


def _sample(
    model: MotionGenerator,
    resolved: ResolvedRequest,
    rows: Sequence[_Row],
    trajectory: list[Tensor] | None,
) -> list[Motion]:
    """Samples a batch of motions."""
    if model.denoiser.context_frames:
        return _sample_streams(model, resolved, rows)
    request, representation = resolved.request, model.representation
    lengths = [row.prompt.frames for row in rows]
    conditions = [row.prompt.conditions for row in rows]
    totals = [sum(frames) for frames in lengths]
    x = representation.mean.new_zeros(
        len(rows), max(totals), representation.features, dtype=torch.float32
    )
    mask = sent(length_mask(torch.tensor(totals)), x.device)
    batch = MotionBatch(x=x, mask=mask, ids=[row.id for row in rows])

    covering = windows(model, request, conditions, lengths) if resolved.is_sequence else None
    if request.kind == "text":
        batch.text = [" | ".join(row.prompt.conditions) for row in rows]
    elif request.kind == "action" and covering is None:
        labels = [model.facts["actions"].index(name) for (name,) in conditions]
        batch.action = torch.tensor(labels, device=mask.device)

    x = model.generate(
        batch,
        request.options,
        seed=request.seed,
        edit=_edit(model, resolved, x),
        windows=covering,
        unconditioned=request.kind == "none",
        shared_noise=request.shared_noise,
        trajectory=trajectory,
    )
    return [_decoded(model, resolved, row, features) for row, features in zip(rows, x, strict=True)]


def _sample_streams(
    model: MotionGenerator, resolved: ResolvedRequest, rows: Sequence[_Row]
) -> list[Motion]:
    """Samples each motion as the beginning of a stream.

    Motions with targets are sampled one by one, because guidance toward targets supports only a
    single motion.
    """
    if resolved.targets is not None and len(rows) > 1:
        return [motion for row in rows for motion in _sample_streams(model, resolved, [row])]
    request, before = resolved.request, resolved.before
    prefix, placement = starting_point(model, None)
    if before is not None:
        features = before[-model.denoiser.context_frames :].to(model.device)
        prefix = model.representation.normalize(features)[None]

    # The noise depends only on the first part, so that later parts do not affect earlier frames.
    numbers = [row.id.rpartition("#")[2] for row in rows]
    first = [row.prompt.conditions[0] for row in rows]
    ids = [f"{condition}#{number}" for condition, number in zip(first, numbers, strict=True)]
    streams = Streams(
        model,
        ["shared"] * len(rows) if request.shared_noise else ids,
        first,
        prefix.expand(len(rows), -1, -1),
        placement,
        request.options,
        kind=request.kind,
        seed=request.seed,
    )
    streams.schedules = [
        Schedule.of_parts(row.prompt.conditions, row.prompt.frames) for row in rows
    ]
    streams.targets = resolved.targets
    motions = streams.take([sum(row.prompt.frames) for row in rows])
    return [_decoded(model, resolved, row, x) for row, x in zip(rows, motions, strict=True)]


def _edit(model: MotionGenerator, resolved: ResolvedRequest, x: Tensor) -> Edit | None:
    """Returns the edit for a batch x (B, F, D).

    The edit includes the targets and is padded to F frames.
    """
    edit, frames = resolved.edit, x.shape[1]
    if resolved.targets is not None:
        goal = resolved.targets.edit(model.representation, frames, model.device)
        start = goal.known if edit is None else torch.where(goal.keep, goal.known, edit.known)
        edit = replace(goal, known=start, strength=None if edit is None else edit.strength)
    if edit is None:
        return None
    features, keep = pad_to(edit.known, frames), pad_to(edit.keep, frames)
    return replace(edit, known=features.expand_as(x), keep=keep.expand_as(x))


def _decoded(model: MotionGenerator, resolved: ResolvedRequest, row: _Row, x: Tensor) -> Motion:
    """Converts normalized features (F, D) to a motion.

    If the motion continues a previous motion, the result begins with the previous motion.
    """
    representation, prompt = model.representation, row.prompt
    features = representation.denormalize(x[: sum(prompt.frames)].float())
    if resolved.before is not None:
        before = resolved.before.to(features)
        features = torch.cat([before, features[overlap(model) :]])
    motion = decoded(representation, features, prompt.text, row.id)
    if not np.isfinite(motion.joints).all():
        raise UserError(f"the model returned non-finite numbers for '{motion.text}'")

    if resolved.is_sequence:
        later = prompt.frames[1:]
        ends = np.cumsum([len(features) - sum(later), *later]).tolist()
        begins = [0 if resolved.before is None else len(resolved.before), *ends]
        motion.parts = tuple(zip(prompt.texts, begins, ends, strict=False))
    return motion


class _First(list[Tensor]):
    """A list that keeps only the first motion (1, F, D) of each appended batch, on the CPU."""

    def append(self, x: Tensor) -> None:
        super().append(x[:1].cpu())


def _stages(model: MotionGenerator, trajectory: Sequence[Tensor], result: Motion) -> list[Motion]:
    """Returns up to `STAGES` clean estimates of the first motion, followed by the motion.

    The estimates come from equally spaced calls to the denoiser.
    """
    count, stages = len(trajectory), []
    for call in sorted({index * count // STAGES for index in range(STAGES)}):
        x = trajectory[call][0, : len(result.features)].float()
        joints = model.representation.to_joints(x.to(model.device)).cpu().numpy()
        stages.append(
            replace(
                result, joints=joints, text=f"estimate after {call / count:.0%} of the sampling"
            )
        )
    return [*stages, replace(result, text=f"result: {result.text}")]
