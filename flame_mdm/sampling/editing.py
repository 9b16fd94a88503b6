# pyright: standard
"""Motion editing without additional training: keeps part of a motion and resamples the rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Unpack

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
from flame_mdm.sampling.generation import sample
from flame_mdm.sampling.keywords import EditKeywords
from flame_mdm.sampling.motion_request import METHODS, EditRequest, Part, SamplingRequest
from flame_mdm.sampling.reading import part_of, read_motion, with_features
from flame_mdm.sampling.resolution import ResolvedRequest, resolve

MFM_STEPS = 25
"""Number of sampling steps for MFM's edits.

With this number and `until` = 0.2, the paper's "first 6 time steps" agree with its "0.2 time" (i /
25 <= 0.2).
"""


@dataclass(eq=False, repr=False, kw_only=True)
class Edited(Motion):
    """An edited motion, with the original motion and the errors of the kept part.

    The joint error can be large even if the features are kept: features are relative to the root,
    so a kept part starts where the resampled part before it ends.

    Example:
        >>> import flame_mdm
        >>> from flame_mdm.sampling.editing import Edited
        >>> issubclass(Edited, flame_mdm.Motion)  # so it can be saved and shown like other motions
        True
    """

    #: The motion before editing.
    original: Motion
    #: (F, D) bool, True if this feature should be kept in this frame.
    keep: np.ndarray
    #: Maximum change of the kept features, which are normalized. It is 0 if the method is exact.
    feature_error: float
    #: Maximum distance in meters between the world positions of kept joints before and after the
    #: edit.
    joint_error: float


@dataclass(frozen=True)
class ResolvedEdit:
    """An edit that was resolved for a model, together with the original motion.

    Attributes:
        resolved: the resolved request, which includes the kept part.
        original: the original motion, with features in the model's representation.
        keep: (F, D) bool, True if this feature is kept in this frame.
        kept_joints: (F, J) bool, True if this joint is kept in this frame.
    """

    resolved: ResolvedRequest
    original: Motion
    keep: Tensor
    kept_joints: Tensor


def edit(
    model: MotionGenerator,
    motion: str | Path | Motion | np.ndarray | Tensor,
    texts: str | Sequence[str] | None = None,
    *,
    fps: float | None = None,
    cut: Sequence[float] | None = None,
    stages: list[Motion] | None = None,
    **keywords: Unpack[EditKeywords],
) -> list[Edited]:
    """Resamples part of a motion and keeps the rest, without additional training.

    Only `joints` in the frames of `region` are resampled. By default, all joints in all frames are
    resampled. With `strength`, the result is a variation of the motion rather than a new one.

    Args:
        model: the model, from `flame_mdm.load`.
        motion: a `Motion`, a file or clip that `read_motion` can read, or joint positions (F, J, 3)
            in meters, with y up and in the joint order of a known skeleton.
        texts: what the person does in the new part, as one string or several. Without texts and
            `actions`, the new part is unconditioned.
        fps: frames per second of an array or an .npy file. For other files, this value overrides
            the frame rate stated in the file.
        cut: the part of the motion to use, as [begin, end] in seconds. Default: the entire motion.
        stages: list that receives clean estimates of the first motion, taken at equal intervals
            during sampling, followed by the motion itself.
        keywords: `region` or `region_seconds`, `joints` and `strength` select what is resampled.
            `method`, `until` and `resample` determine how this part is resampled.
            `flame_mdm.sampling.motion_request.EditRequest` describes all of these keywords. The
            keywords of `flame_mdm.generate`, such as `samples` (1), `seed` (0) and
            `guidance_scale`, also apply. `cleanup` also changes the kept part, usually by
            millimeters; `Edited.joint_error` states by how much.

    Returns:
        The edited motions, with `samples` motions for each text: all samples of the first text come
        first, then all samples of the second text, and so on. The list does not contain the
        original, which is stored in the `original` attribute of each edited motion.

    Raises:
        UserError: If the request is invalid, if the process does not support the method, or if the
            motion cannot be read or is longer than the training motions.

    Example:
        >>> import flame_mdm
        >>> model = flame_mdm.load("quickstart")
        >>> walk = flame_mdm.generate(model, "a person walks", frames=20, num_inference_steps=2)[0]
        >>> edited = flame_mdm.edit(
        ...     model, walk, "a person waves", joints="left_arm", num_inference_steps=2
        ... )[0]
        >>> edited.joints.shape, edited.feature_error < 1e-3  # all other joints are kept
        ((20, 22, 3), True)
    """
    request = SamplingRequest.of("edit", {"texts": texts, **keywords}, editing=True)
    return sample_edit(model, resolve_edit(request, model, motion, fps=fps, cut=cut), stages=stages)


def resolve_edit(
    request: SamplingRequest,
    model: MotionGenerator,
    motion: str | Path | Motion | np.ndarray | Tensor,
    *,
    fps: float | None = None,
    cut: Sequence[float] | None = None,
) -> ResolvedEdit:
    """Reads a motion and determines which of its features `request.editing` keeps.

    The docstring of `edit` describes the arguments `motion`, `fps` and `cut`, and the errors.
    """
    representation, editing = model.representation, request.editing or EditRequest()
    if model.denoiser.context_frames:
        raise UserError(
            "this model can only continue motions. Use generate with after=, or another model"
        )
    original = _original(representation, motion, fps, cut)
    length, longest = len(original.features), model.facts["max_frames"]
    if length > longest and not request.is_sequence:
        raise UserError(
            f"{original.id or 'the motion'}: {length} frames, but the model was trained on at most {longest} "
            f"({longest / original.fps:g} seconds). Select a part with cut=[begin, end], in seconds"
        )
    keep, kept_joints = kept_parts(representation, length, editing)
    if not keep.any() and editing.strength is None:
        advice = "choose region=..., region_seconds=... or joints=..., or vary the entire motion with strength=0.5"
        raise UserError(f"no part of the motion is kept: {advice}")

    edit_options, options = method_options(model.process, editing, request.options)
    frames = [_part_length(parts, length, original.fps) for parts in request.parts]
    # The sentence is not split into actions, because an edit changes a single motion.
    fitted = replace(request, frames=frames, options=options, editing=None, split=False)
    features = torch.from_numpy(original.features).to(model.device)
    normalized = representation.normalize(features)[None]
    resolved = resolve(fitted, model)
    resolved = replace(resolved, edit=Edit(normalized, keep[None].to(model.device), **edit_options))
    return ResolvedEdit(resolved, original, keep, kept_joints)


def sample_edit(
    model: MotionGenerator, edit: ResolvedEdit, *, stages: list[Motion] | None = None
) -> list[Edited]:
    """Samples the motions of a resolved edit and measures the errors of their kept parts."""
    representation, original, request = model.representation, edit.original, edit.resolved.request
    keep, kept_joints = edit.keep.numpy(), edit.kept_joints.numpy()
    # Normalization causes rounding errors, so the kept values are compared with the sampler's
    # input.
    assert edit.resolved.edit is not None
    exact = representation.denormalize(edit.resolved.edit.known[0]).cpu().numpy()
    std = representation.std.cpu().numpy()
    # Features are compared before the cleanup, because cleaned motions have no features.
    uncleaned = replace(edit.resolved, request=replace(request, cleanup=False))
    edits = []
    for motion in sample(model, uncleaned, stages=stages):
        feature_error = (np.abs(motion.features - exact) / std)[keep].max(initial=0)
        if request.cleanup:
            motion = cleaned(motion, representation.contacts(motion.features))
        joint_error = np.linalg.norm(motion.joints - original.joints, axis=-1)[kept_joints].max(
            initial=0
        )
        edits.append(
            Edited(
                **vars(motion),
                original=original,
                keep=keep,
                feature_error=float(feature_error),
                joint_error=float(joint_error),
            )
        )
    return edits


def _original(
    representation: Representation,
    motion: str | Path | Motion | np.ndarray | Tensor,
    fps: float | None,
    cut: Sequence[float] | None,
) -> Motion:
    """Returns the motion to edit, or its part `cut`, with features in the given representation."""
    if isinstance(motion, str | Path):
        return read_motion(representation, motion, fps=fps, cut=cut)
    if not isinstance(motion, Motion):
        motion = from_array(motion, fps)
    elif fps is not None and fps != motion.fps:
        raise UserError(f"fps={fps:g}: this motion has {motion.fps:g} frames per second. Omit fps")
    motion = with_features(representation, motion)
    return motion if cut is None else part_of(representation, motion, cut)


def _part_length(parts: Sequence[Part], length: int, fps: float) -> int:
    """Returns the length, in frames, of each part without a stated duration.

    The parts must add up to the length of the motion.
    """
    timed = [round(seconds * fps) for _, seconds in parts if seconds is not None]
    rest, others = length - sum(timed), len(parts) - len(timed)
    fits = rest == 0 if others == 0 else rest >= others and rest % others == 0
    if not fits:
        raise UserError(
            f"the parts do not add up to the length of the motion, {length / fps:g} seconds. State the "
            "duration of each part, as in 'walks @2 | sits @1'"
        )
    return rest // max(1, others)


def kept_parts(
    representation: Representation, length: int, editing: EditRequest
) -> tuple[Tensor, Tensor]:
    """Returns which features (F, D) and joints (F, J) an edit keeps in each of F frames.

    `length` is F, the number of frames in the motion.
    """
    new_frames = _new_frames(length, representation.fps, editing)[:, None]
    if editing.joints is None:
        return ~new_frames.expand(-1, representation.features), ~new_frames.expand(
            -1, len(representation.skeleton)
        )
    joints = find_joints(representation.skeleton, editing.joints)
    return ~(new_frames & representation.joint_features(joints)), ~(
        new_frames & representation.joint_mask(joints)
    )


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
    new = torch.full((length,), editing.ranges is None)  # without ranges, all frames are new
    for begin, end in editing.ranges or ():
        first, last = round(begin * scale), round(end * scale)
        if not 0 <= first < last <= length:
            frames = f"{length} frames ({length / fps:g} seconds)"
            raise UserError(
                f"{name}=[{begin:g}, {end:g}] is not a range within this motion, which has {frames}"
            )
        new[first:last] = True
    return new


def method_options(
    process: Process, editing: EditRequest, options: SamplerOptions
) -> tuple[dict[str, Any], SamplerOptions]:
    """Returns the `Edit` options and the sampler options that an editing method requires.

    If the request does not name a method, the process's default method is used.
    """
    possible = [
        name for name, method_edit in METHODS.items() if method_edit["mode"] in process.edit_modes
    ]
    method = editing.method or next(
        name for name in possible if METHODS[name]["mode"] == process.edit_modes[0]
    )
    if method not in possible:
        raise UserError(
            f"method={method} is not supported by {type(process).__name__}; this model supports: {', '.join(possible)}"
        )
    if METHODS[method]["mode"] == "trajectory" and options.num_inference_steps is None:
        options = replace(options, num_inference_steps=MFM_STEPS)
    return editing.method_options(method), options
