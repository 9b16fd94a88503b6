"""Which frames of a clip a training sample holds: the rules of the papers' codes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class Crop(Protocol):
    """A rule that turns clips of any length into training samples."""

    def shortest(self) -> int:
        """Frames a clip must have."""
        ...

    def longest(self) -> int:
        """Frames a sample has at most."""
        ...

    def __call__(self, frames: int, generator: np.random.Generator | None) -> np.ndarray:
        """Indices of the frames taken from a clip of `frames` frames; without a generator, always the same ones."""
        ...


@dataclass(frozen=True)
class Units:
    """HumanML3D and KIT (Guo et al. 2022): a multiple of `unit` frames, one unit shorter for one draw in three.

    A clip longer than `max_frames` gives a window of that length; the window lies anywhere in the clip. Without a
    generator: the longest window, from the first frame on.
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
    """FLAME: the clip as it is, cut after `max_frames`."""

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
    """ACTOR's action sets: always `frames` frames; short clips repeat their last one, long ones give a window.

    Legacy of ACTOR's code: the window never starts at the last possible frame. Without a generator: the first window.
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
