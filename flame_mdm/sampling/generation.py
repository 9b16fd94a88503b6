"""Motion sampling, with text, action or no condition, and output files of one request."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flame_mdm.batch import Edit, MotionBatch, length_mask, pad_to
from flame_mdm.errors import UserError
from flame_mdm.formats.cleanup import cleaned
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator
from flame_mdm.safe_io import atomic_folder
from flame_mdm.sampling.motion_request import SamplingRequest, check_model, understood
from flame_mdm.sampling.reading import decoded, read_motion, with_features
from flame_mdm.sampling.sequences import motion_lengths, overlap, windows
from flame_mdm.sampling.targets import read_targets
from flame_mdm.visualize import contact_sheet, write_gif, write_mp4, write_player
from flame_mdm.visualize.body import Mesh

BATCH = 32
STAGES = 10  # number of clean estimates shown of one sampling run, as in figure 5 of MFM
REQUEST_FILES = re.compile(r"motion_\d{3,}\.npz|motions\.mp4|trajectory\.png")
"""Files that some requests write and others do not."""


def generate(
    model: MotionGenerator,
    texts: str | Sequence[str] | None = None,
    *,
    edit: Edit | None = None,
    stages: list[Motion] | None = None,
    **keywords: Any,
) -> list[Motion]:
    """Generates motions for texts or actions, `samples` of each; unconditioned motions if neither is given.

    A motion depends only on its text, its length, the sample number and the seed, not on other texts. If a text is
    given several times, sample numbers continue, so that its samples differ. "A man walks, then sits down" becomes the
    sequence "A man walks | sits down", unless `split=False`.

    Args:
        texts: what the person does; one text or several.
        edit: part of a motion of that length to keep in every sample, with `known` and `keep` (1, F, D).
        stages: list that gets the clean estimates along the sampling of the first motion, at equal intervals, and that
            motion itself (MFM, figure 5).
        keywords: fields of `flame_mdm.sampling.motion_request.SamplingRequest` and of
            `flame_mdm.sampler_options.SamplerOptions`.

    Raises `UserError` if the request is invalid, the model cannot do what is requested, or knows no word of a text that
    says what happens.
    """
    request = SamplingRequest.of("generate", texts=texts, **keywords)
    return sample_request(model, understood(request, model), edit=edit, stages=stages)


def sample_request(
    model: MotionGenerator, request: SamplingRequest, *, edit: Edit | None = None, stages: list[Motion] | None = None
) -> list[Motion]:
    """Samples the motions of a request: checks it against the model, plans, and samples in batches; see `generate`."""
    if edit is not None:
        request.check_edit(edit.strength is not None)
    check_model(request, model)
    plan = _Plan(model, request, edit)
    motions: list[Motion] = []
    for begin in range(0, len(plan.ids), BATCH):
        trajectory = _First() if stages is not None and not begin else None
        motions += _sample(model, plan, slice(begin, begin + BATCH), trajectory)
        if stages is not None and trajectory:
            stages += _stages(model, trajectory, motions[0])
    if request.cleanup:
        motions = [cleaned(motion, model.representation.contacts(motion.features)) for motion in motions]
    return motions


class _Plan:
    """All motions of a request: `captions`, `ids` that seed the noise, and `conditions` and `lengths` of their parts.

    The first part begins with the overlap with `before`, the features (F, D) of a motion that all continue. Each motion
    keeps the part (1, F, D) of `edit` and reaches `targets` in the world.
    """

    def __init__(self, model: MotionGenerator, request: SamplingRequest, edit: Edit | None):
        copies = range(request.samples)
        self.request, self.edit, self.ids = request, edit, list[str]()
        self.captions = [prompt for prompt in request.prompts for _ in copies]
        counts: Counter[str] = Counter()
        for caption in self.captions:
            self.ids.append(f"{caption}#{counts[caption]}")
            counts[caption] += 1
        self.before: Tensor | None = None
        lengths, shared = motion_lengths(model, request), overlap(model)
        representation = model.representation
        if (after := request.after) is not None:  # its last frames are generated again, but kept
            motion = after if isinstance(after, Motion) else read_motion(representation, after)
            motion = with_features(representation, motion)
            self.before = torch.from_numpy(motion.features)
            if (count := len(self.before)) < shared:
                raise UserError(f"after={motion.id}: {count} frames are too short. Give at least {shared}")
            lengths = [[shared + first, *others] for first, *others in lengths]
            ending = representation.normalize(self.before[-shared:].to(model.device))[None]
            self.edit = Edit(ending, torch.ones_like(ending, dtype=torch.bool))
        self.lengths = [parts for parts in lengths for _ in copies]
        self.conditions = [[name for name, _ in parts] for parts in request.parts for _ in copies]
        self.targets = None if request.targets is None else read_targets(representation, request.targets)


def _sample(model: MotionGenerator, plan: _Plan, rows: slice, trajectory: list[Tensor] | None) -> list[Motion]:
    request, conditions, lengths = plan.request, plan.conditions[rows], plan.lengths[rows]
    mask = length_mask(torch.tensor([sum(parts) for parts in lengths], device=model.device))
    x = torch.zeros(*mask.shape, model.representation.features, device=model.device)
    batch = MotionBatch(x=x, mask=mask, ids=plan.ids[rows])
    covering = windows(model, request, conditions, lengths) if request.is_sequence else None
    if request.kind == "text":
        batch.text = plan.captions[rows]
    elif request.kind == "action" and covering is None:
        labels = [model.facts["actions"].index(name) for (name,) in conditions]
        batch.action = torch.tensor(labels, device=model.device)
    edit = plan.edit
    if plan.targets is not None:
        goal = plan.targets.edit(model.representation, batch.lengths.tolist(), model.device)
        start = goal.known if edit is None else torch.where(goal.keep, goal.known, edit.known)
        edit = replace(goal, known=start, strength=None if edit is None else edit.strength)
    if edit is not None:
        padded, keep = pad_to(edit.known, mask.shape[1]), pad_to(edit.keep, mask.shape[1])
        edit = replace(edit, known=padded.expand_as(x), keep=keep.expand_as(x))
    how: dict[str, Any] = {"seed": request.seed, "shared_noise": request.shared_noise}
    how |= {"windows": covering, "edit": edit, "unconditioned": request.kind == "none"}
    x = model.generate(batch, request.options, trajectory=trajectory, **how)
    return [_decoded(model, plan, rows.start + row, features) for row, features in enumerate(x)]


def _decoded(model: MotionGenerator, plan: _Plan, row: int, x: Tensor) -> Motion:
    """Returns motion number `row` of a plan from its normalized features (F, D)."""
    representation, lengths = model.representation, plan.lengths[row]
    features = representation.denormalize(x[: sum(lengths)].float())
    if plan.before is not None:
        before = plan.before.to(features)
        features = torch.cat([before, features[min(len(before), overlap(model)) :]])
    motion = decoded(representation, features, plan.captions[row], plan.ids[row])
    if not np.isfinite(motion.joints).all():
        raise UserError(f"the model returned non-finite numbers for '{motion.text}'")
    if plan.request.is_sequence:
        ends = np.cumsum([len(features) - sum(lengths[1:]), *lengths[1:]]).tolist()
        begins = [0 if plan.before is None else len(plan.before), *ends]
        motion.parts = tuple(zip(plan.conditions[row], begins, ends, strict=False))
    return motion


class _First(list[Tensor]):
    """Keeps the first motion (1, F, D) of each batch that is appended, on the CPU."""

    def append(self, x: Tensor) -> None:
        super().append(x[:1].cpu())


def _stages(model: MotionGenerator, trajectory: Sequence[Tensor], result: Motion) -> list[Motion]:
    """Returns up to `STAGES` of the first motion's clean estimates at equal intervals of the calls, and the motion."""
    count, stages = len(trajectory), []
    for call in sorted({index * count // STAGES for index in range(STAGES)}):
        x = trajectory[call][0, : len(result.features)].float()
        joints = model.representation.to_joints(x.to(model.device)).cpu().numpy()
        stages.append(replace(result, joints=joints, text=f"estimate after {call / count:.0%} of the sampling"))
    return [*stages, replace(result, text=f"result: {result.text}")]


def write_motions(
    folder: Path,
    motions: Sequence[Motion],
    facts: dict[str, Any],
    stages: Sequence[Motion] | None = None,
    mp4: bool = False,
    body: Mesh | None = None,
) -> None:
    """Writes `motion_000.npz` ..., `motions.gif`, `motions.png` and `player.html` into a folder, all or none.

    Such files of an earlier request that are not written again are removed. The first eight motions are drawn, and the
    stages of a sampling run in `trajectory.png`; `facts` are added to each `.npz`.
    """
    scene = [replace(motion, text=motion.text or "unconditioned") for motion in motions]
    with atomic_folder(folder) as made:
        for number, motion in enumerate(motions):
            motion.save(made / f"motion_{number:03d}.npz", **facts)
        write_gif(made / "motions.gif", scene[:8], body=body)
        if mp4:
            write_mp4(made / "motions.mp4", scene[:8], body=body)
        contact_sheet(made / "motions.png", scene[:8], body=body)
        if stages:
            contact_sheet(made / "trajectory.png", stages, body=body)
        title = motions[0].text if len({motion.text for motion in motions}) == 1 else ""
        write_player(made / "player.html", scene, title or "Motions", body=body)
        written = {path.name for path in made.iterdir()}
    for path in list(folder.iterdir()):
        if REQUEST_FILES.fullmatch(path.name) and path.name not in written:
            path.unlink()
