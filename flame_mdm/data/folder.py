"""Own data: a folder of motions (BVH, AMASS or joint files) with captions, described in `docs/own-data.md`."""

import csv
import io
import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch

from flame_mdm.data import Clip, MotionSource, Split, hashed_split, name_hash, swap_sides, without
from flame_mdm.data.parallel import in_order
from flame_mdm.errors import UserError, printable
from flame_mdm.formats import ENDINGS, TREES
from flame_mdm.formats.layouts import (
    array_layout,
    check_feet,
    check_size,
    head_height,
    layout_name,
    leg_length,
    map_bvh,
    read_skeleton,
    read_tree,
    skeleton_file,
)
from flame_mdm.formats.readers import read_arrays, smpl_motion
from flame_mdm.formats.resampling import resample
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.representations.smpl import SMPL
from flame_mdm.safe_io import naming, read_json, read_text, regular_file

FORBIDDEN_CHARACTERS = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
"""Characters not allowed in the name of a motion: names are stored as text, one clip per line."""
LOOK_FPS = 20.0  # frame rate to which `Folder.check` resamples motions
SPLITTABLE = 10  # number of motions from which on each split has at least one
TABLES = ("captions.csv", "captions.json")
COLUMNS = ("id", "text", "action", "split", "source")


@dataclass
class Note:
    """Captions and labels of a motion."""

    texts: list[str] = field(default_factory=list)
    action: str | None = None
    split: Split | None = None
    source: str | None = None


class Facts(NamedTuple):
    """Facts about a motion file: skeleton with unit and frame rate, frames and seconds as recorded, sizes in meters.

    `upright` is the mean of the vertical component of the trunk's direction. Rotations of SMPL have no size.
    """

    skeleton: str
    frames: int
    seconds: float
    leg: float | None = None
    head: float | None = None
    upright: float | None = None


class Folder(MotionSource):
    """Motions and captions in a folder, as SMPL's 22 joints or as raw motions of the SMPL representation.

    If the tables give no split, 85 % of the sources are used for training, 5 % for validation and 10 % for testing,
    selected by a hash of their names.

    Args:
        path: the folder; motions may be in subfolders.
        motion: "joints" for representations of joint positions; "smpl" for those of SMPL's rotations, which only
            AMASS files contain.
        mirror: yield a mirrored copy after each clip of the training split; joints only.
        exclude: motions to leave out, by their path in the folder without extension.
    """

    name = "folder"
    named_by_recipe = True

    def __init__(
        self,
        path: str,
        motion: Literal["joints", "smpl"] = "joints",
        mirror: bool = False,
        exclude: Sequence[str] = (),
        workers: int = 0,
    ):
        if motion not in ("joints", "smpl") or (mirror and motion == "smpl"):
            raise UserError(f"data.source.motion={motion}, mirror={mirror}: give joints, or smpl with mirror=false")
        self.path, self.motion, self.mirror, self.exclude = Path(path), motion, mirror, tuple(exclude)
        self.workers = workers
        self.options = {"motion": motion, "mirror": mirror, "exclude": list(exclude)}
        if exclude:
            self.excluded["motions by data.source.exclude"] = len(exclude)
        self._facts: list[Facts] = []

    def count(self) -> int:
        splits = Counter(self.splits.values())
        return sum(splits.values()) + (splits["train"] if self.mirror else 0)

    def clips(self, fps: float) -> Iterator[Clip]:
        self.actions = tuple(sorted({note.action for note in self.notes.values() if note.action is not None}))
        self._facts = []
        read = in_order(partial(_read, self.motion, fps), self.files.values(), self.workers)
        for name, (motion, facts) in zip(self.files, read, strict=True):
            self._facts.append(facts)
            note, split = self.notes[name], self.splits[name]
            clip = Clip(
                name.replace("/", "_"),
                motion,
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
        """Returns the skeletons of the motions read so far, with lengths and ranges of sizes."""
        lines = []
        for skeleton, motions in self._by_skeleton().items():
            many = f"{len(motions)} motion" + "s" * (len(motions) > 1)
            frames, seconds = (sum(getattr(motion, name) for motion in motions) for name in ("frames", "seconds"))
            line = f"{skeleton}: {many}, {frames:,} frames, {seconds:,.1f} s"
            for what, name in (("legs", "leg"), ("head joint at", "head")):
                sizes = sorted(f"{size:.2f}" for motion in motions if (size := getattr(motion, name)) is not None)
                line += f", {what} {' to '.join(dict.fromkeys((sizes[0], sizes[-1])))} m" if sizes else ""
            lines.append(line)
        return lines

    def _by_skeleton(self) -> dict[str, list[Facts]]:
        motions: dict[str, list[Facts]] = {}
        for facts in self._facts:
            motions.setdefault(facts.skeleton, []).append(facts)
        return motions

    def check(self) -> list[str]:
        """Reads all captions and motions; returns lines on skeletons and failures."""
        self._facts = []
        failed: dict[str, list[Path]] = {}
        looked = in_order(partial(_look, self.motion), self.files.values(), self.workers)
        for path, facts in zip(self.files.values(), looked, strict=True):
            if isinstance(facts, str):
                failed.setdefault(facts, []).append(path)
            else:
                self._facts.append(facts)
        lines = self.findings()
        for error, paths in failed.items():
            more = f" and {len(paths) - 1} more" * (len(paths) > 1)
            lines.append(f"error: {paths[0]}{more}{error}")
        try:
            self._check_upright()
            counts = Counter(self.splits.values())
            splits = ", ".join(f"{counts[split]} {split}" for split in get_args(Split))
        except ValueError as error:
            return [*lines, f"error: {error}"]
        if failed:
            count = sum(map(len, failed.values()))
            return [*lines, f"error: {count} of {len(self.files)} motions of {self.path} cannot be prepared"]
        return [*lines, f"{self.name}: {self.count()} clips can be prepared (motions: {splits})"]

    def _check_upright(self) -> None:
        for skeleton, motions in self._by_skeleton().items():
            upright = [motion.upright for motion in motions if motion.upright is not None]
            if upright and np.median(upright) < 0.3:
                raise UserError(
                    f"{self.path}: the body is lying down in most motions ({skeleton}); set the axis `up` in "
                    "skeleton.yaml"
                )

    @cached_property
    def files(self) -> dict[str, Path]:
        """Path in the folder without extension -> file, sorted."""
        files: dict[str, Path] = {}
        for path in sorted(self.path.rglob("*")) if self.path.is_dir() else ():
            if path.suffix.lower() in ENDINGS and path != self.path / TABLES[1]:
                name = path.relative_to(self.path).with_suffix("").as_posix()
                if FORBIDDEN_CHARACTERS.search(name):
                    raise UserError(
                        f"{printable(str(path))}: its name contains control characters or is not UTF-8. Rename it"
                    )
                regular_file(path)
                if name in files:
                    raise UserError(f"{path}: has the same name as {files[name].name}; each motion needs its own name")
                files[name] = path
        if not files:
            what = "no motion in it" if self.path.is_dir() else "a file" if self.path.exists() else "no such folder"
            raise FileNotFoundError(f"{self.path}: {what}; give a folder of {', '.join(ENDINGS)} files")
        return without(dict(sorted(files.items())), self.exclude, self.path)

    def changed(self, store: Path) -> list[str]:
        when, files = store.stat().st_mtime, self.path.rglob("*") if self.path.is_dir() else ()
        newer = sorted(str(f.relative_to(self.path)) for f in files if f.is_file() and f.stat().st_mtime > when)
        more = f" and {len(newer) - 1} more" * (len(newer) > 1)
        return [f"{self.path}: {newer[0]}{more} changed since: prepare with force=true to read them"] if newer else []

    @cached_property
    def notes(self) -> dict[str, Note]:
        """Captions and labels of each motion, from tables and text files; all motions have a caption, or none."""
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
                raise UserError(
                    f"{self.path}: {len(bare)} of {len(notes)} motions have no {kind}, such as {bare[0]}; add one to "
                    "each, or leave these out with data.source.exclude"
                )
        return notes

    @cached_property
    def splits(self) -> dict[str, Split]:
        """Split of each motion: that of the tables, else drawn by a hash of the source.

        An empty training split, and in a set of `SPLITTABLE` or more motions any empty split, gets the source with the
        highest hash from the split with the most sources. All motions of a source stay in one split.
        """
        sources = {name: note.source or name for name, note in self.notes.items()}
        stated: dict[str, Split] = {sources[name]: note.split for name, note in self.notes.items() if note.split}
        free = sorted(set(sources.values()) - set(stated))
        drawn: dict[str, Split] = {source: hashed_split(source, val=5, test=10) for source in free}
        for split in get_args(Split) if len(sources) >= SPLITTABLE else ("train",):
            if split not in {*stated.values(), *drawn.values()}:
                sizes = Counter(drawn.values())
                most = max(sizes.values(), default=0)
                if movable := [source for source in drawn if sizes[drawn[source]] == most > (split != "train")]:
                    drawn[max(movable, key=name_hash)] = split
        splits: dict[str, Split] = {**stated, **drawn}
        return {name: note.split or splits[sources[name]] for name, note in self.notes.items()}

    def _mirrored(self, clip: Clip, note: Note) -> Clip:
        action = clip.action
        if note.action is not None and swap_sides(note.action) in self.actions:
            action = self.actions.index(swap_sides(note.action))
        motion = SMPL22.mirror(torch.from_numpy(clip.motion)).numpy()
        captions = [swap_sides(text) for text in clip.captions]
        return replace(clip, id=f"M{clip.id}", motion=motion, captions=captions, action=action)


def _look(kind: str, path: Path) -> Facts | str:
    """Returns the facts about a motion, or what is wrong, to be printed after its path."""
    try:
        return _read(kind, LOOK_FPS, path)[1]
    except ValueError as error:
        text = str(error)
        return text.replace(str(path), "") if str(path) in text else f": {text}"


def _read(kind: str, fps: float, path: Path) -> tuple[np.ndarray, Facts]:
    """Reads and checks joints or, if `kind` is "smpl", a raw motion."""
    skeleton = skeleton_file(path)
    fields = read_skeleton(skeleton) if skeleton else {}
    where = f" ({os.path.relpath(skeleton)})" if skeleton else ""
    with naming(path, ValueError):
        if path.suffix.lower() in TREES:
            file = read_tree(path, fields.get("fps") if path.suffix.lower() == ".amc" else None)
            frames, rate = len(file.frames), file.fps
            joints, layout = map_bvh(file, fps, fields)
        else:
            data = read_arrays(path)
            rate = data.setdefault("fps", fields.get("fps"))
            if rate is None:
                raise UserError("no frame rate in the file. Write it into skeleton.yaml, for example `fps: 30`")
            if "poses" in data:
                frames, width = len(data["poses"]), math.prod(data["poses"].shape[1:])
                model = {72: "SMPL", 156: "SMPL+H", 165: "SMPL-X"}.get(width, f"{width // 3} joints")
                facts = Facts(f"AMASS, {model}, {rate:g} fps{where}", frames, frames / rate)
                return _from_smpl(kind, data, fps), facts
            layout, names = array_layout(data["joints"], fields)
            frames = len(data["joints"])
            joints = layout.apply(resample(data["joints"].astype(float), rate, fps), names)
        if kind == "smpl":
            raise UserError("contains no SMPL rotations; use AMASS .npz files, or set motion=joints")
        if not np.isfinite(joints).all():
            frame = int(np.argmin(np.isfinite(joints).all((1, 2))))
            raise UserError(f"numbers in frame {frame} are not finite")
        check_size(joints, layout.unit, layout.children)
        check_feet(joints)
    trunk = joints[:, SMPL22.joints.index("neck")] - joints[:, 0]
    upright = float((trunk[:, 1] / np.linalg.norm(trunk, axis=1)).mean())
    name = f"{layout_name(layout)}, unit {layout.unit:.4g}, {rate:g} fps{where}"
    return joints, Facts(name, frames, frames / rate, leg_length(joints), head_height(joints), upright)


def _from_smpl(kind: str, data: dict[str, Any], fps: float) -> np.ndarray:
    translation, turns = smpl_motion(data, fps)
    angles = rotation.quaternion_to_axis_angle(turns).flatten(1).numpy()
    motion = np.concatenate([translation.numpy(), angles], 1).astype(np.float32)
    if kind == "smpl":
        return motion
    representation = SMPL()
    joints = representation.decode(representation.encode(torch.from_numpy(motion)))
    return joints[:, : len(SMPL22)].numpy()


def _is_there(path: Path) -> bool:
    if not os.path.lexists(path):
        return False
    regular_file(path)
    return True


def _csv_rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    reader = csv.DictReader(io.StringIO(read_text(path).removeprefix("\ufeff"), newline=""), strict=True)
    try:
        names = list(reader.fieldnames or ())
        if len(set(names)) < len(names):
            raise UserError(f"{path}: duplicate column: {', '.join(names)[:200]}")
        if set(names) - set(COLUMNS) or "id" not in names:
            raise UserError(
                f"{path}: its columns are {str(names)[:200]}; use {', '.join(COLUMNS)} (only id is required)"
            )
        for row in reader:
            if None in row or None in row.values():
                raise UserError(
                    f"{path}, line {reader.line_num}: not one cell per column; put texts that contain a comma in quotes"
                )
            yield f"{path}, line {reader.line_num}", {key: cell.strip() for key, cell in row.items()}
    except csv.Error as error:
        raise UserError(f"{path}, line {reader.line_num}: {error}") from error


def _json_rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    data = read_json(path)
    if not isinstance(data, dict) or not all(isinstance(value, dict) for value in data.values()):
        raise UserError(f'{path}: write {{"id": {{"text": ["...", "..."], "action": "..."}}, ...}}')
    for name, value in data.items():
        unknown = set(value) - set(COLUMNS[1:])
        if unknown:
            raise UserError(f"{path}: {name}: unknown key {', '.join(sorted(unknown))}; use {', '.join(COLUMNS[1:])}")
        yield f"{path}: {name}", {"id": name, **value}


def _take(notes: dict[str, Note], exclude: Sequence[str], where: str, row: Mapping[str, Any]) -> None:
    if row["id"] in exclude:
        return
    if row["id"] not in notes:
        raise UserError(f"{where}: no motion {row['id']!r}; ids are paths in the folder without extension")
    note = notes[row["id"]]
    texts = row.get("text") or []
    if not isinstance(texts, str | list) or not all(isinstance(text, str) for text in texts):
        raise UserError(f"{where}: text is {repr(texts)[:100]}, not a text or a list of texts")
    note.texts += [texts] if isinstance(texts, str) else texts
    for key in ("action", "split", "source"):
        value = row.get(key)
        if value:
            if getattr(note, key) not in (None, value):
                raise UserError(f"{where}: {row['id']} has two values of {key}: {getattr(note, key)} and {value}")
            setattr(note, key, str(value))
    if note.split not in (None, *get_args(Split)):
        raise UserError(f"{where}: unknown split {note.split!r}; use {', '.join(get_args(Split))}")
