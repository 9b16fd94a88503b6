"""Motion editing without additional training: part of a motion is kept, the rest is resampled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import torch
from torch import Tensor

from flame_mdm.batch import Edit, Sampling
from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats.cleanup import cleaned
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import from_array
from flame_mdm.processes import Process
from flame_mdm.representations import Representation
from flame_mdm.representations.skeleton import find_joints
from flame_mdm.sampling.generation import generate
from flame_mdm.sampling.reading import is_range, read_motion, with_features
from flame_mdm.task import MotionGeneration

METHODS: dict[str, dict[str, Any]] = {
    "mdm": {"mode": "x0"},
    "flame": {"mode": "x_t", "blend": "after"},
    "flame_code": {"mode": "x_t", "blend": "before"},
    "mfm": {"mode": "trajectory"},
}
"""Methods of the papers, as options of `Edit`."""

MFM_STEPS, MFM_UNTIL = 25, 0.2
"""MFM overwrites "the first 6 time steps" and "0.2 time": both are true for 25 steps (i = 0 ... 5, i / 25 <= 0.2)."""

Ranges = Sequence[float] | Sequence[Sequence[float]]


@dataclass(eq=False, repr=False, kw_only=True)
class Edited(Motion):
    """An edited motion, of which a part was kept.

    Attributes:
        original: the motion before editing.
        keep: (F, D) bool, True if this feature of this frame was to be kept.
        feature_error: maximum change of kept values in normalized features; 0 if the method is exact.
        joint_error: maximum distance in meters between the world positions of a kept joint before and after. It can be
            large although features are kept: they are relative to the root, so frames after a resampled part continue
            from where that part ends.
    """

    original: Motion
    keep: np.ndarray
    feature_error: float
    joint_error: float


def edit(
    model: MotionGeneration,
    motion: str | Path | Motion | np.ndarray | Tensor,
    texts: str | Sequence[str] | None = None,
    *,
    actions: str | Sequence[str] | None = None,
    fps: float | None = None,
    region: str | Ranges | None = None,
    region_seconds: Ranges | None = None,
    joints: str | Sequence[str] | None = None,
    method: str | None = None,
    until: float | None = None,
    resample: int = 1,
    strength: float | None = None,
    samples: int = 1,
    seed: int = 0,
    stages: list[Motion] | None = None,
    cleanup: bool = False,
    **sampling: Unpack[Sampling],
) -> list[Edited]:
    """Resamples part of a motion: `joints` in `region`, each by default all; with `strength`, as a variation of it.

    Args:
        model: from `flame_mdm.load`.
        motion: a file or clip that `read_motion` reads; a motion, generated or read; or joints (F, J, 3) in meters, y
            up, in the order of a known skeleton.
        texts, actions: conditions, as in `generate`; neither = unconditioned.
        fps: frames per second of an array or an .npy file; for other files, it overrides that of the file.
        region: frames to resample, [begin, end) or several such ranges; or a task: "in_between" keeps the first and
            the last quarter, "prediction" ("prefix") the first, "suffix" the last, "interpolate" every fifth frame.
        region_seconds: ranges in seconds instead of `region`.
        joints: names of joints or body parts (see `part_names`) to resample; default all. The root trajectory belongs
            to joint 0, which is in lower_body.
        method: "mdm" overwrites the clean estimate (exact); "flame" blends after each step, as in the paper (exact);
            "flame_code" blends before each call, as in FLAME's code; "mfm" overwrites the early part of the path.
            Default: "mdm" for diffusion, "mfm" for flow matching.
        until: for "mfm", the flow time up to which the path is overwritten; default 0.2, with 25 steps.
        resample: for FLAME's methods, how many times each step is repeated.
        strength: starts from the motion itself with noise added, and takes this fraction of the sampling steps, in
            (0, 1]: the smaller, the closer to the motion. Without region and joints, the entire motion is varied.
        samples, seed, stages, cleanup, sampling: as in `generate`. `cleanup` also changes the kept part, by millimeters
            as a rule; `joint_error` says by how much.

    Raises:
        UserError: the mask keeps everything or nothing, a name is unknown, the process does not support the method, the
            motion is longer than those in training, or `read_motion` or `generate` raises it.
        FileNotFoundError, ValueError: from `read_motion`, or the joints or their skeleton do not fit the model.
    """
    representation = model.representation
    if isinstance(motion, str | Path):
        motion = read_motion(representation, motion, fps=fps)
    elif not isinstance(motion, Motion):
        motion = from_array(motion, fps)
    elif fps is not None and fps != motion.fps:
        raise UserError(f"fps={fps:g}: this motion has {motion.fps:g} frames per second. Omit fps")
    original = with_features(representation, motion)
    features = original.features
    length = len(features)
    if length > (longest := model.facts["max_frames"]):
        raise UserError(
            f"{original.id or 'the motion'}: {length} frames, but the model was trained on at most {longest} "
            f"({longest / original.fps:g} seconds): select a part with cut=[begin, end] in seconds"
        )
    keep, still = kept_parts(representation, length, region=region, region_seconds=region_seconds, joints=joints)
    if not keep.any() and strength is None:
        raise UserError(
            "no part of the motion is kept: choose region=..., region_seconds=... or joints=..., or vary all "
            "of it with strength=0.5"
        )
    if keep.all():
        raise UserError("the entire motion is kept: choose a region or joints to resample")
    how = method_options(model.process, method, until, resample, strength)
    if how["mode"] == "trajectory" and sampling.get("num_inference_steps") is None:
        sampling["num_inference_steps"] = MFM_STEPS
    known = representation.normalize(torch.from_numpy(features).to(model.device))
    generated = generate(
        model,
        texts,
        actions=actions,
        frames=length,
        samples=samples,
        seed=seed,
        stages=stages,
        **sampling,
        edit=Edit(known[None], keep[None].to(model.device), **how),
    )
    # Normalization rounds, so kept values are compared with the input of the sampler.
    exact, std = representation.denormalize(known).cpu().numpy(), representation.std.cpu().numpy()
    edits = []
    for result in generated:
        error = float((np.abs(result.features - exact) / std)[keep.numpy()].max(initial=0))
        result = cleaned(result, representation.contacts(result.features)) if cleanup else result
        moved = np.linalg.norm(result.joints - original.joints, axis=-1)[still.numpy()].max(initial=0)
        facts = {"original": original, "keep": keep.numpy(), "feature_error": error, "joint_error": float(moved)}
        edits.append(Edited(**vars(result), **facts))
    return edits


def kept_parts(
    representation: Representation,
    length: int,
    *,
    region: str | Ranges | None = None,
    region_seconds: Ranges | None = None,
    joints: str | Sequence[str] | None = None,
) -> tuple[Tensor, Tensor]:
    """Returns the mask of an edit of a motion with `length` frames; arguments are those of `edit`.

    Returns:
        (F, D) bool, True if this feature of this frame is kept; (F, J) bool, the same for joints.

    Raises:
        UserError: a range is outside of the motion, or a name is unknown.
    """
    new_frames = _new_frames(length, representation.fps, region, region_seconds)
    part = torch.zeros(len(representation.skeleton), dtype=torch.bool)
    part[list(range(len(part))) if joints is None else find_joints(representation.skeleton, joints)] = True
    features = (
        representation.joint_features(part.nonzero()[:, 0].tolist()) if joints is not None else torch.tensor([True])
    )
    keep = ~(new_frames[:, None] & features).expand(length, representation.features)
    return keep, ~(new_frames[:, None] & part)


def _new_frames(length: int, fps: float, region: str | Ranges | None, seconds: Ranges | None) -> Tensor:
    """Returns (F,) bool, True if this frame is resampled."""
    if region is not None and seconds is not None:
        raise UserError("give region or region_seconds, not both")
    if isinstance(region, str):
        frame = torch.arange(length)
        first, last = int(0.25 * length), int(0.75 * length)
        kept = {
            "in_between": (frame < first) | (frame >= last),
            "prediction": frame < first,
            "prefix": frame < first,
            "suffix": frame >= last,
            "interpolate": frame % 5 == 0,
        }
        if region not in kept:
            raise UserError(
                f"region={region} is unknown.{did_you_mean(region, list(kept))} Give ranges [begin, end], or one of: "
                f"{', '.join(kept)}. Body parts are given by joints="
            )
        return ~kept[region]
    ranges = region if region is not None else seconds
    if ranges is None:  # no region is chosen: all frames
        return torch.ones(length, dtype=torch.bool)
    name, scale = ("region", 1.0) if seconds is None else ("region_seconds", fps)
    new = torch.zeros(length, dtype=torch.bool)
    for begin, end in _pairs(ranges, name):
        first, last = round(begin * scale), round(end * scale)
        if not 0 <= first < last <= length:
            raise UserError(
                f"{name}=[{begin:g}, {end:g}] is not a range of this motion, which has {length} frames "
                f"({length / fps:g} seconds)"
            )
        new[first:last] = True
    return new


def _pairs(ranges: Ranges, name: str) -> list[tuple[float, float]]:
    listed: Any = [ranges] if is_range(ranges) else ranges
    if not isinstance(listed, list | tuple) or not listed or not all(map(is_range, listed)):
        raise UserError(f"{name}={ranges}: write [begin, end], or several ranges as [[begin, end], [begin, end]]")
    return [(begin, end) for begin, end in listed]


def method_options(
    process: Process,
    method: str | None = None,
    until: float | None = None,
    resample: int = 1,
    strength: float | None = None,
) -> dict[str, Any]:
    """Returns the options of `Edit` for a method, by default that of the process; arguments are those of `edit`.

    Raises:
        UserError: the process does not support the method, or the method does not have an option.
    """
    possible = [name for name, how in METHODS.items() if how["mode"] in process.edit_modes]
    if method is None:
        method = next(name for name in possible if METHODS[name]["mode"] == process.edit_modes[0])
    if method not in possible:
        raise UserError(
            f"method={method} is not supported by {type(process).__name__}; this model supports: {', '.join(possible)}"
        )
    how = dict(METHODS[method])
    if until is not None and how["mode"] != "trajectory":
        raise UserError(f"until={until:g} is an option of method=mfm, not of {method}")
    if resample != 1 and how["mode"] != "x_t":
        raise UserError(f"resample={resample} is an option of method=flame and flame_code, not of {method}")
    if how["mode"] == "trajectory":
        how["until"] = MFM_UNTIL if until is None else until
    if strength is not None:
        if not 0 < strength <= 1:
            raise UserError(f"strength={strength:g}: give a number above 0, up to 1")
        how["strength"] = strength
    return how | {"resample": resample}
