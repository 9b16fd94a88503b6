"""Editing without training: a part of a motion is kept, the rest is sampled anew."""

from __future__ import annotations

import difflib
import math
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from flame_mdm.config import UserError
from flame_mdm.data.folder import read_bvh
from flame_mdm.data.store import Store
from flame_mdm.generation import Generated, generate
from flame_mdm.motion import Edit
from flame_mdm.processes import Process
from flame_mdm.representations import Representation
from flame_mdm.representations.skeleton import Skeleton
from flame_mdm.task import MotionGeneration

METHODS: dict[str, dict[str, Any]] = {
    "mdm": {"mode": "x0"},
    "flame": {"mode": "x_t", "blend": "after"},
    "flame_code": {"mode": "x_t", "blend": "before"},
    "mfm": {"mode": "trajectory"},
}
"""What the papers do, in terms of `Edit`."""

MFM_STEPS, MFM_UNTIL = 25, 0.2
"""MFM rewrites "the first 6 time steps" and "0.2 time": both hold for 25 steps (i = 0 ... 5, i / 25 <= 0.2)."""

LEG, ARM = ("hip", "knee", "ankle", "foot", "toes"), ("collar", "shoulder", "elbow", "wrist", "hand")

Ranges = Sequence[float] | Sequence[Sequence[float]]


@dataclass
class Edited(Generated):
    """A motion of which a part was kept.

    Attributes:
        original: the motion it was made from.
        keep: (F, D) bool, True = this feature of this frame was to be kept.
        feature_error: largest change of what was to be kept, in normalized features; 0 where the method is exact.
        joint_error: largest way in metres that a joint to be kept went from where it was in the world. Features that
            are relative to the root do not pin it: behind a new part, kept frames start where that part ends.
    """

    original: Generated
    keep: np.ndarray
    feature_error: float
    joint_error: float


def edit(
    model: MotionGeneration,
    motion: str | Path | Generated,
    texts: str | Sequence[str] | None = None,
    *,
    actions: Sequence[str] | None = None,
    frames: str | Ranges | None = None,
    seconds: Ranges | None = None,
    joints: str | Sequence[str] | None = None,
    method: str | None = None,
    until: float | None = None,
    resample: int = 1,
    samples: int = 1,
    seed: int = 0,
    guidance_scale: float | None = None,
    sampler: str | None = None,
    num_inference_steps: int | None = None,
) -> list[Edited]:
    """Samples a part of a motion anew: `joints` in `frames` or `seconds`, each by default all.

    Args:
        model: from `flame_mdm.load`.
        motion: what `read_motion` reads, or its result, or a generated motion.
        texts, actions: what to do, as in `generate`; neither = without condition.
        frames: [begin, end) or several such ranges, to sample anew; or a task: "in_between" keeps the first and the
            last quarter, "prediction" ("prefix") the first, "suffix" the last, "interpolate" every fifth frame.
        seconds: ranges in seconds, in place of `frames`.
        joints: names of joints or of parts of the body (see `part_names`), to sample anew; default all. The root's
            way belongs to joint 0, which is in lower_body.
        method: "mdm" overwrites the clean estimate (exact); "flame" blends after each step as the paper says (exact);
            "flame_code" before each call as the paper's code; "mfm" rewrites the path early on. Default: "mdm" on
            diffusion, "mfm" on flows.
        until: for "mfm", the flow time up to which the path is rewritten; default 0.2, with 25 steps.
        resample: for FLAME's methods, how often each step is taken.
        samples, seed, guidance_scale, sampler, num_inference_steps: as in `generate`.

    Raises:
        UserError: a mask that keeps all or nothing, unknown names, a method that the model's process does not allow, a
            motion longer than those of the training, or what `read_motion` and `generate` refuse.
        FileNotFoundError, ValueError: from `read_motion`.
    """
    representation = model.representation
    original = motion if isinstance(motion, Generated) else read_motion(representation, motion)
    length = len(original.features)
    if length > model.facts["max_frames"]:
        raise UserError(
            f"{original.id}: {length} frames are more than the {model.facts['max_frames']} "
            f"({model.facts['max_frames'] / original.fps:g} seconds) that the model was trained on: take a part, "
            "cut=[begin, end] in seconds"
        )
    keep, still = kept_parts(representation, length, frames=frames, seconds=seconds, joints=joints)
    if not keep.any():
        raise UserError("this keeps nothing of the motion: choose frames=..., seconds=... or joints=...")
    if keep.all():
        raise UserError("this keeps all of the motion: nothing is left to sample")
    how = method_options(model.process, method, until, resample)
    if how["mode"] == "trajectory" and num_inference_steps is None:
        num_inference_steps = MFM_STEPS
    known = representation.normalize(torch.from_numpy(original.features).to(model.device))
    generated = generate(
        model,
        texts,
        actions=actions,
        frames=length,
        samples=samples,
        seed=seed,
        guidance_scale=guidance_scale,
        sampler=sampler,
        num_inference_steps=num_inference_steps,
        edit=Edit(known[None], keep[None].to(model.device), **how),
    )
    # Normalizing rounds, so what is kept is compared with what the sampler was given.
    given, std = representation.denormalize(known).cpu().numpy(), representation.std.cpu().numpy()
    return [
        Edited(
            **vars(result),
            original=original,
            keep=keep.numpy(),
            feature_error=float((np.abs(result.features - given) / std)[keep.numpy()].max()),
            joint_error=float(np.linalg.norm(result.joints - original.joints, axis=-1)[still.numpy()].max()),
        )
        for result in generated
    ]


def kept_parts(
    representation: Representation,
    length: int,
    *,
    frames: str | Ranges | None = None,
    seconds: Ranges | None = None,
    joints: str | Sequence[str] | None = None,
) -> tuple[Tensor, Tensor]:
    """What an edit of a motion of `length` frames keeps; arguments as of `edit`.

    Returns:
        (F, D) bool, True = this feature of this frame is kept; (F, J) bool, the same of the joints.

    Raises:
        UserError: frames outside of the motion, unknown names.
    """
    new_frames = _new_frames(length, representation.fps, frames, seconds)
    part = torch.zeros(len(representation.skeleton), dtype=torch.bool)
    part[list(range(len(part))) if joints is None else find_joints(representation.skeleton, joints)] = True
    features = (
        representation.joint_features(part.nonzero()[:, 0].tolist()) if joints is not None else torch.tensor([True])
    )
    keep = ~(new_frames[:, None] & features).expand(length, representation.features)
    return keep, ~(new_frames[:, None] & part)


def _new_frames(length: int, fps: float, frames: str | Ranges | None, seconds: Ranges | None) -> Tensor:
    """(F,) bool, True = this frame is sampled anew."""
    if frames is not None and seconds is not None:
        raise UserError("give frames or seconds, not both")
    if isinstance(frames, str):
        frame = torch.arange(length)
        first, last = int(0.25 * length), int(0.75 * length)
        kept = {
            "in_between": (frame < first) | (frame >= last),
            "prediction": frame < first,
            "prefix": frame < first,
            "suffix": frame >= last,
            "interpolate": frame % 5 == 0,
        }
        if frames not in kept:
            raise UserError(
                f"frames={frames} is unknown.{_nearest(frames, list(kept))} Give ranges [begin, end], or one of: "
                f"{', '.join(kept)}"
            )
        return ~kept[frames]
    ranges = frames if frames is not None else seconds
    if ranges is None:  # no frames are chosen: all of them
        return torch.ones(length, dtype=torch.bool)
    unit, scale = ("frames", 1.0) if seconds is None else ("seconds", fps)
    new = torch.zeros(length, dtype=torch.bool)
    for begin, end in _pairs(ranges, unit):
        first, last = round(begin * scale), round(end * scale)
        if not 0 <= first < last <= length:
            raise UserError(
                f"{unit}=[{begin:g}, {end:g}] is no part of this motion, which has {length} frames "
                f"({length / fps:g} seconds)"
            )
        new[first:last] = True
    return new


def _pairs(ranges: Ranges, unit: str) -> list[tuple[float, float]]:
    listed: Any = [ranges] if is_range(ranges) else ranges
    if not isinstance(listed, list | tuple) or not listed or not all(map(is_range, listed)):
        raise UserError(f"{unit}={ranges}: write [begin, end], or several as [[begin, end], [begin, end]]")
    return [(begin, end) for begin, end in listed]


def is_range(value: Any) -> bool:
    """Whether this is a pair of finite numbers."""
    return (
        isinstance(value, list | tuple)
        and len(value) == 2
        and all(isinstance(v, int | float) and math.isfinite(v) for v in value)
    )


def part_names(skeleton: Skeleton) -> dict[str, list[int]]:
    """Parts of the body by name: indices of their joints.

    lower_body is the root and the legs, as in MDM; upper_body is all the rest.
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
    """Indices of the joints that are named, one by one or as parts of the body.

    Raises:
        UserError: an unknown name, with the nearest ones.
    """
    known = part_names(skeleton) | {name: [i] for i, name in enumerate(skeleton.joints)}
    found: set[int] = set()
    for name in names if isinstance(names, list | tuple) else [names]:
        if not isinstance(name, str) or name not in known:
            raise UserError(
                f"skeleton {skeleton.name} has no joint or part '{name}'.{_nearest(str(name), list(known))} "
                f"Parts: {', '.join(part_names(skeleton))}; joints: {', '.join(skeleton.joints)}"
            )
        found.update(known[name])
    return sorted(found)


def method_options(
    process: Process, method: str | None = None, until: float | None = None, resample: int = 1
) -> dict[str, Any]:
    """The options of `Edit` for a method, by default the one of the process; arguments as of `edit`.

    Raises:
        UserError: the process does not allow the method, or the method lacks an option.
    """
    possible = [name for name, how in METHODS.items() if how["mode"] in process.edit_modes]
    if method is None:
        method = next(name for name in possible if METHODS[name]["mode"] == process.edit_modes[0])
    if method not in possible:
        raise UserError(
            f"method={method} is not possible with {type(process).__name__}; this model takes: {', '.join(possible)}"
        )
    how = dict(METHODS[method])
    if until is not None and how["mode"] != "trajectory":
        raise UserError(f"until={until:g} is an option of method=mfm, not of {method}")
    if resample != 1 and how["mode"] != "x_t":
        raise UserError(f"resample={resample} is an option of method=flame and flame_code, not of {method}")
    if how["mode"] == "trajectory":
        how["until"] = MFM_UNTIL if until is None else until
    return how | {"resample": resample}


def _nearest(name: str, names: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, names, 3, 0.5)
    return f" Did you mean {', '.join(near)}?" if near else ""


# Reading motions ------------------------------------------------------------------------------------------------------


def read_motion(
    representation: Representation,
    source: str | Path,
    *,
    cut: Sequence[float] | None = None,
    data_root: str | Path = "data",
) -> Generated:
    """Reads a motion to edit, in the features of a model.

    Args:
        representation: of the model.
        source: an .npz of `make sample`; an .npz with `joints` (F, J, 3) in metres, y up, and `fps`; a .bvh file of a
            known skeleton; or `dataset:id`, a clip of a prepared data set. Joints are brought to the
            frame rate of the model and turned as its features have them.
        cut: begin and end in seconds, of the part that counts.
        data_root: folder of the prepared data sets.

    Raises:
        FileNotFoundError: no such file or data set.
        ValueError: a damaged file, or a motion whose features this representation cannot compute.
        UserError: an unknown clip, or a `cut` outside of the motion.
    """
    name, suffix = str(source), Path(source).suffix.lower()
    caption = ""
    if suffix == ".npz":
        features, caption = _read_npz(representation, Path(source))
    elif suffix == ".bvh":
        features = _encode(representation, read_bvh(Path(source), representation.fps)[0], name)
    elif ":" in name:
        features, caption = _read_clip(representation, name, Path(data_root))
    else:
        raise UserError(f"motion={name}: give an .npz or .bvh file, or dataset:id for a clip of a prepared data set")
    if cut is not None:
        if not is_range(cut):
            raise UserError(f"cut={cut}: write [begin, end], in seconds")
        begin, end = (round(second * representation.fps) for second in cut)
        if not 0 <= begin < end <= len(features):
            seconds = len(features) / representation.fps
            raise UserError(f"cut=[{cut[0]:g}, {cut[1]:g}] is no part of {name}, which lasts {seconds:g} seconds")
        features = representation.rebase(features[begin:end])
    joints = representation.decode(torch.from_numpy(features)).numpy()
    return Generated(name, joints, features, representation.fps, caption)


def _read_npz(representation: Representation, path: Path) -> tuple[np.ndarray, str]:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except (ValueError, OSError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: damaged, or not an .npz file of numbers") from error
    caption, kind = str(arrays.get("text", "")), str(arrays.get("representation", ""))
    try:
        fps = float(arrays["fps"])
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"{path}: needs fps, the frames a second, as one number") from None
    if not 0 < fps < math.inf:
        raise ValueError(f"{path}: fps is {fps:g}, not a number above 0")
    if kind == representation.name and math.isclose(fps, representation.fps) and "features" in arrays:
        features = np.asarray(arrays["features"], np.float32)
        if features.ndim != 2 or features.shape[1] != representation.features or not np.isfinite(features).all():
            shape = f"(frames, {representation.features})"
            raise ValueError(f"{path}: features have shape {features.shape}, not {shape}, or are not finite")
        return features, caption
    if "joints" not in arrays:
        what = f"features {kind or '(unnamed)'} at {fps:g} fps" if "features" in arrays else "neither features"
        raise ValueError(
            f"{path}: holds {what} and no joints, but the model takes {representation.name} at "
            f"{representation.fps:g} fps"
        )
    if arrays["joints"].dtype.kind not in "fiu":
        raise ValueError(f"{path}: joints are no array of real numbers")
    joints = np.asarray(arrays["joints"], np.float64)
    if joints.ndim != 3 or joints.shape[2] != 3 or len(joints) < 2 or not (np.abs(joints) < 1e6).all():
        raise ValueError(f"{path}: joints have shape {joints.shape}, not (frames, joints, 3), or are not finite")
    return _encode(representation, resample(joints, fps, representation.fps), str(path)), caption


def resample(joints: np.ndarray, fps: float, to: float) -> np.ndarray:
    """Joints (F, J, 3) at another frame rate, by cubic splines from the first frame on; bones change by about 0.1 %."""
    if math.isclose(fps, to):
        return joints
    count = math.floor((len(joints) - 1) * to / fps + 1e-9) + 1
    return CubicSpline(np.arange(len(joints)), joints)(np.arange(count) * fps / to)


def _encode(representation: Representation, joints: np.ndarray, name: str) -> np.ndarray:
    try:
        return representation.encode(torch.from_numpy(joints)).numpy()
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _read_clip(representation: Representation, source: str, data_root: Path) -> tuple[np.ndarray, str]:
    dataset, _, clip_id = source.partition(":")
    store = Store(data_root / f"{dataset}-{representation.name}")
    if store.info["fps"] != representation.fps:
        raise ValueError(f"{store.folder}: prepared at {store.info['fps']:g} fps, the model has {representation.fps:g}")
    clips = {clip.id: clip for clip in store.clips}
    if clip_id not in clips:
        raise UserError(f"{store.folder} has no clip '{clip_id}'.{_nearest(clip_id, list(clips))}")
    clip = clips[clip_id]
    return np.array(store.motion(clip)), clip.captions[0] if clip.captions else ""
