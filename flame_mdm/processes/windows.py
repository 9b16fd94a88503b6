"""Long motions from overlapping windows: a wrapper with the interface of a denoiser.

At each sampling step, the denoiser processes all windows of a motion in one batch, each with its
own condition. Where windows overlap, the outputs are averaged (Bar-Tal et al. 2023,
"MultiDiffusion"; Zhang et al. 2023, "DiffCollage"). For fixed x_t and t, the output is an affine
function of the clean estimate, so averaging outputs also blends the clean estimates.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from flame_mdm.batch import Condition, Denoise, MotionBatch, length_mask


@dataclass
class Windows:
    """W windows of at most L frames that cover B motions."""

    #: Conditions and masks (W, L) of the windows. The `x` of this batch has no features.
    batch: MotionBatch
    #: (W,) int64, the index of each window's motion.
    rows: Tensor
    #: (W, L) int64, the index of each frame of a window in its motion.
    frames: Tensor
    #: (W, L), 0 past the end of a window. The weights of each frame of a motion sum to 1.
    weights: Tensor


def blended(denoise: Denoise, windows: Windows) -> Denoise:
    """Returns a denoiser for entire motions, which may be longer than the training motions.

    Args:
        denoise: denoiser for the windows.
        windows: the windows; see `cover`.

    Returns:
        A function that maps x_t (B, F, D), t (B,), mask (B, F) and the conditions of W windows to
        the blended output (B, F, out_features).
    """

    def blend(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        rows = windows.rows[:, None]
        output = denoise(x_t[rows, windows.frames], t[windows.rows], windows.batch.mask, cond)
        weighted = output * windows.weights[..., None].to(output.dtype)
        total = output.new_zeros(*x_t.shape[:2], output.shape[-1])
        return total.index_put(
            (rows.expand_as(windows.frames), windows.frames), weighted, accumulate=True
        )

    return blend


def spans(
    lengths: Sequence[int], longest: int, overlap: int, loop: bool = False
) -> list[tuple[int, int, int]]:
    """Covers the consecutive parts of a motion with windows.

    The windows of a part extend by half the overlap into the neighboring parts. A part that does
    not fit into one window is covered by several windows.

    Args:
        lengths: number of frames in each part.
        longest: maximum number of frames in a window.
        overlap: even number of frames that neighboring windows share.
        loop: whether the last part is followed by the first one. In this case, windows may begin
            before frame 0.

    Returns:
        For each window, the index of its part, its first frame and its number of frames.

    Example:
        >>> spans([10, 10], longest=16, overlap=4)
        [(0, 0, 12), (1, 8, 12)]
    """
    total, begin, windows = sum(lengths), 0, []
    for part, length in enumerate(lengths):
        first = begin - overlap // 2 * (loop or begin > 0)
        begin += length
        size = begin + overlap // 2 * (loop or begin < total) - first
        count = max(1, -(-(size - overlap) // (longest - overlap)))
        width = -(-(size + (count - 1) * overlap) // count)
        windows += [
            (part, first + round(i * (size - width) / max(1, count - 1)), width)
            for i in range(count)
        ]
    return windows


def cover(
    windows: Sequence[tuple[int, int, int]],
    totals: Sequence[int],
    overlap: int,
    width: int,
    device: torch.device,
) -> Windows:
    """Returns the frames and weights of windows, without conditions.

    The weight of a window rises over the overlap at its start and falls over the overlap at its
    end. Past its end, a window is padded with the subsequent frames of the motion, wrapping around
    after the last frame.

    Args:
        windows: W windows, each given by the index of its motion, its first frame and its number of
            frames.
        totals: number of frames in each motion.
        overlap: number of frames over which a weight rises or falls.
        width: L, the padded length of the windows.
        device: device of the result.

    Example:
        >>> windows = cover([(0, 0, 12), (0, 8, 12)], [20], 4, 12, torch.device("cpu"))
        >>> windows.weights[0, 8:].add(windows.weights[1, :4]).tolist()
        [1.0, 1.0, 1.0, 1.0]
    """
    rows, first, size = torch.tensor(windows, device=device).T
    mask, position = length_mask(size, width), torch.arange(width, device=device)
    frames = (first[:, None] + position) % torch.tensor(totals, device=device)[rows, None]
    ramp = torch.minimum(position + 0.5, size[:, None] - position - 0.5) / overlap
    weights, index = (
        torch.sin(ramp.clamp(0, 1) * torch.pi / 2) ** 2 * mask,
        (rows[:, None].expand_as(frames), frames),
    )
    total = weights.new_zeros(len(totals), max(totals)).index_put(index, weights, accumulate=True)
    batch = MotionBatch(torch.zeros(*mask.shape, 0, device=device), mask, [""] * len(windows))
    return Windows(batch, rows, frames, weights / total[index])
