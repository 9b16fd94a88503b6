"""Skeletons of motion files and their mapping to the 22 joints of SMPL."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flame_mdm.files import read_yaml
from flame_mdm.formats import bvh
from flame_mdm.formats.resampling import RATES
from flame_mdm.representations.skeleton import KIT21, SMPL22

UP = {
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}
"""The axis that points up -> rows of the rotation that maps it to +y."""

Place = str | Mapping[str, float]
"""A joint of a file, or weights of several joints whose weighted mean is the position."""


@dataclass(frozen=True)
class Layout:
    """Mapping from the joints of files to the 22 joints of SMPL, in meters, y up.

    Attributes:
        map: for each of SMPL's joints, the corresponding joint in the files.
        joints: names of the joints of arrays, in order; BVH files contain their own.
        unit: meters per unit of length in the files.
        up: the axis that points up.
        mirrored: the files contain mirrored motion; the sign of x is changed.
        fps: frames per second, for files that do not contain it.
    """

    map: Mapping[str, Place]
    joints: tuple[str, ...] = ()
    unit: float = 1.0
    up: str = "y"
    mirrored: bool = False
    fps: float | None = None

    def knows(self, names: Sequence[str]) -> bool:
        """Returns whether these names include all joints that the mapping uses."""
        return {name for place in self.map.values() for name in _shares(place)} <= set(names)

    def apply(self, positions: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Maps joints (F, J, 3) of a file with these names to (F, 22, 3) float32, meters, y up."""
        weights = np.zeros((len(SMPL22), len(names)))
        for row, joint in zip(weights, SMPL22.joints, strict=True):
            for name, share in _shares(self.map[joint]).items():
                row[names.index(name)] = share
        turned = self.unit * (weights @ positions) @ np.array(UP[self.up], float).T
        return (turned * [-1 if self.mirrored else 1, 1, 1]).astype(np.float32)


def _shares(place: Place) -> Mapping[str, float]:
    return {place: 1.0} if isinstance(place, str) else place


def _body(left: str, right: str, limbs: Mapping[str, Place], **middle: Place) -> dict[str, Place]:
    """Returns a map whose limbs have the same names on both sides; the mark of the side replaces `*`."""
    both = {
        f"{side}_{joint}": {name.replace("*", mark): share for name, share in _shares(place).items()}
        for side, mark in (("left", left), ("right", right))
        for joint, place in limbs.items()
    }
    return {**middle, **both}


_MIXAMO_LIMBS: dict[str, Place] = {
    **{"hip": "*UpLeg", "knee": "*Leg", "ankle": "*Foot", "foot": "*ToeBase"},
    **{"collar": "*Shoulder", "shoulder": "*Arm", "elbow": "*ForeArm", "wrist": "*Hand"},
}
_MMM_LIMBS: dict[str, Place] = {
    **{"hip": "*_hip", "knee": "*_knee", "ankle": "*_ankle", "foot": "*_toes"},
    "collar": {"thorax": 0.5, "*_shoulder": 0.5},
    **{"shoulder": "*_shoulder", "elbow": "*_elbow", "wrist": "*_wrist"},
}
_BANDAI_LIMBS: dict[str, Place] = {
    **{"hip": "UpperLeg_*", "knee": "LowerLeg_*", "ankle": "Foot_*", "foot": "Toes_*"},
    **{"collar": "Shoulder_*", "shoulder": "UpperArm_*", "elbow": "LowerArm_*", "wrist": "Hand_*"},
}
LAYOUTS: dict[str, Layout] = {
    "SMPL": Layout(dict(zip(SMPL22.joints, SMPL22.joints, strict=True))),
    "Mixamo": Layout(
        _body(
            *("Left", "Right", _MIXAMO_LIMBS),
            **{"pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2"},
            **{"neck": "Neck", "head": "Head"},
        ),
        unit=0.01,
    ),
    # CMU, Bandai-Namco and MMM have two joints between hips and neck, SMPL has three. CMU's shoulders start in the
    # middle of the chest; MMM has no collars.
    "CMU": Layout(
        _body(
            *("Left", "Right", {**_MIXAMO_LIMBS, "collar": {"*Shoulder": 0.5, "*Arm": 0.5}}),
            **{"pelvis": "Hips", "spine1": {"Hips": 0.5, "Spine": 0.5}, "spine2": "Spine", "spine3": "Spine1"},
            **{"neck": "Neck1", "head": "Head"},
        ),
        unit=0.0254 / 0.45,
    ),
    "Bandai-Namco": Layout(
        _body(
            *("L", "R", _BANDAI_LIMBS),
            **{"pelvis": "Hips", "spine1": {"Hips": 0.6, "Spine": 0.4}, "spine2": "Spine", "spine3": "Chest"},
            **{"neck": "Neck", "head": "Head"},
        ),
        unit=0.01,
    ),
    "MMM": Layout(
        _body(
            *("left", "right", _MMM_LIMBS),
            **{"pelvis": "root", "spine1": {"root": 0.5, "belly": 0.5}, "spine2": "belly", "spine3": "thorax"},
            **{"neck": "neck", "head": "head"},
        ),
        joints=KIT21.joints,
        unit=1 / 640,
        mirrored=True,
    ),
}
"""Known skeletons, recognized by the names of their joints. CMU's unit is that of its recordings: 0.45 per inch."""


def read_bvh(
    path: Path, fps: float | None = None, overrides: Mapping[str, Any] = {}, rate: float | None = None
) -> tuple[np.ndarray, float]:
    """Reads the joints of SMPL from a BVH file with a known skeleton.

    Args:
        path: the file.
        fps: target frames per second; None = those of the file. Rotations are interpolated, so bones keep their length.
        overrides: fields of `Layout` that override the known ones. Joints with SMPL's names are in centimeters, as
            written by `flame_mdm.formats`.
        rate: overrides the frame rate of the file.

    Returns:
        Joints (F, 22, 3) float32 in meters, y up, and frames per second.

    Raises:
        FileNotFoundError: the file does not exist.
        UserError: the path is not a regular file, or the file is too large.
        ValueError: the file is damaged or has an unknown skeleton.
    """
    file = bvh.read(path)
    file = file if rate is None else replace(file, fps=rate)
    names = [name.rpartition(":")[2] for name in file.joints]
    layout = find_layout(path, names, overrides)
    if layout.map is LAYOUTS["SMPL"].map and "unit" not in overrides:
        layout = replace(layout, unit=0.01)
    if fps is None:
        return layout.apply(file.positions(), names), file.fps
    try:
        moved = file.resample(fps)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return layout.apply(bvh.forward_kinematics(file.parents, *moved)[0], names), fps


def find_layout(path: Path, names: Sequence[str], overrides: Mapping[str, Any]) -> Layout:
    """Returns the known layout for joints with these names, with the fields in `overrides` overridden.

    Raises:
        ValueError: no known layout has these names.
    """
    known = (layout for layout in LAYOUTS.values() if layout.knows(names))
    layout = Layout(overrides["map"]) if "map" in overrides else next(known, None)
    if layout is None or not layout.knows(names):
        which = "the map" if "map" in overrides else f"any of the known skeletons {', '.join(LAYOUTS)}"
        raise ValueError(
            f"{path}: its joints ({', '.join(names)[:1000]}) do not match {which}. Rename them, or map them to SMPL's "
            "in the skeleton.yaml of a folder of own data"
        )
    return replace(layout, **overrides)


def read_skeleton(path: Path) -> dict[str, Any]:
    """Reads the fields of `Layout` in a skeleton file; the others are those of a known skeleton.

    Raises:
        UserError: the file cannot be read.
        ValueError: a key or value is invalid; the message names the file and the key.
    """
    data = read_yaml(path)
    allowed = tuple(Layout.__dataclass_fields__)
    if not isinstance(data, dict) or not set(data) <= set(allowed):
        unknown = ", ".join(map(str, set(data) - set(allowed))) if isinstance(data, dict) else type(data).__name__
        raise ValueError(f"{path}: unknown key {unknown}; use {', '.join(allowed)}")
    kinds = {"map": dict, "joints": list, "unit": (int, float), "up": str, "mirrored": bool, "fps": (int, float)}
    for key, value in data.items():
        fits = isinstance(value, kinds[key]) and (key == "mirrored" or not isinstance(value, bool))
        fits = fits and (key != "map" or all(_is_place(place) for place in data["map"].values()))
        fits = fits and (key != "joints" or all(isinstance(name, str) for name in data["joints"]))
        fits = fits and (key != "fps" or RATES[0] <= value <= RATES[1])
        if not fits or (key == "unit" and not 0 < value < math.inf) or (key == "up" and value not in UP):
            raise ValueError(
                f"{path}: {key}: {str(value)[:100]} is not valid. map is a mapping and joints a list of names, unit "
                f"(meters per unit) a number above 0, fps one from {RATES[0]:g} to {RATES[1]:g}, up one of "
                f"{', '.join(UP)}, mirrored true or false"
            )
    if "map" in data:
        missing = sorted(set(SMPL22.joints) - set(map(str, data["map"])))
        if missing:
            raise ValueError(f"{path}: map: no joint given for {', '.join(missing)}")
        named = {name for place in data["map"].values() for name in _shares(place)}
        if "joints" in data and not named <= set(data["joints"]):
            raise ValueError(f"{path}: map: {', '.join(sorted(named - set(data['joints'])))} is not among the joints")
    return data


def _is_place(place: object) -> bool:
    """Returns whether a value of the map is the name of a joint or weights of several."""
    if not isinstance(place, dict):
        return isinstance(place, str)
    numbers = all(isinstance(share, int | float) and math.isfinite(share) for share in place.values())
    return bool(place) and numbers and all(isinstance(name, str) for name in place)
