"""Skeletons of motion files and their mapping to the 22 joints of SMPL; `layouts.yaml` contains the known ones."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from flame_mdm.errors import UserError
from flame_mdm.formats import asf, bvh
from flame_mdm.formats.resampling import RATES
from flame_mdm.formats.retarget import joint_names, presets
from flame_mdm.representations.skeleton import SKELETONS, SMPL22
from flame_mdm.safe_io import read_yaml, regular_file

UP = {
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}
"""The axis that points up -> rows of the rotation that maps it to +y."""

Source = str | Mapping[str, float]
"""A joint of a file, or weights of several joints whose weighted mean is the position."""


@dataclass(frozen=True)
class Layout:
    """Mapping from the joints of files to the 22 joints of SMPL, in meters, y up."""

    map: Mapping[str, Source]  # for each of SMPL's joints, the corresponding joint in the files
    joints: tuple[str, ...] = ()  # names of the joints of arrays, in order; BVH files contain their own
    unit: float = 1.0  # meters per unit of length in the files
    up: str = "y"  # the axis that points up
    mirrored: bool = False  # the files contain mirrored motion; the sign of x is changed
    fps: float | None = None  # frames per second, for files that do not contain it
    children: bool = False  # the bodies may be those of children

    @property
    def used(self) -> set[str]:
        """The joints of files that the mapping uses."""
        return {name for source in self.map.values() for name in _shares(source)}

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


def _shares(source: Source) -> Mapping[str, float]:
    return {source: 1.0} if isinstance(source, str) else source


def _layout(joints: str | Sequence[str] | None = None, rig: str = "", map: Mapping = {}, **fields: Any) -> Layout:
    """Returns a layout of `layouts.yaml`, which describes the arguments."""
    parts = {key: fields.pop(key) for key in ("sides", "trunk", "arm", "leg") if key in fields}
    skeleton = presets()[rig] if rig else parts
    same = {joint: joint for joint in SMPL22.joints}
    sources: dict[str, Source] = dict(joint_names(skeleton) if skeleton else same)
    for joint, shares in map.items():
        sides = [("", "")] if joint in SMPL22.joints else zip(("left_", "right_"), skeleton["sides"], strict=True)
        for side, mark in sides:
            sources[side + joint] = {name.replace("*", mark): share for name, share in shares.items()}
    names = SKELETONS[joints].joints if isinstance(joints, str) else tuple(joints or ())
    return Layout({joint: sources[joint] for joint in SMPL22.joints}, names, **fields)


LAYOUTS: dict[str, Layout] = {
    name: _layout(**fields) for name, fields in read_yaml(Path(__file__).with_name("layouts.yaml")).items()
}
"""Known skeletons, recognized by the names of their joints."""
_TOELESS = {f"{name} without toes": layout.without_toes() for name, layout in LAYOUTS.items()}


def read_tree(path: Path, rate: float | None = None) -> bvh.Bvh:
    """Reads a BVH or AMC file; `rate` overrides its frame rate."""
    if path.suffix.lower() == ".amc":
        return asf.read(path, rate)
    file = bvh.read(path)
    return file if rate is None else replace(file, fps=rate)


def map_bvh(
    path: Path, file: bvh.Bvh, fps: float | None, fields: Mapping[str, Any]
) -> tuple[np.ndarray, float, Layout]:
    """Returns the joints of SMPL in a BVH or AMC file with a known skeleton.

    Args:
        path, file: the file, and what `read_tree` read.
        fps: target frames per second; None = those of the file. Rotations are interpolated, so bones keep their length.
        fields: fields of `Layout` that override the known ones. Known skeletons whose arrays are in meters are in
            centimeters in BVH files, as written by `flame_mdm.formats`.

    Returns:
        Joints (F, 22, 3) float32 in meters, y up; frames per second; the layout of the file, with its frame rate.
    """
    ended = file.with_end_joints()
    names = [name.rpartition(":")[2] for name in ended.joints]
    if "map" not in fields:
        names = [re.sub(r"^mixamorig\d*_?", "", name) for name in names]
    layout = find_layout(path, names, fields)
    in_meters = layout.unit == 1 and not {"map", "unit"} & set(fields)
    layout = replace(layout, fps=file.fps, unit=0.01 if in_meters else layout.unit)
    if any(name in names[len(file.joints) :] for name in layout.used):
        file = ended
    names = names[: len(file.joints)]
    if fps is None:
        return layout.apply(file.positions(), names), file.fps, layout
    try:
        moved = file.resample(fps)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return layout.apply(bvh.forward_kinematics(file.parents, *moved)[0], names), fps, layout


def array_layout(path: Path, joints: np.ndarray, fields: Mapping[str, Any]) -> tuple[Layout, tuple[str, ...]]:
    """Returns layout and joint names of an array (F, J, 3), from `fields` or inferred from their number."""
    if joints.ndim != 3 or joints.shape[2] != 3 or not len(joints):
        raise UserError(f"{path}: joints of shape {joints.shape}, not (frames, joints, 3)")
    count = joints.shape[1]
    names = next((layout.joints for layout in LAYOUTS.values() if count == len(layout.joints)), ())
    if fields.get("joints"):
        names = tuple(fields["joints"])
        if len(names) != count:
            raise UserError(f"{path}: {count} joints, but skeleton.yaml names {len(names)}")
    elif count in (22, 24, 52):
        names = (*SMPL22.joints, *(f"joint{number}" for number in range(len(SMPL22), count)))
    elif not names and count < len(SMPL22):
        raise UserError(f"{path}: {count} joints with unknown names; write their names and a map into skeleton.yaml")
    elif not names:
        raise UserError(f"{path}: {count} joints, not the 22, 24 or 52 of SMPL or 77 of SOMA; write a skeleton.yaml")
    return find_layout(path, names, fields), names


def layout_name(layout: Layout) -> str:
    """Returns the name of a known layout, or "own map"."""
    return next((name for name, own in (LAYOUTS | _TOELESS).items() if own.map is layout.map), "own map")


def find_layout(path: Path, names: Sequence[str], fields: Mapping[str, Any]) -> Layout:
    """Returns the known layout for joints with these names, overridden by `fields`; errors begin with missing ones."""
    candidates = {"the map": Layout(fields["map"])} if "map" in fields else LAYOUTS | _TOELESS
    name, nearest = min(candidates.items(), key=lambda item: len(item[1].used - set(names)))
    if missing := sorted(nearest.used - set(names)):
        lacking = ", ".join(missing)[:500]
        if "map" in fields:
            which = f"the map in skeleton.yaml uses joints that the file lacks: {lacking}"
        elif len(missing) > len(SMPL22) / 2:
            which = f"unknown skeleton, like none of {', '.join(LAYOUTS)}"
        else:
            which = f"unknown skeleton. {name} is the nearest known one; missing: {lacking}"
        raise UserError(
            f"{path}: {which}. Map the joints of SMPL in skeleton.yaml (docs/own-data.md) to those of the file: "
            f"{', '.join(names)[:1000]}"
        )
    return replace(nearest, **fields)


# skeleton.yaml --------------------------------------------------------------------------------------------------------


class _Fields(BaseModel):
    """The fields of `Layout` in a skeleton file."""

    model_config = ConfigDict(strict=True, extra="forbid")
    map: dict[str, str | Annotated[dict[str, FiniteFloat], Field(min_length=1)]] = {}
    joints: list[str] = []
    unit: Annotated[FiniteFloat, Field(gt=0)] = 1.0
    up: Literal["y", "z", "-y"] = "y"
    fps: Annotated[float, Field(ge=RATES[0], le=RATES[1])] = 1.0
    mirrored: bool = False
    children: bool = False


def skeleton_file(path: Path) -> Path | None:
    """Returns the nearest `skeleton.yaml`, a regular file, in the folder of a file or above it."""
    for folder in path.absolute().parents:
        if os.path.lexists(folder / "skeleton.yaml"):
            regular_file(folder / "skeleton.yaml")
            return folder / "skeleton.yaml"
    return None


def find_skeleton(path: Path, up: str | None = None) -> dict[str, Any]:
    """Returns the fields of `Layout` for a file: those of its `skeleton_file`, overridden by `up` (y, z or -y)."""
    if up is not None and up not in UP:
        raise UserError(f"up={up}: the axis that points up is one of {', '.join(UP)}")
    file = skeleton_file(path)
    return (read_skeleton(file) if file else {}) | ({} if up is None else {"up": up})


def read_skeleton(path: Path) -> dict[str, Any]:
    """Reads some fields of `Layout` from a skeleton file; a `UserError` names the file and the key."""
    data = read_yaml(path)
    allowed = _Fields.model_fields.keys()
    if not isinstance(data, dict) or not set(data) <= allowed:
        unknown = ", ".join(map(str, set(data) - allowed)) if isinstance(data, dict) else type(data).__name__
        raise UserError(f"{path}: unknown key {unknown}; use {', '.join(allowed)}")
    try:
        fields = _Fields.model_validate(data).model_dump(exclude_unset=True)
    except ValidationError as error:
        key = error.errors(include_url=False, include_input=False)[0]["loc"][0]
        raise UserError(
            f"{path}: {key}: {str(data[key])[:100]} is not valid. map is a mapping and joints a list of names, unit "
            f"(meters per unit) a number above 0, fps one from {RATES[0]:g} to {RATES[1]:g}, up one of "
            f"{', '.join(UP)}, mirrored and children true or false"
        ) from error
    if "map" in fields:
        if missing := sorted(set(SMPL22.joints) - set(fields["map"])):
            raise UserError(f"{path}: map: no joint given for {', '.join(missing)}")
        named = {name for source in fields["map"].values() for name in _shares(source)}
        if "joints" in fields and not named <= set(fields["joints"]):
            raise UserError(f"{path}: map: {', '.join(sorted(named - set(fields['joints'])))} is not among the joints")
    return fields
