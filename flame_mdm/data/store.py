"""Stores of prepared data: packed clips with an index, statistics and hashes.

All clips are in one memory-mapped array. A store is a folder that is written once and never
changed:

    features.npy     (N, D) float32, the unnormalized frames of all clips, concatenated
    clips.jsonl      one clip per line: id, start, length, split, source, captions,
                     action, attributes
    statistics.npz   mean and std (D,) of the training frames, used by the representation for normalization
    references.npz   joint positions (F', J, 3) float32 by clip id, at the frame rate of the
                     recording; written only if the data set contains them
    store.json       representation, frame rate, options of the source, counts, hashes of the other
                     files, fingerprint

Verifying the store adds the report `verify.json` to the folder.
"""

import hashlib
import json
import os
import zipfile
from collections import Counter, deque
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import IO, Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from flame_mdm.data import SPLITS, Clip, MotionSource, Split, advice_on_splits
from flame_mdm.data.parallel import in_order
from flame_mdm.errors import UserError, first_line, say
from flame_mdm.progress import ProgressBar
from flame_mdm.representations import Frames, Representation
from flame_mdm.safe_io import (
    atomic_folder,
    locked,
    naming,
    parse_json,
    read_json,
    read_npy,
    read_npz,
    regular_file,
    sha256,
)
from flame_mdm.safe_io.paths import check_within, remove_abandoned
from flame_mdm.schemas import Int, Schema, check_shape

FILES = ("features.npy", "clips.jsonl", "statistics.npz", "references.npz")
"""Files that `store.json` lists with their hashes.

Other files in the folder are never removed.
"""
BLOCK = 8192  # number of frames that are read together for the statistics
Count = Annotated[int, Field(ge=0, lt=2**63)]


@dataclass(frozen=True)
class Entry:
    """A clip in a store: `length` frames of the packed array, beginning with frame `start`.

    All other fields have the same meaning as in `Clip`.
    """

    id: Annotated[str, Field(min_length=1)]
    start: Count
    length: Annotated[Count, Field(ge=1)]
    split: Split
    source: str
    captions: list[str]
    action: Count | None
    attributes: dict[str, Any] = field(default_factory=dict)
    license: str = ""


class Contents(Schema):
    """The values in store.json that commands need."""

    format: Literal[1]
    dataset: str
    representation: str
    fingerprint: str
    published_split: bool
    actions: list[str]
    shape: Annotated[list[Count], Field(min_length=2, max_length=2)]
    version: Int = 1
    clips: Annotated[dict[Split, Int], Field(min_length=len(SPLITS))]
    excluded: dict[str, Int]
    sha256: dict[str, str]
    fps: Annotated[float, Field(ge=0, lt=1e9)]
    hours: Annotated[float, Field(ge=0, lt=1e9)]
    source: dict[str, Any] = Field({})


class Store:
    """A prepared data set, opened for reading.

    Raises:
        FileNotFoundError: If `folder` contains no store.
        UserError: If the files of the store are damaged.
    """

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        contents = self.folder / "store.json"
        if not contents.exists():
            raise FileNotFoundError(f"{folder}: no prepared data set. Run `make prepare`")
        with _intact(contents):
            self.info: dict[str, Any] = read_json(contents)
            check_shape(self.info, Contents)
        # Results contain the fingerprint. It is the same on every machine for the same clips and
        # options.
        self.fingerprint: str = self.info["fingerprint"]
        self._check("clips.jsonl", "statistics.npz")
        frames, width = self.info["shape"]
        with _intact(self.folder / "features.npy") as path:
            self.features: np.ndarray = read_npy(path, mmap=True)
            if self.features.shape != (frames, width) or self.features.dtype != np.float32:
                raise ValueError(
                    f"its shape is {self.features.shape} instead of {(frames, width)}, or it is not float32"
                )
        self.clips = _entries(self.folder / "clips.jsonl", frames, len(self.info["actions"]))
        with _intact(self.folder / "statistics.npz") as path:
            statistics = read_npz(path)
            self.mean, self.std = statistics["mean"], statistics["std"]
            kinds = {self.mean.dtype.kind, self.std.dtype.kind}
            if not self.mean.shape == self.std.shape == (width,) or kinds != {"f"}:
                raise ValueError(f"it does not contain the mean and std of {width} features")
        name, fps = self.info["representation"], self.info["fps"]
        with _intact(contents):
            version = self.info.get("version", 1)
            if (
                _fingerprint(self.folder, name, fps, self.mean, self.std, version)
                != self.fingerprint
            ):
                raise ValueError("its fingerprint does not match the clips")

    def motion(self, clip: Entry) -> np.ndarray:
        """Returns the unnormalized features (F, D) float32 of a clip.

        The result is a view of the memory-mapped array.
        """
        return self.features[clip.start : clip.start + clip.length]

    def references(self, ids: Sequence[str]) -> list[np.ndarray] | None:
        """Returns the joint positions of clips at the frame rate of their recordings.

        Returns None if positions are missing for any of the clips.
        """
        if "references.npz" not in self.info["sha256"]:
            return None
        self._check("references.npz")
        joints = read_npz(self.folder / "references.npz", only=set(ids))
        return [joints[name] for name in ids] if joints.keys() == set(ids) else None

    def licenses(self) -> list[dict[str, Any]]:
        """Lists each license with its number of clips, total minutes and actions.

        The list is empty if the data set does not specify licenses. A clip and its copies count as
        one clip.
        """
        frames: dict[str, dict[int, int]] = {}
        actions: dict[str, set[str]] = {}
        for clip in self.clips:
            if clip.license:
                frames.setdefault(clip.license, {})[clip.start] = clip.length
                names = actions.setdefault(clip.license, set())
                if clip.action is not None:
                    names.add(self.info["actions"][clip.action])
        return [
            {
                "license": license,
                "clips": len(lengths),
                "minutes": round(sum(lengths.values()) / self.info["fps"] / 60, 1),
                "actions": sorted(actions[license]),
            }
            for license, lengths in sorted(frames.items())
        ]

    def verify(self) -> None:
        """Checks the hashes of the features and the references.

        The other files were checked when the store was opened.
        """
        self._check("features.npy", *{"references.npz"} & self.info["sha256"].keys())

    def _check(self, *names: str) -> None:
        for name in names:
            with _intact(self.folder / name) as path:
                regular_file(path)
                if sha256(path) != self.info["sha256"].get(name):
                    raise ValueError("its hash differs from the hash in store.json")


def write_store(folder: Path, source: MotionSource, representation: Representation) -> Store:
    """Encodes every clip of a data set and writes the store.

    The store has a temporary name until it is complete. If another process is writing the same
    store, this function waits and then opens this store. If data cannot be read, no files are left
    behind. An existing intact store is replaced.

    Raises:
        UserError: If `folder` contains anything other than an intact store.
    """
    source.suit(representation)
    total, before = source.count(), (folder / "store.json").exists()
    lock = folder.with_name(folder.name + ".lock")
    waiting = f"{folder}: another process is preparing it; waiting"
    with locked(lock, lambda _: say(waiting), "prepare in one process at a time"):
        # This process holds the lock, so temporary files of all other processes can be removed.
        remove_abandoned(folder.parent, folder, is_locked=True)
        remove_abandoned(folder.parent)
        if before or not (folder / "store.json").exists():
            replaced = _replaceable(folder)
            with atomic_folder(folder, within=folder.parent) as temporary:
                _write(temporary, source, representation, total)
                for file in replaced:
                    file.unlink()
    return Store(folder)


def _replaceable(folder: Path) -> list[Path]:
    """Returns the files of the store in a folder, beginning with `store.json`.

    The list is empty if the folder is missing or empty.

    Raises:
        UserError: If the folder is a link, contains other files but no store, or contains a
            damaged store.
    """
    check_within(folder, folder.parent)
    if not folder.is_dir() or not any(folder.iterdir()):
        return []
    if not (folder / "store.json").is_file():
        raise UserError(
            f"{folder}: exists, but is not a prepared data set, so it is not replaced. Choose another data_root or "
            "data.name, or move this folder elsewhere"
        )
    store = Store(folder)
    store.verify()
    return [
        folder / "store.json",
        *(folder / name for name in FILES if name in store.info["sha256"]),
    ]


def _write(folder: Path, source: MotionSource, representation: Representation, total: int) -> None:
    bar = ProgressBar(
        source.clips(representation.fps), f"preparing {source.name}", total, unit=" clips"
    )
    with bar as clips, closing(_encoded(clips, representation, source.workers)) as encoded:
        entries, frames = _pack(folder, source.name, encoded, representation.features)
    splits = Counter(entry.split for entry in entries)
    if not splits["train"]:
        reason = f"{source.name}: no clip is in the training split."
        raise UserError(f"{reason}{advice_on_splits(source)}")
    index = "".join(f"{_line(entry)}\n" for entry in entries)
    (folder / "clips.jsonl").write_text(index, encoding="utf-8")
    mean, std = source.statistics() or training_statistics(folder, entries, frames, representation)
    mean, std = mean[: representation.features], std[: representation.features]
    np.savez(folder / "statistics.npz", mean=mean, std=std)
    info = {
        "format": 1,
        "dataset": source.name,
        "source": dict(source.options),
        "actions": list(source.actions),
        "published_split": source.published_split,
        "excluded": dict(source.excluded),
        "counts": source.counts(),
        "representation": representation.name,
        "fps": representation.fps,
        "clips": {split: splits[split] for split in SPLITS},
        "shape": [frames, representation.features],
        "hours": round(frames / representation.fps / 3600, 3),
        **({"version": source.version} if source.version > 1 else {}),
        "fingerprint": _fingerprint(
            folder, representation.name, representation.fps, mean, std, source.version
        ),
        "sha256": {path.name: sha256(path) for path in sorted(folder.iterdir())},
    }
    (folder / "store.json").write_text(json.dumps(info, indent=2) + "\n")


def _line(entry: Entry) -> str:
    """Returns the line that represents a clip in clips.jsonl.

    If the clip has no license, the key `license` is left out, as in older stores.
    """
    values = asdict(entry)
    if not entry.license:
        del values["license"]
    return json.dumps(values, ensure_ascii=False, sort_keys=True)


def _pack(
    folder: Path, name: str, encoded: Iterable[tuple[Clip, np.ndarray]], features: int
) -> tuple[list[Entry], int]:
    """Writes the features and references of the data set `name`, one clip at a time.

    Returns the entries of the clips and the total number of frames. Consecutive clips with the same
    motion share the frames of the motion.

    Raises:
        UserError: If a clip extends past the end of its motion, if two clips have the same id, or
            if clips of the same source are in different splits.
    """
    entries: dict[str, Entry] = {}
    split_of: dict[str, Split] = {}  # split of each source
    begin, frames, motion, references = 0, 0, None, None
    with ExitStack() as stack:
        packed = stack.enter_context((folder / "features.npy").open("wb"))
        _write_header(packed, 0, features)
        for clip, values in encoded:
            if clip.motion is not motion:
                motion, begin = clip.motion, frames
                frames += len(values)
                # Written with file operations, because with a memory map, a full disk would kill
                # the process (SIGBUS).
                packed.write(values.tobytes())
            first, length = clip.window or (0, len(values))
            if first < 0 or length < 1 or first + length > len(values):
                raise UserError(
                    f"clip {clip.id}: window {clip.window} exceeds {len(values)} frames"
                )
            if (other := split_of.setdefault(clip.source, clip.split)) != clip.split:
                raise UserError(
                    f"{name}: clips of {clip.source} are in both {other} and {clip.split}"
                )
            if clip.id in entries:
                raise UserError(f"{name}: two clips have the same id, {clip.id}")
            start, attributes = begin + first, dict(clip.attributes)
            entries[clip.id] = Entry(
                id=clip.id,
                start=start,
                length=length,
                split=clip.split,
                source=clip.source,
                captions=clip.captions,
                action=clip.action,
                attributes=attributes,
                license=clip.license,
            )
            if clip.reference is not None:
                references = references or stack.enter_context(
                    zipfile.ZipFile(folder / "references.npz", "w")
                )
                with references.open(f"{clip.id}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.asarray(clip.reference, np.float32))
        packed.seek(0)
        _write_header(packed, frames, features)
    return list(entries.values()), frames


def _write_header(file: IO[bytes], frames: int, features: int) -> None:
    """Writes a header to features.npy. NumPy pads it to the same size for any frame count."""
    np.lib.format.write_array_header_1_0(
        file, {"descr": "<f4", "fortran_order": False, "shape": (frames, features)}
    )


def training_statistics(
    folder: Path, clips: Iterable[Entry], frames: int, representation: Representation
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mean and std (D,) of the training frames in a store.

    The frames are read from the file in blocks.
    """
    training = np.zeros(frames, bool)  # cuts may overlap, but each frame counts only once
    for clip in clips:
        training[clip.start : clip.start + clip.length] |= clip.split == "train"

    def blocks() -> Iterator[np.ndarray]:
        with (folder / "features.npy").open("rb") as file:
            file.seek(-4 * frames * representation.features, os.SEEK_END)
            for begin in range(0, frames, BLOCK):
                block = np.fromfile(file, np.float32, BLOCK * representation.features)
                yield block.reshape(-1, representation.features)[training[begin : begin + BLOCK]]

    mean, std = representation.statistics(Frames(blocks, int(training.sum())))
    return mean.numpy(), std.numpy()


def _encoded(
    clips: Iterable[Clip], representation: Representation, workers: int
) -> Generator[tuple[Clip, np.ndarray]]:
    """Yields each clip with the features of its entire motion.

    Worker processes encode the motions. If several clips share a motion, the motion is encoded only
    once.
    """
    groups: deque[list[Clip]] = deque()

    def motions() -> Iterator[tuple[str, str, np.ndarray]]:
        for _, group in groupby(clips, key=lambda clip: id(clip.motion)):
            groups.append(list(group))
            first = groups[-1][0]
            yield first.id, first.encoded, first.motion

    for features in in_order(partial(_encode, representation), motions(), workers):
        yield from ((clip, features) for clip in groups.popleft())


def _encode(encoder: Representation, named: tuple[str, str, np.ndarray]) -> np.ndarray:
    """Returns the features of a motion.

    `named` consists of the name of the motion, the representation in which it was published, and
    the motion itself. The representation is "" if the motion is raw.
    """
    name, encoded, motion = named
    if encoded and encoded not in (encoder.name, encoder.part_of):
        raise UserError(
            f"clip {name}: its features are in the {encoded} representation, which cannot be "
            f"converted to {encoder.name}"
        )
    if not encoded:
        try:
            motion = encoder.encode(torch.from_numpy(np.ascontiguousarray(motion))).numpy()
        except ValueError as error:
            raise UserError(f"clip {name}: {error}") from error
    features = np.asarray(
        motion[:, : encoder.features] if encoded == encoder.part_of else motion, np.float32
    )
    if features.ndim != 2 or features.shape[1] != encoder.features:
        raise UserError(
            f"clip {name}: its features have shape {features.shape}, not (frames, {encoder.features})"
        )
    if not np.isfinite(features).all():
        frame = int(np.argwhere(~np.isfinite(features).all(1))[0, 0])
        raise UserError(
            f"clip {name}: the features of frame {frame} contain NaN or infinite values. "
            "Exclude the clip by name"
        )
    return features


def _fingerprint(
    folder: Path, representation: str, fps: float, mean: np.ndarray, std: np.ndarray, version: int
) -> str:
    digest = hashlib.sha256((folder / "clips.jsonl").read_bytes())
    # The last bits of features differ between processors and thread counts. Therefore, the
    # fingerprint contains only their statistics, rounded to a fixed number of decimals. Adding 0.0
    # makes -0.0 and 0.0 equal.
    rounded = [round(float(value), 4) + 0.0 for value in np.concatenate([mean, std])]
    versions = (
        [version] if version > 1 else []
    )  # fingerprints of version 1 do not contain the version
    digest.update(json.dumps([representation, fps, rounded, *versions]).encode())
    return digest.hexdigest()[:16]


@contextmanager
def _intact(path: Path) -> Iterator[Path]:
    """Yields the path of a file in a store, and converts errors in its content to a `UserError`."""
    try:
        yield path
    except (OSError, ValueError, KeyError) as error:
        raise UserError(
            f"{path} is damaged: {first_line(error)}. Delete {path.parent} and prepare the data "
            "set again"
        ) from error


def _entries(path: Path, frames: int, actions: int) -> list[Entry]:
    clips: list[Entry] = []
    # Lines are read from the file, because `str.splitlines` would also split captions at Unicode
    # separators.
    with (
        _intact(path),
        path.open(encoding="utf-8") as lines,
    ):
        for number, line in enumerate(lines, 1):
            with naming(f"line {number}", ValueError):
                clip: Entry = check_shape(parse_json(line), Entry, strict=False)
                if clip.start + clip.length > frames:
                    raise ValueError(
                        f"{clip.id}: frames {clip.start} to {clip.start + clip.length} exceed the {frames} "
                        "frames of the store"
                    )
                if clip.action is not None and clip.action >= actions:
                    raise ValueError(
                        f"{clip.id}: action {clip.action} is not one of the {actions} actions"
                    )
            clips.append(clip)
    return clips
