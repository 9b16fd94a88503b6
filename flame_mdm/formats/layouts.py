"""Skeletons in motion files, their maps to SMPL's joints, and checks of the body size."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PrivateAttr, ValidationError

from flame_mdm.errors import UserError
from flame_mdm.formats import asf, bvh
from flame_mdm.formats.names import Match, best_match, spelled
from flame_mdm.formats.resampling import RATES
from flame_mdm.formats.retarget import joint_names, presets
from flame_mdm.representations.skeleton import SKELETONS, SMPL22
from flame_mdm.safe_io import read_package_yaml, read_yaml, regular_file

# For each possible up axis, the rows of the rotation that maps it to +y
UP = {
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}
# Minimum, maximum and usual length of an adult's leg in meters, from hip to knee to ankle
LEG, USUAL_LEG = (
    (0.6, 1.2),
    0.83,
)
# Minimum leg length of a child in meters, at the age of about one year
CHILD = 0.25
# Minimum length of a foot in meters, from ankle to toes
FOOT = 0.02
# The joints are not in the assumed order if the lengths of left and right limbs differ by more than
# this ratio
UNEQUAL = 1.5
# The order is also wrong if the length of a limb varies by more than this fraction of its mean
CHANGING = 0.25
LIMBS = (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
# Prefixes of SMPL's joints
SIDES = ("left_", "right_")
UNITS = {  # in meters
    "meters": 1.0,
    "centimeters": 0.01,
    "millimeters": 0.001,
    "inches": 0.0254,
    "feet": 0.3048,
    "the unit of CMU's recordings": 0.0564444,
}

# A joint in the file, or several joints with the weights of their mean
Source = str | Annotated[dict[str, FiniteFloat], Field(min_length=1)]


class Layout(BaseModel):
    """A map from the joints in files to SMPL's 22 joints, whose positions are in meters, with y up.

    The fields are the keys of `skeleton.yaml`.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)
    # For each SMPL joint, the name of its joint in the files
    map: dict[str, Source] = {joint: joint for joint in SMPL22.joints}
    # Names of the joints in arrays, in order. BVH files contain the names of their joints.
    joints: list[str] = []
    # Meters per unit of length in the files
    unit: Annotated[FiniteFloat, Field(gt=0)] = 1.0
    # The up axis
    up: Literal["y", "z", "-y"] = "y"
    # Frame rate of files that contain none
    fps: Annotated[float, Field(ge=RATES[0], le=RATES[1])] | None = None
    # Whether the files contain mirrored motion, in which case the sign of x is changed
    mirrored: bool = False
    # Whether the people in the files may be children
    children: bool = False
    _name: str = PrivateAttr("own map")
    _bones: dict[str, str] = PrivateAttr(default_factory=dict)
    _rig: str = PrivateAttr("")

    @property
    def used(self) -> set[str]:
        """The names of the joints that the map uses, as spelled in the files."""
        return {name for source in self.map.values() for name in _shares(source)}

    @property
    def name(self) -> str:
        """The name of a supported layout, or "own map"."""
        return self._name

    @property
    def bones(self) -> Mapping[str, str]:
        """For each SMPL joint, the name (in the files) of the bone whose rotation it follows.

        The joint's position, in contrast, may be the mean position of several joints.
        """
        return self._bones

    @property
    def rig(self) -> str:
        """The name of the `rigs.yaml` skeleton that has the same joints, or "" if there is none."""
        return self._rig

    def bone(self, joint: str) -> str:
        """Returns the name (in the files) of the joint that turns in the same way as an SMPL joint.

        This is the SMPL joint's bone. If the SMPL joint has no bone, its position is a weighted
        mean of joints in the files, and the joint with the largest weight is returned.
        """
        shares = _shares(self.map[joint])
        return self.bones.get(joint) or max(shares, key=lambda name: shares[name])

    def named(self, name: str, map: Mapping[str, Source]) -> Layout:
        """Returns a copy of the layout with the given map and the name of a supported layout."""
        layout = self.model_copy(update={"map": dict(map)})
        layout._name = name
        return layout

    def ending(self, **ends: str) -> dict[str, Source]:
        """Returns a map in which some SMPL joints are the end sites of their parents.

        Each keyword argument consists of such a joint and its parent, for example foot="ankle".
        """
        return {
            side + joint: f"{self.map[side + parent]}.end"
            for joint, parent in ends.items()
            for side in SIDES
        }

    def pairs(self) -> dict[str, str]:
        """Returns each joint that the map uses, with its counterpart on the other side of the body.

        A joint without a counterpart is its own counterpart.
        """
        pairs: dict[str, str] = {}
        for joint, source in self.map.items():
            other = self.map[opposite(joint)]
            shares, others = list(_shares(source)), list(_shares(other))
            pairs |= dict(
                zip(shares, others if len(others) == len(shares) else shares, strict=True)
            )
        return pairs

    def apply(self, positions: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Maps joints (F, J, 3) with the given names to SMPL's joints (F, 22, 3).

        The result is float32, in meters, with y up.
        """
        weights = np.zeros((len(SMPL22), len(names)))
        for row, joint in zip(weights, SMPL22.joints, strict=True):
            for name, share in _shares(self.map[joint]).items():
                row[names.index(name)] = share
        return self.turn(weights @ positions).astype(np.float32)

    def turn(self, positions: np.ndarray) -> np.ndarray:
        """Converts positions (F, J, 3) to meters, with y up."""
        return (
            self.unit
            * positions
            @ np.array(UP[self.up], float).T
            * [-1 if self.mirrored else 1, 1, 1]
        )


def opposite(joint: str) -> str:
    """Returns the SMPL joint on the other side, or the joint itself if it has no counterpart."""
    for side, other in (SIDES, SIDES[::-1]):
        if joint.startswith(side):
            return other + joint.removeprefix(side)
    return joint


def _shares(source: Source) -> Mapping[str, float]:
    return {source: 1.0} if isinstance(source, str) else source


def _layout(
    joints: str | Sequence[str] = (), rig: str = "", map: Mapping = {}, **fields: Any
) -> Layout:
    """Returns a layout from `layouts.yaml`. The comments in that file describe the arguments."""
    parts = {key: fields.pop(key) for key in ("sides", "trunk", "arm", "leg") if key in fields}
    skeleton = presets()[rig] if rig else parts
    bones = joint_names(skeleton) if skeleton else {joint: joint for joint in SMPL22.joints}
    sources: dict[str, Source] = dict(bones)
    for joint, shares in map.items():
        sides = (
            [("", "")]
            if joint in SMPL22.joints
            else zip(("left_", "right_"), skeleton["sides"], strict=True)
        )
        for side, mark in sides:
            sources[side + joint] = {
                name.replace("*", mark): share for name, share in shares.items()
            }
    names = SKELETONS[joints].joints if isinstance(joints, str) else joints
    layout = Layout(
        map={joint: sources[joint] for joint in SMPL22.joints}, joints=list(names), **fields
    )
    layout._bones, layout._rig = bones, rig
    return layout


LAYOUTS: dict[str, Layout] = {
    name: _layout(**fields)
    for name, fields in read_package_yaml(Path(__file__).with_name("layouts.yaml")).items()
}
"""Known skeletons, recognized by the names of their joints."""


@cache
def _variants() -> dict[str, Layout]:
    """Returns the supported layouts and their variants that use end sites, keyed by name."""
    variants = {name: layout.named(name, layout.map) for name, layout in LAYOUTS.items()}
    toes, hands = {"foot": "ankle"}, {"wrist": "elbow"}
    for parts, ends in (("toes", toes), ("hands", hands), ("toes and hands", toes | hands)):
        for name, layout in LAYOUTS.items():
            label = f"{name} without {parts}"
            variants[label] = layout.named(label, layout.map | layout.ending(**ends))
    return variants


@cache
def _spelled() -> dict[str, dict[str, str]]:
    """Returns the spellings of the joint names for each of `_variants`.

    For each layout, the result contains a mapping from spellings to names.
    """
    return {name: spelled(layout.pairs()) for name, layout in _variants().items()}


@lru_cache(64)
def _nearest(names: tuple[str, ...]) -> Match:
    """Returns the supported layout that fits the names best."""
    return best_match(names, _spelled())


def read_tree(path: Path, rate: float | None = None) -> bvh.Bvh:
    """Reads a BVH or AMC file. `rate` overrides the frame rate of the file."""
    if path.suffix.lower() == ".amc":
        return asf.read(path, rate)
    file = bvh.read(path)
    return file if rate is None else replace(file, fps=rate)


def tree_layout(file: bvh.Bvh, fields: Mapping[str, Any]) -> tuple[Layout, Sequence[str]]:
    """Returns the layout and joint names of a file that was read with `read_tree`.

    `fields` override the fields of the supported layout. The file is assumed to be in centimeters,
    like the BVH files written by `flame_mdm.formats`, unless the layout specifies a unit or
    `fields` contain a map.
    """
    layout = find_layout(file.joints, fields)
    if "map" not in fields and "unit" not in layout.model_fields_set:
        layout = layout.model_copy(update={"unit": 0.01})
    return layout, file.joints


def array_layout(joints: np.ndarray, fields: Mapping[str, Any]) -> tuple[Layout, Sequence[str]]:
    """Returns the layout and joint names of an array (F, J, 3).

    The layout and the names are taken from `fields` or determined by the number of joints.
    """
    if joints.ndim != 3 or joints.shape[2] != 3 or not len(joints):
        raise UserError(f"joints have shape {joints.shape}, not (frames, joints, 3)")
    count = joints.shape[1]
    names: Sequence[str] = fields.get("joints", ())
    if not names and count in (22, 24, 52):
        names = (*SMPL22.joints, *(f"joint{number}" for number in range(len(SMPL22), count)))
    elif not names:
        names = next(
            (layout.joints for layout in LAYOUTS.values() if count == len(layout.joints)), ()
        )
    if len(names) != count:
        rest = (
            f"but skeleton.yaml lists {len(names)}"
            if names
            else "but SMPL has 22, 24 or 52, and SOMA has 30 or 77"
        )
        raise UserError(
            f"the array has {count} joints, {rest}. Add the names of all joints and a map to "
            "skeleton.yaml"
        )
    return find_layout(names, fields), names


def layout_name(layout: Layout) -> str:
    """Returns the name of a supported layout, or "own map"."""
    return layout.name


def find_layout(names: Sequence[str], fields: Mapping[str, Any]) -> Layout:
    """Returns the supported layout for joints with these names, modified by `fields`.

    The layout's map uses the given `names`, which are matched as in `flame_mdm.formats.names`.

    Raises:
        UserError: If no layout fits, or if a name could refer to several joints.
    """
    joints, mapped = ", ".join(names)[:1000], "map" in fields
    advice = (
        f"In skeleton.yaml (docs/own-data.md), map SMPL's joints to the file's joints: {joints}"
    )
    if mapped:
        layout = Layout(map=fields["map"])
        match = best_match(names, {"": spelled(layout.pairs())})
    else:
        match = _nearest(tuple(names))
        layout = _variants()[match.skeleton]
    if match.missing:
        lacking = ", ".join(sorted(match.missing))[:500]
        reason = f"unknown skeleton. {match.skeleton} is the nearest known one; missing: {lacking}"
        if mapped:
            reason = f"the map in skeleton.yaml uses joints that the file lacks: {lacking}"
        raise UserError(f"{reason}. {advice}")
    chosen = {
        name: _one(name, [names[number] for number in numbers])
        for name, numbers in match.numbers.items()
    }
    map = {joint: _renamed(source, chosen) for joint, source in layout.map.items()}
    renamed = {joint: chosen.get(name, name) for joint, name in layout.bones.items()}
    layout = layout.named(layout.name, map).model_copy(update={**fields, "map": map})
    layout._bones = {joint: name for joint, name in renamed.items() if name in names}
    return layout


def _one(name: str, candidates: Sequence[str]) -> str:
    """Returns the joint that the given name refers to in a file.

    If several joints match, the joint with exactly this name is returned.
    """
    if len(set(candidates)) == 1 or name in candidates:
        return name if name in candidates else candidates[0]
    listed = " or ".join(dict.fromkeys(candidates))[:500]
    raise UserError(
        f"{name} could refer to {listed}. Remove one from the file, or map SMPL's joints in skeleton.yaml"
    )


def _renamed(source: Source, names: Mapping[str, str]) -> Source:
    if isinstance(source, str):
        return names[source]
    return {names[name]: share for name, share in source.items()}


def skeleton_file(path: Path) -> Path | None:
    """Returns the nearest `skeleton.yaml` in a file's folder or its parent folders.

    Raises `UserError` if this `skeleton.yaml` is not a regular file.
    """
    for folder in path.absolute().parents:
        if os.path.lexists(folder / "skeleton.yaml"):
            regular_file(folder / "skeleton.yaml")
            return folder / "skeleton.yaml"
    return None


def find_skeleton(path: Path, up: str | None = None) -> dict[str, Any]:
    """Returns the fields of `Layout` that a file's `skeleton_file` contains.

    `up` (y, z or -y) overrides the up axis.
    """
    if up is not None and up not in UP:
        raise UserError(f"up={up}: the axis that points up must be one of {', '.join(UP)}")
    file = skeleton_file(path)
    return (read_skeleton(file) if file else {}) | ({} if up is None else {"up": up})


def read_skeleton(path: Path) -> dict[str, Any]:
    """Reads fields of `Layout` from a skeleton file.

    If a field is invalid, raises a `UserError` that names the file and the key.
    """
    try:
        fields = Layout.model_validate(read_yaml(path)).model_dump(exclude_unset=True)
    except ValidationError as error:
        first, keys = (
            error.errors(include_url=False, include_input=False)[0],
            ", ".join(Layout.model_fields),
        )
        where = ".".join(map(str, first["loc"]))[:100]
        raise UserError(
            f"{path}: {where}: {first['msg']}. Valid keys: {keys} (see docs/own-data.md)"
        ) from error
    if missing := sorted(set(SMPL22.joints) - set(fields.get("map", SMPL22.joints))):
        raise UserError(f"{path}: the map has no joint for {', '.join(missing)}")
    return fields


def leg_length(joints: np.ndarray) -> float:
    """Returns the mean length, in meters, of the left leg from hip to knee to ankle.

    `joints` (F, 22, 3) are the positions of SMPL's joints.
    """
    return _bone(joints, "left_hip", "left_knee") + _bone(joints, "left_knee", "left_ankle")


def head_height(joints: np.ndarray) -> float:
    """Returns the median height of the head joint above each frame's lowest joint, in meters."""
    return float(np.median(joints[:, SMPL22.joints.index("head"), 1] - joints[..., 1].min(1)))


def check_size(joints: np.ndarray, unit: float, children: bool = False, doubt: str = "") -> None:
    """Checks the length of the legs.

    Args:
        joints: (F, 22, 3), positions of SMPL's joints in meters.
        unit: meters per unit of length in the file.
        children: whether the person may be a child.
        doubt: a line about another problem with the motion, which is added to the error message.

    Raises:
        UserError: If the length of the legs is implausible for a person. The message suggests a
            unit.
    """
    leg, shortest = leg_length(joints), CHILD if children else LEG[0]
    if shortest <= leg <= LEG[1]:
        return
    fitting = {name: u for name, u in UNITS.items() if LEG[0] <= leg / unit * u <= LEG[1]}
    name = min(
        fitting,
        key=lambda name: abs(math.log(leg / unit * fitting[name] / USUAL_LEG)),
        default=None,
    )
    advice = f"The unit may be {fitting[name]:.6g} ({name})" if name else _usual_unit(leg, unit)
    also = f". Also, {doubt}" if doubt else ""
    small = (
        " If these are children, set `children: true`."
        if not children and CHILD <= leg < LEG[0]
        else ""
    )
    raise UserError(
        f"the legs are {leg:.3g} m long (unit {unit:.6g}), but human legs are {shortest:g} to {LEG[1]:g} m long."
        f"{small} {advice}. Set `unit` in skeleton.yaml, or unit=... in convert and edit{also}"
    )


def _usual_unit(leg: float, unit: float) -> str:
    """Returns advice for a file whose leg length is implausible in all common units.

    `leg` is the length in meters that results from `unit`.
    """
    usual = unit * USUAL_LEG / leg if leg > 0 else 0.0
    if not 0 < usual < math.inf:
        return "The unit is wrong"
    return f"No common unit fits the file; with {usual:.3g}, the legs have the usual length of {USUAL_LEG:g} m"


# Left and right count as swapped if the toes of both feet point backwards in more than this
# fraction of the frames
BACKWARDS = 0.25


def check_feet(joints: np.ndarray) -> None:
    """Checks the feet of a body with SMPL's joints (F, 22, 3).

    Raises:
        UserError: If a foot has no length, or if the toes point backward.
    """
    at = {name: joints[:, number] for number, name in enumerate(SMPL22.joints)}
    for side in ("left", "right"):
        if _bone(joints, f"{side}_ankle", f"{side}_foot") < FOOT:
            advice = "to the toes, or to the end site of the ankle, such as LeftAnkle.end"
            raise UserError(
                f"the {side} foot has no length. Map {side}_foot in skeleton.yaml {advice}"
            )
    # Only the lower foot of each frame counts, because the toes of a foot in the air may point
    # backwards, for example in a run. One foot of a kneeling person may also point backwards, so
    # left and right count as swapped only if both feet do so in enough frames.
    across, trunk = at["left_hip"] - at["right_hip"], at["neck"] - at["pelvis"]
    depths = [
        ((at[f"{side}_hip"] - at[f"{side}_ankle"]) * trunk).sum(1) for side in ("left", "right")
    ]
    left, right = (at[f"{side}_foot"] - at[f"{side}_ankle"] for side in ("left", "right"))
    ahead = np.cross(across, trunk)
    forward = np.stack([(ahead * foot).sum(1) for foot in (left, right)])
    lower = np.where(depths[0] > depths[1], *forward)
    if np.median(lower) < 0 and np.mean(forward.max(0) < 0) > BACKWARDS:
        raise UserError(
            "the toes point backwards. Swap left and right in skeleton.yaml, or set `mirrored: true`"
        )


def check_order(joints: np.ndarray, count: int, skeleton: str) -> None:
    """Checks that an array does not belong to another skeleton with the same number of joints.

    A person's limbs have the same length on both sides, and their lengths do not change. If the
    joint order or the skeleton is wrong, the compared pairs of joints are not limbs.

    Args:
        joints: (F, 22, 3), positions of SMPL's joints, on the assumption that the array contains
            the joints of the skeleton.
        count: number of joints in the array.
        skeleton: name of the skeleton.

    Raises:
        UserError: If limbs differ in length between the sides, or if the length of a limb changes.
    """
    lengths = np.stack(
        [_lengths(joints, side + start, side + end) for side in SIDES for start, end in LIMBS], 1
    )
    usual = np.maximum(lengths.mean(0), 1e-9)
    unequal = np.abs(np.log(usual[:4] / usual[4:])).mean() > math.log(UNEQUAL)
    changing = (lengths.std(0) / usual).mean() > CHANGING
    if unequal or changing:
        fault = "left and right limbs differ in length" if unequal else "the limbs change in length"
        raise UserError(
            f"the array has {count} joints like {skeleton}, but not in the same order: {fault}. "
            "Add the names of all joints and a map to skeleton.yaml"
        )


def _bone(joints: np.ndarray, start: str, end: str) -> float:
    return float(_lengths(joints, start, end).mean())


def _lengths(joints: np.ndarray, start: str, end: str) -> np.ndarray:
    """Returns the distances (F,) between two of SMPL's joints."""
    first, last = (joints[:, SMPL22.joints.index(name)].astype(float) for name in (start, end))
    return np.linalg.norm(first - last, axis=1)
