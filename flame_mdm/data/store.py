"""Stores of prepared data: all clips packed in one memory-mapped array, with an index, statistics and hashes.

A store is a folder that is written once and never changed:

    features.npy     (N, D) float32, the concatenated frames of all clips, not normalized
    clips.jsonl      one clip per line: id, start, length, split, source, captions, action, attributes
    statistics.npz   mean and std (D,) of the training frames, used by the representation for normalization
    references.npz   joints (F', J, 3) float32 by clip id, at the frame rate of the recording, if the data set has them
    store.json       representation, frame rate, options of the source, counts, hashes of the other files, fingerprint

Verification adds a report to the folder, `verify.json`.
"""

from __future__ import annotations

import hashlib
import io
import json
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from tqdm import tqdm

from flame_mdm.data import Clip, MotionSource, Split
from flame_mdm.data.parallel import locked
from flame_mdm.errors import UserError, first_line, say
from flame_mdm.files import parse_json, read_json, read_npy, read_npz, regular_file, sha256, writing
from flame_mdm.representations import Representation

FORMAT = 1
CHUNK = 64
SPLITS = get_args(Split)


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
        FileNotFoundError: `folder` contains no store.
        ValueError: the files are damaged or do not belong together.
    """

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        self.info: dict[str, Any] = _read_info(self.folder)
        for name in ("clips.jsonl", "statistics.npz"):
            if _sha256(self.folder / name) != self.info["sha256"].get(name):
                raise _damaged(self.folder / name, "its hash differs from the one in store.json")
        shape: list[int] = self.info["shape"]
        try:
            self.features: np.ndarray = read_npy(self.folder / "features.npy", mmap=True)
        except (UserError, OSError, ValueError) as error:
            raise _damaged(self.folder / "features.npy", str(error)) from error
        if list(self.features.shape) != shape or len(shape) != 2 or self.features.dtype != np.float32:
            raise _damaged(self.folder / "features.npy", f"shape {self.features.shape}, not {shape}, or not float32")
        self.clips = _entries(self.folder / "clips.jsonl", shape[0], len(self.info["actions"]))
        try:
            statistics = read_npz(self.folder / "statistics.npz")
            self.mean, self.std = (statistics[name] for name in ("mean", "std"))
        except (ValueError, KeyError) as error:
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
        """Returns the joints of clips at the frame rate of their recording; None if a clip has none.

        Raises:
            ValueError: references.npz has changed since it was written.
        """
        if "references.npz" not in self.info["sha256"]:
            return None
        self._check("references.npz")
        found = read_npz(self.folder / "references.npz", only=set(ids))
        return [found[name] for name in ids] if found.keys() == set(ids) else None

    def verify(self) -> None:
        """Checks the hashes of the features and references; opening the store checks the other files only.

        Raises:
            ValueError: one of them has changed since it was written.
        """
        for name in {"features.npy"} | ({"references.npz"} & self.info["sha256"].keys()):
            self._check(name)

    def _check(self, name: str) -> None:
        if _sha256(self.folder / name) != self.info["sha256"].get(name):
            raise _damaged(self.folder / name, "its hash differs from the one in store.json")


def write_store(folder: Path, source: MotionSource, representation: Representation) -> Store:
    """Encodes every clip of a data set and writes the store, under a temporary name until it is complete.

    If another process is writing the store, waits for it and opens the result.

    Raises:
        FileNotFoundError, ValueError: the data set cannot be read, or features are not finite. No files are left
            behind.
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
        entries: list[Entry] = []
        motion, begin, frames = None, 0, 0
        bar = tqdm(source.clips(representation.fps), f"preparing {source.name}", total, unit=" clips")
        references: dict[str, np.ndarray] = {}
        with bar as clips, (partial / "features.npy").open("wb", buffering=0) as file:
            _append(file, folder, _header(frames, representation.features))
            for chunk in _batched(clips, CHUNK):
                for clip, features in zip(chunk, _encode(chunk, representation), strict=True):
                    if clip.motion is not motion:
                        motion, begin = clip.motion, frames
                        frames += len(features)
                        _append(file, folder, features.tobytes())
                    first, length = clip.window or (0, len(features))
                    if first < 0 or length < 1 or first + length > len(features):
                        raise ValueError(f"clip {clip.id}: window {clip.window} exceeds {len(features)} frames")
                    entry = Entry(clip.id, begin + first, length, clip.split, clip.source, clip.captions, clip.action)
                    entries.append(replace(entry, attributes=dict(clip.attributes)))
                    if clip.reference is not None:
                        references[clip.id] = np.asarray(clip.reference, np.float32)
            _check_entries(source.name, entries)
            file.seek(0)
            _append(file, folder, _header(frames, representation.features))
        packed = np.load(partial / "features.npy", mmap_mode="r")
        mean, std = source.statistics() or _statistics(representation, packed, entries)
        lines = [json.dumps(asdict(entry), ensure_ascii=False, sort_keys=True) for entry in entries]
        with writing(folder, partial):
            (partial / "clips.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
            np.savez(partial / "statistics.npz", mean=mean, std=std)
            if references:
                np.savez(partial / "references.npz", **references)  # type: ignore[arg-type]
            info = _describe(partial, source, representation, entries, frames, mean, std)
            (partial / "store.json").write_text(json.dumps(info, indent=2) + "\n")
            shutil.rmtree(folder, ignore_errors=True)
            partial.rename(folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _encode(clips: Sequence[Clip], representation: Representation) -> list[np.ndarray]:
    """Returns the features of each clip's entire motion; encodes a motion shared by several clips once."""
    whole = {id(clip.motion): clip for clip in clips}
    for clip in whole.values():
        if clip.encoded and clip.encoded != representation.name:
            raise ValueError(
                f"clip {clip.id}: published as {clip.encoded}, which cannot be converted to {representation.name}"
            )
    raw = [torch.from_numpy(np.ascontiguousarray(clip.motion)) for clip in whole.values() if not clip.encoded]
    try:
        fresh = iter(representation.encode_many(raw) if raw else [])
    except ValueError as error:
        if len(clips) == 1:
            raise ValueError(f"clip {clips[0].id}: {error}") from error
        return [features for clip in clips for features in _encode([clip], representation)]  # names the clip
    arrays: dict[int, np.ndarray] = {}
    for key, clip in whole.items():
        features = np.asarray(clip.motion if clip.encoded else next(fresh).numpy(), np.float32)
        if features.ndim != 2 or features.shape[1] != representation.features:
            raise ValueError(f"clip {clip.id}: shape {features.shape}, not (frames, {representation.features})")
        if not np.isfinite(features).all():
            frame = int(np.argwhere(~np.isfinite(features).all(1))[0, 0])
            raise ValueError(f"clip {clip.id}: the features of frame {frame} are not finite. Exclude it by name")
        arrays[key] = features
    return [arrays[id(clip.motion)] for clip in clips]


def _batched(clips: Iterable[Clip], size: int) -> Iterator[list[Clip]]:
    iterator = iter(clips)
    while chunk := list(islice(iterator, size)):
        yield chunk


def _statistics(
    representation: Representation, packed: np.ndarray, entries: list[Entry]
) -> tuple[np.ndarray, np.ndarray]:
    training = np.zeros(len(packed), bool)  # cuts may overlap; each frame counts once
    for entry in entries:
        training[entry.start : entry.start + entry.length] |= entry.split == "train"
    mean, std = representation.statistics(torch.from_numpy(packed[training]))
    return mean.numpy(), std.numpy()


def _check_entries(name: str, entries: list[Entry]) -> None:
    seen: dict[str, str] = {}
    for entry in entries:
        if seen.setdefault(entry.source, entry.split) != entry.split:
            raise ValueError(f"{name}: clips of {entry.source} are in both {seen[entry.source]} and {entry.split}")
    if len({entry.id for entry in entries}) != len(entries):
        raise ValueError(f"{name}: two clips have the same id")
    if not any(entry.split == "train" for entry in entries):
        advice = "For your own data, add a `split` column to captions.csv"
        raise ValueError(f"{name}: no clip is in the training split. {advice}")


def _header(frames: int, features: int) -> bytes:
    """Returns the header of features.npy. NumPy pads it to the same size for any number of frames."""
    header = io.BytesIO()
    array = np.empty((0, features), np.float32)
    content = np.lib.format.header_data_from_array_1_0(array) | {"shape": (frames, features)}
    np.lib.format.write_array_header_1_0(header, content)
    return header.getvalue()


def _append(file: io.RawIOBase, folder: Path, content: bytes) -> None:
    """Writes all bytes of a part of features.npy. With a memory map, a full disk would kill the process (SIGBUS)."""
    left = memoryview(content)
    with writing(folder / "features.npy", folder):
        while left:
            left = left[file.write(left) or 0 :]


def _describe(
    folder: Path,
    source: MotionSource,
    representation: Representation,
    entries: list[Entry],
    frames: int,
    mean: np.ndarray,
    std: np.ndarray,
) -> dict[str, Any]:
    splits = {split: sum(e.split == split for e in entries) for split in ("train", "val", "test")}
    return {
        "format": FORMAT,
        "dataset": source.name,
        "source": dict(source.options),
        "actions": list(source.actions),
        "published_split": source.published_split,
        "excluded": source.excluded(),
        "counts": source.counts(),
        "representation": representation.name,
        "fps": representation.fps,
        "clips": splits,
        "shape": [frames, representation.features],
        "hours": round(frames / representation.fps / 3600, 3),
        "fingerprint": _fingerprint(folder, representation.name, representation.fps, mean, std),
        "sha256": {path.name: _sha256(path) for path in sorted(folder.iterdir())},
    }


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
        raise ValueError(f"{folder}: not a store of format {FORMAT}. Prepare the data set again")
    wrong = [name for name, kind in INFO.items() if not isinstance(info.get(name), kind)]
    if not wrong:
        counts, numbers = info["clips"], {"fps": info["fps"], "hours": info["hours"]}
        usable = {name: 0 <= number < 1e9 for name, number in numbers.items()}
        usable["clips"] = counts.keys() == set(SPLITS) and all(type(n) is int for n in counts.values())
        usable["actions"] = all(isinstance(name, str) for name in info["actions"])
        usable["source"] = isinstance(info.get("source", {}), dict)
        wrong = [name for name, good in usable.items() if not good]
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
    good = {
        "id": isinstance(clip.id, str) and clip.id != "",
        "start": type(clip.start) is int,
        "length": type(clip.length) is int,
        "split": clip.split in SPLITS,
        "source": isinstance(clip.source, str),
        "captions": isinstance(clip.captions, list) and all(isinstance(text, str) for text in clip.captions),
        "action": clip.action is None or (type(clip.action) is int and 0 <= clip.action < actions),
        "attributes": isinstance(clip.attributes, dict),
    }
    return next((name for name, right in good.items() if not right), None)


def _damaged(path: Path, what: str) -> ValueError:
    return ValueError(f"{path}: damaged: {what}. Delete {path.parent} and prepare the data set again")


def _sha256(path: Path) -> str:
    try:
        regular_file(path)
        return sha256(path)
    except (UserError, OSError) as error:
        raise _damaged(path, str(error)) from error
