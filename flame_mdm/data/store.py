"""Stores of prepared data: all clips packed in one memory-mapped array, with an index, statistics and hashes.

A store is a folder that is written once and never changed:

    features.npy     (N, D) float32, the concatenated frames of all clips, not normalized
    clips.jsonl      one clip per line: id, start, length, split, source, captions, action, attributes
    statistics.npz   mean and std (D,) of the training frames, used by the representation for normalization
    references.npz   joints (F', J, 3) float32 by clip id, at the frame rate of the recording, if the data set has them
    store.json       representation, frame rate, options of the source, counts, hashes of the other files, fingerprint

Verification adds a report to the folder, `verify.json`.
"""

import functools
import hashlib
import io
import json
import shutil
import zipfile
from array import array
from collections import Counter, deque
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flame_mdm.data import SPLITS, Clip, MotionSource, Split
from flame_mdm.data.parallel import in_order
from flame_mdm.errors import UserError, first_line, say
from flame_mdm.progress import ProgressBar
from flame_mdm.representations import Frames, Representation
from flame_mdm.safe_io import locked, parse_json, read_json, read_npy, read_npz, regular_file, sha256, writing

FORMAT = 1
CHUNK = 4096  # frames that are encoded together
BLOCK = 8192  # frames that are read together for the statistics
_Motion = tuple[str, str, np.ndarray]
"""Clip that names a motion in errors, name of the representation or "", and the motion itself."""


@dataclass(frozen=True)
class Entry:
    """One clip of a store: frames `start` to `start + length` of the packed array; other fields as in `Clip`."""

    id: str
    start: int
    length: int
    split: Split
    source: str
    captions: list[str]
    action: int | None
    attributes: dict[str, Any] = field(default_factory=dict)


class Store:
    """A prepared data set, opened for reading.

    Raises:
        FileNotFoundError: If `folder` contains no store.
        UserError: If the files are damaged or do not belong together.
    """

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        self.info: dict[str, Any] = _read_info(self.folder)
        self._check("clips.jsonl", "statistics.npz")
        shape: list[int] = self.info["shape"]
        try:
            self.features: np.ndarray = read_npy(self.folder / "features.npy", mmap=True)
        except (UserError, OSError) as error:
            raise _damaged(self.folder / "features.npy", str(error)) from error
        if list(self.features.shape) != shape or len(shape) != 2 or self.features.dtype != np.float32:
            raise _damaged(self.folder / "features.npy", f"shape {self.features.shape}, not {shape}, or not float32")
        self.clips = _entries(self.folder / "clips.jsonl", shape[0], len(self.info["actions"]))
        try:
            statistics = read_npz(self.folder / "statistics.npz")
            self.mean, self.std = (statistics[name] for name in ("mean", "std"))
        except (UserError, KeyError) as error:
            raise _damaged(self.folder / "statistics.npz", str(error)) from error
        if not self.mean.shape == self.std.shape == (shape[1],) or {self.mean.dtype.kind, self.std.dtype.kind} != {"f"}:
            raise _damaged(self.folder / "statistics.npz", f"not a mean and std of {shape[1]} features")
        name, fps = self.info["representation"], self.info["fps"]
        if _fingerprint(self.folder, name, fps, self.mean, self.std) != self.fingerprint:
            raise _damaged(self.folder / "store.json", "its fingerprint does not match the clips")

    @property
    def fingerprint(self) -> str:
        """Identifier of the data in results: equal for equal clips and options, on any machine."""
        return self.info["fingerprint"]

    def motion(self, clip: Entry) -> np.ndarray:
        """Returns the features (F, D) float32 of a clip, not normalized: a view of the memory-mapped array."""
        return self.features[clip.start : clip.start + clip.length]

    def references(self, ids: Sequence[str]) -> list[np.ndarray] | None:
        """Returns the joints of clips at the frame rate of their recording; None if a clip has none."""
        if "references.npz" not in self.info["sha256"]:
            return None
        self._check("references.npz")
        joints = read_npz(self.folder / "references.npz", only=set(ids))
        return [joints[name] for name in ids] if joints.keys() == set(ids) else None

    def verify(self) -> None:
        """Checks the hashes of the features and references; opening the store checks the other files only."""
        self._check("features.npy", *{"references.npz"} & self.info["sha256"].keys())

    def _check(self, *names: str) -> None:
        for name in names:
            if _sha256(self.folder / name) != self.info["sha256"].get(name):
                raise _damaged(self.folder / name, "its hash differs from the one in store.json")


def write_store(folder: Path, source: MotionSource, representation: Representation) -> Store:
    """Encodes every clip of a data set and writes the store, under a temporary name until it is complete.

    If another process is writing it, waits and opens the result. If data cannot be read, leaves no files behind.
    """
    total, before = source.count(), (folder / "store.json").exists()
    lock = folder.with_name(folder.name + ".lock")
    waiting = f"{folder}: another process is preparing it; waiting"
    with locked(lock, lambda _: say(waiting), "prepare in one process at a time"):
        if before or not (folder / "store.json").exists():
            _write(folder, source, representation, total)
    return Store(folder)


def _write(folder: Path, source: MotionSource, representation: Representation, total: int) -> None:
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        with writing(folder, partial):
            partial.mkdir(parents=True)
        bar = ProgressBar(source.clips(representation.fps), f"preparing {source.name}", total, unit=" clips")
        with bar as clips, _Writer(folder, partial, representation.features) as writer:
            with closing(_encoded(clips, representation, source.workers)) as encoded:
                for clip, features in encoded:
                    writer.add(source.name, clip, features)
            writer.finish(source.name)
        mean, std = source.statistics() or writer.statistics(representation)
        mean, std = mean[: representation.features], std[: representation.features]
        with writing(folder, partial):
            np.savez(partial / "statistics.npz", mean=mean, std=std)
            info = {
                "format": FORMAT,
                "dataset": source.name,
                "source": dict(source.options),
                "actions": list(source.actions),
                "published_split": source.published_split,
                "excluded": dict(source.excluded),
                "counts": source.counts(),
                "representation": representation.name,
                "fps": representation.fps,
                "clips": {split: writer.splits[split] for split in SPLITS},
                "shape": [writer.frames, representation.features],
                "hours": round(writer.frames / representation.fps / 3600, 3),
                "fingerprint": _fingerprint(partial, representation.name, representation.fps, mean, std),
                "sha256": {path.name: _sha256(path) for path in sorted(partial.iterdir())},
            }
            (partial / "store.json").write_text(json.dumps(info, indent=2) + "\n")
            shutil.rmtree(folder, ignore_errors=True)
            partial.rename(folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


class _Writer(ExitStack):
    """Writes the files of a store clip by clip into its temporary folder `partial`; keeps a few numbers per clip."""

    def __init__(self, folder: Path, partial: Path, features: int):
        super().__init__()
        self.folder, self.partial, self.features = folder, partial, features
        self.splits: Counter[str] = Counter()
        self.frames, self._begin, self._motion = 0, 0, None
        self._split_of: dict[str, str] = {}  # source -> split
        self._ids: set[str] = set()
        self._training = array("q")  # start and end of each training clip
        self._references: zipfile.ZipFile | None = None
        self._packed = self.enter_context((partial / "features.npy").open("wb", buffering=0))
        self._index = self.enter_context((partial / "clips.jsonl").open("wb", buffering=0))
        self._packed.seek(len(_header(0, features)))  # the header is written at the end

    def add(self, name: str, clip: Clip, features: np.ndarray) -> None:
        """Writes a clip of the data set `name`, and the features of its motion unless the previous clip has the same.

        Raises `UserError` if the clip exceeds its motion, or its id or split contradicts that of another clip.
        """
        if clip.motion is not self._motion:
            self._motion, self._begin = clip.motion, self.frames
            self.frames += len(features)
            self._append(self._packed, features.tobytes())
        first, length = clip.window or (0, len(features))
        if first < 0 or length < 1 or first + length > len(features):
            raise UserError(f"clip {clip.id}: window {clip.window} exceeds {len(features)} frames")
        if (other := self._split_of.setdefault(clip.source, clip.split)) != clip.split:
            raise UserError(f"{name}: clips of {clip.source} are in both {other} and {clip.split}")
        if clip.id in self._ids:
            raise UserError(f"{name}: two clips have the same id, {clip.id}")
        self._ids.add(clip.id)
        self.splits[clip.split] += 1
        start, attributes = self._begin + first, dict(clip.attributes)
        if clip.split == "train":
            self._training.extend((start, start + length))
        entry = Entry(clip.id, start, length, clip.split, clip.source, clip.captions, clip.action, attributes)
        self._append(self._index, (json.dumps(asdict(entry), ensure_ascii=False, sort_keys=True) + "\n").encode())
        if clip.reference is not None:
            with writing(self.folder, self.partial):
                if self._references is None:
                    self._references = self.enter_context(zipfile.ZipFile(self.partial / "references.npz", "w"))
                with self._references.open(f"{clip.id}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.asarray(clip.reference, np.float32))

    def finish(self, name: str) -> None:
        """Completes the files; raises `UserError` if no clip of the data set `name` is in the training split."""
        if not self.splits["train"]:
            advice = "For your own data, add a `split` column to captions.csv"
            raise UserError(f"{name}: no clip is in the training split. {advice}")
        self._packed.seek(0)
        self._append(self._packed, _header(self.frames, self.features))
        self.close()

    def __exit__(self, *details: Any) -> bool | None:
        with writing(self.folder, self.partial):  # a zip archive is completed when it is closed
            return super().__exit__(*details)

    def statistics(self, representation: Representation) -> tuple[np.ndarray, np.ndarray]:
        """Returns mean and std of the training frames, which are read from the file."""
        training = np.zeros(self.frames, bool)  # cuts may overlap; each frame counts once
        for start, end in zip(self._training[::2], self._training[1::2], strict=True):
            training[start:end] = True

        def frames() -> Iterator[np.ndarray]:
            with (self.partial / "features.npy").open("rb") as file:
                file.seek(len(_header(0, self.features)))
                for begin in range(0, self.frames, BLOCK):
                    used = training[begin : begin + BLOCK]
                    block = np.fromfile(file, np.float32, len(used) * self.features)
                    yield block.reshape(len(used), self.features)[used]

        mean, std = representation.statistics(Frames(frames, int(training.sum())))
        return mean.numpy(), std.numpy()

    def _append(self, file: io.FileIO, content: bytes) -> None:
        """Writes all bytes. Through a memory map, a full disk would kill the process (SIGBUS)."""
        left = memoryview(content)
        with writing(self.folder / Path(file.name).name, self.folder):
            while left:
                left = left[file.write(left) or 0 :]


def _encoded(clips: Iterable[Clip], representation: Representation, workers: int) -> Generator[tuple[Clip, np.ndarray]]:
    """Yields each clip with the features of its entire motion, encoded in worker processes, each shared motion once."""
    chunks: deque[tuple[list[Clip], list[int]]] = deque()
    iterator = iter(clips)
    first = list(islice(iterator, 1))
    if first and first[0].encoded:  # published features are only copied
        workers = 1

    def motions() -> Iterator[list[_Motion]]:
        for chunk in _chunks(chain(first, iterator)):
            whole = {id(clip.motion): (clip.id, clip.encoded, clip.motion) for clip in chunk}
            chunks.append((chunk, list(whole)))
            yield list(whole.values())

    for arrays in in_order(functools.partial(_encode, representation), motions(), workers):
        chunk, keys = chunks.popleft()
        features = dict(zip(keys, arrays, strict=True))
        yield from ((clip, features[id(clip.motion)]) for clip in chunk)


def _chunks(clips: Iterable[Clip]) -> Iterator[list[Clip]]:
    """Yields consecutive clips whose motions have `CHUNK` frames together, or a single one that is longer."""
    chunk: list[Clip] = []
    frames = 0
    for clip in clips:
        fresh = 0 if chunk and clip.motion is chunk[-1].motion else len(clip.motion)
        if chunk and fresh and frames + fresh > CHUNK:
            yield chunk
            chunk, frames = [], 0
        chunk.append(clip)
        frames += fresh
    if chunk:
        yield chunk


def _encode(encoder: Representation, motions: Sequence[_Motion]) -> list[np.ndarray]:
    """Returns the features of motions; published features are only checked."""
    for name, encoded, _ in motions:
        if encoded and encoded not in (encoder.name, encoder.part_of):
            raise UserError(f"clip {name}: published as {encoded}, which cannot be converted to {encoder.name}")
    raw = [torch.from_numpy(np.ascontiguousarray(motion)) for _, encoded, motion in motions if not encoded]
    try:
        fresh = iter(encoder.encode_many(raw) if raw else [])
    except ValueError as error:
        if len(motions) == 1:
            raise UserError(f"clip {motions[0][0]}: {error}") from error
        return [features for motion in motions for features in _encode(encoder, [motion])]  # names the clip
    arrays = []
    for name, encoded, motion in motions:
        features = np.asarray(motion if encoded else next(fresh).numpy(), np.float32)
        features = features[:, : encoder.features] if encoded == encoder.part_of else features
        if features.ndim != 2 or features.shape[1] != encoder.features:
            raise UserError(f"clip {name}: shape {features.shape}, not (frames, {encoder.features})")
        if not np.isfinite(features).all():
            frame = int(np.argwhere(~np.isfinite(features).all(1))[0, 0])
            raise UserError(f"clip {name}: the features of frame {frame} are not finite. Exclude it by name")
        arrays.append(features)
    return arrays


def _header(frames: int, features: int) -> bytes:
    """Returns the header of features.npy. NumPy pads it to the same size for any number of frames."""
    header = io.BytesIO()
    array = np.empty((0, features), np.float32)
    content = np.lib.format.header_data_from_array_1_0(array) | {"shape": (frames, features)}
    np.lib.format.write_array_header_1_0(header, content)
    return header.getvalue()


def _fingerprint(folder: Path, representation: str, fps: float, mean: np.ndarray, std: np.ndarray) -> str:
    digest = hashlib.sha256((folder / "clips.jsonl").read_bytes())
    # Features differ in their last bits between processors and thread counts, so the fingerprint depends on them only
    # through statistics rounded to a fixed number of decimals. Adding 0.0 makes -0.0 and 0.0 equal.
    rounded = [round(float(value), 4) + 0.0 for value in np.concatenate([mean, std])]
    digest.update(json.dumps([representation, fps, rounded]).encode())
    return digest.hexdigest()[:16]


INFO: dict[str, type | tuple[type, ...]] = {
    **dict.fromkeys(("dataset", "representation", "fingerprint"), str),
    **dict.fromkeys(("actions", "shape"), list),
    **dict.fromkeys(("excluded", "clips", "sha256"), dict),
    **dict.fromkeys(("fps", "hours"), (int, float)),
    "published_split": bool,
}
"""Types of the values of store.json that commands rely on."""


def _read_info(folder: Path) -> dict[str, Any]:
    try:
        info = read_json(folder / "store.json")
    except FileNotFoundError:
        raise FileNotFoundError(f"{folder}: no prepared data set; run `make prepare`") from None
    except UserError as error:
        raise _damaged(folder / "store.json", str(error)) from error
    if not isinstance(info, dict) or info.get("format") != FORMAT:
        raise UserError(f"{folder}: not a store of format {FORMAT}. Prepare the data set again")
    wrong = [name for name, kind in INFO.items() if not isinstance(info.get(name), kind)]
    if not wrong:
        counts = info["clips"]
        is_usable = {name: 0 <= info[name] < 1e9 for name in ("fps", "hours")}
        is_usable["clips"] = counts.keys() == set(SPLITS) and all(type(n) is int for n in counts.values())
        is_usable["actions"] = all(isinstance(name, str) for name in info["actions"])
        is_usable["source"] = isinstance(info.get("source", {}), dict)
        wrong = [name for name, usable in is_usable.items() if not usable]
    if wrong:
        raise _damaged(folder / "store.json", f"no valid {wrong[0]}")
    return info


def _entries(path: Path, frames: int, actions: int) -> list[Entry]:
    clips: list[Entry] = []
    try:
        with path.open(encoding="utf-8") as lines:  # not splitlines: captions may contain other line separators
            for line in lines:
                clip = Entry(**parse_json(line))
                if wrong := _wrong_field(clip, actions):
                    raise ValueError(f"no valid {wrong}: {getattr(clip, wrong)!r:.80}")
                if clip.start < 0 or clip.length < 1 or clip.start + clip.length > frames:
                    raise ValueError(f"{clip.id}: frames {clip.start} to {clip.start + clip.length} exceed {frames}")
                clips.append(clip)
    except UnicodeDecodeError as error:
        raise _damaged(path, "not a UTF-8 text file") from error
    except (TypeError, ValueError) as error:
        raise _damaged(path, f"line {len(clips) + 1}: {first_line(error)}") from error
    return clips


def _wrong_field(clip: Entry, actions: int) -> str | None:
    """Returns the first field of a clip with a value of the wrong type, or None."""
    is_right = {
        "id": isinstance(clip.id, str) and clip.id != "",
        "start": type(clip.start) is int,
        "length": type(clip.length) is int,
        "split": clip.split in SPLITS,
        "source": isinstance(clip.source, str),
        "captions": isinstance(clip.captions, list) and all(isinstance(text, str) for text in clip.captions),
        "action": clip.action is None or (type(clip.action) is int and 0 <= clip.action < actions),
        "attributes": isinstance(clip.attributes, dict),
    }
    return next((name for name, right in is_right.items() if not right), None)


def _damaged(path: Path, what: str) -> UserError:
    return UserError(f"{path}: damaged: {what}. Delete {path.parent} and prepare the data set again")


def _sha256(path: Path) -> str:
    try:
        regular_file(path)
        return sha256(path)
    except (UserError, OSError) as error:
        raise _damaged(path, str(error)) from error
