"""Rules for cropping clips to training samples, and data sets of cropped clips.

The rules follow the authors' code.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from flame_mdm.data import Split
from flame_mdm.data.store import Store
from flame_mdm.errors import UserError
from flame_mdm.representations import Representation
from flame_mdm.seeds import integers, key

# Index of a clip, and number of the batch for which it is drawn (-1 in evaluation)
Draw = tuple[int, int]
# Id, features x (F, D), caption and action of a clip, as expected by `collate`
Sample = tuple[str, Tensor, str | None, int | None]
# Draws uniform integers from 0 up to, but not including, the argument, which is a number or an
# array (B,)
Below = Callable[[Any], Any]


class Crop(ABC):
    """A rule that selects the frames of a training sample from a clip of any length."""

    # Minimum number of frames in a clip
    min_frames: int
    # Maximum number of frames in a sample
    max_frames: int

    def longest(self) -> int:
        """Returns the maximum number of frames in a sample."""
        return self.max_frames

    @abstractmethod
    def draw(self, frames: Any, below: Below | None) -> tuple[Any, Any]:
        """Draws the first frame and the number of frames for one or more samples.

        Without `below`, the result is deterministic. A sample may extend past the end of its clip.
        In this case, the last frame is repeated.

        Args:
            frames: (B,) number of frames in each clip.
            below: function that draws random integers.

        Returns:
            First frame (B,) and number of frames (B,) of each sample.
        """

    def __call__(self, frames: int, generator: np.random.Generator | None) -> np.ndarray:
        """Returns the indices of the frames to use from a clip that has `frames` frames.

        Without a generator, the indices are deterministic.
        """
        first, length = self.draw(frames, generator.integers if generator else None)
        return np.minimum(np.arange(length) + first, frames - 1)


@dataclass(frozen=True)
class Units(Crop):
    """The rule for HumanML3D and KIT (Guo et al. 2022): lengths are multiples of `unit` frames.

    With probability 1/3, the sample is one unit shorter than the clip allows. If a clip is longer
    than `max_frames`, the sample is a window at a random position. Without a generator, the longest
    window that starts at the first frame is used.
    """

    min_frames: int = 40
    max_frames: int = 196
    unit: int = 4

    def __post_init__(self) -> None:
        if not 1 <= self.unit <= self.min_frames <= self.max_frames or self.max_frames % self.unit:
            raise UserError(
                f"data.crop={self}: expected 1 <= unit <= min_frames <= max_frames, "
                "where max_frames is a multiple of unit"
            )

    def draw(self, frames: Any, below: Below | None) -> tuple[Any, Any]:
        """Draws the first frames uniformly; lengths are multiples of `unit`."""
        length = np.minimum(frames, self.max_frames) // self.unit * self.unit
        if below is None:
            return np.zeros_like(length), length
        length = length - self.unit * ((below(3) == 0) & (length > self.unit))
        return below(frames - length + 1), length


@dataclass(frozen=True)
class Whole(Crop):
    """FLAME's rule: a sample is an entire clip, truncated to at most `max_frames` frames."""

    min_frames: int = 1
    max_frames: int = 471

    def draw(self, frames: Any, below: Below | None) -> tuple[Any, Any]:
        """Returns frame 0 and the length of the clip, limited to `max_frames`."""
        length = np.minimum(frames, self.max_frames)
        return np.zeros_like(length), length


@dataclass(frozen=True)
class Fixed(Crop):
    """The rule for ACTOR's action data sets: every sample consists of `frames` frames.

    The last frame of a short clip is repeated. A long clip is cropped to a window. As in ACTOR's
    code, the window never starts at the last possible frame. Without a generator, the first window
    is used.
    """

    frames: int = 60
    min_frames: int = 1

    def longest(self) -> int:
        """Returns the number of frames in every sample."""
        return self.frames

    def draw(self, frames: Any, below: Below | None) -> tuple[Any, Any]:
        """Draws the first frames uniformly; all lengths are equal."""
        spare = np.maximum(0, frames - self.frames - 1)
        first = np.zeros_like(spare) if below is None else below(spare + 1)
        return first, np.full_like(spare, self.frames)


class Clips(Dataset[Sample]):
    """The clips of a split that are long enough for the crop rule.

    Each time a clip is drawn, it is cropped and then normalized. `advice` is added to the error
    message for a split without clips; see `flame_mdm.data.advice_on_splits`.
    """

    def __init__(
        self,
        store: Store,
        split: Split,
        *,
        representation: Representation,
        crop: Crop,
        seed: int,
        advice: str = "",
    ):
        self.store, self.representation, self.crop, self.seed = store, representation, crop, seed
        self.advice = advice
        of_split = [clip for clip in store.clips if clip.split == split]
        self.clips = [clip for clip in of_split if clip.length >= crop.min_frames]
        self.too_short = len(of_split) - len(self.clips)
        self.frames = np.array([clip.length for clip in self.clips], np.int64)
        self.lengths = np.minimum(self.frames, crop.longest())
        self.captions = np.array([len(clip.captions) for clip in self.clips], np.int64)
        self.mean, self.std = store.mean.astype(np.float32), store.std.astype(np.float32)

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, draw: Draw) -> Sample:
        return self.__getitems__([draw])[0]

    def __getitems__(self, draws: Sequence[Draw]) -> list[Sample]:
        """Returns the samples of a batch. The data loader calls this method."""
        samples: list[Sample] = []
        indices = [index for index, _ in draws]
        for index, first, length, caption in zip(
            indices, *self.draw(indices, draws[0][1]), strict=True
        ):
            clip = self.clips[index]
            frames = np.minimum(np.arange(length) + first, clip.length - 1)
            features = self.representation.rebase(self.store.motion(clip)[frames])
            x = torch.from_numpy((features - self.mean) / self.std)
            samples.append(
                (clip.id, x, clip.captions[caption] if clip.captions else None, clip.action)
            )
        return samples

    def draw(
        self, indices: Sequence[int] | np.ndarray, batch: int | Sequence[int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draws the first frame, the number of frames and the caption index for each of B clips.

        The results depend only on the seed, the batch and the index of the clip. In evaluation
        (batch -1), the results are always the same.

        Args:
            indices: (B,) indices of the clips.
            batch: number of the batch, or an array (B,) with the batch number of each clip.
        """
        rows = np.asarray(indices)
        batches = [batch] if isinstance(batch, int) else batch
        if batches[0] < 0:
            return *self.crop.draw(self.frames[rows], None), self.evaluated[rows]
        keys = {number: key("sample", self.seed, number) for number in dict.fromkeys(batches)}
        below = integers(np.array([keys[number] for number in batches], np.int64) + rows)
        return *self.crop.draw(self.frames[rows], below), below(self.captions[rows])

    @cached_property
    def evaluated(self) -> np.ndarray:
        """Index of the caption used in evaluation for each clip, derived from the clip's id."""
        draws = (
            key("caption", self.seed, -1, clip.id) % max(1, len(clip.captions))
            for clip in self.clips
        )
        return np.fromiter(draws, np.int64, len(self.clips))
