"""Crop rules: which frames of a clip a training sample contains, as in the authors' code."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from flame_mdm.errors import UserError

Below = Callable[[Any], Any]
"""Draws uniform integers from 0 up to, and not including, its argument: an integer, or one for each of B clips."""


class Crop(ABC):
    """A rule that selects the frames of a training sample from a clip of any length."""

    min_frames: int
    max_frames: int

    def shortest(self) -> int:
        """Returns the minimum number of frames of a clip."""
        return self.min_frames

    def longest(self) -> int:
        """Returns the maximum number of frames of a sample."""
        return self.max_frames

    @abstractmethod
    def draw(self, frames: Any, below: Below | None) -> tuple[Any, Any]:
        """Draws samples from clips with `frames` (B,) frames, or from one clip; without `below`, they are fixed.

        Returns:
            First frame and number of frames (B,) of the samples. Past the end of a clip, its last frame is repeated.
        """

    def __call__(self, frames: int, generator: np.random.Generator | None) -> np.ndarray:
        """Returns the indices of the frames selected from a clip of `frames` frames; fixed without a generator."""
        first, length = self.draw(frames, generator.integers if generator else None)
        return np.minimum(np.arange(length) + first, frames - 1)


@dataclass(frozen=True)
class Units(Crop):
    """HumanML3D and KIT (Guo et al. 2022): a multiple of `unit` frames, one unit shorter in one of three draws.

    A clip longer than `max_frames` gives a window of that length at a random position. Without a generator: the longest
    window, beginning at the first frame.
    """

    min_frames: int = 40
    max_frames: int = 196
    unit: int = 4

    def __post_init__(self) -> None:
        if not 1 <= self.unit <= self.min_frames <= self.max_frames or self.max_frames % self.unit:
            raise UserError(
                f"crop: needs 1 <= unit <= min_frames <= max_frames and whole units, not unit {self.unit}, "
                f"min_frames {self.min_frames}, max_frames {self.max_frames}"
            )

    def draw(self, frames: Any, below: Below | None) -> tuple[Any, Any]:
        length = np.minimum(frames, self.max_frames) // self.unit * self.unit
        if below is None:
            return np.zeros_like(length), length
        length = length - self.unit * ((below(3) == 0) & (length > self.unit))
        return below(frames - length + 1), length


@dataclass(frozen=True)
class Whole(Crop):
    """FLAME: the whole clip, cut after `max_frames`."""

    min_frames: int = 1
    max_frames: int = 471

    def draw(self, frames: Any, below: Below | None) -> tuple[Any, Any]:
        length = np.minimum(frames, self.max_frames)
        return np.zeros_like(length), length


@dataclass(frozen=True)
class Fixed(Crop):
    """ACTOR's action data sets: always `frames` frames; short clips repeat their last frame, long ones give a window.

    As in ACTOR's code, the window never starts at the last possible frame. Without a generator: the first window.
    """

    frames: int = 60
    min_frames: int = 1

    def longest(self) -> int:
        return self.frames

    def draw(self, frames: Any, below: Below | None) -> tuple[Any, Any]:
        spare = np.maximum(0, frames - self.frames - 1)
        first = np.zeros_like(spare) if below is None else below(spare + 1)
        return first, np.full_like(spare, self.frames)
