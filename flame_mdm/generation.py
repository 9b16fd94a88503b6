"""Motions on request: from texts, actions or nothing to joints, features and the files that hold them."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flame_mdm.config import UserError
from flame_mdm.motion import Edit, MotionBatch, length_mask
from flame_mdm.task import MotionGeneration
from flame_mdm.visualize import Motion, contact_sheet, write_gif, write_player
from flame_mdm.visualize.scene import written_whole

BATCH = 32
MOST = 10_000
"""Samples of one request; they are kept in memory until all are there."""


@dataclass
class Generated:
    """One motion, generated or real.

    Attributes:
        id: what it was asked to be and the number of the sample, which decide the noise with the seed; or the clip.
        joints: (F, J, 3) float32, metres, y up.
        features: (F, D) float32, in the data's units, as the representation defines them.
        fps: frames a second.
        caption: the text or the name of the action; "" where unconditioned.
    """

    id: str
    joints: np.ndarray
    features: np.ndarray
    fps: float
    caption: str


def generate(
    model: MotionGeneration,
    texts: str | Sequence[str] | None = None,
    *,
    actions: Sequence[str] | None = None,
    seconds: float | None = None,
    frames: int | Sequence[int] | None = None,
    samples: int = 1,
    seed: int = 0,
    guidance_scale: float | None = None,
    sampler: str | None = None,
    num_inference_steps: int | None = None,
    edit: Edit | None = None,
) -> list[Generated]:
    """Motions for texts or actions, `samples` of each; for neither, unconditioned ones.

    A motion depends on its text, its length, the number of the sample and the seed alone, not on the others.

    Args:
        model: from `flame_mdm.load`.
        texts, actions: what to do; one of the two, as the model was trained, or neither.
        seconds, frames: length; frames may differ from motion to motion. Default: 3 seconds, or the longest possible.
        samples: motions for each text.
        seed: of the noise.
        guidance_scale, sampler, num_inference_steps: instead of the recipe's.
        edit: what to keep of a motion of that length, `known` and `keep` (1, F, D), in every motion; see
            `flame_mdm.edit`.

    Raises:
        UserError: an empty text, an unknown action, a length the model was not trained for.
    """
    for name, value, most in (("samples", samples, MOST), ("num_inference_steps", num_inference_steps, None)):
        if value is not None and not 1 <= value <= (most or value):
            raise UserError(f"{name}={value}: give 1{f' to {most:,}' if most else ' or more'}")
    if guidance_scale is not None and not math.isfinite(guidance_scale):
        raise UserError(f"guidance_scale={guidance_scale} is no finite number")
    texts = [texts] if isinstance(texts, str) else texts
    wanted = list(texts or actions or [""])
    if texts is not None and not all(text.strip() for text in texts):
        raise UserError("an empty text describes no motion; leave the text out to sample without condition")
    ids = [f"{text}#{number}" for text in wanted for number in range(samples)]
    captions = [text for text in wanted for _ in range(samples)]
    lengths = _lengths(model, len(wanted), samples, seconds, frames)
    labels = None if actions is None else [_action(model, name) for name in captions]
    results = []
    for begin in range(0, len(ids), BATCH):
        part = slice(begin, begin + BATCH)
        mask = length_mask(torch.tensor(lengths[part], device=model.device))
        batch = MotionBatch(
            x=torch.zeros(*mask.shape, model.representation.features, device=model.device),
            mask=mask,
            ids=ids[part],
            text=captions[part] if texts is not None else None,
            action=None if labels is None else torch.tensor(labels[part], device=model.device),
        )
        x = model.generate(
            batch,
            seed=seed,
            guidance_scale=guidance_scale,
            sampler=sampler,
            num_inference_steps=num_inference_steps,
            edit=edit and replace(edit, known=edit.known.expand_as(batch.x), keep=edit.keep.expand_as(batch.x)),
            unconditioned=texts is None and actions is None,
        )
        results += _finish(model, batch, x, captions[part])
    return results


def _finish(model: MotionGeneration, batch: MotionBatch, x: torch.Tensor, captions: Sequence[str]) -> list[Generated]:
    results = []
    for row, length in enumerate(batch.lengths.tolist()):
        features = model.representation.denormalize(x[row, :length].float())
        joints = model.representation.decode(features)
        if not torch.isfinite(joints).all():
            raise UserError(f"the model returned a motion that is not finite for '{captions[row]}'")
        fps = model.representation.fps
        results.append(Generated(batch.ids[row], joints.cpu().numpy(), features.cpu().numpy(), fps, captions[row]))
    return results


def _lengths(
    model: MotionGeneration, wanted: int, samples: int, seconds: float | None, frames: int | Sequence[int] | None
) -> list[int]:
    fps, longest = model.representation.fps, model.facts["max_frames"]
    if seconds is not None and not (isinstance(seconds, int | float) and math.isfinite(seconds)):
        raise UserError(f"seconds={seconds} is no length of a motion")
    if frames is None:
        frames = min(round(3 * fps), longest) if seconds is None else round(seconds * fps)
    each = [frames] * wanted if isinstance(frames, int) else list(frames)
    if len(each) != wanted:
        raise UserError(f"{len(each)} lengths for {wanted} motions")
    for length in each:
        if not 2 <= length <= longest:
            raise UserError(
                f"{length / fps:g} seconds ({length} frames) cannot be sampled: the model was trained on motions of up "
                f"to {longest / fps:g} seconds ({longest} frames at {fps:g} a second)"
            )
    return [length for length in each for _ in range(samples)]


def _action(model: MotionGeneration, name: str) -> int:
    actions = model.facts["actions"]
    if name not in actions:
        raise UserError(f"no action is called '{name}'; there are: {', '.join(actions) or 'none in this model'}")
    return actions.index(name)


def write_motions(folder: Path, model: MotionGeneration, motions: Sequence[Generated], facts: dict[str, Any]) -> None:
    """Writes `motion_000.npz` ..., `motions.gif`, `motions.png` and `player.html` into a folder, which it makes.

    `facts` are added to each `.npz`: seed, checkpoint hash ...
    """
    folder.mkdir(parents=True, exist_ok=True)
    skeleton = model.representation.skeleton
    scene = [Motion(m.joints, m.fps, skeleton, caption=m.caption or "unconditioned", id=m.id) for m in motions]
    for number, motion in enumerate(motions):
        write_motion(folder / f"motion_{number:03d}.npz", motion, model.representation.name, facts)
    write_gif(folder / "motions.gif", scene[:8])
    contact_sheet(folder / "motions.png", scene[:8])
    write_player(
        folder / "player.html",
        scene,
        title=motions[0].caption if len({m.caption for m in motions}) == 1 and motions[0].caption else "Motions",
    )


def write_motion(path: Path, motion: Generated, representation: str, facts: dict[str, Any]) -> None:
    """Writes an `.npz` that `flame_mdm.formats.read` takes.

    It holds `joints` (F, J, 3) in metres, y up; `features` (F, D); `fps`, `text`, `representation` and `facts`.
    """
    with written_whole(path) as temporary:
        np.savez_compressed(
            temporary,
            joints=motion.joints,
            features=motion.features,
            fps=motion.fps,
            text=motion.caption,
            representation=representation,
            **facts,
        )


def file_sha256(path: str | Path) -> str:
    """Hash of a file, as it stands in results."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
