"""The user's own data: a folder of motions (BVH, AMASS or joint files) with captions.

`docs/own-data.md` describes the folder.
"""

import contextlib
import math
import os
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch

from flame_mdm.data import SPLITS, Clip, MotionSource, Split, mirrored, some
from flame_mdm.data.captions import TABLE, drawn_splits, known_split, table_rows
from flame_mdm.data.parallel import in_order
from flame_mdm.errors import UserError, first_line, printable
from flame_mdm.formats import ENDINGS, SCENES, motions_in, scenes
from flame_mdm.formats.checks import LYING
from flame_mdm.formats.conversion import needs_rotations, raw_motion
from flame_mdm.formats.readers import read_recording
from flame_mdm.representations import Representation, rotation
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.rifke import Rifke
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import KIT21, SMPL22
from flame_mdm.representations.smpl import SMPL
from flame_mdm.safe_io import naming, read_text

# Minimum number of frames that representations require
SHORTEST = 3
# Maximum number of copies of a clip in a balanced data set. With more copies, a model would
# memorize the clip.
MOST_COPIES = 16


class MotionFile(NamedTuple):
    """A motion file and, if it contains several animations, the name of one of them."""

    path: Path
    animation: str | None = None


@dataclass
class Note:
    """Captions and labels for a motion."""

    texts: list[str] = field(default_factory=list)
    action: str | None = None
    split: Split | None = None
    source: str | None = None
    license: str | None = None


class Folder(MotionSource):
    """Motions and captions in a folder.

    Motions are positions of SMPL's 22 joints, or raw motions for the SMPL representation. If the
    table does not specify splits, 85 % of the sources are used for training, 5 % for validation and
    10 % for testing, based on a hash of their names.

    Args:
        path: the folder. Motions may be in subfolders.
        motion: "joints" for representations of joint positions; "smpl" for representations of
            SMPL's rotations. Rotations are read from AMASS files and derived from the bones of BVH
            files. For all other files, the rotations are fitted to the joints.
        mirror: whether a mirrored copy follows each clip of the training split. This requires
            `motion="joints"`.
        exclude: paths of motions to leave out, relative to the folder and without extension.
        balance: requested number of training clips per action, including mirrored copies. If an
            action has fewer clips, its clips are repeated until there are about this many. Each
            clip occurs at most 16 times. 0 = clips are not repeated.
        license: license of the motions for which the table does not specify a license. The value is
            a key in `licenses.yaml`, or "" if the license is unknown.
        prefixes: maps each word to a list of actions. The word is inserted before the captions of
            these actions. A model can then distinguish these motions from motions with the same
            action name in another data set.
    """

    name = "folder"
    named_by_recipe = True
    version = 2  # in version 1, joints of arrays were interpolated linearly

    def __init__(
        self,
        path: str,
        motion: Literal["joints", "smpl"] = "joints",
        mirror: bool = False,
        exclude: Sequence[str] = (),
        balance: int = 0,
        license: str = "",
        workers: int = 0,
        prefixes: Mapping[str, Sequence[str]] | None = None,
    ):
        if balance < 0:
            raise UserError(
                f"data.source.balance={balance}: expected a number of clips per action, or 0"
            )
        if mirror and motion == "smpl":
            raise UserError("data.source.mirror=true: requires data.source.motion=joints")
        self.path, self.motion, self.mirror, self.exclude = (
            Path(path),
            motion,
            mirror,
            tuple(exclude),
        )
        self.workers, self.balance, self.license = workers, balance, license
        self.options = {"motion": motion, "mirror": mirror, "exclude": list(exclude)}
        if balance:
            self.options["balance"] = balance
        if license:
            self.options["license"] = license
        self.prefixes = {
            action: word for word, actions in (prefixes or {}).items() for action in actions
        }
        if self.prefixes:
            self.options["prefixes"] = self.prefixes
        # For each layout, how upright the body is in each motion read so far
        self._uprights: defaultdict[str, list[float]] = defaultdict(list)
        # Notes about the motions read so far, each with the number of motions that it applies to
        self._notes: Counter[str] = Counter()
        # The representation whose raw motions are yielded; see `suit`
        self._representation: Representation | None = None

    def suit(self, representation: Representation) -> None:
        """Configures the source so that `clips` yields raw motions for a representation.

        Raises:
            UserError: If `motion` does not match the representation.
        """
        name = representation.name
        if needs_rotations(representation) and self.motion == "joints":
            raise UserError(
                f"{name} encodes rotations. Add data.source.motion=smpl to read rotations "
                "from the files or to fit them to the joints"
            )
        if isinstance(representation, HumanML | Rifke) and self.motion == "smpl":
            raise UserError(f"{name} encodes joint positions. Remove data.source.motion=smpl")
        self._representation = representation

    def count(self) -> int:
        """Returns the number of clips, including repeated and mirrored copies."""
        images = sum(
            self.copies[name] for name in self.files if self.mirror and self.splits[name] == "train"
        )
        return sum(self.copies.values()) + images

    def licenses(self) -> set[str]:
        """Returns the licenses of all motions; `license` applies if the table specifies none."""
        return {note.license or self.license for note in self.notes.values()}

    @cached_property
    def copies(self) -> dict[str, int]:
        """The number of times that each motion occurs in the data set; see `balance`.

        A mirrored copy occurs as often as its original.
        """
        sizes = Counter(
            note.action for name, note in self.notes.items() if self.splits[name] == "train"
        )
        copies = dict.fromkeys(self.files, 1)
        for name, note in self.notes.items():
            if self.balance and self.splits[name] == "train":
                clips = sizes[note.action] * (2 if self.mirror else 1)
                copies[name] = min(max(1, round(self.balance / clips)), MOST_COPIES)
        return copies

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields the clips of all readable motions.

        `failures` lists the motions that cannot be read.
        """
        self.actions = tuple(
            sorted({note.action for note in self.notes.values() if note.action is not None})
        )
        for name, motion in self._motions(fps):
            note, split = self.notes[name], self.splits[name]
            action = None if note.action is None else self.actions.index(note.action)
            clip = Clip(
                id=name.replace("/", "_"),
                motion=motion,
                captions=note.texts,
                split=split,
                source=note.source or name,
                action=action,
                license=note.license or self.license,
            )
            yield from _repeated(clip, self.copies[name])
            if self.mirror and split == "train":
                skeleton = SMPL22 if self._representation is None else self._representation.skeleton
                image = mirrored(
                    clip, skeleton.mirror(torch.from_numpy(motion)).numpy(), self.actions
                )
                yield from _repeated(image, self.copies[name])
        if len(self.failures) == len(self.files):
            self.require_all()
        self.leave_out("motions that cannot be read", len(self.failures))
        _check_upright(self.path, self._uprights)

    def _motions(self, fps: float) -> Iterator[tuple[str, np.ndarray]]:
        """Yields the name and content of each readable motion, and records findings about it."""
        self.failures = failures = list[str]()
        self._uprights, self._notes = defaultdict(list), Counter()
        attempts = in_order(
            partial(_read, self.motion, self._representation, fps),
            self.files.values(),
            self.workers,
        )
        for name, attempt in zip(self.files, attempts, strict=True):
            if attempt.error:
                failures.append(attempt.error)
                continue
            self._uprights[attempt.layout].append(attempt.upright)
            self._notes.update(attempt.notes)
            yield name, attempt.motion

    def findings(self) -> list[str]:
        """Returns findings about the motions that have been read so far.

        The findings state the number of motions for each skeleton and, for example, which frames
        were left out.
        """
        skeletons = [
            f"{layout}: {len(motions)} motions" for layout, motions in self._uprights.items()
        ]
        return skeletons + [f"{count} motions: {note}" for note, count in self._notes.items()]

    def check(self, fps: float) -> list[str]:
        """Reads all captions and motions, and returns a report on skeletons and failures."""
        splits = Counter(self.splits[name] for name, _ in self._motions(fps))
        if self.failures:
            return [*self.findings(), *self.failure_lines()]
        _check_upright(self.path, self._uprights)
        motions = ", ".join(f"{splits[split]} {split}" for split in SPLITS)
        return [
            *self.findings(),
            f"{self.name}: {self.count()} clips can be prepared (motions: {motions})",
        ]

    def failure_lines(self) -> list[str]:
        """Returns one line for each motion that cannot be prepared, and a line with the total."""
        if not self.failures:
            return []
        summary = f"error: {len(self.failures)} of {len(self.files)} motions in {self.path} cannot be prepared"
        return [*(f"error: {failure}" for failure in self.failures), summary]

    def require_all(self) -> None:
        """Raises `UserError` if a motion could not be read."""
        if self.failures:
            more = f" (and {len(self.failures) - 1} more)" if len(self.failures) > 1 else ""
            raise UserError(f"{self.failures[0]}{more}")

    @cached_property
    def files(self) -> dict[str, MotionFile]:
        """Maps names to motion files, in sorted order.

        The name of a file is its path relative to the folder, without extension. If a file has
        several animations, each animation is called `PATH/ANIMATION`.
        """
        files: dict[str, MotionFile] = {}
        for path in motions_in(self.path):
            name = path.relative_to(self.path).with_suffix("").as_posix()
            if (shown := printable(name)) != name:
                raise UserError(
                    f"{shown}: its name contains control characters or is not UTF-8. Rename it"
                )
            for label, file in _animations(name, path):
                if label in files:
                    other = files[label].path.name
                    raise UserError(
                        f"{path}: has the same name as {other}. Give each motion a unique name"
                    )
                files[label] = file
        if not files:
            reason = "no motions in this folder" if self.path.is_dir() else "no such folder"
            raise FileNotFoundError(
                f"{self.path}: {reason}. Use a folder of {', '.join(ENDINGS)} files"
            )
        return self.not_excluded(dict(sorted(files.items())), self.path)

    def changed(self, store: Path) -> list[str]:
        """Returns a line if files in the folder are newer than the file `store`."""
        when = store.stat().st_mtime
        files = [
            path for path in self.path.rglob("*") if path.is_file() and path.stat().st_mtime > when
        ]
        newer = [str(path.relative_to(self.path)) for path in files]
        return (
            [
                f"{self.path}: {some(newer)} changed since the data set was prepared. Prepare it again with force=true"
            ]
            if newer
            else []
        )

    @cached_property
    def notes(self) -> dict[str, Note]:
        """Captions and labels of each motion, from the table and text files.

        If one motion has captions, all motions must have captions. The same applies to actions.
        """
        notes = {name: Note() for name in self.files}
        if os.path.lexists(self.path / TABLE):
            _read_table(self.path / TABLE, notes, self.exclude)
        for name, file in self.files.items():
            texts = file.path.with_suffix(".txt")
            if os.path.lexists(texts):
                lines = read_text(texts).splitlines()
                notes[name].texts += [
                    text for line in lines if (text := line.partition("#")[0].strip())
                ]
        for kind, values in (("caption", "texts"), ("action", "action")):
            bare = [name for name, note in notes.items() if not getattr(note, values)]
            if 0 < len(bare) < len(notes):
                raise UserError(
                    f"{self.path}: {len(bare)} of {len(notes)} motions have no {kind} (for example, {bare[0]}). Add "
                    "one to each, or leave these motions out with data.source.exclude"
                )
        _put_prefixes(self.prefixes, notes.values(), self.path / TABLE)
        return notes

    @cached_property
    def splits(self) -> dict[str, Split]:
        """Maps motions to splits, which are specified in the table or drawn by `drawn_splits`."""
        sources = {name: note.source or name for name, note in self.notes.items()}
        return drawn_splits(sources, {name: note.split for name, note in self.notes.items()})


def _put_prefixes(prefixes: Mapping[str, str], notes: Collection[Note], table: Path) -> None:
    """Inserts a word before the captions of some actions.

    Args:
        prefixes: the word to insert for each action.
        notes: captions and labels of all motions.
        table: the file that lists the actions, for the error message.

    Raises:
        UserError: If `prefixes` contains an action that no motion has.
    """
    unknown = set(prefixes) - {note.action for note in notes}
    if unknown:
        raise UserError(
            f"data.source.prefixes: no motion has the action {some(sorted(unknown))}; "
            f"{table} lists the actions"
        )
    for note in notes:
        if word := prefixes.get(note.action or ""):
            note.texts = [f"{word}, {text}" for text in note.texts]


def _check_upright(folder: Path, uprights: Mapping[str, Sequence[float]]) -> None:
    """Raises `UserError` if the body is lying down in most motions of a layout.

    Args:
        folder: the folder to name in the error message.
        uprights: for each layout, the value `upright` of each motion; see `Doubts`.
    """
    for layout, values in uprights.items():
        if np.median(values) < LYING:
            raise UserError(
                f"{folder}: the body is lying down in most motions ({layout}). "
                "Set the `up` axis in skeleton.yaml"
            )


def _repeated(clip: Clip, copies: int) -> Iterator[Clip]:
    """Yields a clip and its copies, which share the clip's frames in the store."""
    yield clip
    for number in range(2, copies + 1):
        yield replace(clip, id=f"{clip.id}~{number}")


def _animations(name: str, path: Path) -> Iterator[tuple[str, MotionFile]]:
    """Yields the name and the location of each motion in a file.

    If there are several animations, each animation gets its own name.
    """
    animations: list[str] = []
    if path.suffix.lower() in SCENES:
        with contextlib.suppress(UserError):  # the reader reports faults of this file later
            animations = scenes.animations(path)
    if len(animations) <= 1:
        yield name, MotionFile(path)
        return
    for number, animation in enumerate(animations, 1):
        label = re.sub(r"[^\w .-]", "_", animation)
        yield f"{name}/{label}", MotionFile(path, str(number))


def _read_table(path: Path, notes: dict[str, Note], exclude: Collection[str]) -> None:
    """Adds the rows of a table to the notes of the motions. Motions in `exclude` are skipped."""
    for where, cells in table_rows(path):
        with naming(where):
            if cells["id"] not in exclude:
                _add(notes, cells)


def _add(notes: dict[str, Note], cells: dict[str, str]) -> None:
    """Adds the cells of a table row to the note of its motion."""
    name, split = cells["id"], cells.get("split")
    if name not in notes:
        raise UserError(
            f"unknown motion {name!r}. Ids are the paths of files in the folder, without extensions"
        )
    if split:
        known_split(split)
    note = notes[name]
    note.texts += [text] if (text := cells.get("text")) else []
    for key in ("action", "split", "source", "license"):
        if value := cells.get(key):
            if getattr(note, key) not in (None, value):
                raise UserError(
                    f"{name} has two values for {key}: {getattr(note, key)} and {value}. Keep one "
                    "of them"
                )
            setattr(note, key, value)


@dataclass
class _Attempt:
    """A motion that was read for a data set, or a message that states why it cannot be used."""

    error: str = ""
    motion: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    # Skeleton, unit and frame rate of the file
    layout: str = ""
    # How upright the body is, and notes about the motion, both from the recording
    upright: float = math.nan
    notes: Sequence[str] = ()


def _read(
    kind: str, representation: Representation | None, fps: float, file: MotionFile
) -> _Attempt:
    """Reads joints or, if `kind` is "smpl", a raw motion with SMPL's rotations.

    The motion has `fps` frames per second. Without a `representation`, the joints are SMPL's 22
    joints, and rotations are in AMASS's axes. For KIT-ML's representations, the joints are KIT-ML's
    21 joints. If the representation uses camera axes, the rotations use them as well.
    """
    path = file.path
    try:
        recording = read_recording(path, fps, as_smpl=True, animation=file.animation)
        joints, doubts = recording.motion.joints, recording.doubts
        if doubts.jump:
            raise UserError(f"{path}: {doubts.jump}")
        if len(joints) < SHORTEST:
            raise UserError(
                f"{path}: only {len(joints)} frames at {fps:g} fps, but a motion requires at least {SHORTEST} frames"
            )
        notes = [note for note in recording.motion.notes if note not in doubts.lines]
        of_kit = representation is not None and representation.skeleton is KIT21
        if kind == "joints" and of_kit and representation is not None:
            motion = raw_motion(recording.motion, representation).values.numpy().astype(np.float32)
        elif kind == "joints":
            motion = joints
        elif recording.smpl is None or isinstance(representation, Rot6D):
            fitted = raw_motion(recording.motion, representation or SMPL(fps))
            motion = fitted.values.numpy().astype(np.float32)
            if fitted.note:
                source, _, _ = fitted.note.partition(", on the body")
                centimeters = math.ceil(100 * fitted.error)
                notes.append(f"{source}, with a mean error of at most {centimeters} cm")
        else:
            translation, turns = recording.smpl
            angles = rotation.quaternion_to_axis_angle(turns).flatten(1)
            motion = torch.cat([translation, angles], 1).numpy().astype(np.float32)
    except (ValueError, OSError) as error:
        return _Attempt(first_line(error))
    return _Attempt("", motion, recording.layout, doubts.upright, notes)
