"""Crop rules: which frames of a clip a training sample contains, as in the authors' code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class Crop(Protocol):
    """A rule that selects the frames of a training sample from a clip of any length."""

    def shortest(self) -> int:
        """Returns the minimum number of frames of a clip."""
        ...

    def longest(self) -> int:
        """Returns the maximum number of frames of a sample."""
        ...

    def __call__(self, frames: int, generator: np.random.Generator | None) -> np.ndarray:
        """Returns the indices of the frames selected from a clip of `frames` frames; fixed without a generator."""
        ...


@dataclass(frozen=True)
class Units:
    """HumanML3D and KIT (Guo et al. 2022): a multiple of `unit` frames, one unit shorter in one of three draws.

    A clip longer than `max_frames` gives a window of that length at a random position. Without a generator: the longest
    window, beginning at the first frame.
    """

    min_frames: int = 40
    max_frames: int = 196
    unit: int = 4

    def __post_init__(self) -> None:
        if not 1 <= self.unit <= self.min_frames <= self.max_frames or self.max_frames % self.unit:
            raise ValueError(
                f"crop: needs 1 <= unit <= min_frames <= max_frames and whole units, not unit {self.unit}, "
                f"min_frames {self.min_frames}, max_frames {self.max_frames}"
            )

    def shortest(self) -> int:
        return self.min_frames

    def longest(self) -> int:
        return self.max_frames

    def __call__(self, frames: int, generator: np.random.Generator | None) -> np.ndarray:
        length = min(frames, self.max_frames) // self.unit * self.unit
        if generator is None:
            return np.arange(length)
        if generator.integers(3) == 0 and length > self.unit:
            length -= self.unit
        return np.arange(length) + generator.integers(frames - length + 1)


@dataclass(frozen=True)
class Whole:
    """FLAME: the whole clip, cut after `max_frames`."""

    min_frames: int = 1
    max_frames: int = 471

    def shortest(self) -> int:
        return self.min_frames

    def longest(self) -> int:
        return self.max_frames

    def __call__(self, frames: int, generator: np.random.Generator | None) -> np.ndarray:
        return np.arange(min(frames, self.max_frames))


@dataclass(frozen=True)
class Fixed:
    """ACTOR's action data sets: always `frames` frames; short clips repeat their last frame, long ones give a window.

    As in ACTOR's code, the window never starts at the last possible frame. Without a generator: the first window.
    """

    frames: int = 60
    min_frames: int = 1

    def shortest(self) -> int:
        return self.min_frames

    def longest(self) -> int:
        return self.frames

    def __call__(self, frames: int, generator: np.random.Generator | None) -> np.ndarray:
        spare = max(0, frames - self.frames - 1)
        start = 0 if generator is None else int(generator.integers(spare + 1))
        return np.minimum(np.arange(self.frames) + start, frames - 1)
