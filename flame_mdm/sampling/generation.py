"""Motion sampling, with text, action or no condition, and output files of one request."""

from __future__ import annotations

import inspect
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import torch

from flame_mdm.batch import Edit, MotionBatch, Sampling, length_mask, pad_to
from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats.cleanup import cleaned
from flame_mdm.formats.faults import find_faults
from flame_mdm.formats.motion import Motion
from flame_mdm.safe_io import atomic_folder
from flame_mdm.sampling.reading import read_motion, with_features
from flame_mdm.sampling.sequences import Part, check_sequence, overlap, part_frames, read_parts, windows
from flame_mdm.sampling.targets import read_targets
from flame_mdm.task import MotionGeneration
from flame_mdm.visualize import contact_sheet, write_gif, write_mp4, write_player
from flame_mdm.visualize.scene import shortened

BATCH = 32
MAX_SAMPLES = 10_000
"""Maximum number of samples per request; they are kept in memory until all are complete."""
STAGES = 10
"""Clean estimates shown of one sampling run: one per tenth of it, as in figure 5 of MFM."""
OWN_FILES = re.compile(r"motion_\d{3,}\.npz|motions\.mp4|trajectory\.png")
"""Files that some requests write and others do not."""
TRAINED_ON = {
    "text": ("was trained on captions", 'text="a person walks"'),
    "action": ("was trained on action labels", "action=NAME"),
    "none": ("was trained without texts and labels", "unconditioned=true"),
}
MAX_TEXT_LENGTH = 2000
"""Maximum number of characters of a text; captions of the data sets are far shorter."""


def generate(
    model: MotionGeneration,
    texts: str | Sequence[str] | None = None,
    *,
    actions: str | Sequence[str] | None = None,
    seconds: float | Sequence[float] | None = None,
    frames: int | Sequence[int] | None = None,
    samples: int = 1,
    candidates: int = 1,
    score: Callable[[Sequence[Motion]], Sequence[float]] | None = None,
    seed: int = 0,
    edit: Edit | None = None,
    after: str | Path | Motion | None = None,
    loop: bool = False,
    targets: str | Path | Mapping[str, Any] | None = None,
    shared_noise: bool = False,
    stages: list[Motion] | None = None,
    cleanup: bool = False,
    **sampling: Unpack[Sampling],
) -> list[Motion]:
    """Generates motions for texts or actions, `samples` of each; unconditioned motions if neither is given.

    A text or action may have several parts, "walks forward @3 | turns left | sits down @2", with their seconds. They
    are generated together as one motion, in windows that overlap; see docs/sequences.md. So is a single part with
    seconds, "walks forward @10", which may be longer than the motions in training.

    A motion depends only on its text, its length, the sample number and the seed, not on other texts. If a text is
    given several times, sample numbers continue, so that its samples differ.

    Args:
        model: from `flame_mdm.load`.
        texts, actions: conditions; one of the two, depending on the model's training, or neither.
        seconds, frames: length of all motions, or a list with one length per text or action; of a sequence, the length
            of each part that gives none. Default: 3 seconds, or the maximum if shorter.
        samples: motions per text.
        candidates: how many motions are generated for each one that is returned: of those without faults
            (`flame_mdm.formats.faults`), if there are any, the one with the highest score.
        score: scores motions, higher is better; None = the number of faulty frames decides.
        seed: seed of the noise.
        edit: part of a motion of that length to keep in every sample, with `known` and `keep` (1, F, D); see
            `flame_mdm.commands.edit`.
        after: a motion, or a file that `flame_mdm.sampling.reading.read_motion` reads, that the result begins with.
        loop: the last frame leads to the first one. The body may be at another place by then.
        targets: places to reach in the world, a JSON file or its content; see docs/targets.md.
        shared_noise: all motions get the same noise, so that they differ by their texts and lengths alone.
        stages: list that gets the clean estimates along the sampling of the first motion, at equal intervals, and that
            motion itself (MFM, figure 5).
        cleanup: smooth the motions, keep bone lengths constant and feet in place where they touch the floor; see
            `flame_mdm.formats.cleanup`. Such motions have no features.
        sampling: options of `flame_mdm.batch.Sampling`, instead of the recipe's.

    Raises:
        UserError: a text is not a string, empty or too long, an action is unknown, or the model was not trained for the
            length.
    """
    steps, scale = sampling.get("num_inference_steps"), sampling.get("guidance_scale")
    for name, value in (("samples", samples), ("candidates", candidates)):
        if not 1 <= value <= MAX_SAMPLES:
            raise UserError(f"{name}={value}: give 1 to {MAX_SAMPLES:,}")
    if stages is not None and candidates > 1:
        raise UserError("the estimates along the sampling are those of one motion: omit candidates, or trajectory")
    if steps is not None and isinstance(steps, int) and steps < 1:
        raise UserError(f"num_inference_steps={steps}: give 1 or more")
    samples *= candidates
    if scale is not None and not math.isfinite(scale):
        raise UserError(f"guidance_scale={scale} is not a finite number")
    for name in sampling:
        if name not in Sampling.__annotations__:
            known = [*inspect.signature(generate).parameters, *Sampling.__annotations__]
            raise UserError(f"generate has no option {name}.{did_you_mean(name, known)}")
    texts = [texts] if isinstance(texts, str) else texts
    actions = [actions] if isinstance(actions, str) else actions
    kind = "text" if texts is not None else "action" if actions is not None else "none"
    requested = list(texts or actions or [""])
    for value in requested:
        if not isinstance(value, str):
            raise UserError(f"{kind}={value!r} is not a string. Give a string, such as {kind}='walk'")
    if kind not in ("none", model.conditioned_on):
        trained, instead = TRAINED_ON[model.conditioned_on]
        raise UserError(f"{kind}={shortened(requested[0], 60)}: this model {trained}. Give {instead}")
    if texts is not None and not all(text.strip() for text in requested):
        raise UserError("empty text. Omit the text to sample without condition")
    for text in requested:
        if len(text) > MAX_TEXT_LENGTH:
            raise UserError(
                f"{shortened(text, 60)}: {len(text):,} characters are too many. Give at most {MAX_TEXT_LENGTH:,}"
            )
    if len(requested) * samples > MAX_SAMPLES:
        raise UserError(f"{len(requested):,} texts with samples={samples}: at most {MAX_SAMPLES:,} motions per request")
    parts = [[(text, None)] if kind == "none" else read_parts(text) for text in requested]
    sequence = loop or after is not None or any(len(each) > 1 or each[0][1] is not None for each in parts)
    if edit is not None and (sequence or targets is not None):
        raise UserError("an edit keeps a single motion: give neither parts (|), after, loop nor targets with it")
    if sequence:
        check_sequence(model)
    other = "loop" if loop else "targets" if targets is not None else None
    begun = None if after is None else _begun(model, after, other)
    wanted = None if targets is None else read_targets(model.representation, targets)
    captions = [text for text in requested for _ in range(samples)]
    numbers: Counter[str] = Counter()
    ids = []
    for text in captions:
        ids.append(f"{text}#{numbers[text]}")
        numbers[text] += 1
    lengths = _lengths(model, requested, parts if sequence else None, samples, seconds, frames, loop)
    if begun is not None:  # its last frames are generated again, but kept
        known = model.representation.normalize(begun[-overlap(model) :].to(model.device))
        lengths = [[len(known) + each[0], *each[1:]] for each in lengths]
    conditions = [[name for name, _ in each] for each in parts for _ in range(samples)]
    labels = None if actions is None else [_action(model, name) for each in conditions for name in each]
    results = []
    for begin in range(0, len(ids), BATCH):
        part = slice(begin, begin + BATCH)
        mask = length_mask(torch.tensor([sum(each) for each in lengths[part]], device=model.device))
        batch = MotionBatch(
            x=torch.zeros(*mask.shape, model.representation.features, device=model.device),
            mask=mask,
            ids=ids[part],
            text=captions[part] if texts is not None else None,
            action=None if labels is None or sequence else torch.tensor(labels[part], device=model.device),
        )
        covering = None
        if sequence:
            covering = windows(model, conditions[part], lengths[part], model.facts["actions"] if labels else None, loop)
        if wanted is not None:
            wanted.edit(model.representation, int(mask.sum(1).min()), model.device)  # refuses motions that are shorter
            edit = wanted.edit(model.representation, mask.shape[1], model.device)
        if begun is not None:
            padded = pad_to(known[None], mask.shape[1])
            edit = Edit(padded, pad_to(torch.ones_like(known, dtype=torch.bool)[None], mask.shape[1]))
        trajectory = _First() if stages is not None and not begin else None
        x = model.generate(
            batch,
            seed=seed,
            shared_noise=shared_noise,
            trajectory=trajectory,
            **sampling,
            windows=covering,
            edit=edit and replace(edit, known=edit.known.expand_as(batch.x), keep=edit.keep.expand_as(batch.x)),
            unconditioned=texts is None and actions is None,
        )
        results += _finish(model, batch, x, captions[part], begun)
        if sequence:
            for motion, names, each in zip(results[begin:], conditions[part], lengths[part], strict=True):
                ends = np.cumsum([len(motion.joints) - sum(each[1:]), *each[1:]]).tolist()
                motion.parts = tuple(zip(names, [0 if begun is None else len(begun), *ends], ends, strict=False))
        if stages is not None and trajectory:
            stages += _stages(model, trajectory, results[0])
    groups = [results[begin : begin + candidates] for begin in range(0, len(results), candidates)]
    results = results if candidates == 1 else [best(group, score) for group in groups]
    contacts = model.representation.contacts
    return [cleaned(motion, contacts(motion.features)) for motion in results] if cleanup else results


def best(candidates: Sequence[Motion], score: Callable[[Sequence[Motion]], Sequence[float]] | None = None) -> Motion:
    """Returns the best of several motions for the same request; see `generate`."""
    faulty = [len({frame for f in find_faults(x) for frame in range(f.start, f.end)}) for x in candidates]
    if score is None:
        return candidates[faulty.index(min(faulty))]
    passed = [motion for motion, frames in zip(candidates, faulty, strict=True) if not frames] or candidates
    scores = list(score(passed))
    return passed[scores.index(max(scores))]


class _First(list[torch.Tensor]):
    """Keeps the first motion (1, F, D) of each batch that is appended, on the CPU."""

    def append(self, x: torch.Tensor) -> None:
        super().append(x[:1].cpu())


def _stages(model: MotionGeneration, trajectory: Sequence[torch.Tensor], result: Motion) -> list[Motion]:
    """Returns up to `STAGES` of the first motion's clean estimates at equal intervals of the calls, and the motion."""
    count, stages = len(trajectory), []
    for call in sorted({index * count // STAGES for index in range(STAGES)}):
        x = trajectory[call][0, : len(result.features)].float()
        joints = model.representation.to_joints(x.to(model.device)).cpu().numpy()
        stages.append(replace(result, joints=joints, text=f"estimate after {call / count:.0%} of the sampling"))
    return [*stages, replace(result, text=f"result: {result.text}")]


def _finish(
    model: MotionGeneration,
    batch: MotionBatch,
    x: torch.Tensor,
    captions: Sequence[str],
    begun: torch.Tensor | None = None,
) -> list[Motion]:
    known, results = model.representation, []
    for row, length in enumerate(batch.lengths.tolist()):
        features = known.denormalize(x[row, :length].float())
        if begun is not None:
            before = begun.to(features)
            features = torch.cat([before, features[min(len(before), overlap(model)) :]])
        joints = known.decode(features)
        if not torch.isfinite(joints).all():
            raise UserError(f"the model returned non-finite numbers for '{captions[row]}'")
        motion = Motion(joints.cpu().numpy(), known.fps, known.skeleton, captions[row], batch.ids[row])
        motion.features, motion.representation = features.cpu().numpy(), known.name
        results.append(motion)
    return results


def _begun(model: MotionGeneration, after: str | Path | Motion, other: str | None) -> torch.Tensor:
    """Returns the features (F, D) of the motion that is continued; `other` is an option that excludes it."""
    if other is not None:
        name = after.id if isinstance(after, Motion) else after
        raise UserError(f"after={name}: a motion that continues another cannot have {other}. Give one of the two")
    known = model.representation
    motion = with_features(known, after) if isinstance(after, Motion) else read_motion(known, after)
    if (least := overlap(model)) > len(motion.features):
        raise UserError(f"after={motion.id}: {len(motion.features)} frames are too short. Give at least {least}")
    return torch.from_numpy(motion.features)


def _lengths(
    model: MotionGeneration,
    requested: Sequence[str],
    parts: Sequence[Sequence[Part]] | None,
    samples: int,
    seconds: float | Sequence[float] | None,
    frames: int | Sequence[int] | None,
    loop: bool,
) -> list[list[int]]:
    """Returns the number of frames of each part of each motion; motions that are not sequences have no `parts`."""
    fps, longest = model.representation.fps, model.facts["max_frames"]
    if seconds is not None and frames is not None:
        raise UserError("give seconds or frames, not both")
    key, scale, given = ("frames", 1, frames) if seconds is None else ("seconds", fps, seconds)
    if given is None and parts is None:
        given = min(round(3 * fps), longest)
    values: list[Any] = list(given) if isinstance(given, list | tuple | np.ndarray) else [given] * len(requested)
    if len(values) != len(requested):
        prompts = "1 prompt" if len(requested) == 1 else f"{len(requested)} prompts"
        raise UserError(f"{key}={given}: {len(values)} lengths for {prompts}. Give one length, or one per prompt")
    for value in values if given is not None else ():
        number = isinstance(value, int | float | np.integer | np.floating) and abs(value) < 1e9
        if not number or (key == "frames" and value % 1):
            raise UserError(f"{key}={given} is not a valid length")
    if parts is not None:
        usual = [None if value is None else value * scale / fps for value in values]
        each = [part_frames(model, *row, loop) for row in zip(requested, parts, usual, strict=True)]
    else:
        each = [[round(value * scale)] for value in values]
    for (length,) in each if parts is None else ():
        if length < 2:
            raise UserError(
                f"{length / fps:g} seconds ({length} frames) are too short: give at least {2 / fps:g} seconds"
            )
        if length > longest:
            raise UserError(
                f"{length / fps:g} seconds ({length} frames) cannot be sampled: the model was trained on motions of up "
                f"to {longest / fps:g} seconds ({longest} frames at {fps:g} fps). Overlapping windows make longer "
                f"ones: write the seconds in the text, 'walks @{length / fps:g}'"
            )
    return [lengths for lengths in each for _ in range(samples)]


def _action(model: MotionGeneration, name: str) -> int:
    actions = model.facts["actions"]
    if name not in actions:
        raise UserError(f"unknown action '{name}'; this model knows: {', '.join(actions) or 'none'}")
    return actions.index(name)


def write_motions(
    folder: Path,
    motions: Sequence[Motion],
    facts: dict[str, Any],
    stages: Sequence[Motion] | None = None,
    mp4: bool = False,
) -> None:
    """Writes `motion_000.npz` ..., `motions.gif`, `motions.png` and `player.html` into a folder, all or none.

    Such files of an earlier request that are not written again are removed.

    Args:
        folder: where to write; other files in it are kept.
        motions: the first eight are drawn.
        facts: such as seed and checkpoint hash, added to each `.npz`.
        stages: of a sampling run, drawn in `trajectory.png`.
        mp4: also write `motions.mp4`.
    """
    scene = [replace(motion, text=motion.text or "unconditioned") for motion in motions]
    with atomic_folder(folder) as made:
        for number, motion in enumerate(motions):
            motion.save(made / f"motion_{number:03d}.npz", **facts)
        write_gif(made / "motions.gif", scene[:8])
        if mp4:
            write_mp4(made / "motions.mp4", scene[:8])
        contact_sheet(made / "motions.png", scene[:8])
        if stages:
            contact_sheet(made / "trajectory.png", stages)
        title = motions[0].text if len({motion.text for motion in motions}) == 1 else ""
        write_player(made / "player.html", scene, title or "Motions")
        written = {path.name for path in made.iterdir()}
    for path in list(folder.iterdir()):
        if OWN_FILES.fullmatch(path.name) and path.name not in written:
            path.unlink()
