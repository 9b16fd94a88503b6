"""Motion editing without additional training: part of a motion is kept, the rest is resampled."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flame_mdm.batch import Edit
from flame_mdm.errors import UserError
from flame_mdm.formats.cleanup import cleaned
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import from_array
from flame_mdm.generator import MotionGenerator
from flame_mdm.processes import Process
from flame_mdm.representations import Representation
from flame_mdm.representations.skeleton import find_joints
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.generation import sample_request
from flame_mdm.sampling.motion_request import METHODS, EditRequest, Part, SamplingRequest, understood
from flame_mdm.sampling.reading import read_motion, with_features

MFM_STEPS = 25
"""Sampling steps of MFM's edits: with `until` = 0.2, "the first 6 time steps" are up to "0.2 time" (i / 25 <= 0.2)."""


@dataclass(eq=False, repr=False, kw_only=True)
class Edited(Motion):
    """An edited motion, of which a part was kept.

    The joint error can be large although features are kept: they are relative to the root, so a kept part continues
    from where a resampled part ends.
    """

    original: Motion  # before editing
    keep: np.ndarray  # (F, D) bool, True if this feature of this frame was to be kept
    feature_error: float  # maximum change of kept values in normalized features; 0 if the method is exact
    joint_error: float  # maximum distance in meters between the world positions of a kept joint before and after


def edit(
    model: MotionGenerator,
    motion: str | Path | Motion | np.ndarray | Tensor,
    texts: str | Sequence[str] | None = None,
    *,
    fps: float | None = None,
    stages: list[Motion] | None = None,
    **keywords: Any,
) -> list[Edited]:
    """Resamples part of a motion: `joints` in `region`, each by default all; with `strength`, as a variation of it.

    Args:
        motion: a file or clip that `read_motion` reads; a motion, generated or read; or joints (F, J, 3) in meters, y
            up, in the order of a known skeleton.
        texts: what the person does in the new part; one text or several.
        fps: frames per second of an array or an .npy file; for other files, it overrides that of the file.
        stages: as in `flame_mdm.generate`.
        keywords: fields of `EditRequest` and `SamplingRequest` in `flame_mdm.sampling.motion_request`, and of
            `flame_mdm.sampler_options.SamplerOptions`. `cleanup` also changes the kept part, by millimeters as a rule;
            `joint_error` says by how much.

    Raises `UserError` if the request is invalid, the process does not support the method, or the motion cannot be read
    or is longer than those in training.
    """
    request = SamplingRequest.of("edit", True, texts=texts, **keywords)
    return edit_request(model, motion, request, fps=fps, stages=stages)


def edit_request(
    model: MotionGenerator,
    motion: str | Path | Motion | np.ndarray | Tensor,
    request: SamplingRequest,
    *,
    fps: float | None = None,
    stages: list[Motion] | None = None,
) -> list[Edited]:
    """Edits a motion as `request.editing` says; for the other arguments, see `edit`."""
    request = understood(request, model)
    representation, editing = model.representation, request.editing or EditRequest()
    if isinstance(motion, str | Path):
        motion = read_motion(representation, motion, fps=fps)
    elif not isinstance(motion, Motion):
        motion = from_array(motion, fps)
    elif fps is not None and fps != motion.fps:
        raise UserError(f"fps={fps:g}: this motion has {motion.fps:g} frames per second. Omit fps")
    original = with_features(representation, motion)
    length = len(original.features)
    if length > (longest := model.facts["max_frames"]) and not request.is_sequence:
        what = f"{length} frames, but the model was trained on at most {longest} ({longest / original.fps:g} seconds)"
        raise UserError(f"{original.id or 'the motion'}: {what}: select a part with cut=[begin, end] in seconds")
    keep, kept_joints = kept_parts(representation, length, editing)
    if not keep.any() and editing.strength is None:
        advice = "choose region=..., region_seconds=... or joints=..., or vary all of it with strength=0.5"
        raise UserError(f"no part of the motion is kept: {advice}")
    frames = tuple(_part_length(parts, length, original.fps) for parts in request.parts)
    how, options = method_options(model.process, editing, request.options)
    normalized = representation.normalize(torch.from_numpy(original.features).to(model.device))
    results = sample_request(
        model,
        replace(request, frames=frames, options=options, editing=None, cleanup=False),
        stages=stages,
        edit=Edit(normalized[None], keep[None].to(model.device), **how),
    )
    # Normalization rounds, so kept values are compared with the input of the sampler.
    exact, std = representation.denormalize(normalized).cpu().numpy(), representation.std.cpu().numpy()
    edits = []
    for result in results:
        error = float((np.abs(result.features - exact) / std)[keep.numpy()].max(initial=0))
        result = cleaned(result, representation.contacts(result.features)) if request.cleanup else result
        moved = np.linalg.norm(result.joints - original.joints, axis=-1)[kept_joints.numpy()].max(initial=0)
        facts = {"original": original, "keep": keep.numpy(), "feature_error": error, "joint_error": float(moved)}
        edits.append(Edited(**vars(result), **facts))
    return edits


def _part_length(parts: Sequence[Part], length: int, fps: float) -> int:
    """Returns the frames of each part that gives no seconds, so that all parts are as long as the motion."""
    timed = [round(seconds * fps) for _, seconds in parts if seconds is not None]
    rest, others = length - sum(timed), len(parts) - len(timed)
    if rest < others or (rest % others if others else rest):
        what = f"the parts are not as long as the motion, which has {length / fps:g} seconds"
        raise UserError(f"{what}. Give each part its seconds, as in 'walks @2 | sits @1'")
    return rest // max(1, others)


def kept_parts(representation: Representation, length: int, editing: EditRequest) -> tuple[Tensor, Tensor]:
    """Returns which features (F, D) and joints (F, J) of each frame an edit of a motion with `length` frames keeps."""
    new_frames = _new_frames(length, representation.fps, editing)[:, None]
    if editing.joints is None:
        return ~new_frames.expand(-1, representation.features), ~new_frames.expand(-1, len(representation.skeleton))
    joints = find_joints(representation.skeleton, editing.joints)
    return ~(new_frames & representation.joint_features(joints)), ~(new_frames & representation.joint_mask(joints))


def _new_frames(length: int, fps: float, editing: EditRequest) -> Tensor:
    frame = torch.arange(length)
    first, last = int(0.25 * length), int(0.75 * length)
    if isinstance(editing.region, str):
        new = {
            "in_between": (frame >= first) & (frame < last),
            "prediction": frame >= first,
            "prefix": frame >= first,
            "suffix": frame < last,
            "interpolate": frame % 5 != 0,
        }
        return new[editing.region]
    name, scale = ("region", 1.0) if editing.region_seconds is None else ("region_seconds", fps)
    new = torch.full((length,), editing.ranges is None)  # by default, all frames
    for begin, end in editing.ranges or ():
        first, last = round(begin * scale), round(end * scale)
        if not 0 <= first < last <= length:
            frames = f"{length} frames ({length / fps:g} seconds)"
            raise UserError(f"{name}=[{begin:g}, {end:g}] is not a range of this motion, which has {frames}")
        new[first:last] = True
    return new


def method_options(
    process: Process, editing: EditRequest, options: SamplerOptions
) -> tuple[dict[str, Any], SamplerOptions]:
    """Returns the options of `Edit` for the requested method, by default that of the process, and of the sampler."""
    possible = [name for name, how in METHODS.items() if how["mode"] in process.edit_modes]
    method = editing.method or next(name for name in possible if METHODS[name]["mode"] == process.edit_modes[0])
    if method not in possible:
        what = f"is not supported by {type(process).__name__}; this model supports: {', '.join(possible)}"
        raise UserError(f"method={method} {what}")
    if METHODS[method]["mode"] == "trajectory" and options.num_inference_steps is None:
        options = replace(options, num_inference_steps=MFM_STEPS)
    return editing.method_options(method), options
