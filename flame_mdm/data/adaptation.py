"""Data of an adaptation: a few clips of the user, and clips of what the model knows, half of each batch."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.ndimage import minimum_filter1d
from torch.utils.data import Sampler

from flame_mdm.data import Clip, MotionSource, some
from flame_mdm.data.crops import Draw
from flame_mdm.data.datamodule import MotionDataModule, TrainingBatches
from flame_mdm.data.folder import Folder
from flame_mdm.data.store import Entry, Store
from flame_mdm.errors import UserError, say
from flame_mdm.representations import Representation

DRIFT, FLOAT = 0.05, 0.1
"""Limits in meters of a clip: rise of its floor from the first to the last second, and median height above it."""
# Maximum number of kept clips of what the model knows, evenly spaced in its data
PRIOR = {
    "train": 2000,
    "val": 64,
}
KEPT = "prior/"  # beginning of the names of these clips


class Lesson(MotionSource):
    """Clips of a folder, mirrored too, for training unless a table says otherwise, and clips of a store, `prior`.

    All are normalized as those of the store. Captions in the folder become "CAPTION in NAME style".
    """

    named_by_recipe = True

    def __init__(self, path: str, prior: str, motion: Literal["joints", "smpl"] = "joints"):
        self.folder, self.prior = Folder(path, motion, mirror=motion == "joints"), Path(prior)
        self.options = {"motion": motion}

    @cached_property
    def store(self) -> Store:
        return Store(self.prior)

    def kept(self) -> list[Entry]:
        clips = {
            split: [clip for clip in self.store.clips if clip.split == split] for split in PRIOR
        }
        return [
            clip for split, of in clips.items() for clip in of[:: -(-len(of) // PRIOR[split]) or 1]
        ]

    def count(self) -> int:
        self.folder.splits = {
            name: note.split or "train" for name, note in self.folder.notes.items()
        }
        return self.folder.count() + len(self.kept())

    def suit(self, representation: Representation) -> None:
        self.folder.suit(representation)

    def statistics(self) -> tuple[np.ndarray, np.ndarray]:
        return self.store.mean, self.store.std

    def clips(self, fps: float) -> Iterator[Clip]:
        for clip in self.folder.clips(fps):
            yield replace(clip, captions=[styled(caption, self.name) for caption in clip.captions])
        self.folder.require_all()  # of a few clips, none is left out
        for entry in self.kept():
            features, name, encoded = (
                self.store.motion(entry),
                KEPT + entry.id,
                self.store.info["representation"],
            )
            yield Clip(name, features, entry.captions, entry.split, name, encoded=encoded)


def styled(caption: str, name: str) -> str:
    return f"{caption.rstrip(' .')} in {name} style"


def check_clips(path: str | Path, fps: float) -> None:
    """Raises `UserError` if motions in a folder cannot be read, their floor rises, or their bodies float above it.

    Prints the skeletons of the motions, and what was left out of them.
    """
    folder = Folder(str(path))
    faults = [
        f"{clip.id} {fault}" for clip in folder.clips(fps) if (fault := fault_of(clip.motion, fps))
    ]
    folder.require_all()
    say(*folder.findings())
    if listed := some(faults):
        raise UserError(
            f"{path}: {listed}. The model would learn that: correct these clips, or add force=true"
        )


def fault_of(joints: np.ndarray, fps: float) -> str:
    """Returns how far the floor of a clip (F, J, 3) rises, or the body floats; "" within `DRIFT` and `FLOAT`.

    The floor at a time is the lowest joint within a second around it, which is longer than a jump; height 0 is that of
    the lowest joint of the clip.
    """
    floor = minimum_filter1d(joints[..., 1].min(1), round(fps), mode="nearest")
    rise, height = floor[-1] - floor[0], np.median(floor) - floor.min()
    if rise > DRIFT:
        return f"drifts upward by {100 * rise:.0f} cm (limit {100 * DRIFT:.0f})"
    return (
        f"floats {100 * height:.0f} cm above the floor (limit {100 * FLOAT:.0f})"
        if height > FLOAT
        else ""
    )


class LessonBatches(Sampler[list[Draw]]):
    """Joins the batches of streams, each of the clips with some indices."""

    def __init__(self, rows: list[np.ndarray], streams: list[TrainingBatches]):
        self.rows, self.streams = rows, streams

    def __iter__(self) -> Iterator[list[Draw]]:
        for parts in zip(*self.streams, strict=True):
            yield [
                (int(r[index]), n)
                for r, part in zip(self.rows, parts, strict=True)
                for index, n in part
            ]


class LessonData(MotionDataModule):
    """Serves a `Lesson`: half of each batch is of the user's clips, half of what the model knows."""

    def halves(self) -> list[np.ndarray]:
        """Returns the indices of the user's training clips, and of the others."""
        is_kept = np.array([clip.id.startswith(KEPT) for clip in self.train.clips])
        if is_kept.all():
            raise UserError(
                f"{self.source.name}: all clips are shorter than {self.crop.min_frames} frames"
            )
        return [np.flatnonzero(~is_kept), np.flatnonzero(is_kept)]

    def counts(self, store: Store) -> list[str]:
        taught, kept = map(len, self.halves())
        return [
            f"clips: {taught} of {self.source.name}, mirrored copies included; {kept} of what the model knows"
        ]

    def training_batches(self, **of_process: int) -> Sampler[list[Draw]]:
        rows, few = self.halves(), self.batch_size // 2
        sizes = zip(rows, (self.batch_size - few, few), strict=True)
        return LessonBatches(
            rows, [TrainingBatches(self.train.lengths[r], size, **of_process) for r, size in sizes]
        )
