"""Own data: a folder of motions in BVH, AMASS's or joint files, with captions beside them. `docs/own-data.md`."""

from __future__ import annotations

import csv
import json
import math
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
import yaml

from flame_mdm.data import Clip, MotionSource, Split, bandai, bvh, hashed_split
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import KIT21, SMPL22
from flame_mdm.representations.smpl import SMPL, read_pose

MOTIONS = (".bvh", ".npz", ".npy")
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
        unit: metres that a 1 in the files stands for.
        up: the axis that points up.
        mirrored: the files show the world in a mirror; x changes its sign.
        fps: frames a second, for files that do not tell.
    """

    map: Mapping[str, Place]
    joints: tuple[str, ...] = ()
    unit: float = 1.0
    up: str = "y"
    mirrored: bool = False
    fps: float | None = None

    def knows(self, names: Sequence[str]) -> bool:
        """Are all joints that it maps from among these?"""
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
    "Bandai-Namco": Layout({**bandai.JOINTS, "spine1": {"Hips": 0.6, "Spine": 0.4}}, unit=0.01),
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

TABLES = ("captions.csv", "captions.json")
COLUMNS = ("id", "text", "action", "split", "source")


@dataclass
class Note:
    """What is said about a motion."""

    texts: list[str] = field(default_factory=list)
    action: str | None = None
    split: Split | None = None
    source: str | None = None


class Folder(MotionSource):
    """Motions and captions in a folder, as joints of SMPL's 22 or as raw motions of the SMPL representation.

    Without a split of their own, 85 % of the sources are for training, 5 % for validation and 10 % for testing, drawn
    by their names.
    """

    name = "folder"

    def __init__(
        self,
        path: str,
        motion: Literal["joints", "smpl"] = "joints",
        mirror: bool = False,
        exclude: Sequence[str] = (),
    ):
        """Reads nothing yet.

        Args:
            path: the folder; motions may lie in folders below.
            motion: "joints" for representations of joint positions; "smpl" for those of SMPL's rotations, which only
                AMASS's files hold.
            mirror: yield a mirrored copy after each clip of the training split; joints only.
            exclude: motions to leave out, by their path in the folder without ending.

        Raises:
            ValueError: another `motion`, or mirrored SMPL rotations are wanted.
        """
        if motion not in ("joints", "smpl") or (mirror and motion == "smpl"):
            raise ValueError(f"data.source.motion={motion}, mirror={mirror}: give joints, or smpl with mirror=false")
        self.path, self.motion, self.mirror, self.exclude = Path(path), motion, mirror, tuple(exclude)

    def count(self) -> int:
        splits = Counter(self._split(name) for name in self.files)
        return sum(splits.values()) + (splits["train"] if self.mirror else 0)

    def excluded(self) -> dict[str, int]:
        return {"motions by data.source.exclude": len(self.exclude)} if self.exclude else {}

    def clips(self, fps: float) -> Iterator[Clip]:
        self.actions = tuple(sorted({note.action for note in self.notes.values() if note.action is not None}))
        self._upright: list[float] = []
        for name, path in self.files.items():
            note, split = self.notes[name], self._split(name)
            clip = Clip(
                name.replace("/", "_"),
                self._read(path, fps),
                note.texts,
                split,
                note.source or name,
                None if note.action is None else self.actions.index(note.action),
            )
            yield clip
            if self.mirror and split == "train":
                yield self._mirrored(clip, note)
        if self._upright and np.median(self._upright) < 0.3:
            raise ValueError(f"{self.path}: in most motions the body lies; say in skeleton.yaml which axis is `up`")

    @cached_property
    def files(self) -> dict[str, Path]:
        """Path in the folder without ending -> file, sorted.

        Raises:
            FileNotFoundError: no such folder, or no motion in it.
            ValueError: two motions of one name, or an unknown name in `exclude`.
        """
        found: dict[str, Path] = {}
        for path in sorted(self.path.rglob("*")) if self.path.is_dir() else ():
            if path.suffix.lower() in MOTIONS:
                name = path.relative_to(self.path).with_suffix("").as_posix()
                if name in found:
                    raise ValueError(f"{path}: there is {found[name].name}, too; each motion needs a name of its own")
                found[name] = path
        if not found:
            what = "no motion in it" if self.path.is_dir() else "no such folder"
            raise FileNotFoundError(f"{self.path}: {what}; give a folder of {', '.join(MOTIONS)} files")
        unknown = sorted(set(self.exclude) - set(found))
        if unknown:
            raise ValueError(f"data.source.exclude: {self.path} has no motion {', '.join(unknown)}")
        return {name: path for name, path in sorted(found.items()) if name not in self.exclude}

    @cached_property
    def notes(self) -> dict[str, Note]:
        """What tables and text files say about each motion.

        Raises:
            ValueError: a table that cannot be read, names a motion that is not there, or leaves one without a caption.
        """
        notes = {name: Note() for name in self.files}
        for table in TABLES:
            if (self.path / table).is_file():
                for where, row in (_csv_rows if table.endswith("csv") else _json_rows)(self.path / table):
                    _take(notes, self.exclude, where, row)
        for name, path in self.files.items():
            texts = path.with_suffix(".txt")
            if texts.is_file():
                lines = texts.read_text(encoding="utf-8").splitlines()
                notes[name].texts += [text for line in lines if (text := line.partition("#")[0].strip())]
        for kind, values in (("caption", "texts"), ("action", "action")):
            bare = [name for name, note in notes.items() if not getattr(note, values)]
            if 0 < len(bare) < len(notes):
                raise ValueError(
                    f"{self.path}: {len(bare)} of {len(notes)} motions have no {kind}, such as {bare[0]}; give all "
                    "of them one, or leave these out by data.source.exclude"
                )
        return notes

    @cached_property
    def skeleton(self) -> dict[str, Any]:
        """What `skeleton.yaml` in the folder says; nothing without one."""
        path = self.path / "skeleton.yaml"
        return read_skeleton(path) if path.is_file() else {}

    def _split(self, name: str) -> Split:
        note = self.notes[name]
        return note.split or hashed_split(note.source or name, val=5, test=10)

    def _read(self, path: Path, fps: float) -> np.ndarray:
        if path.suffix.lower() == ".bvh":
            return self._checked(path, read_bvh(path, fps, self.skeleton)[0])
        data = _arrays(path)
        if "poses" in data:
            return self._from_smpl(path, data, fps)
        rate = float(data["fps"] if "fps" in data else self.skeleton.get("fps", 0))
        if not rate > 0:
            raise ValueError(f"{path}: it does not tell its frame rate; write `fps: 30` (or yours) into skeleton.yaml")
        joints = data["joints"].astype(float)
        if joints.ndim != 3 or joints.shape[2] != 3 or not len(joints):
            raise ValueError(f"{path}: joints of shape {joints.shape}, not (frames, joints, 3)")
        return self._joints(path, resample(joints, rate, fps), self._names(path, joints.shape[1]))

    def _names(self, path: Path, joints: int) -> tuple[str, ...]:
        """Names of the joints of an array, told by their number where `skeleton.yaml` does not tell."""
        given = self.skeleton.get("joints")
        if given:
            if len(given) != joints:
                raise ValueError(f"{path}: {joints} joints, but skeleton.yaml names {len(given)}")
            return tuple(given)
        if joints == len(KIT21):
            return KIT21.joints
        if joints < len(SMPL22):
            raise ValueError(
                f"{path}: {joints} joints of unknown names; write their names and a map into skeleton.yaml"
            )
        if joints not in (22, 24, 52):
            raise ValueError(f"{path}: {joints} joints, not the 22, 24 or 52 of SMPL; write a skeleton.yaml")
        return (*SMPL22.joints, *(f"joint{number}" for number in range(len(SMPL22), joints)))

    def _joints(self, path: Path, positions: np.ndarray, names: Sequence[str]) -> np.ndarray:
        return self._checked(path, _layout(path, names, self.skeleton).apply(positions, names))

    def _checked(self, path: Path, joints: np.ndarray) -> np.ndarray:
        if self.motion == "smpl":
            raise ValueError(f"{path}: it holds no rotations of SMPL; AMASS's .npz files do, or take motion=joints")
        _check_body(path, joints)
        trunk = joints[:, SMPL22.joints.index("neck")] - joints[:, 0]
        self._upright.append(float((trunk[:, 1] / np.linalg.norm(trunk, axis=1)).mean()))
        return joints

    def _from_smpl(self, path: Path, data: Mapping[str, np.ndarray], fps: float) -> np.ndarray:
        rate = next((float(data[key]) for key in ("mocap_framerate", "mocap_frame_rate", "fps") if key in data), 0.0)
        if "trans" not in data or not rate > 0 or data["trans"].shape != (len(data["poses"]), 3):
            raise ValueError(f"{path}: AMASS's files hold poses (F, 3 K), trans (F, 3) and mocap_framerate")
        poses = data["poses"].reshape(len(data["poses"]), -1)
        try:
            translation, rotations = read_pose(torch.from_numpy(np.concatenate([data["trans"], poses], 1)))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        before, after, share = _between(len(poses), rate, fps)
        quaternions = rotation.matrix_to_quaternion(rotations)
        turned = rotation.slerp(quaternions[before], quaternions[after], torch.from_numpy(share)[:, None, None])
        moved = resample(translation.numpy(), rate, fps)
        angles = rotation.quaternion_to_axis_angle(turned).flatten(1).numpy()
        motion = np.concatenate([moved, angles], 1).astype(np.float32)
        if self.motion == "smpl":
            return motion
        representation = SMPL()
        joints = representation.decode(representation.encode(torch.from_numpy(motion)))
        return joints[:, : len(SMPL22)].numpy()

    def _mirrored(self, clip: Clip, note: Note) -> Clip:
        action = clip.action
        if note.action is not None and _swapped(note.action) in self.actions:
            action = self.actions.index(_swapped(note.action))
        motion = SMPL22.mirror(torch.from_numpy(clip.motion)).numpy()
        return Clip(f"M{clip.id}", motion, [_swapped(text) for text in clip.captions], clip.split, clip.source, action)


def read_bvh(path: Path, fps: float | None = None, given: Mapping[str, Any] = {}) -> tuple[np.ndarray, float]:
    """The joints of SMPL in a BVH file of a known skeleton.

    Args:
        path: the file.
        fps: frames a second wanted; None = those of the file. Rotations are interpolated, so bones keep their length.
        given: fields of `Layout` in place of the known ones. Joints with SMPL's own names are in centimetres, as
            `flame_mdm.formats` writes them.

    Returns:
        (F, 22, 3) float32 in metres, y up; frames a second.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: damaged, or an unknown skeleton.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    file = bvh.read(path)
    names = [name.rpartition(":")[2] for name in file.joints]
    layout = _layout(path, names, given)
    if layout.map is LAYOUTS["SMPL"].map and "unit" not in given:
        layout = replace(layout, unit=0.01)
    if fps is None:
        return layout.apply(file.positions(), names), file.fps
    return layout.apply(bvh.forward_kinematics(file.parents, *file.resample(fps))[0], names), fps


def _layout(path: Path, names: Sequence[str], given: Mapping[str, Any]) -> Layout:
    """The layout of joints with these names: a known one, with the fields that are given in place of its own."""
    known = (layout for layout in LAYOUTS.values() if layout.knows(names))
    layout = Layout(given["map"]) if "map" in given else next(known, None)
    if layout is None or not layout.knows(names):
        which = "not those of the map" if "map" in given else f"those of none of the skeletons {', '.join(LAYOUTS)}"
        raise ValueError(
            f"{path}: its joints ({', '.join(names)}) are {which}; rename them, or in a folder of own data write into "
            "skeleton.yaml which of them stands for which of SMPL's"
        )
    return replace(layout, **given)


def read_skeleton(path: Path) -> dict[str, Any]:
    """The fields of `Layout` that a skeleton file gives; the others are those of a known skeleton.

    Raises:
        ValueError: it cannot be read, or misnames something; the message names the file and the key.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{path}: not read as YAML: {' '.join(str(error).split())}") from error
    allowed = tuple(Layout.__dataclass_fields__)
    if not isinstance(data, dict) or not set(data) <= set(allowed):
        unknown = ", ".join(map(str, set(data) - set(allowed))) if isinstance(data, dict) else type(data).__name__
        raise ValueError(f"{path}: unknown key {unknown}; there are {', '.join(allowed)}")
    kinds = {"map": dict, "joints": list, "unit": (int, float), "up": str, "mirrored": bool, "fps": (int, float)}
    for key, value in data.items():
        fits = isinstance(value, kinds[key]) and (key == "mirrored" or not isinstance(value, bool))
        if not fits or (key in ("unit", "fps") and not 0 < value < math.inf) or (key == "up" and value not in UP):
            raise ValueError(
                f"{path}: {key}: {value} does not do; map and joints are a map and a list, unit (metres in a 1) and "
                f"fps numbers above 0, up one of {', '.join(UP)}, mirrored true or false"
            )
    if "map" in data:
        missing = sorted(set(SMPL22.joints) - set(data["map"]))
        if missing:
            raise ValueError(f"{path}: map: which joint stands for {', '.join(missing)}?")
        named = {name for place in data["map"].values() for name in _shares(place)}
        if "joints" in data and not named <= set(data["joints"]):
            raise ValueError(f"{path}: map: {', '.join(sorted(named - set(data['joints'])))} is not among the joints")
    return data


def resample(values: np.ndarray, rate: float, fps: float) -> np.ndarray:
    """(F, ...) at `rate` frames a second -> at times 0, 1 / fps, ... up to the last frame, by straight lines."""
    before, after, share = _between(len(values), rate, fps)
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    return (1 - share) * values[before] + share * values[after]


def _between(frames: int, rate: float, fps: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames before and after each new one, and how far it is from the one to the other, 0 to 1."""
    times = np.arange(math.floor((frames - 1) * fps / rate + 1e-6) + 1) * rate / fps
    before = np.minimum(times.astype(int), frames - 1)
    return before, np.minimum(before + 1, frames - 1), times - before


def _check_body(path: Path, joints: np.ndarray) -> None:
    """Wrong units and sides show in the length of a leg and in where the toes point."""
    at = {name: joints[:, number] for number, name in enumerate(SMPL22.joints)}
    if not np.isfinite(joints).all():
        raise ValueError(f"{path}: numbers in frame {int(np.argmin(np.isfinite(joints).all((1, 2))))} are not finite")
    bones = at["left_hip"] - at["left_knee"], at["left_knee"] - at["left_ankle"]
    leg = sum(float(np.linalg.norm(bone, axis=1).mean()) for bone in bones)
    if not 0.3 < leg < 1.5:
        raise ValueError(f"{path}: a leg of {leg:.3g} m; say in skeleton.yaml how many metres a unit of the file is")
    across, trunk = at["left_hip"] - at["right_hip"], at["neck"] - at["pelvis"]
    toes = at["left_foot"] + at["right_foot"] - at["left_ankle"] - at["right_ankle"]
    if np.median((np.cross(across, trunk) * toes).sum(1)) < 0:
        raise ValueError(
            f"{path}: the toes point backwards: left and right are swapped, or the axes are mirrored (mirrored: true "
            "in skeleton.yaml)"
        )


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """Arrays of a .npz file, or the one of a .npy file under the name joints."""
    try:
        with path.open("rb") as file:
            loaded = np.load(file, allow_pickle=False)
            data = {"joints": loaded} if isinstance(loaded, np.ndarray) else {key: loaded[key] for key in loaded.files}
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: damaged, or not a file of plain arrays: {error}") from error
    if not {"joints", "poses"} & set(data):
        raise ValueError(f"{path}: it holds {', '.join(data)}; a motion is joints, or poses, trans and mocap_framerate")
    for name in {"joints", "poses", "trans"} & set(data):
        if data[name].dtype.kind not in "fiu":
            raise ValueError(f"{path}: {name} are no real numbers")
        if not data[name].ndim or not len(data[name]):
            raise ValueError(f"{path}: {name} of shape {data[name].shape} have no frames")
        if (beyond := ~(np.abs(data[name]) < 1e6)).any():
            raise ValueError(
                f"{path}: numbers in frame {np.argwhere(beyond)[0][0]} are not finite, or beyond a million"
            )
    for name in {"fps", "mocap_framerate", "mocap_frame_rate"} & set(data):
        if data[name].shape or data[name].dtype.kind not in "fiu":
            raise ValueError(f"{path}: {name} is not one number")
    return data


def _csv_rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        reader = csv.DictReader(file, strict=True)
        unknown = set(reader.fieldnames or ()) - set(COLUMNS)
        if len(set(reader.fieldnames or ())) < len(reader.fieldnames or ()):
            raise ValueError(f"{path}: a column stands in it twice: {', '.join(reader.fieldnames or ())}")
        if unknown or "id" not in (reader.fieldnames or ()):
            raise ValueError(f"{path}: its columns are {reader.fieldnames}; there are {', '.join(COLUMNS)}, id needed")
        try:
            for row in reader:
                if None in row or None in row.values():
                    raise ValueError(
                        f"{path}, line {reader.line_num}: not as many cells as columns; quote texts with ,"
                    )
                yield f"{path}, line {reader.line_num}", {key: cell.strip() for key, cell in row.items()}
        except csv.Error as error:
            raise ValueError(f"{path}, line {reader.line_num}: {error}") from error


def _json_rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not read as JSON: {error}") from error
    if not isinstance(data, dict) or not all(isinstance(value, dict) for value in data.values()):
        raise ValueError(f'{path}: write {{"id": {{"text": ["...", "..."], "action": "..."}}, ...}}')
    for name, value in data.items():
        unknown = set(value) - set(COLUMNS[1:])
        if unknown:
            raise ValueError(
                f"{path}: {name}: unknown key {', '.join(sorted(unknown))}; there are {', '.join(COLUMNS[1:])}"
            )
        yield f"{path}: {name}", {"id": name, **value}


def _take(notes: dict[str, Note], exclude: Sequence[str], where: str, row: Mapping[str, Any]) -> None:
    """Adds what a row of a table says."""
    if row["id"] in exclude:
        return
    if row["id"] not in notes:
        raise ValueError(f"{where}: there is no motion {row['id']!r}; ids are paths in the folder without ending")
    note = notes[row["id"]]
    texts = row.get("text") or []
    if not isinstance(texts, str | list) or not all(isinstance(text, str) for text in texts):
        raise ValueError(f"{where}: text is {texts!r}, not a text or a list of texts")
    note.texts += [texts] if isinstance(texts, str) else texts
    for key in ("action", "split", "source"):
        value = row.get(key)
        if value:
            if getattr(note, key) not in (None, value):
                raise ValueError(f"{where}: {row['id']} has the {key} {getattr(note, key)} and {value}")
            setattr(note, key, str(value))
    if note.split not in (None, *get_args(Split)):
        raise ValueError(f"{where}: the split {note.split!r} is none of {', '.join(get_args(Split))}")


def _swapped(text: str) -> str:
    """Left for right and clockwise for counterclockwise, and the other way around."""
    pairs = {"left": "right", "right": "left", "clockwise": "counterclockwise"}
    pairs |= {"counterclockwise": "clockwise", "anticlockwise": "clockwise"}

    def swap(match: re.Match[str]) -> str:
        word = pairs[match[0].lower()]
        return word.capitalize() if match[0][0].isupper() else word

    return re.sub(rf"(?<![a-z])({'|'.join(pairs)})(?![a-z])", swap, text, flags=re.IGNORECASE)
