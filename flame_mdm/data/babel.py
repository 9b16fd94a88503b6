"""BABEL: time-stamped action labels on the motions of AMASS, cut into clips as FLAME does.

Punnakkal et al., "BABEL: Bodies, Action and Behavior with English Labels", CVPR 2021; Kim et al., "FLAME: Free-form
Language-based Motion Synthesis & Editing", AAAI 2023, appendix "BABEL". `docs/babel.md` describes the set.
"""

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flame_mdm.data import Clip, MotionSource, Split, hashed_split, required
from flame_mdm.data.amass import Amass, Recording, key_of
from flame_mdm.errors import UserError
from flame_mdm.progress import ProgressBar
from flame_mdm.safe_io import naming, read_json

FPS = 20.0
GET_IT = (
    "BABEL v1.0 is published at https://babel.is.tue.mpg.de: unpack it, then run `make prepare` with "
    "SOURCE=/path/to/babel_v1.0_release"
)

PARTS: dict[str, tuple[str, ...]] = {"train": ("train", "extra_train"), "val": ("val", "extra_val")}
"""Files of each part. The "extra" files contain labels of several annotators; only the first annotator's are used."""


@dataclass(frozen=True)
class Label:
    """One text for one segment of a motion."""

    motion: str  # key of the AMASS recording, as returned by `amass.key_of`
    text: str
    start: float | None  # seconds, like the end; None if BABEL does not give them
    end: float | None
    kind: Literal["words", "category"]  # the annotator's words or the category of the action


@dataclass(frozen=True)
class Window:
    """A clip: a fixed number of frames of a motion, beginning at `start`; `id` contains FLAME's number in the part."""

    id: str
    motion: str
    split: Split
    start: int
    label: Label


class Babel(MotionSource):
    """Clips of `length` frames, as raw motions of the SMPL representations, in AMASS's coordinates.

    A longer label gives one window every `stride` frames. A shorter one is extended past its end, or left out if the
    motion is too short for that. A label covers frames floor(20 start) to floor(20 end) - 1, as in FLAME's code.

    Both splits train on BABEL's entire train part and use 20 % of its val part for testing. Our split uses 20 % of the
    motions, so that no motion is in two splits. FLAME's split uses every fifth clip, so that overlapping windows of one
    label are in both val and test.

    Args:
        path: folder with `train.json`, `extra_train.json`, `val.json` and `extra_val.json` (BABEL v1.0).
        amass: folder of AMASS's SMPL+H G release, as archives or unpacked.
        published_split: use FLAME's split, in which clips of val and test overlap.
        length: frames per clip at 20 frames per second.
        stride: frames between the windows of a label.
    """

    name = "babel"

    def __init__(
        self,
        path: str,
        amass: str,
        published_split: bool = False,
        length: int = 128,
        stride: int = 10,
        workers: int = 0,
    ):
        self.path, self.amass, self.published_split = Path(path), Amass(Path(amass)), published_split
        self.length, self.stride, self.workers = length, stride, workers
        self.options = {"published_split": published_split, "length": length, "stride": stride}

    def counts(self) -> dict[str, int]:
        files = (self.path / f"{name}.json" for part in PARTS for name in PARTS[part])
        return {"labels": sum(1 for file in files for _ in self._annotations(file))}

    def count(self) -> int:
        return len(self.windows)

    def clips(self, fps: float) -> Iterator[Clip]:
        self.check_fps(fps, FPS)
        windows: defaultdict[str, list[Window]] = defaultdict(list)
        for window in self.windows:
            windows[window.motion].append(window)
        for key, motion in self.amass.map(dict.fromkeys(windows), _motion, self.workers):
            for window in windows[key]:
                yield Clip(
                    window.id,
                    motion,
                    [window.label.text],
                    window.split,
                    window.id if self.published_split else key,
                    attributes={"motion": key, "start": window.start, "label": window.label.kind},
                    window=(window.start, self.length),
                )

    @cached_property
    def windows(self) -> list[Window]:
        """All clips in FLAME's order; reads the labels and the lengths of the motions."""
        labels = {part: self.labels(part) for part in PARTS}
        keys = dict.fromkeys(label.motion for part in PARTS for label in labels[part])
        measured = self.amass.map(keys, _measure, self.workers)
        lengths = dict(ProgressBar(measured, "measuring the motions of AMASS", len(keys), unit=" motions"))
        windows = []
        trained = {label.motion for label in labels["train"]}
        for part in PARTS:
            number = 0
            for label in labels[part]:
                starts = self._starts(label, lengths[label.motion])
                if starts and part == "val" and label.motion in trained and not self.published_split:
                    self._exclude("labels of the val part on motions of the train part")
                else:
                    for n, start in enumerate(starts, number):
                        split = self._split(part, n, label.motion)
                        windows.append(Window(f"{part}_{n:06d}", label.motion, split, start, label))
                number += len(starts)
        return windows

    def labels(self, part: str) -> list[Label]:
        """Returns the labels of a part in FLAME's order: for each file the annotators' words, then the categories.

        Empty labels and repeated labels (same text, motion, start and end) are dropped.
        """
        labels = []
        for name in PARTS[part]:
            words, categories = [], []
            for motion, annotation in self._annotations(self.path / f"{name}.json"):
                segment = annotation["start_t"], annotation["end_t"]
                kinds = annotation["act_cat"]
                if kinds is None or kinds:  # FLAME's code drops the words if the list of categories is empty
                    words.append(Label(motion, annotation["proc_label"], *segment, "words"))
                categories += [Label(motion, kind, *segment, "category") for kind in kinds or ()]
            once: dict[tuple, Label] = {}
            for label in words + categories:
                once.setdefault((label.motion, label.text, label.start, label.end), label)
            labels += [label for label in once.values() if label.text]
        return labels

    def _annotations(self, path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
        data = read_json(required(path, GET_IT))
        key = "frame_anns" if path.stem.startswith("extra_") else "frame_ann"
        with naming(path, AttributeError, KeyError, TypeError, IndexError, what="not in the layout of BABEL v1.0: "):
            for sequence in data.values():
                annotation = sequence[key][0] if key == "frame_anns" and sequence[key] else sequence[key]
                for label in annotation["labels"] if annotation else ():
                    fields = {k: label[k] for k in ("proc_label", "act_cat", "start_t", "end_t")}
                    _check(fields)
                    yield self._key(str(sequence["feat_p"])), fields

    def _starts(self, label: Label, frames: int) -> range:
        """Returns the first frame of each clip of a label in a motion of `frames` frames; counts why there are none."""
        if label.text == "transition":
            return self._exclude("transitions")
        if label.start is None or label.end is None:
            return self._exclude("labels without a time")
        first, last = math.floor(label.start * FPS), math.floor(label.end * FPS) - 1
        if label.end < label.start:
            return self._exclude("labels that end before they start")
        if first < 0 or last > frames - 1:
            return self._exclude("labels that reach past the motion")
        if last <= first:
            return self._exclude("labels without a frame")
        if last - first > self.length:
            return range(first, last - self.length + 1, self.stride)
        if first + self.length >= frames:
            return self._exclude("labels too near to the end of the motion")
        return range(first, first + 1)

    def _exclude(self, reason: str) -> range:
        self.excluded[reason] += 1
        return range(0)

    def _split(self, part: str, number: int, motion: str) -> Split:
        if part == "train":
            return "train"
        if not self.published_split:
            return hashed_split(motion, val=80, test=20)
        return "test" if number % 5 == 0 else "val"

    def _key(self, motion: str) -> str:
        key = key_of(motion)
        if key is None:
            raise UserError(f"{self.path}: the labels refer to {motion}, which is in no subset of AMASS")
        return key


def _check(label: dict[str, Any]) -> None:
    """Raises `TypeError` if a value of a label has the wrong type."""
    for key in ("start_t", "end_t"):
        time = label[key]
        if time is not None and not (isinstance(time, int | float) and abs(time) < 1e6):
            raise TypeError(f"{key}: {str(time)[:40]}")
    kinds = label["act_cat"]
    texts = [label["proc_label"], *(kinds if isinstance(kinds, list) else [])]
    if not isinstance(kinds, list | None) or not all(isinstance(text, str | None) for text in texts):
        raise TypeError(f"act_cat: {str(kinds)[:40]}")


def _measure(_: None, recording: Recording) -> int:
    return len(recording.every(FPS).translation)


def _motion(_: None, recording: Recording) -> np.ndarray:
    """Returns (F, 75) float32: translation and the rotations of the 24 joints that FLAME uses."""
    kept = recording.every(FPS)
    return np.concatenate([kept.translation, kept.poses[:, :72]], 1).astype(np.float32)
