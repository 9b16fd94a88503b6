"""Skeletons of motion files and their mapping to the 22 joints of SMPL."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flame_mdm.errors import UserError
from flame_mdm.formats import bvh
from flame_mdm.formats.resampling import RATES
from flame_mdm.representations.skeleton import KIT21, SMPL22
from flame_mdm.safe_io import read_yaml, regular_file

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
        children: the bodies may be those of children.
    """

    map: Mapping[str, Place]
    joints: tuple[str, ...] = ()
    unit: float = 1.0
    up: str = "y"
    mirrored: bool = False
    fps: float | None = None
    children: bool = False

    @property
    def used(self) -> set[str]:
        """The joints of files that the mapping uses."""
        return {name for place in self.map.values() for name in _shares(place)}

    def knows(self, names: Sequence[str]) -> bool:
        """Returns whether these names include all joints that the mapping uses."""
        return self.used <= set(names)

    def without_toes(self) -> Layout:
        """Returns the layout of the same skeleton with the end sites of the ankles instead of toes."""
        ends = {f"{side}_foot": f"{next(iter(_shares(self.map[f'{side}_ankle'])))}.end" for side in ("left", "right")}
        return replace(self, map={**self.map, **ends})

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
_XSENS_LIMBS: dict[str, Place] = {
    **{"hip": "*Hip", "knee": "*Knee", "ankle": "*Ankle", "foot": "*Toe"},
    **{"collar": "*Collar", "shoulder": "*Shoulder", "elbow": "*Elbow", "wrist": "*Wrist"},
}
_SOMA_LIMBS: dict[str, Place] = {**_MIXAMO_LIMBS, "hip": "*Leg", "knee": "*Shin"}
_MMM_LIMBS: dict[str, Place] = {
    **{"hip": "*_hip", "knee": "*_knee", "ankle": "*_ankle", "foot": "*_toes"},
    "collar": {"thorax": 0.5, "*_shoulder": 0.5},
    **{"shoulder": "*_shoulder", "elbow": "*_elbow", "wrist": "*_wrist"},
}
_BANDAI_LIMBS: dict[str, Place] = {
    **{"hip": "UpperLeg_*", "knee": "LowerLeg_*", "ankle": "Foot_*", "foot": "Toes_*"},
    **{"collar": "Shoulder_*", "shoulder": "UpperArm_*", "elbow": "LowerArm_*", "wrist": "Hand_*"},
}
_UNREAL_LIMBS: dict[str, Place] = {
    **{"hip": "thigh_*", "knee": "calf_*", "ankle": "foot_*", "foot": "ball_*"},
    **{"collar": "clavicle_*", "shoulder": "upperarm_*", "elbow": "lowerarm_*", "wrist": "hand_*"},
}
_UNITY_LIMBS: dict[str, Place] = {
    **{"hip": "*UpperLeg", "knee": "*LowerLeg", "ankle": "*Foot", "foot": "*Toes"},
    **{"collar": "*Shoulder", "shoulder": "*UpperArm", "elbow": "*LowerArm", "wrist": "*Hand"},
}
_MIXAMO_MIDDLE: dict[str, Place] = {
    **{"pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2"},
    **{"neck": "Neck", "head": "Head"},
}
_FINGERS = [
    f"{finger}{part}"
    for finger, parts in (("Thumb", "123"), ("Index", "1234"), ("Middle", "1234"), ("Ring", "1234"), ("Pinky", "1234"))
    for part in (*parts, "End")
]
SOMA77 = (
    *("Hips", "Spine1", "Spine2", "Chest", "Neck1", "Neck2", "Head", "HeadEnd", "Jaw", "LeftEye", "RightEye"),
    *(
        f"{side}{name}"
        for side in ("Left", "Right")
        for name in ("Shoulder", "Arm", "ForeArm", "Hand", *(f"Hand{finger}" for finger in _FINGERS))
    ),
    *(f"{side}{name}" for side in ("Left", "Right") for name in ("Leg", "Shin", "Foot", "ToeBase", "ToeEnd")),
)
"""Joints of NVIDIA's SOMA skeleton, in the order of its arrays."""

LAYOUTS: dict[str, Layout] = {
    "SMPL": Layout(dict(zip(SMPL22.joints, SMPL22.joints, strict=True))),
    "Mixamo": Layout(_body("Left", "Right", _MIXAMO_LIMBS, **_MIXAMO_MIDDLE), unit=0.01),
    "LAFAN1": Layout(_body("Left", "Right", {**_MIXAMO_LIMBS, "foot": "*Toe"}, **_MIXAMO_MIDDLE), unit=0.01),
    "Unreal": Layout(
        _body(
            *("l", "r", _UNREAL_LIMBS),
            **{"pelvis": "pelvis", "spine1": "spine_01", "spine2": "spine_02", "spine3": "spine_03"},
            **{"neck": "neck_01", "head": "head"},
        ),
        unit=0.01,
    ),
    "Unity": Layout(
        _body(
            *("Left", "Right", _UNITY_LIMBS),
            **{"pelvis": "Hips", "spine1": "Spine", "spine2": "Chest", "spine3": "UpperChest"},
            **{"neck": "Neck", "head": "Head"},
        ),
        unit=0.01,
    ),
    # Four joints between hips and neck; SMPL's spine3 is between the upper two.
    "Xsens": Layout(
        _body(
            *("Left", "Right", _XSENS_LIMBS),
            **{"pelvis": "Hips", "spine1": "Chest2", "spine2": "Chest3", "spine3": {"Chest3": 0.5, "Chest4": 0.5}},
            **{"neck": "Neck", "head": "Head"},
        ),
        unit=0.01,
    ),
    "SOMA": Layout(
        _body(
            *("Left", "Right", _SOMA_LIMBS),
            **{"pelvis": "Hips", "spine1": "Spine1", "spine2": "Spine2", "spine3": "Chest"},
            **{"neck": "Neck1", "head": "Head"},
        ),
        joints=SOMA77,
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
_TOELESS = {f"{name} without toes": layout.without_toes() for name, layout in LAYOUTS.items()}


def read_bvh(
    path: Path, fps: float | None = None, given: Mapping[str, Any] = {}, rate: float | None = None
) -> tuple[np.ndarray, float, Layout]:
    """Reads the joints of SMPL from a BVH file with a known skeleton.

    Args:
        path: the file.
        fps: target frames per second; None = those of the file. Rotations are interpolated, so bones keep their length.
        given: fields of `Layout` that override the known ones. Known skeletons whose arrays are in meters are in
            centimeters in BVH files, as written by `flame_mdm.formats`.
        rate: overrides the frame rate of the file.

    Returns:
        Joints (F, 22, 3) float32 in meters, y up; frames per second; the layout of the file, with its frame rate.

    Raises:
        FileNotFoundError: the file does not exist.
        UserError: the path is not a regular file, or the file is too large.
        ValueError: the file is damaged or has an unknown skeleton.
    """
    file = bvh.read(path)
    return map_bvh(path, file if rate is None else replace(file, fps=rate), fps, given)


def map_bvh(path: Path, file: bvh.Bvh, fps: float | None, given: Mapping[str, Any]) -> tuple[np.ndarray, float, Layout]:
    """Returns what `read_bvh` returns, of a file that is already read."""
    ended = file.with_end_joints()
    names = _plain(ended.joints, given)
    layout = find_layout(path, names, given)
    in_meters = layout.unit == 1 and not {"map", "unit"} & set(given)
    layout = replace(layout, fps=file.fps, unit=0.01 if in_meters else layout.unit)
    if any(name in names[len(file.joints) :] for name in layout.used):
        file = ended
    names = names[: len(file.joints)]
    if fps is None:
        return layout.apply(file.positions(), names), file.fps, layout
    try:
        moved = file.resample(fps)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return layout.apply(bvh.forward_kinematics(file.parents, *moved)[0], names), fps, layout


def _plain(joints: Sequence[str], given: Mapping[str, Any]) -> list[str]:
    """Returns names of joints without the prefix before a colon, and without Mixamo's prefix unless a map is given."""
    names = [name.rpartition(":")[2] for name in joints]
    return names if "map" in given else [re.sub(r"^mixamorig\d*_?", "", name) for name in names]


def array_layout(path: Path, joints: np.ndarray, given: Mapping[str, Any]) -> tuple[Layout, tuple[str, ...]]:
    """Returns the layout of an array and the names of its joints, from `given` or inferred from their number.

    Raises:
        ValueError: the shape is not (frames, joints, 3), or no known skeleton has this number of joints or these names.
    """
    if joints.ndim != 3 or joints.shape[2] != 3 or not len(joints):
        raise ValueError(f"{path}: joints of shape {joints.shape}, not (frames, joints, 3)")
    count = joints.shape[1]
    names = next((layout.joints for layout in LAYOUTS.values() if count == len(layout.joints)), ())
    if given.get("joints"):
        names = tuple(given["joints"])
        if len(names) != count:
            raise ValueError(f"{path}: {count} joints, but skeleton.yaml names {len(names)}")
    elif count in (22, 24, 52):
        names = (*SMPL22.joints, *(f"joint{number}" for number in range(len(SMPL22), count)))
    elif not names and count < len(SMPL22):
        raise ValueError(f"{path}: {count} joints with unknown names; write their names and a map into skeleton.yaml")
    elif not names:
        raise ValueError(f"{path}: {count} joints, not the 22, 24 or 52 of SMPL or 77 of SOMA; write a skeleton.yaml")
    return find_layout(path, names, given), names


def layout_name(layout: Layout) -> str:
    """Returns the name of a known layout, or "own map"."""
    known = LAYOUTS | _TOELESS
    return next((name for name, each in known.items() if each.map is layout.map), "own map")


def find_layout(path: Path, names: Sequence[str], given: Mapping[str, Any]) -> Layout:
    """Returns the known layout for joints with these names, with the fields in `given` overridden.

    Raises:
        ValueError: no known layout has these names; the message begins with the missing ones.
    """
    known = {"the map": Layout(given["map"])} if "map" in given else LAYOUTS | _TOELESS
    name, nearest = min(known.items(), key=lambda item: len(item[1].used - set(names)))
    if missing := sorted(nearest.used - set(names)):
        lacking = ", ".join(missing)[:500]
        if "map" in given:
            which = f"the map in skeleton.yaml uses joints that the file lacks: {lacking}"
        elif len(missing) > len(SMPL22) / 2:
            which = f"unknown skeleton, like none of {', '.join(LAYOUTS)}"
        else:
            which = f"unknown skeleton. {name} is the nearest known one; missing: {lacking}"
        raise ValueError(
            f"{path}: {which}. Map the joints of SMPL in skeleton.yaml (docs/own-data.md) to those of the file: "
            f"{', '.join(names)[:1000]}"
        )
    return replace(nearest, **given)


def skeleton_file(path: Path) -> Path | None:
    """Returns the nearest `skeleton.yaml` in the folder of a file or above it.

    Raises:
        UserError: it is not a regular file.
    """
    for folder in path.absolute().parents:
        if os.path.lexists(folder / "skeleton.yaml"):
            regular_file(folder / "skeleton.yaml")
            return folder / "skeleton.yaml"
    return None


def find_skeleton(path: Path, up: str | None = None) -> dict[str, Any]:
    """Returns the fields of `Layout` for a file: those of `skeleton_file`, overridden by `up` (y, z or -y).

    Raises:
        UserError: `up` is no axis, or the skeleton file cannot be read.
        ValueError: the skeleton file is invalid.
    """
    if up is not None and up not in UP:
        raise UserError(f"up={up}: the axis that points up is one of {', '.join(UP)}")
    found = skeleton_file(path)
    return (read_skeleton(found) if found else {}) | ({} if up is None else {"up": up})


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
    kinds = {"map": dict, "joints": list, "unit": (int, float), "up": str, "fps": (int, float)}
    kinds |= {"mirrored": bool, "children": bool}
    for key, value in data.items():
        fits = isinstance(value, kinds[key]) and (kinds[key] is bool or not isinstance(value, bool))
        fits = fits and (key != "map" or all(_is_place(place) for place in data["map"].values()))
        fits = fits and (key != "joints" or all(isinstance(name, str) for name in data["joints"]))
        fits = fits and (key != "fps" or RATES[0] <= value <= RATES[1])
        if not fits or (key == "unit" and not 0 < value < math.inf) or (key == "up" and value not in UP):
            raise ValueError(
                f"{path}: {key}: {str(value)[:100]} is not valid. map is a mapping and joints a list of names, unit "
                f"(meters per unit) a number above 0, fps one from {RATES[0]:g} to {RATES[1]:g}, up one of "
                f"{', '.join(UP)}, mirrored and children true or false"
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
