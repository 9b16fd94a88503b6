"""Motion editing without additional training: part of a motion is kept, the rest is resampled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import torch
from torch import Tensor

from flame_mdm.data.store import Store
from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats.body import check_size, leg_length
from flame_mdm.formats.cleanup import cleaned
from flame_mdm.formats.files import ENDINGS, from_array, read
from flame_mdm.formats.layouts import find_skeleton
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.resampling import resample as resample_joints
from flame_mdm.generation import generate
from flame_mdm.motion import Edit, Sampling
from flame_mdm.processes import Process
from flame_mdm.representations import Representation
from flame_mdm.representations.skeleton import SMPL22, Skeleton
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

LEG, ARM = ("hip", "knee", "ankle", "foot", "toes"), ("collar", "shoulder", "elbow", "wrist", "hand")

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
        result = cleaned(result) if cleanup else result
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


def is_range(value: Any) -> bool:
    """Returns whether the value is a pair of finite numbers."""
    return (
        isinstance(value, list | tuple)
        and len(value) == 2
        and all(isinstance(v, int | float) and math.isfinite(v) for v in value)
    )


def part_names(skeleton: Skeleton) -> dict[str, list[int]]:
    """Returns body parts by name, as indices of their joints.

    lower_body is the root and the legs, as in MDM; upper_body is everything else.
    """
    sided = {
        f"{side}_{limb}": [
            i for i, name in enumerate(skeleton.joints) if name.removeprefix(f"{side}_") in words and side in name
        ]
        for side in ("left", "right")
        for limb, words in (("arm", ARM), ("leg", LEG))
    }
    legs = sided["left_leg"] + sided["right_leg"]
    lower = [0, *legs]
    return sided | {
        "arms": sided["left_arm"] + sided["right_arm"],
        "legs": legs,
        "lower_body": lower,
        "upper_body": [joint for joint in range(len(skeleton)) if joint not in lower],
    }


def find_joints(skeleton: Skeleton, names: str | Sequence[str]) -> list[int]:
    """Returns the indices of joints given by names of joints or body parts.

    Raises:
        UserError: a name is unknown; the message suggests similar ones.
    """
    known = part_names(skeleton) | {name: [i] for i, name in enumerate(skeleton.joints)}
    found: set[int] = set()
    for name in names if isinstance(names, list | tuple) else [names]:
        if not isinstance(name, str) or name not in known:
            raise UserError(
                f"skeleton {skeleton.name} has no joint or part '{name}'.{did_you_mean(str(name), list(known))} "
                f"Parts: {', '.join(part_names(skeleton))}; joints: {', '.join(skeleton.joints)}"
            )
        found.update(known[name])
    return sorted(found)


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


# Reading motions ------------------------------------------------------------------------------------------------------


def read_motion(
    representation: Representation,
    source: str | Path,
    *,
    fps: float | None = None,
    unit: float | None = None,
    up: str | None = None,
    cut: Sequence[float] | None = None,
    data_root: str | Path = "data",
) -> Motion:
    """Reads a motion to edit and computes the features of a model.

    Args:
        representation: the representation of the model.
        source: a motion file of any kind that `flame_mdm.formats.files.read` reads; or `dataset:id`, a clip of a
            prepared data set. Features of the same representation and frame rate are kept. Joints are resampled to the
            frame rate of the model and made canonical by its representation.
        fps, unit: of the file, as in `flame_mdm.formats.files.read`.
        up: the axis of the file that points up (y, z or -y); other facts are those of the nearest `skeleton.yaml`.
        cut: begin and end, in seconds, of the part to use.
        data_root: folder of the prepared data sets.

    Raises:
        FileNotFoundError: the file or data set does not exist.
        ValueError: the file is damaged, or this representation cannot encode the motion.
        UserError: the clip is unknown, or `cut` is outside of the motion.
    """
    name = str(source)
    if Path(source).suffix.lower() in ENDINGS:
        given = find_skeleton(Path(source), up)
        motion = replace(read(source, fps, unit, representation.fps, given), id=name)
        motion = with_features(representation, motion)
    elif ":" in name:
        motion = _read_clip(representation, name, Path(data_root))
    else:
        raise UserError(
            f"motion={name}: not a motion. Give a {', '.join(ENDINGS)} file, or dataset:id for a clip of a prepared "
            "data set"
        )
    if cut is not None:
        if not is_range(cut):
            raise UserError(f"cut={cut}: write [begin, end], in seconds")
        begin, end = (round(second * representation.fps) for second in cut)
        if not 0 <= begin < end <= len(motion.features):
            seconds = len(motion.features) / representation.fps
            raise UserError(f"cut=[{cut[0]:g}, {cut[1]:g}] is not a range of {name}, which lasts {seconds:g} seconds")
        motion = _decoded(representation, representation.rebase(motion.features[begin:end]), motion.text, name)
    return motion


def with_features(representation: Representation, motion: Motion) -> Motion:
    """Returns the motion if it has features of this representation, otherwise computes them from its joints.

    Raises:
        ValueError: the features have another shape, the body has the wrong size, the motion is too long, or its joints
            cannot be encoded.
    """
    name = f"{motion.id}: " if motion.id else ""
    fits = motion.representation == representation.name and math.isclose(motion.fps, representation.fps)
    if fits:
        shape, size = motion.features.shape, representation.features
        if shape[1:] != (size,) or not np.isfinite(motion.features).all():
            raise ValueError(f"{name}features of shape {shape}, not (frames, {size}), or not finite")
        return motion
    joints, skeleton = motion.joints.astype(float), representation.skeleton
    if skeleton.joints == motion.skeleton.joints[: len(skeleton)]:
        joints = joints[:, : len(skeleton)]  # without the hands
    try:
        joints = resample_joints(joints, motion.fps, representation.fps, cubic=True)
        features = representation.encode(torch.from_numpy(joints)).numpy()
        if motion.skeleton.joints[: len(SMPL22)] == SMPL22.joints:
            check_size(leg_length(joints), 1.0, children=True)
    except ValueError as error:
        raise ValueError(f"{name}{error}") from error
    return _decoded(representation, features, motion.text, motion.id)


def _decoded(representation: Representation, features: np.ndarray, text: str, name: str) -> Motion:
    joints = representation.decode(torch.from_numpy(features)).numpy()
    skeleton, known = representation.skeleton, representation.name
    return Motion(joints, representation.fps, skeleton, text, name, features=features, representation=known)


def _read_clip(representation: Representation, source: str, data_root: Path) -> Motion:
    dataset, _, clip_id = source.partition(":")
    store = Store(data_root / f"{dataset}-{representation.name}")
    if store.info["fps"] != representation.fps:
        raise ValueError(
            f"{store.folder}: prepared at {store.info['fps']:g} fps, but the model has {representation.fps:g}"
        )
    clips = {clip.id: clip for clip in store.clips}
    if clip_id not in clips:
        raise UserError(f"{store.folder} has no clip '{clip_id}'.{did_you_mean(clip_id, list(clips))}")
    clip = clips[clip_id]
    text = clip.captions[0] if clip.captions else ""
    return _decoded(representation, np.array(store.motion(clip)), text, source)
