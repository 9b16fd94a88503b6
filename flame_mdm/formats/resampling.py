"""Checks frame rates and lengths, and resamples motions.

Frame rates and lengths are limited, because even a file of a few bytes can declare any value.
"""

import math
from typing import Any

import numpy as np

from flame_mdm.errors import UserError

# Lowest and highest frame rate of a motion file, in frames per second
RATES = (0.1, 1000.0)
# Maximum number of frames in a motion: 70 minutes at 120 frames per second
MAX_FRAMES = 500_000
# Maximum number of frames times joints in a tree of joints: one hour with 57 joints at 120 frames
# per second
MAX_POSITIONS = 25_000_000
# Number of frames times joints that is accepted in files of any size; reading so many takes 300 MB
# of memory
FEW_POSITIONS = 1_000_000
BYTES_PER_POSITION = 4
"""Minimum number of bytes per frame and joint, for files with more positions.

A joint with three one-digit numbers takes 6 bytes per frame, but end sites take no bytes.
"""
# Maximum number of joint positions after upsampling: 38 minutes with 22 joints at 20 fps
MAX_RESAMPLED = 1_000_000


def frame_rate(value: Any, name: str = "fps") -> float:
    """Checks a frame rate and returns it as a float. Error messages call the value `name`.

    Raises:
        UserError: If the value is not a number in the range `RATES`.
    """
    number = np.asarray(value)
    # Some programs write an array that contains one number
    number = number.reshape(()) if number.size == 1 else number
    if number.shape or number.dtype.kind not in "fiu" or not RATES[0] <= float(number) <= RATES[1]:
        limits = f"from {RATES[0]:g} to {RATES[1]:g}"
        raise UserError(f"{name} is {str(value)[:40]}, not a number of frames per second {limits}")
    return float(number)


def check_frames(frames: int) -> None:
    """Raises `UserError` if a motion has more than `MAX_FRAMES` frames."""
    if frames > MAX_FRAMES:
        raise UserError(
            f"{frames:,} frames, but a motion may have at most {MAX_FRAMES:,}. Cut the motion"
        )


def check_tree(frames: int, joints: int, size: int) -> None:
    """Raises `UserError` if a file of `size` bytes has too many frames for its number of joints.

    Each joint requires memory in each frame, even if the file contains no numbers for the joint.
    """
    check_frames(frames)
    most = min(MAX_POSITIONS, max(FEW_POSITIONS, size // BYTES_PER_POSITION))
    if frames * joints > most:
        raise UserError(
            f"{frames:,} frames of {joints:,} joints, but a file of this size may have at most {most // joints:,} "
            "frames. Cut the motion, or remove joints that do not move"
        )


def frame_pairs(
    frames: int, rate: float, fps: float, joints: int, slack: float = 1e-6
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each new frame, returns the old frames before and after it and its position between them.

    The third array contains the position of each new frame between the two old frames, from 0 to 1.

    New frames are at times 0, 1/fps, 2/fps, ... up to the last old frame. The last new frame may
    lie up to `slack` frames after the last old frame.

    Raises:
        UserError: If there are more than `MAX_FRAMES` frames before resampling, or more than
            `MAX_RESAMPLED` joint positions after resampling.
    """
    check_frames(frames)
    count = math.floor((frames - 1) * fps / rate + slack) + 1
    if count * joints > max(frames * joints, MAX_RESAMPLED):
        raise UserError(
            f"{frames:,} frames at {rate:g} frames per second would become {count:,} frames at {fps:g} frames per "
            f"second, which is too many for {joints} joints. Check the frame rate, or cut the motion"
        )
    # Frames are counted from the first frame, so that rounding errors do not accumulate. A new
    # frame that is slightly past the last old frame takes the value of the last old frame.
    times = np.arange(count) * rate / fps
    before = np.minimum(times.astype(int), frames - 1)
    return before, np.minimum(before + 1, frames - 1), times - before


def resample(values: np.ndarray, rate: float, fps: float, cubic: bool = False) -> np.ndarray:
    """Resamples positions (F, ...) from `rate` to `fps` frames per second.

    The result has F' = floor((F - 1) fps / rate) + 1 frames. If `cubic` is set, values between
    frames lie on a cubic spline, and bones keep their lengths to within 0.1 %. Otherwise, values
    are interpolated linearly.
    """
    before, after, share = frame_pairs(len(values), rate, fps, math.prod(values.shape[1:-1]))
    if cubic:
        return interpolate(values, before + share)
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    return (1 - share) * values[before] + share * values[after]


def interpolate(values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Evaluates the cubic spline through values (F, ...) at `times` (N,).

    Times are in frames. The values are given at times 0, 1, ...
    """
    from scipy.interpolate import CubicSpline  # imported here, because few motions need it

    if len(values) < 2:
        return values[np.zeros(len(times), int)]
    return CubicSpline(np.arange(len(values)), values)(times)
