"""Faults of generated motion after each step of cleanup: `python benchmarks/cleanup.py MODEL MODEL ...`.

The models are trained with different seeds on one data set (folder: $FLAME_MDM_DATA). They generate a motion for each
test clip, with its caption and length, in 10 sampling steps. Prints a Markdown table of the means over the models and
their 95 % intervals by Student's t, and the values of the real motions.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from quality import shown
from sections import Row, table

import flame_mdm
from evaluators.metrics.attributes import ATTRIBUTES, read_attributes, right_attributes
from evaluators.metrics.physics import FootSkating
from flame_mdm.data.store import Store
from flame_mdm.formats import cleanup
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.skeleton import SMPL22

SHORTEST = 24
"""Minimum length of a clip in frames, as in training."""
STEPS = ("_smooth", "_constant_bones", "_follow_feet", "_bend")
"""Functions of `flame_mdm.formats.cleanup`, in their order. Those after the measured step do nothing."""
LABELS = ("generated", "+ smooth paths", "+ constant bones", "+ body follows its feet", "+ feet pinned")


def faults(motions: Sequence[np.ndarray], kinds: Sequence[str], fps: float) -> dict[str, float]:
    """Returns the faults of motions (F, J, 3); kinds are "walk", "run" or ""."""
    found, parents = {}, list(SMPL22.parents)
    for kind in ("walk", "run"):
        chosen = [motion for motion, each in zip(motions, kinds, strict=True) if each == kind]
        skating, peaks = FootSkating(fps), []
        for motion in chosen:
            skating.update(torch.from_numpy(motion)[None], torch.ones(1, len(motion), dtype=torch.bool))
            peaks.append(np.linalg.norm(np.diff(motion, n=2, axis=0), axis=-1).max() * fps**2)
        found |= {f"skating, {kind}s": float(skating.compute() or 0), f"peak, {kind}s": float(np.mean(peaks))}
    ends = [np.linalg.norm(np.diff(motion[-5:], n=2, axis=0), axis=-1).max() * fps**2 for motion in motions]
    bones = [np.linalg.norm(motion[:, 1:] - motion[:, parents[1:]], axis=-1) for motion in motions]
    change = [np.abs(bone / np.median(bone, axis=0) - 1).max() for bone in bones]
    return found | {"peak of the last frames": float(np.mean(ends)), "bones, %": round(100 * float(np.mean(change)), 3)}


def right(motions: Sequence[np.ndarray], wanted: Sequence[dict[str, object]], fps: float) -> dict[str, float]:
    """Returns the share of motions that have all requested attributes; nothing for data sets without actions."""
    if not all("action" in each for each in wanted):
        return {}
    pairs = zip(motions, wanted, strict=True)
    return {"attributes right": float(np.mean([right_attributes(read_attributes(m, fps), a)["all"] for m, a in pairs]))}


def main(*words: str) -> None:
    """Prints the table."""
    by_step: dict[str, list[dict[str, float]]] = {label: [] for label in (*LABELS, "real motions")}
    for name in words:
        model = flame_mdm.load(name)
        known, fps = model.representation, model.representation.fps
        store = Store(Path(os.environ.get("FLAME_MDM_DATA", "data")) / f"{model.facts['dataset']}-{known.name}")
        clips = [clip for clip in store.clips if clip.split == "test" and clip.length >= SHORTEST]
        actions = [str(store.info["actions"][clip.action]) for clip in clips]
        kinds = ["walk" if "walk" in each else "run" if each in ("run", "dash") else "" for each in actions]
        wanted = [{k: v for k, v in clip.attributes.items() if k in ATTRIBUTES} for clip in clips]
        lengths = [min(clip.length, model.facts["max_frames"]) for clip in clips]
        real = [known.decode(torch.tensor(store.motion(c)[:n])).numpy() for c, n in zip(clips, lengths, strict=True)]
        texts = [clip.captions[0] for clip in clips]
        made = flame_mdm.generate(model, texts, frames=lengths, sampler="dpm_solver_pp_2m", num_inference_steps=10)

        def add(label: str, motions: Sequence[np.ndarray]) -> None:
            by_step[label].append(faults(motions, kinds, fps) | right(motions, wanted, fps))  # noqa: B023

        add("real motions", real)
        for steps, label in enumerate(LABELS):
            add(label, [_after(motion, steps, known.contacts(motion.features)) for motion in made])
    rows: list[Row] = []
    for label, each in by_step.items():
        cells = {
            key: f"{each[0][key]:.3g}" if label == "real motions" else shown([x[key] for x in each]) for key in each[0]
        }
        rows.append({"": label, **cells})
    print(table(rows))


def _after(motion: Motion, steps: int, contacts: np.ndarray | None) -> np.ndarray:
    """Returns the joints after the first steps of cleanup."""
    functions = {name: getattr(cleanup, name) for name in STEPS}
    try:
        for name in STEPS[steps:]:
            setattr(cleanup, name, lambda motion, *_: motion)
        return cleanup.cleaned(motion, contacts).joints
    finally:
        for name, function in functions.items():
            setattr(cleanup, name, function)


if __name__ == "__main__":
    main(*sys.argv[1:])
