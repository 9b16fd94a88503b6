"""HumanML3D: captioned motions from AMASS and HumanAct12, as features or SMPL parameters.

Source: Guo et al., "Generating Diverse and Natural 3D Human Motions From Text", CVPR 2022. See
`docs/humanml3d.md`.
"""

import csv
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property, partial
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import torch

from flame_mdm.data import Clip, MotionSource, archives, required, restricted_pickle, some
from flame_mdm.data.amass import FACTS, Amass, Recording, key_of
from flame_mdm.data.body_model import Body, load_body
from flame_mdm.data.t2m import T2MFolder
from flame_mdm.errors import UserError
from flame_mdm.progress import ProgressBar
from flame_mdm.representations import Frames
from flame_mdm.representations.humanml import HumanML
from flame_mdm.safe_io import atomic_write, made_folder, naming, read_npy, read_text
from flame_mdm.safe_io.paths import remove_abandoned

FPS = 20


class IndexedClip(NamedTuple):
    """A clip in `index.csv`: frames `start` to `end` of a recording, counted at 20 fps.

    `key` is the key of the recording (see `amass.key_of`) or, for a clip from HumanAct12, the name
    of its file.
    """

    name: str
    key: str
    start: int
    end: int

    @property
    def humanact12(self) -> bool:
        """Whether the clip is an entire HumanAct12 file. `key` is then the name of this file."""
        return "/" not in self.key

    def frames(self, count: int) -> slice:
        """Returns the slice that selects the clip from a recording of `count` frames."""
        if self.humanact12:
            return slice(0, count)
        trimmed = FACTS["trimmed"].get(self.key.partition("/")[0], 0)
        frames = range(count)[trimmed:][self.start : self.end]
        return slice(frames.start, frames.stop)


def read_index(path: Path) -> list[IndexedClip]:
    """Reads `index.csv`.

    Raises:
        UserError: If the file has an unexpected layout, or refers to an unknown recording.
    """
    required(path, "it is index.csv from https://github.com/EricGuo5513/HumanML3D")
    rows = []
    with naming(
        path, csv.Error, KeyError, TypeError, ValueError, prefix="not HumanML3D's clip index: "
    ):
        for line in csv.DictReader(read_text(path).splitlines()):
            source, name = line["source_path"], PurePosixPath(line["new_name"]).stem
            key = PurePosixPath(source).stem if "humanact12" in source.lower() else key_of(source)
            if key is None:
                raise UserError(f"{source} is not in any subset of AMASS")
            rows.append(IndexedClip(name, key, int(line["start_frame"]), int(line["end_frame"])))
    return rows


def by_recording(rows: Iterable[IndexedClip]) -> dict[str, list[IndexedClip]]:
    """Groups the clips from AMASS by recording."""
    recordings = defaultdict(list)
    for row in rows:
        if not row.humanact12:
            recordings[row.key].append(row)
    return recordings


class HumanML3D(T2MFolder):
    """Reader for the processed folder with 263 features per frame (Guo et al., CVPR 2022).

    Args:
        path: the folder, which must contain texts and splits.
        exclude: names of motions to leave out. Mirrored copies have names of their own.
        amass: folder with AMASS's SMPL+H G release, either unpacked or as archives. Missing motions
            are created from this release. Creating them also requires `index.csv` and HumanAct12's
            joint positions (`pose_data/humanact12.zip`) in `path` or next to it.
        body_models: folder with the extended SMPL+H model.
        bone_lengths: 22 bone lengths, in meters, of the skeleton to which all motions are
            retargeted.
        workers: number of processes; 0 = one per core.
    """

    name = "humanml3d"
    representation = "humanml-legacy-smpl22"
    fps = 20.0
    shortest = 40
    get_it = (
        "clone https://github.com/EricGuo5513/HumanML3D and use its folder HumanML3D. docs/humanml3d.md describes how "
        "to create the motions from AMASS"
    )

    def __init__(
        self,
        path: str,
        exclude: Sequence[str] = (),
        *,
        amass: str | None = None,
        body_models: str | None = None,
        bone_lengths: Sequence[float] | None = None,
        workers: int = 0,
    ):
        super().__init__(path, exclude)
        self.amass = Amass(Path(amass)) if amass else None
        self.body_models = Path(body_models) if body_models else None
        self.bone_lengths, self.workers = bone_lengths, workers
        self.options = {**self.options, "bone_lengths": bone_lengths and list(bone_lengths)}

    def count(self) -> int:
        """Returns the number of clips.

        If `amass` is set, missing motions are first created from AMASS.
        """
        if self.amass:
            self._make(self.amass)
        return super().count()

    def check(self, fps: float) -> list[str]:
        """Returns a line with the number of created motions, and one line per missing input."""
        if not self.amass:
            return super().check(fps)
        todo = self._todo()
        done = f"{len(self.rows) - len(todo)} of {len(self.rows)} motions and their mirrored copies are created"
        return [done, *(f"missing: {line}" for line in self._missing(self.amass, todo))]

    @cached_property
    def rows(self) -> list[IndexedClip]:
        """The clips in `index.csv` that are not excluded."""
        return [
            row for row in read_index(self._beside("index.csv")) if row.name not in self.exclude
        ]

    @cached_property
    def humanact12_files(self) -> dict[str, Path]:
        """The files with HumanAct12's joint positions, keyed by name.

        The dictionary is empty if the files are missing.
        """
        path = self._beside("humanact12", "pose_data/humanact12", "pose_data/humanact12.zip")
        folder = archives.as_folder(path, self, lambda name: name.endswith(".npy"))
        return {file.stem: file for file in folder.rglob("*.npy")}

    def _beside(self, *names: str) -> Path:
        """Returns the path of the first of `names` that exists in the folder or next to it.

        If none of them exists, returns the path that the first name would have in the folder.
        """
        candidates = [folder / name for name in names for folder in (self.path, self.path.parent)]
        return next((candidate for candidate in candidates if candidate.exists()), candidates[0])

    def _todo(self) -> list[IndexedClip]:
        created = self._motions()
        return [row for row in self.rows if not {row.name, f"M{row.name}"} <= created]

    def _bodies(self) -> dict[str, Body]:
        if not self.body_models:
            raise FileNotFoundError(
                "data.source.body_models is not set. Set it to the folder with the extended SMPL+H model"
            )
        return {gender: load_body(self.body_models, gender) for gender in ("male", "female")}

    def _missing(self, amass: Amass, todo: Sequence[IndexedClip]) -> list[str]:
        missing = amass.missing(by_recording(todo))
        if absent := {row.key for row in todo if row.humanact12} - self.humanact12_files.keys():
            missing.append(f"{len(absent)} clips of HumanAct12, such as {min(absent)}")
        try:
            self._bodies()
        except FileNotFoundError as error:
            missing.append(str(error))
        return missing

    def _make(self, amass: Amass) -> None:
        """Creates the motions that do not exist yet.

        An interrupted command can therefore be resumed.
        """
        if todo := self._todo():
            _ = self.names, self.texts  # raises an error if they are missing
            if missing := self._missing(amass, todo):
                raise FileNotFoundError(
                    f"{self.name} cannot be created. Missing: {'; '.join(missing)}"
                )
            with made_folder(self.path / "new_joint_vecs"):
                self._make_motions(amass, todo)
        if not (self.path / "Mean.npy").is_file():
            self._write_statistics()

    def _make_motions(self, amass: Amass, todo: Sequence[IndexedClip]) -> None:
        folder = self.path / "new_joint_vecs"
        encoder = HumanML("smpl22", "legacy", bone_lengths=self.bone_lengths)
        write = partial(_write_features, folder, encoder)
        write_all = partial(_from_amass, write, self._bodies())
        try:
            with ProgressBar(
                desc=f"creating {self.name}", total=len(todo), unit=" motions"
            ) as progress:
                for _, count in amass.map(by_recording(todo), write_all, self.workers):
                    progress.update(count)
                for row in todo:
                    if row.humanact12:
                        write(row, _read_joints(self.humanact12_files[row.key]))
                        progress.update()
        finally:
            remove_abandoned(folder)  # temporary files of workers that were stopped

    def _write_statistics(self) -> None:
        """Writes the mean and std of all motions and their mirrored copies.

        Motions are included regardless of their length and split.
        """
        representation = HumanML("smpl22", "legacy")
        shapes = {name: self._load(name, mmap=True).shape for name in sorted(self._motions())}
        if wrong := [
            name for name, (_, features) in shapes.items() if features != representation.features
        ]:
            raise UserError(
                f"{self.path}: these files have the wrong number of features: {some(wrong)}. Delete "
                "them and prepare the data set again"
            )
        count = sum(frames for frames, _ in shapes.values())
        frames = Frames(lambda: (self._load(name).astype(np.float32) for name in shapes), count)
        mean, std = representation.statistics(frames)
        _save(self.path / "Std.npy", std.numpy())
        _save(self.path / "Mean.npy", mean.numpy())


def _from_amass(
    write: partial[None], bodies: dict[str, Body], rows: Sequence[IndexedClip], recording: Recording
) -> int:
    """Writes the features of all clips in a recording, and returns the number of clips.

    As in the published code, every gender other than "male" is treated as female.
    """
    recording = recording.every(FPS)
    body = bodies["male" if recording.gender == "male" else "female"]
    for row in rows:
        write(row, body.joints(recording.cut(row.frames(len(recording.poses)))))
    return len(rows)


def _write_features(
    folder: Path, representation: HumanML, row: IndexedClip, joints: np.ndarray
) -> None:
    """Writes the features of a clip and of its mirror image.

    Each file has a temporary name until it is complete.
    """
    motion = torch.from_numpy(joints).double()
    with naming(f"clip {row.name} (data.source.exclude=[{row.name}] leaves it out)", ValueError):
        features = representation.encode_many([motion, representation.skeleton.mirror(motion)])
    for name, array in zip((row.name, f"M{row.name}"), features, strict=True):
        _save(folder / f"{name}.npy", array.numpy())


def _save(path: Path, array: np.ndarray) -> None:
    with atomic_write(path) as temporary:
        np.save(temporary, array)


def _read_joints(path: Path) -> np.ndarray:
    joints = read_npy(path)
    if (
        joints.dtype.kind not in "fiu"
        or joints.ndim != 3
        or joints.shape[1] < 22
        or joints.shape[2] != 3
    ):
        raise UserError(
            f"{path}: expected a numeric array of shape (frames, 22 or more joints, 3), but found "
            f"shape {joints.shape} and type {joints.dtype}"
        )
    return joints[:, :22]


class HumanML3DSMPL(MotionSource):
    """FLAME's version of the data set (Kim et al., AAAI 2023): SMPL parameters of entire clips.

    There is one clip per caption. The clips of a motion are called NAME#0, NAME#1 and so on. As in
    FLAME's code, there are no mirrored copies, length limits or cuts. A caption that describes only
    a part of a motion is used for the entire motion. In five subsets, HumanML3D dropped the first
    frames of each recording. Unlike FLAME's code, this class accounts for the dropped frames, so
    that motions and captions match.

    Args:
        path: folder of HumanML3D with texts, splits and `index.csv`. The folder does not have to
            contain motions.
        amass: folder with AMASS's SMPL+H G release, either unpacked or as archives.
        humanact12: path of FLAME's `humanact12_processed.pkl`. Without this file, the clips of
            HumanAct12 are left out.
        published_split: whether to also train on the validation clips, so that no clips are left
            for validation. FLAME's code calls this "final".
    """

    name = "humanml3d-smpl"

    def __init__(
        self,
        path: str,
        amass: str,
        humanact12: str | None = None,
        *,
        published_split: bool = False,
        exclude: Sequence[str] = (),
        workers: int = 0,
    ):
        self.folder, self.amass = HumanML3D(path, exclude), Amass(Path(amass))
        self.humanact12 = Path(humanact12) if humanact12 else None
        self.published_split, self.workers = published_split, workers
        self.options = {"published_split": published_split, "exclude": list(exclude)}

    @cached_property
    def rows(self) -> list[IndexedClip]:
        """The clips to read, in the order of the index."""
        rows = [row for row in self.folder.rows if row.name in self.folder.names]
        if absent := [row.name for row in rows if not self.folder.texts.get(row.name)]:
            lacking = f"{len(absent)} clips have no text, such as {absent[0]}"
            raise FileNotFoundError(f"{self.folder.path}: {lacking}; unpack texts.zip again")
        used = [row for row in rows if self.humanact12 or not row.humanact12]
        # Only originals are counted, because mirrored copies are not used.
        listed = sum(not name.startswith("M") for name in self.folder.names)
        excluded = sum(not name.startswith("M") for name in self.folder.exclude)
        self.leave_out("motions by data.source.exclude", excluded)
        self.leave_out("motions that index.csv lacks", listed - len(rows))
        self.leave_out(
            "motions of HumanAct12, as data.source.humanact12 is not given", len(rows) - len(used)
        )
        return used

    def count(self) -> int:
        """Returns the number of clips, one per caption.

        Raises:
            FileNotFoundError: If recordings are missing.
        """
        self.amass.check(by_recording(self.rows))
        return sum(len(self.folder.texts[row.name]) for row in self.rows)

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields the clips from AMASS, followed by the clips from HumanAct12."""
        self.check_fps(fps, FPS)
        from_amass = by_recording(self.rows)
        for key, motions in self.amass.map(from_amass, _parameters, self.workers):
            for row, motion in zip(from_amass[key], motions, strict=True):
                yield from self._clips(row, motion)
        if self.humanact12:
            yield from self._from_humanact12(self.humanact12)

    def _from_humanact12(self, path: Path) -> Iterator[Clip]:
        """Yields the clips of HumanAct12 as SMPL poses.

        As in FLAME's code, the root position is used as SMPL's translation.
        """
        data = restricted_pickle.read(path)
        for row in sorted((row for row in self.rows if row.humanact12), key=lambda row: row.key):
            entry = (
                data.get(f"{row.key}.npy", data.get(row.key)) if isinstance(data, dict) else None
            )
            if entry is None:
                self.leave_out(f"motions of HumanAct12 that {path.name} lacks")
                continue
            errors = (KeyError, TypeError, ValueError, IndexError)
            with naming(
                path, *errors, prefix=f"{row.key} lacks poses (F, 72) or joints3D (F, 24, 3): "
            ):
                poses = np.asarray(entry["poses"], np.float32)
                motion = np.concatenate(
                    [np.asarray(entry["joints3D"], np.float32)[:, 0], poses.reshape(-1, 72)], 1
                )
            yield from self._clips(row, motion)

    def _clips(self, row: IndexedClip, motion: np.ndarray) -> Iterator[Clip]:
        if not len(motion):
            self.leave_out("motions without a frame")
            return
        split = self.folder.names[row.name]
        if self.published_split and split == "val":
            split = "train"
        for number, description in enumerate(self.folder.texts[row.name]):
            caption = description.caption.removesuffix(".") + "."
            yield Clip(f"{row.name}#{number}", motion, [caption], split, row.name)


def _parameters(rows: Sequence[IndexedClip], recording: Recording) -> list[np.ndarray]:
    motion = recording.every(FPS).parameters()
    return [motion[row.frames(len(motion))] for row in rows]
