# pyright: standard
"""Reads motions from files and prepared data sets, and computes their features for a model."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from flame_mdm.data.store import Store
from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.formats.conversion import raw_motion
from flame_mdm.formats.layouts import check_size
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import ENDINGS, read
from flame_mdm.representations import Representation
from flame_mdm.representations.rotation import is_degenerate
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.sampling.motion_request import is_range


def read_motion(
    representation: Representation,
    source: str | Path,
    *,
    fps: float | None = None,
    unit: float | None = None,
    up: str | None = None,
    animation: str | None = None,
    cut: Sequence[float] | None = None,
    data_root: str | Path = "data",
) -> Motion:
    """Reads a motion and computes its features in a model's representation.

    If the file contains features in the same representation and at the same frame rate, they are
    kept. Otherwise, the motion is converted as in `flame_mdm.formats.conversion` and made
    canonical. If joints were fitted, the `notes` of the result describe the fit and its error.

    Args:
        representation: the model's representation.
        source: a motion file, or `dataset:id` for a clip of a prepared data set.
        fps, unit, up, animation: how to read the file; see `flame_mdm.formats.readers.read`.
        cut: the part to use, as [begin, end] in seconds. Default: the entire motion.
        data_root: folder of the prepared data sets.

    Raises:
        FileNotFoundError: If the motion does not exist.
        UserError: If the motion is damaged or cannot be encoded, or if `cut` is outside the motion.
    """
    name = str(source)
    if Path(source).suffix.lower() in ENDINGS:
        motion = read(source, fps, unit, up, representation.fps, animation)
        motion = with_features(representation, replace(motion, id=name))
    elif ":" in name:
        dataset, _, clip_id = name.partition(":")
        store = Store(Path(data_root) / f"{dataset}-{representation.name}")
        if (rate := store.info["fps"]) != representation.fps:
            raise UserError(
                f"{store.folder} was prepared at {rate:g} fps, but the model uses {representation.fps:g} fps"
            )
        clips = {clip.id: clip for clip in store.clips}
        if clip_id not in clips:
            raise UserError(
                f"{store.folder} has no clip '{clip_id}'.{did_you_mean(clip_id, list(clips))}"
            )
        features, captions = np.array(store.motion(clips[clip_id])), clips[clip_id].captions
        motion = decoded(representation, torch.from_numpy(features), next(iter(captions), ""), name)
    else:
        raise UserError(
            f"{name}: not a motion. Use a file of type {', '.join(ENDINGS)}, or dataset:id for a prepared clip"
        )
    return motion if cut is None else part_of(representation, motion, cut)


def part_of(representation: Representation, motion: Motion, cut: Sequence[float]) -> Motion:
    """Returns the part of a motion between two times; `cut` is [begin, end] in seconds.

    The returned motion begins at the origin.

    Raises:
        UserError: If [begin, end] is not a range within the motion.
    """
    if not is_range(cut):
        raise UserError(f"cut={cut}: expected [begin, end], in seconds")
    begin, end = (round(second * representation.fps) for second in cut)
    if not 0 <= begin < end <= len(motion.features):
        seconds, name = len(motion.features) / representation.fps, motion.id or "the motion"
        raise UserError(
            f"cut=[{cut[0]:g}, {cut[1]:g}] is not a range within {name}, which lasts {seconds:g} seconds"
        )
    features = torch.from_numpy(representation.rebase(motion.features[begin:end]))
    return replace(decoded(representation, features, motion.text, motion.id), notes=motion.notes)


def with_features(representation: Representation, motion: Motion) -> Motion:
    """Returns the motion with features in the given representation.

    If the motion has no features, they are computed from its joint positions.
    """
    name = f"{motion.id}: " if motion.id else ""
    if motion.representation == representation.name and math.isclose(
        motion.fps, representation.fps
    ):
        shape, size = motion.features.shape, representation.features
        if shape[1:] != (size,) or not np.isfinite(motion.features).all():
            fault = (
                "contain NaN or infinite values"
                if shape[1:] == (size,)
                else f"have shape {shape}, not (frames, {size})"
            )
            raise UserError(f"{name}features {fault}")
        return motion
    try:
        if motion.skeleton.joints[: len(SMPL22)] == SMPL22.joints:
            check_size(motion.joints, 1.0, children=True)
        raw = raw_motion(motion, representation)
        features = representation.encode(raw.values)
        # Some representations have one row per pair of neighboring frames. Repeating a frame
        # preserves the number of frames.
        if len(features) < len(raw.values):
            step = (raw.values[-1:] - raw.values[-2:-1]) * raw.values.new_tensor([1.0, 0.0, 1.0])
            features = representation.encode(torch.cat([raw.values, raw.values[-1:] + step]))
    except ValueError as error:
        raise UserError(f"{name}{error}") from error
    encoded = decoded(representation, features, motion.text, motion.id)
    encoded.notes = (*motion.notes, *([raw.note] if raw.note else []))
    return encoded


def decoded(representation: Representation, features: Tensor, text: str, name: str) -> Motion:
    """Decodes unnormalized features (F, D) to a motion."""
    joints, fps, skeleton = (
        representation.decode(features).cpu().numpy(),
        representation.fps,
        representation.skeleton,
    )
    return Motion(
        joints=joints,
        fps=fps,
        skeleton=skeleton,
        text=text,
        id=name,
        features=features.cpu().numpy(),
        representation=representation.name,
        degenerate=int(is_degenerate(representation.rotations6d(features)).any(-1).sum()),
    )
