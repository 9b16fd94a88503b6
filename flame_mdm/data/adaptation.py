"""Data for adaptation: half of each batch consists of the user's clips.

The other half consists of clips that the model already knows.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.ndimage import minimum_filter1d
from torch.utils.data import Sampler

from flame_mdm.batch import ceil_div
from flame_mdm.data import Clip, MotionSource, some
from flame_mdm.data.crops import Draw
from flame_mdm.data.datamodule import MotionDataModule, TrainingBatches
from flame_mdm.data.folder import Folder
from flame_mdm.data.store import Entry, Store
from flame_mdm.errors import UserError, say
from flame_mdm.representations import Representation

DRIFT = 0.05
"""Maximum rise of the floor, in meters, from the first to the last second of a clip."""
FLOAT = 0.1
"""Maximum median height of the body above the floor, in meters."""
# Maximum number of known clips per split. They are selected at even intervals from the data that
# the model was trained on.
PRIOR = {
    "train": 2000,
    "val": 64,
}
KEPT = "prior/"  # prefix of the names of the known clips


class Lesson(MotionSource):
    """The user's clips with mirrored copies, combined with clips that the model already knows.

    All clips in the folder are used for training unless the caption table says otherwise. Clips are
    normalized with the statistics of the store that contains the known clips.

    Args:
        path: folder with the user's motions.
        prior: folder of the store that contains clips on which the model was trained.
        motion: "joints" for representations of joint positions, "smpl" for representations of
            rotations.
    """

    named_by_recipe = True

    def __init__(self, path: str, prior: str, motion: Literal["joints", "smpl"] = "joints"):
        self.folder, self.prior = Folder(path, motion, mirror=motion == "joints"), Path(prior)
        self.options = {"motion": motion}

    @cached_property
    def store(self) -> Store:
        """The store that contains clips on which the model was trained."""
        return Store(self.prior)

    def kept(self) -> list[Entry]:
        """Returns known clips from each split; `PRIOR` is the maximum number per split."""
        kept: list[Entry] = []
        for split, most in PRIOR.items():
            clips = [clip for clip in self.store.clips if clip.split == split]
            step = max(1, ceil_div(len(clips), most))
            kept += clips[::step]
        return kept

    def count(self) -> int:
        """Returns the number of clips.

        The user's clips go into the training split unless the caption table specifies a split.
        """
        self.folder.splits = {
            name: note.split or "train" for name, note in self.folder.notes.items()
        }
        return self.folder.count() + len(self.kept())

    def suit(self, representation: Representation) -> None:
        """Configures the user's clips for a representation.

        The store's clips are already encoded.
        """
        self.folder.suit(representation)

    def statistics(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the mean and std (D,) of the store. The model was trained with these values."""
        return self.store.mean, self.store.std

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields the user's clips with the style added to their captions, and then the known clips.

        Raises:
            UserError: If one of the user's motions cannot be read. The folder contains only a few
                motions, so unreadable motions are not skipped.
        """
        for clip in self.folder.clips(fps):
            # Actions are left out, because the known clips have none.
            captions = [styled(caption, self.name) for caption in clip.captions]
            yield replace(clip, captions=captions, action=None)
        self.folder.require_all()
        encoded = self.store.info["representation"]
        for entry in self.kept():
            name, features = KEPT + entry.id, self.store.motion(entry)
            yield Clip(name, features, entry.captions, entry.split, name, encoded=encoded)


def styled(caption: str, name: str) -> str:
    """Adds the style `name` to a training caption."""
    return f"{caption.rstrip(' .')} in {name} style"


def check_clips(path: str | Path, fps: float) -> None:
    """Checks the motions in a folder before training.

    Prints the number of motions for each skeleton, and findings about the files, such as frames
    that were left out.

    Raises:
        UserError: If a motion cannot be read, if the floor rises, or if the body floats.
    """
    folder = Folder(str(path))
    faults = [
        f"{clip.id} {fault}" for clip in folder.clips(fps) if (fault := fault_of(clip.motion, fps))
    ]
    folder.require_all()
    say(*folder.findings())
    if listed := some(faults):
        raise UserError(
            f"{path}: {listed}. The model would learn these faults. Correct the clips, or add force=true"
        )


def fault_of(joints: np.ndarray, fps: float) -> str:
    """Returns a message if the floor rises during a clip, or if the body floats above the floor.

    The message is "" if the clip is within the limits `DRIFT` and `FLOAT`.

    Args:
        joints: (F, J, 3) joint positions in meters, with y up.
        fps: frames per second.
    """
    # The height of the floor at a given time is the height of the lowest joint within a window of
    # one second. Jumps are shorter, so they do not raise the floor. Heights are measured from the
    # lowest joint of the entire clip.
    floor = minimum_filter1d(joints[..., 1].min(1), round(fps), mode="nearest")
    rise, height = floor[-1] - floor[0], np.median(floor) - floor.min()
    if rise > DRIFT:
        return f"drifts upward by {100 * rise:.0f} cm (limit {100 * DRIFT:.0f})"
    if height > FLOAT:
        return f"floats {100 * height:.0f} cm above the floor (limit {100 * FLOAT:.0f})"
    return ""


class LessonBatches(Sampler[list[Draw]]):
    """Joins the corresponding batches of several streams into one batch.

    Args:
        rows: for each stream, the indices of its clips in the data set.
        streams: for each stream, batches of indices into its `rows`.
    """

    def __init__(self, rows: list[np.ndarray], streams: list[TrainingBatches]):
        self.rows, self.streams = rows, streams

    def __iter__(self) -> Iterator[list[Draw]]:
        for parts in zip(*self.streams, strict=True):
            yield [
                (int(rows[index]), number)
                for rows, part in zip(self.rows, parts, strict=True)
                for index, number in part
            ]


class LessonData(MotionDataModule):
    """Data module for a `Lesson`. Half of the clips in each batch are the user's clips."""

    def halves(self) -> list[np.ndarray]:
        """Returns the indices of the user's training clips and of the known clips."""
        is_kept = np.array([clip.id.startswith(KEPT) for clip in self.train.clips])
        if is_kept.all():
            raise UserError(
                f"{self.source.name}: all clips are shorter than {self.crop.min_frames} frames"
            )
        return [np.flatnonzero(~is_kept), np.flatnonzero(is_kept)]

    def counts(self, store: Store) -> list[str]:
        """Returns a line with the number of training clips in each half."""
        taught, kept = map(len, self.halves())
        return [
            f"clips: {taught} from {self.source.name}, including mirrored copies; {kept} that the model already knows"
        ]

    def training_batches(self, **of_process: int) -> Sampler[list[Draw]]:
        """Returns an endless stream of batches for one rank.

        See `MotionDataModule.training_batches`.
        """
        halves, smaller = self.halves(), self.batch_size // 2
        sizes = (self.batch_size - smaller, smaller)
        streams = [
            TrainingBatches(self.train.lengths[rows], size, **of_process)
            for rows, size in zip(halves, sizes, strict=True)
        ]
        return LessonBatches(halves, streams)
