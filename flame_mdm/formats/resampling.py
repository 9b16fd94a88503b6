"""Frame rates, lengths and resampling of motions.

Rates and lengths are bounded: a file of a few bytes may declare any.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

RATES = (0.1, 1000.0)
"""Lowest and highest frame rate of a motion file, in frames per second."""
MAX_FRAMES = 500_000
"""Most frames of one motion: 70 minutes at 120 frames per second."""
MAX_RESAMPLED = 1_000_000
"""Most joint positions that resampling makes of a motion that has fewer itself: 38 minutes of 22 joints at 20 frames
per second."""


def frame_rate(value: Any, name: str = "fps") -> float:
    """Returns a frame rate out of a file as a float.

    Args:
        value: one number, plain or of NumPy.
        name: what the file calls it.

    Raises:
        ValueError: it is not one number within `RATES`.
    """
    number = np.asarray(value)
    if number.shape or number.dtype.kind not in "fiu" or not RATES[0] <= float(number) <= RATES[1]:
        shown = f"{float(number):g}" if not number.shape and number.dtype.kind in "fiu" else f"{value}"[:40]
        raise ValueError(f"{name} is {shown}, not a number of frames per second from {RATES[0]:g} to {RATES[1]:g}")
    return float(number)


def check_frames(frames: int) -> None:
    """Raises `ValueError` if a motion has more than `MAX_FRAMES` frames."""
    if frames > MAX_FRAMES:
        raise ValueError(f"{frames:,} frames are more than the {MAX_FRAMES:,} that a motion may have: cut it")


def resampled_frames(frames: int, rate: float, fps: float, joints: int, slack: float = 0.0) -> int:
    """Returns how many frames a motion has at another frame rate, from its first to its last frame.

    Args:
        frames: of the motion.
        rate: its frames per second.
        fps: the frames per second wanted.
        joints: of the motion.
        slack: share of a frame by which the last one may lie past the end.

    Raises:
        ValueError: they are more than `MAX_FRAMES`, or resampling makes more than `MAX_RESAMPLED` joint positions.
    """
    check_frames(frames)
    count = math.floor((frames - 1) * fps / rate + slack) + 1
    if count * joints > max(frames * joints, MAX_RESAMPLED):
        raise ValueError(
            f"{frames:,} frames at {rate:g} frames per second would become {count:,} at {fps:g}, of {joints} joints: "
            "too many; check the frame rate, or cut the motion"
        )
    return count


def between(
    frames: int, rate: float, fps: float, joints: int, slack: float = 1e-6
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the frames before and after each new one, and its place between them, 0 to 1; arguments as above.

    New frames are at times 0, 1/fps, 2/fps, ... up to the last frame of the motion.

    Raises:
        ValueError: as `resampled_frames`.
    """
    times = np.arange(resampled_frames(frames, rate, fps, joints, slack)) * rate / fps
    before = np.minimum(times.astype(int), frames - 1)
    return before, np.minimum(before + 1, frames - 1), times - before


def resample(values: np.ndarray, rate: float, fps: float, cubic: bool = False) -> np.ndarray:
    """Returns positions (F, ...) recorded at `rate` at `fps` frames per second.

    Args:
        values: positions.
        rate: their frames per second.
        fps: the frames per second wanted.
        cubic: interpolates by cubic splines, which keep bones to about 0.1 % of their length; linearly otherwise.

    Raises:
        ValueError: as `resampled_frames`.
    """
    before, after, share = between(len(values), rate, fps, math.prod(values.shape[1:-1]))
    if cubic and len(values) > 1:
        return CubicSpline(np.arange(len(values)), values)(before + share)
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    return (1 - share) * values[before] + share * values[after]


def slerp(rotations: np.ndarray, before: np.ndarray, after: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Returns rotations (F', J, 3, 3) between frames of rotations (F, J, 3, 3), interpolated on the sphere."""
    turn = np.swapaxes(rotations[before], -1, -2) @ rotations[after]
    vectors = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(turn.shape[:3])
    part = Rotation.from_rotvec((share[:, None, None] * vectors).reshape(-1, 3)).as_matrix().reshape(turn.shape)
    return rotations[before] @ part
