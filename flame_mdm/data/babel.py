"""BABEL: AMASS's motions with timed action labels, cut into clips as in FLAME's code.

Sources: Punnakkal et al., "BABEL: Bodies, Action and Behavior with English Labels", CVPR 2021; Kim
et al. (FLAME), AAAI 2023, appendix "BABEL". `docs/babel.md` describes the data set.
"""

import math
from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from flame_mdm.data import Clip, MotionSource, Split, hashed_split, required
from flame_mdm.data.amass import Amass, Recording, key_of
from flame_mdm.errors import UserError
from flame_mdm.progress import ProgressBar
from flame_mdm.safe_io import naming, read_json

FPS = 20.0
# Number of frames in a clip, and number of frames between the starts of windows for the same label
LENGTH, STRIDE = 128, 10
# Words, categories, start and end of a label
Segment = tuple[str, list[str] | None, float | None, float | None]
GET_IT = "BABEL v1.0 is published at https://babel.is.tue.mpg.de: unpack it, then run `make prepare SOURCE=/path/to/it`"

# Files of each part. In the `extra_*` files, only the labels of the first annotator are used.
PARTS = {
    "train": ("train", "extra_train"),
    "val": ("val", "extra_val"),
}


class Label(NamedTuple):
    """A label: the text that describes a segment of a motion."""

    motion: str  # key of the AMASS recording, as returned by `amass.key_of`
    text: str
    start: float | None  # in seconds, like `end`; None if BABEL gives no times
    end: float | None
    kind: Literal["words", "category"]  # the annotator's words, or the category of the action


class Window(NamedTuple):
    """A clip: consecutive frames of a motion.

    `id` contains the number of the clip within its part, as in FLAME.
    """

    id: str
    split: Split
    start: int
    label: Label


class Babel(MotionSource):
    """Clips of `LENGTH` frames, given as raw motions for the SMPL representations.

    Motions are in AMASS's coordinates. As in FLAME's code, a label covers the frames floor(20
    start) to floor(20 end) - 1. If a label is longer than a clip, one clip begins every `STRIDE`
    frames. If a label is shorter than a clip, the clip continues past the end of the label. The
    label is left out if the motion is too short for the clip.

    FLAME's split and the project's own split both use BABEL's entire train part for training, and
    20 % of its val part for testing. In the project's own split, these 20 % are drawn from the
    motions rather than the clips, so that no motion is in both val and test. FLAME's split uses
    every fifth clip for testing, so clips in val overlap with clips in test.

    Args:
        path: folder of BABEL v1.0.
        amass: folder with AMASS's SMPL+H G release, either unpacked or as archives.
        published_split: whether to use FLAME's split.
        workers: number of processes; 0 = one per core.
    """

    name = "babel"

    def __init__(self, path: str, amass: str, published_split: bool = False, workers: int = 0):
        self.path = Path(path)
        self.amass = Amass(Path(amass))
        self.published_split = published_split
        self.workers = workers
        self.options = {"published_split": published_split}

    def counts(self) -> dict[str, int]:
        """Returns the number of labels in the files."""
        files = (self.path / f"{name}.json" for part in PARTS for name in PARTS[part])
        return {"labels": sum(1 for file in files for _ in self._annotations(file))}

    def count(self) -> int:
        """Returns the number of clips, based on the labels and the lengths of the motions."""
        return len(self.windows)

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields the clips of each motion, with the attributes `motion`, `start` and `label`."""
        self.check_fps(fps, FPS)
        windows: defaultdict[str, list[Window]] = defaultdict(list)
        for window in self.windows:
            windows[window.label.motion].append(window)
        for key, motion in self.amass.map(dict.fromkeys(windows), _motion, self.workers):
            for id_, split, start, label in windows[key]:
                source = id_ if self.published_split else key
                attributes = {"motion": key, "start": start, "label": label.kind}
                yield Clip(
                    id=id_,
                    motion=motion,
                    captions=[label.text],
                    split=split,
                    source=source,
                    attributes=attributes,
                    window=(start, LENGTH),
                )

    @cached_property
    def windows(self) -> list[Window]:
        """All clips in FLAME's order.

        The clips are determined by the labels and the lengths of the motions.
        """
        labels = {part: self.labels(part) for part in PARTS}
        keys = dict.fromkeys(label.motion for part in PARTS for label in labels[part])
        measured = self.amass.map(keys, _measure, self.workers)
        lengths = dict(ProgressBar(measured, "measuring AMASS motions", len(keys), unit=" motions"))
        windows, trained = [], {label.motion for label in labels["train"]}
        for part in PARTS:
            number = 0
            for label in labels[part]:
                starts, reason = _starts(label, lengths[label.motion])
                is_trained = part == "val" and label.motion in trained
                if starts and is_trained and not self.published_split:
                    reason = "labels in the val part for motions in the train part"
                if reason:
                    self.leave_out(reason)
                else:
                    for n, start in enumerate(starts, number):
                        split = self._split(part, n, label.motion)
                        windows.append(Window(f"{part}_{n:06d}", split, start, label))
                number += len(starts)
        return windows

    def labels(self, part: str) -> list[Label]:
        """Returns the labels of a part ("train" or "val") in FLAME's order.

        Within each file, the labels in the annotators' words come first, followed by the
        categories. Empty and duplicate labels (same text, motion, start and end) are dropped.
        """
        labels = []
        for name in PARTS[part]:
            words, categories = [], []
            for motion, (text, kinds, start, end) in self._annotations(self.path / f"{name}.json"):
                # FLAME's code drops the words of a label with an empty list of categories.
                if kinds is None or kinds:
                    words.append(Label(motion, text, start, end, "words"))
                categories += [Label(motion, kind, start, end, "category") for kind in kinds or ()]
            once = {}
            for label in words + categories:
                once.setdefault(label[:4], label)
            labels += [label for label in once.values() if label.text]
        return labels

    def _annotations(self, path: Path) -> Iterator[tuple[str, Segment]]:
        data = read_json(required(path, GET_IT))
        key = "frame_anns" if path.stem.startswith("extra_") else "frame_ann"
        errors = (AttributeError, KeyError, TypeError, IndexError, ValueError)
        with naming(path, *errors, prefix="not in the layout of BABEL v1.0: "):
            for sequence in data.values():
                annotation = (
                    sequence[key][0] if key == "frame_anns" and sequence[key] else sequence[key]
                )
                for label in annotation["labels"] if annotation else ():
                    motion = key_of(str(sequence["feat_p"]))
                    if motion is None:
                        raise UserError(
                            f"the labels refer to {sequence['feat_p']}, which is not in AMASS"
                        )
                    yield motion, _segment(label)

    def _split(self, part: str, number: int, motion: str) -> Split:
        if part == "train":
            return "train"
        flames: Split = "test" if number % 5 == 0 else "val"
        return flames if self.published_split else hashed_split(motion, val=80, test=20)


def _segment(label: dict[str, Any]) -> Segment:
    """Returns the fields of a label that this module uses.

    Raises `TypeError` if a field has the wrong type.
    """
    text, kinds, times = label["proc_label"], label["act_cat"], (label["start_t"], label["end_t"])
    are_texts = all(isinstance(value, str | None) for value in (text, *(kinds or ())))
    if not are_texts or not all(time is None or -1e6 < time < 1e6 for time in times):
        raise TypeError(f"{label!r:.200}")
    return text, kinds, *times


def _starts(label: Label, frames: int) -> tuple[range, str]:
    """Returns the first frame of each clip for a label, or the reason why there are no clips.

    `frames` is the number of frames in the motion.
    """
    none = range(0)
    if label.text == "transition":
        return none, "transitions"
    if label.start is None or label.end is None:
        return none, "labels without a time"
    first, last = math.floor(label.start * FPS), math.floor(label.end * FPS) - 1
    if label.end < label.start:
        return none, "labels that end before they start"
    if first < 0 or last > frames - 1:
        return none, "labels that reach past the motion"
    if last <= first:
        return none, "labels without a frame"
    if last - first > LENGTH:
        return range(first, last - LENGTH + 1, STRIDE), ""
    if first + LENGTH >= frames:
        return none, "labels too close to the end of the motion"
    return range(first, first + 1), ""


def _measure(_: None, recording: Recording) -> int:
    return len(recording.every(FPS).translation)


def _motion(_: None, recording: Recording) -> np.ndarray:
    return recording.every(FPS).parameters()
