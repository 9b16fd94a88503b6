"""Own data: a folder of motions (BVH, AMASS or joint files) with captions, described in `docs/own-data.md`."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch

from flame_mdm.data import Clip, MotionSource, Split, hashed_split
from flame_mdm.errors import UserError, printable
from flame_mdm.files import read_json, read_text, regular_file
from flame_mdm.formats.body import check_feet, check_size, head_height, leg_length
from flame_mdm.formats.files import read_arrays, smpl_motion
from flame_mdm.formats.layouts import Layout, array_layout, layout_name, read_bvh, read_skeleton, skeleton_file
from flame_mdm.formats.resampling import resample
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.representations.smpl import SMPL

MOTIONS = (".bvh", ".npz", ".npy", ".json")
FORBIDDEN_CHARACTERS = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
"""Characters not allowed in the name of a motion: names are stored as text, one clip per line."""
SPLITTABLE = 10
"""Number of motions from which on each split has at least one."""
TABLES = ("captions.csv", "captions.json")
COLUMNS = ("id", "text", "action", "split", "source")


@dataclass
class Note:
    """Captions and labels of a motion."""

    texts: list[str] = field(default_factory=list)
    action: str | None = None
    split: Split | None = None
    source: str | None = None


class Folder(MotionSource):
    """Motions and captions in a folder, as SMPL's 22 joints or as raw motions of the SMPL representation.

    If the tables give no split, 85 % of the sources are used for training, 5 % for validation and 10 % for testing,
    selected by a hash of their names.
    """

    name = "folder"
    named_by_recipe = True

    def __init__(
        self,
        path: str,
        motion: Literal["joints", "smpl"] = "joints",
        mirror: bool = False,
        exclude: Sequence[str] = (),
    ):
        """Stores the arguments; reads no files.

        Args:
            path: the folder; motions may be in subfolders.
            motion: "joints" for representations of joint positions; "smpl" for those of SMPL's rotations, which only
                AMASS files contain.
            mirror: yield a mirrored copy after each clip of the training split; joints only.
            exclude: motions to leave out, by their path in the folder without extension.

        Raises:
            ValueError: `motion` has another value, or `mirror` is combined with SMPL rotations.
        """
        if motion not in ("joints", "smpl") or (mirror and motion == "smpl"):
            raise ValueError(f"data.source.motion={motion}, mirror={mirror}: give joints, or smpl with mirror=false")
        self.path, self.motion, self.mirror, self.exclude = Path(path), motion, mirror, tuple(exclude)
        self._skeletons: dict[Path, dict[str, Any]] = {}
        self._sizes: dict[str, list[tuple[float, float, float]]] = {}

    def count(self) -> int:
        splits = Counter(self.splits.values())
        return sum(splits.values()) + (splits["train"] if self.mirror else 0)

    def excluded(self) -> dict[str, int]:
        return {"motions by data.source.exclude": len(self.exclude)} if self.exclude else {}

    def clips(self, fps: float) -> Iterator[Clip]:
        self.actions = tuple(sorted({note.action for note in self.notes.values() if note.action is not None}))
        self._sizes: dict[str, list[tuple[float, float, float]]] = {}
        for name, path in self.files.items():
            note, split = self.notes[name], self.splits[name]
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
        self._check_upright()

    def findings(self) -> list[str]:
        """Returns the skeletons found so far, with the range of their sizes."""
        lines = []
        for skeleton, sizes in self._sizes.items():
            legs, heads = (sorted({f"{size[k]:.2f}" for size in sizes}) for k in (0, 1))
            legs, heads = (" to ".join(dict.fromkeys((values[0], values[-1]))) for values in (legs, heads))
            many = f"{len(sizes)} motion" + "s" * (len(sizes) > 1)
            lines.append(f"{skeleton}: {many}, legs {legs} m, head joint at {heads} m")
        return lines

    def check(self) -> list[str]:
        """Reads all motions and captions; returns a line per skeleton and per failure."""
        self._sizes, failed = {}, {}
        for name, path in self.files.items():
            try:
                self._read(path, 20.0)
            except (ValueError, UserError) as error:
                failed.setdefault(str(error).replace(str(path), ""), []).append(name)
        lines = self.findings()
        for error, names in failed.items():
            more = f" and {len(names) - 1} more" * (len(names) > 1)
            lines.append(f"error: {self.files[names[0]]}{more}{error}")
        try:
            self._check_upright()
            counts = Counter(self.splits.values())
            splits = ", ".join(f"{counts[split]} {split}" for split in get_args(Split))
        except (ValueError, UserError) as error:
            return [*lines, f"error: {error}"]
        if failed:
            count = sum(map(len, failed.values()))
            return [*lines, f"error: {count} of {len(self.files)} motions of {self.path} cannot be prepared"]
        return [*lines, f"{self.name}: {self.count()} clips can be prepared (motions: {splits})"]

    def _check_upright(self) -> None:
        for skeleton, sizes in self._sizes.items():
            if np.median([upright for _, _, upright in sizes]) < 0.3:
                raise ValueError(
                    f"{self.path}: the body is lying down in most motions ({skeleton}); set the axis `up` in "
                    "skeleton.yaml"
                )

    @cached_property
    def files(self) -> dict[str, Path]:
        """Path in the folder without extension -> file, sorted.

        Raises:
            FileNotFoundError: the folder does not exist or contains no motion.
            UserError: a motion is not a regular file, or its name cannot be stored.
            ValueError: two motions have the same name, or `exclude` has an unknown name.
        """
        found: dict[str, Path] = {}
        for path in sorted(self.path.rglob("*")) if self.path.is_dir() else ():
            if path.suffix.lower() in MOTIONS and path != self.path / TABLES[1]:
                name = path.relative_to(self.path).with_suffix("").as_posix()
                if FORBIDDEN_CHARACTERS.search(name):
                    raise UserError(
                        f"{printable(str(path))}: its name contains control characters or is not UTF-8. Rename it"
                    )
                regular_file(path)
                if name in found:
                    raise ValueError(f"{path}: has the same name as {found[name].name}; each motion needs its own name")
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
        """Captions and labels of each motion, from tables and text files.

        Raises:
            ValueError: a table cannot be read or names an unknown motion, or some motions lack a caption or an action.
        """
        notes = {name: Note() for name in self.files}
        for table in TABLES:
            if _is_there(self.path / table):
                for where, row in (_csv_rows if table.endswith("csv") else _json_rows)(self.path / table):
                    _take(notes, self.exclude, where, row)
        for name, path in self.files.items():
            texts = path.with_suffix(".txt")
            if _is_there(texts):
                lines = read_text(texts).splitlines()
                notes[name].texts += [text for line in lines if (text := line.partition("#")[0].strip())]
        for kind, values in (("caption", "texts"), ("action", "action")):
            bare = [name for name, note in notes.items() if not getattr(note, values)]
            if 0 < len(bare) < len(notes):
                raise ValueError(
                    f"{self.path}: {len(bare)} of {len(notes)} motions have no {kind}, such as {bare[0]}; add one to "
                    "each, or leave these out with data.source.exclude"
                )
        return notes

    def _skeleton(self, path: Path) -> tuple[str, dict[str, Any]]:
        """Returns the name and the content of the nearest `skeleton.yaml` above a motion; empty without one."""
        found = skeleton_file(path)
        if found is None:
            return "", {}
        if found not in self._skeletons:
            self._skeletons[found] = read_skeleton(found)
        return os.path.relpath(found), self._skeletons[found]

    @cached_property
    def splits(self) -> dict[str, Split]:
        """Split of each motion: that of the tables, else drawn by a hash of the source.

        An empty training split, and in a set of `SPLITTABLE` or more motions any empty split, gets the source with the
        highest hash from the split with the most sources. All motions of a source stay in one split.
        """
        sources = {name: note.source or name for name, note in self.notes.items()}
        given: dict[str, Split] = {sources[name]: note.split for name, note in self.notes.items() if note.split}
        free = sorted(set(sources.values()) - set(given))
        drawn: dict[str, Split] = {source: hashed_split(source, val=5, test=10) for source in free}
        for split in get_args(Split) if len(sources) >= SPLITTABLE else ("train",):
            if split not in {*given.values(), *drawn.values()}:
                sizes = Counter(drawn.values())
                most = max(sizes.values(), default=0)
                if movable := [source for source in drawn if sizes[drawn[source]] == most > (split != "train")]:
                    drawn[max(movable, key=lambda source: hashlib.sha1(source.encode()).digest())] = split
        splits: dict[str, Split] = {**given, **drawn}
        return {name: note.split or splits[sources[name]] for name, note in self.notes.items()}

    def _read(self, path: Path, fps: float) -> np.ndarray:
        where, given = self._skeleton(path)
        if path.suffix.lower() == ".bvh":
            joints, _, layout = read_bvh(path, fps, given)
            return self._checked(path, joints, layout, where)
        data = read_arrays(path)
        rate = data.setdefault("fps", given.get("fps"))
        if rate is None:
            raise ValueError(f"{path}: no frame rate in the file. Write it into skeleton.yaml, for example `fps: 30`")
        if "poses" in data:
            return self._from_smpl(path, data, fps)
        layout, names = array_layout(path, data["joints"], given)
        try:
            moved = resample(data["joints"].astype(float), rate, fps)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        return self._checked(path, layout.apply(moved, names), replace(layout, fps=rate), where)

    def _checked(self, path: Path, joints: np.ndarray, layout: Layout, where: str) -> np.ndarray:
        """Returns the joints; raises `ValueError` if their size, feet or values are wrong."""
        if self.motion == "smpl":
            raise ValueError(f"{path}: contains no SMPL rotations; use AMASS .npz files, or set motion=joints")
        if not np.isfinite(joints).all():
            frame = int(np.argmin(np.isfinite(joints).all((1, 2))))
            raise ValueError(f"{path}: numbers in frame {frame} are not finite")
        leg = leg_length(joints)
        try:
            check_size(leg, layout.unit, layout.children)
            check_feet(joints)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        trunk = joints[:, SMPL22.joints.index("neck")] - joints[:, 0]
        upright = float((trunk[:, 1] / np.linalg.norm(trunk, axis=1)).mean())
        name = f"{layout_name(layout)}, unit {layout.unit:.4g}, {layout.fps:g} fps" + f" ({where})" * bool(where)
        self._sizes.setdefault(name, []).append((leg, head_height(joints), upright))
        return joints

    def _from_smpl(self, path: Path, data: dict[str, Any], fps: float) -> np.ndarray:
        try:
            translation, turns = smpl_motion(data, fps)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        angles = rotation.quaternion_to_axis_angle(turns).flatten(1).numpy()
        motion = np.concatenate([translation.numpy(), angles], 1).astype(np.float32)
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


def _is_there(path: Path) -> bool:
    """Returns whether the file exists; raises `UserError` if it is not a regular file."""
    if not os.path.lexists(path):
        return False
    regular_file(path)
    return True


def _csv_rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    reader = csv.DictReader(io.StringIO(read_text(path).removeprefix("\ufeff"), newline=""), strict=True)
    try:
        names = list(reader.fieldnames or ())
        if len(set(names)) < len(names):
            raise ValueError(f"{path}: duplicate column: {', '.join(names)[:200]}")
        if set(names) - set(COLUMNS) or "id" not in names:
            raise ValueError(
                f"{path}: its columns are {str(names)[:200]}; use {', '.join(COLUMNS)} (only id is required)"
            )
        for row in reader:
            if None in row or None in row.values():
                raise ValueError(
                    f"{path}, line {reader.line_num}: not one cell per column; put texts that contain a comma in quotes"
                )
            yield f"{path}, line {reader.line_num}", {key: cell.strip() for key, cell in row.items()}
    except csv.Error as error:
        raise ValueError(f"{path}, line {reader.line_num}: {error}") from error


def _json_rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    data = read_json(path)
    if not isinstance(data, dict) or not all(isinstance(value, dict) for value in data.values()):
        raise ValueError(f'{path}: write {{"id": {{"text": ["...", "..."], "action": "..."}}, ...}}')
    for name, value in data.items():
        unknown = set(value) - set(COLUMNS[1:])
        if unknown:
            raise ValueError(f"{path}: {name}: unknown key {', '.join(sorted(unknown))}; use {', '.join(COLUMNS[1:])}")
        yield f"{path}: {name}", {"id": name, **value}


def _take(notes: dict[str, Note], exclude: Sequence[str], where: str, row: Mapping[str, Any]) -> None:
    """Adds a row of a table to the notes."""
    if row["id"] in exclude:
        return
    if row["id"] not in notes:
        raise ValueError(f"{where}: no motion {row['id']!r}; ids are paths in the folder without extension")
    note = notes[row["id"]]
    texts = row.get("text") or []
    if not isinstance(texts, str | list) or not all(isinstance(text, str) for text in texts):
        raise ValueError(f"{where}: text is {repr(texts)[:100]}, not a text or a list of texts")
    note.texts += [texts] if isinstance(texts, str) else texts
    for key in ("action", "split", "source"):
        value = row.get(key)
        if value:
            if getattr(note, key) not in (None, value):
                raise ValueError(f"{where}: {row['id']} has two values of {key}: {getattr(note, key)} and {value}")
            setattr(note, key, str(value))
    if note.split not in (None, *get_args(Split)):
        raise ValueError(f"{where}: unknown split {note.split!r}; use {', '.join(get_args(Split))}")


def _swapped(text: str) -> str:
    """Swaps left and right, clockwise and counterclockwise."""
    pairs = {"left": "right", "right": "left", "clockwise": "counterclockwise"}
    pairs |= {"counterclockwise": "clockwise", "anticlockwise": "clockwise"}

    def swap(match: re.Match[str]) -> str:
        word = pairs[match[0].lower()]
        return word.capitalize() if match[0][0].isupper() else word

    return re.sub(rf"(?<![a-z])({'|'.join(pairs)})(?![a-z])", swap, text, flags=re.IGNORECASE)
