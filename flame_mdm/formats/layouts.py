"""Skeletons of motion files: how their joints become the 22 joints of SMPL."""

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
"""The axis that points up -> rows of the rotation that turns it to +y."""

Place = str | Mapping[str, float]
"""A joint of a file, or shares of several that lie around the place that is meant."""


@dataclass(frozen=True)
class Layout:
    """How the joints of files become the 22 joints of SMPL, in metres, y up.

    Attributes:
        map: for each of SMPL's joints the joint of the files that stands for it.
        joints: names of the joints of arrays, in their order; BVH files bring their own.
        unit: metres per unit of length in the files.
        up: the axis that points up.
        mirrored: the files hold mirrored motion; x changes its sign.
        fps: frames per second, for files that do not give it.
    """

    map: Mapping[str, Place]
    joints: tuple[str, ...] = ()
    unit: float = 1.0
    up: str = "y"
    mirrored: bool = False
    fps: float | None = None

    def knows(self, names: Sequence[str]) -> bool:
        """Returns whether all joints that it maps from are among these."""
        return {name for place in self.map.values() for name in _shares(place)} <= set(names)

    def apply(self, positions: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Joints (F, J, 3) of a file with these names -> (F, 22, 3) float32, metres, y up."""
        weights = np.zeros((len(SMPL22), len(names)))
        for row, joint in zip(weights, SMPL22.joints, strict=True):
            for name, share in _shares(self.map[joint]).items():
                row[names.index(name)] = share
        turned = self.unit * (weights @ positions) @ np.array(UP[self.up], float).T
        return (turned * [-1 if self.mirrored else 1, 1, 1]).astype(np.float32)


def _shares(place: Place) -> Mapping[str, float]:
    return {place: 1.0} if isinstance(place, str) else place


def _body(left: str, right: str, limbs: Mapping[str, Place], **middle: Place) -> dict[str, Place]:
    """A map whose limbs have the same names on both sides but for the mark of the side, which stands for `*`."""
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
BANDAI = {
    "pelvis": "Hips",
    "left_hip": "UpperLeg_L",
    "right_hip": "UpperLeg_R",
    "spine1": "Hips",
    "left_knee": "LowerLeg_L",
    "right_knee": "LowerLeg_R",
    "spine2": "Spine",
    "left_ankle": "Foot_L",
    "right_ankle": "Foot_R",
    "spine3": "Chest",
    "left_foot": "Toes_L",
    "right_foot": "Toes_R",
    "neck": "Neck",
    "left_collar": "Shoulder_L",
    "right_collar": "Shoulder_R",
    "head": "Head",
    "left_shoulder": "UpperArm_L",
    "right_shoulder": "UpperArm_R",
    "left_elbow": "LowerArm_L",
    "right_elbow": "LowerArm_R",
    "left_wrist": "Hand_L",
    "right_wrist": "Hand_R",
}
"""The joint of the BVH files of the Bandai-Namco set for each joint of SMPL, in the order of SMPL. The files have two
joints between hips and neck where SMPL has three: spine1 is at 40 % of the way from Hips to Spine."""
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
    # CMU, Bandai-Namco and MMM have two joints between hips and neck where SMPL has three. CMU's shoulders start in the
    # middle of the chest; MMM has no collars.
    "CMU": Layout(
        _body(
            *("Left", "Right", {**_MIXAMO_LIMBS, "collar": {"*Shoulder": 0.5, "*Arm": 0.5}}),
            **{"pelvis": "Hips", "spine1": {"Hips": 0.5, "Spine": 0.5}, "spine2": "Spine", "spine3": "Spine1"},
            **{"neck": "Neck1", "head": "Head"},
        ),
        unit=0.0254 / 0.45,
    ),
    "Bandai-Namco": Layout({**BANDAI, "spine1": {"Hips": 0.6, "Spine": 0.4}}, unit=0.01),
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
"""Skeletons that are known by the names of their joints. CMU's unit is that of its recordings, 0.45 an inch."""


def read_bvh(
    path: Path, fps: float | None = None, given: Mapping[str, Any] = {}, rate: float | None = None
) -> tuple[np.ndarray, float]:
    """The joints of SMPL in a BVH file of a known skeleton.

    Args:
        path: the file.
        fps: frames per second wanted; None = those of the file. Rotations are interpolated, so bones keep their length.
        given: fields of `Layout` that replace the known ones. Joints with SMPL's own names are in centimetres, as
            `flame_mdm.formats` writes them.
        rate: replaces the frame rate that the file gives.

    Returns:
        (F, 22, 3) float32 in metres, y up; frames per second.

    Raises:
        FileNotFoundError: there is no such file.
        UserError: it is not a regular file, or too large.
        ValueError: damaged, or an unknown skeleton.
    """
    file = bvh.read(path)
    file = file if rate is None else replace(file, fps=rate)
    names = [name.rpartition(":")[2] for name in file.joints]
    layout = find_layout(path, names, given)
    if layout.map is LAYOUTS["SMPL"].map and "unit" not in given:
        layout = replace(layout, unit=0.01)
    if fps is None:
        return layout.apply(file.positions(), names), file.fps
    try:
        moved = file.resample(fps)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return layout.apply(bvh.forward_kinematics(file.parents, *moved)[0], names), fps


def find_layout(path: Path, names: Sequence[str], given: Mapping[str, Any]) -> Layout:
    """Returns the layout of joints with these names: a known one, with its fields replaced by those that are given.

    Raises:
        ValueError: no known layout has these names.
    """
    known = (layout for layout in LAYOUTS.values() if layout.knows(names))
    layout = Layout(given["map"]) if "map" in given else next(known, None)
    if layout is None or not layout.knows(names):
        which = "not those of the map" if "map" in given else f"those of none of the skeletons {', '.join(LAYOUTS)}"
        raise ValueError(
            f"{path}: its joints ({', '.join(names)[:1000]}) are {which}. Rename them, or map them to SMPL's in the "
            "skeleton.yaml of a folder of own data"
        )
    return replace(layout, **given)


def read_skeleton(path: Path) -> dict[str, Any]:
    """The fields of `Layout` that a skeleton file gives; the others are those of a known skeleton.

    Raises:
        UserError: it cannot be read.
        ValueError: it misnames something; the message names the file and the key.
    """
    data = read_yaml(path)
    allowed = tuple(Layout.__dataclass_fields__)
    if not isinstance(data, dict) or not set(data) <= set(allowed):
        unknown = ", ".join(map(str, set(data) - set(allowed))) if isinstance(data, dict) else type(data).__name__
        raise ValueError(f"{path}: unknown key {unknown}; there are {', '.join(allowed)}")
    kinds = {"map": dict, "joints": list, "unit": (int, float), "up": str, "mirrored": bool, "fps": (int, float)}
    for key, value in data.items():
        fits = isinstance(value, kinds[key]) and (key == "mirrored" or not isinstance(value, bool))
        fits = fits and (key != "map" or all(_is_place(place) for place in data["map"].values()))
        fits = fits and (key != "joints" or all(isinstance(name, str) for name in data["joints"]))
        fits = fits and (key != "fps" or RATES[0] <= value <= RATES[1])
        if not fits or (key == "unit" and not 0 < value < math.inf) or (key == "up" and value not in UP):
            raise ValueError(
                f"{path}: {key}: {str(value)[:100]} is not valid. map and joints are a map and a list, unit (metres "
                f"per unit) is a number above 0, fps one from {RATES[0]:g} to {RATES[1]:g}, up one of {', '.join(UP)}, "
                "mirrored true or false"
            )
    if "map" in data:
        missing = sorted(set(SMPL22.joints) - set(map(str, data["map"])))
        if missing:
            raise ValueError(f"{path}: map: which joint stands for {', '.join(missing)}?")
        named = {name for place in data["map"].values() for name in _shares(place)}
        if "joints" in data and not named <= set(data["joints"]):
            raise ValueError(f"{path}: map: {', '.join(sorted(named - set(data['joints'])))} is not among the joints")
    return data


def _is_place(place: object) -> bool:
    """Whether a value of the map is the name of a joint, or shares of several."""
    if not isinstance(place, dict):
        return isinstance(place, str)
    numbers = all(isinstance(share, int | float) and math.isfinite(share) for share in place.values())
    return bool(place) and numbers and all(isinstance(name, str) for name in place)
