"""Common data types: batches of motions, conditions, edits and masks.

Shapes: B is the batch size, F the number of frames, D the number of features, S the number of
condition tokens, and C the condition width. All masks are True for real entries and False for
padding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import torch
from torch import Tensor


@dataclass
class MotionBatch:
    """Motions of different lengths, padded to the length of the longest one.

    Attributes:
        x: (B, F, D) float32, normalized features, with zeros after the end of each motion.
        mask: (B, F) bool, True for real frames.
        ids: B names, each unique in the data set. A sample's name seeds its noise and identifies
            the sample in results.
        text: one caption per motion, or None if the data contains no captions.
        action: (B,) int64 class labels, or None if the data contains no classes.

    Example:
        >>> batch = collate([("a", torch.ones(4, 2), "walks", None), ("b", torch.ones(2, 2), "sits", None)])
        >>> batch.x.shape, batch.lengths.tolist(), batch.text
        (torch.Size([2, 4, 2]), [4, 2], ['walks', 'sits'])
    """

    x: Tensor
    mask: Tensor
    ids: list[str]
    text: list[str] | None = None
    action: Tensor | None = None

    @property
    def lengths(self) -> Tensor:
        """Number of real frames in each motion, (B,) int64."""
        return self.mask.sum(1)

    def __len__(self) -> int:
        return len(self.ids)

    def to(self, device: torch.device) -> MotionBatch:
        """Copies the batch to a device asynchronously.

        Lightning calls this method.
        """
        action = None if self.action is None else sent(self.action, device)
        return replace(self, x=sent(self.x, device), mask=sent(self.mask, device), action=action)

    def pin_memory(self) -> MotionBatch:
        """Copies the batch to pinned memory, so that copies to a GPU are asynchronous.

        The data loader calls this method.
        """
        action = None if self.action is None else self.action.pin_memory()
        return replace(self, x=self.x.pin_memory(), mask=self.mask.pin_memory(), action=action)


@dataclass
class Condition:
    """Encoded conditions of a batch.

    Attributes:
        pooled: (B, C), one vector per sample.
        tokens: (B, S, C), one vector per word piece, or S = 0 if the encoder returns no tokens.
        token_mask: (B, S) bool, True for real tokens. If the null condition has no mask (None),
            samples that receive the null condition keep their own masks.
        null: the null condition ("no condition"), with batch size 1, or None if the encoder has no
            null condition.
        prefix: (B, P, D), normalized features of the P clean frames before the motion, or None if
            no frames precede it.
        target: (B, 8, 4), where the motion should end (see `flame_mdm.conditions.target`), or None
            if it may end anywhere.
        target_mask: (B,) bool, False for samples without a target, or None if every sample has one.

    Example:
        >>> null = Condition(torch.zeros(1, 3), torch.zeros(1, 0, 3), None)
        >>> cond = Condition(torch.ones(2, 3), torch.zeros(2, 0, 3), None, null)
        >>> cond.drop(torch.tensor([True, False])).pooled.tolist()
        [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
    """

    pooled: Tensor
    tokens: Tensor
    token_mask: Tensor | None
    null: Condition | None = None
    prefix: Tensor | None = None
    target: Tensor | None = None
    target_mask: Tensor | None = None

    def drop(self, drop: Tensor) -> Condition:
        """Replaces the conditions of some samples with the null condition.

        Only the text or action is replaced, not the prefix or the target.

        Args:
            drop: (B,) bool, True for samples whose condition is replaced.
        """
        if self.null is None:
            raise ValueError("there is no null condition with which to replace conditions")
        if not self.pooled.shape[1]:  # an unconditional model: every condition is null
            return self
        null = self.null
        pooled = torch.where(drop[:, None], null.pooled.to(self.pooled), self.pooled)
        if self.token_mask is None:
            return replace(self, pooled=pooled)
        if null.token_mask is None:
            tokens = torch.where(drop[:, None, None], null.tokens.to(self.tokens), self.tokens)
            return replace(self, pooled=pooled, tokens=tokens)
        size = max(self.tokens.shape[1], null.tokens.shape[1])
        tokens = torch.where(
            drop[:, None, None],
            pad_to(null.tokens.to(self.tokens), size),
            pad_to(self.tokens, size),
        )
        replaced = drop[:, None]
        token_mask = (replaced & pad_to(null.token_mask, size)) | (
            ~replaced & pad_to(self.token_mask, size)
        )
        return replace(self, pooled=pooled, tokens=tokens, token_mask=token_mask)

    def with_null(self) -> Condition:
        """Returns a batch of size 2B: the conditions, followed by their null conditions.

        This lets classifier-free guidance compute both predictions in one forward pass.
        """
        batch = self.pooled.shape[0]
        rows = torch.arange(batch, device=self.pooled.device)
        twice = self.select(torch.cat([rows, rows]))
        return twice.drop(torch.arange(2 * batch, device=self.pooled.device) >= batch)

    def select(self, rows: Tensor) -> Condition:
        """Returns the conditions of the samples at the indices `rows`, (N,) int64."""

        def selected(x: Tensor | None) -> Tensor | None:
            return None if x is None else x[rows]

        return Condition(
            self.pooled[rows],
            self.tokens[rows],
            selected(self.token_mask),
            self.null,
            selected(self.prefix),
            selected(self.target),
            selected(self.target_mask),
        )


class Guide(Protocol):
    """Interface for objects that guide motions (B, F, D) toward a goal, such as world positions."""

    def steer(self, clean: Callable[[Tensor], Tensor], x_t: Tensor) -> Tensor:
        """Returns a version of `x_t` whose clean estimate is closer to the goal.

        Args:
            clean: function that returns the clean estimate of a noisy motion.
            x_t: (B, F, D), the noisy motion.
        """
        ...

    def reach(self, x0_hat: Tensor) -> Tensor:
        """Returns the clean estimate, changed so that it reaches the goal."""
        ...


@dataclass
class Edit:
    """The part of a motion to keep while the rest is generated.

    In-betweening, prediction, interpolation and body-part editing differ only in `keep`.

    Attributes:
        known: (B, F, D) normalized features of the motion.
        keep: (B, F, D) bool, True if this feature is kept in this frame.
        mode: how the kept features are imposed. "x0" overwrites them in the clean estimate (MDM).
            "x_t" overwrites them in the noisy sample with the known motion at the same noise level
            (FLAME, RePaint). "trajectory" overwrites the beginning of the flow's path (MFM).
        until: for "trajectory", the last flow time at which the path is overwritten.
        blend: for "x_t", when the kept features are overwritten. "after" = after each step (FLAME,
            eq. 6); the result then contains the known motion itself. "before" = before each call of
            the denoiser (FLAME's code); the result then contains the model's version of the known
            motion.
        resample: for "x_t", how many times each sampling step is repeated. Noise is added again
            before each repetition (RePaint, algorithm 1).
        guide: for "x0", a guide that moves the clean estimate toward a goal at each sampling step,
            before the kept features are imposed. If None, there is no goal.
        strength: fraction of the sampling steps to take, in (0, 1]. Sampling starts from `known`,
            noised to the level of the first of these steps (SDEdit). MDM's code sets the number of
            skipped steps instead: for N steps, `skip_timesteps` = (1 - strength) N. If `strength`
            is None, sampling starts from pure noise.

    Example:
        >>> known, keep = torch.ones(1, 4, 2), torch.zeros(1, 4, 2, dtype=torch.bool)
        >>> keep[:, :2] = True  # the first two frames are kept
        >>> Edit(known, keep).impose(torch.zeros(1, 4, 2))[0, :, 0].tolist()
        [1.0, 1.0, 0.0, 0.0]
    """

    known: Tensor
    keep: Tensor
    mode: Literal["x0", "x_t", "trajectory"] = "x0"
    until: float = 0.2
    blend: Literal["after", "before"] = "after"
    resample: int = 1
    strength: float | None = None
    guide: Guide | None = None

    def impose(self, x0_hat: Tensor) -> Tensor:
        """Replaces the kept features of a clean estimate (B, F, D) with the known features.

        This implements mode "x0".
        """
        x0_hat = x0_hat if self.guide is None else self.guide.reach(x0_hat)
        return torch.where(self.keep, self.known, x0_hat)

    def steps(self, total: int) -> int:
        """Returns how many of the `total` sampling steps to take (at least one)."""
        return total if self.strength is None else max(1, round(self.strength * total))


Denoise = Callable[[Tensor, Tensor, Tensor, Condition], Tensor]
"""Function of a denoiser, with or without guidance.

Its signature is (x_t (B, F, D), t (B,) in [0, 1000), mask (B, F), cond) -> (B, F, out_features).
"""

Noise = Callable[[int], Tensor]
"""Function that maps the draw index (0, 1, 2, ...) to the noise (B, F, D) of a sampling run.

Sampling starts from draw 0; stochastic samplers use the later draws.
"""


def pad_to(x: Tensor, size: int) -> Tensor:
    """Pads dimension 1 of x (B, N, ...) to `size` entries, with zeros (False in masks)."""
    missing = size - x.shape[1]
    return x if missing == 0 else torch.cat([x, x.new_zeros(x.shape[0], missing, *x.shape[2:])], 1)


def length_mask(lengths: Tensor, frames: int | None = None) -> Tensor:
    """Returns a bool mask (B, F) in which the first `lengths` (B,) frames of each motion are True.

    `frames` is F; it defaults to the maximum length.

    Example:
        >>> length_mask(torch.tensor([1, 2])).tolist()
        [[True, False], [True, True]]
    """
    frames = int(lengths.max()) if frames is None else frames
    return torch.arange(frames, device=lengths.device) < lengths[:, None]


def ceil_div(count: int, size: int) -> int:
    """Returns how many groups of `size` items are needed for `count` items."""
    return -(-count // size)


def padded_length(length: int, multiple: int, most: int) -> int:
    """Returns `length` rounded up to a multiple of `multiple`, but at most `most`."""
    return min(ceil_div(length, multiple) * multiple, max(most, length))


def sent(x: Tensor, device: torch.device) -> Tensor:
    """Moves a tensor to a device.

    A copy to a GPU does not wait for earlier work on that GPU.
    """
    copied = device.type == "cuda" and x.device.type == "cpu"
    return (x.pin_memory() if copied else x).to(device, non_blocking=copied)


class Constant:
    """Constant numbers, stored as one tensor per device.

    They are not registered as buffers of a module, so they do not change when a model is cast or is
    built on the meta device.

    Example:
        >>> table = Constant([1.0, 2.0])
        >>> table.on(torch.device("cpu")) is table.on(torch.device("cpu"))
        True
    """

    def __init__(self, values: Sequence[Any]):
        self.values = values
        self.tensors: dict[torch.device, Tensor] = {}

    def on(self, device: torch.device) -> Tensor:
        """Returns the numbers as a tensor on a device.

        Only the first call for each device waits for the copy.
        """
        if device not in self.tensors:
            # The first call may happen during validation, but training cannot use inference
            # tensors.
            with torch.inference_mode(False):
                self.tensors[device] = torch.tensor(self.values, device=device)
        return self.tensors[device]


def collate(
    samples: Sequence[tuple[str, Tensor, str | None, int | None]], multiple: int = 1, most: int = 0
) -> MotionBatch:
    """Collates samples into a batch, padded with zeros.

    Args:
        samples: (id, normalized features (F, D), caption, action) for each motion.
        multiple: the length of the longest sample is rounded up to a multiple of this number of
            frames.
        most: maximum number of frames after rounding. Longer samples are not cut.
    """
    ids, motions, texts, actions = zip(*samples, strict=True)
    lengths = torch.tensor([len(x) for x in motions])
    frames = padded_length(int(lengths.max()), multiple, most)
    return MotionBatch(
        x=pad_to(torch.nn.utils.rnn.pad_sequence(list(motions), batch_first=True), frames),
        mask=length_mask(lengths, frames),
        ids=list(ids),
        text=None if any(t is None for t in texts) else list(texts),
        action=None if any(a is None for a in actions) else torch.tensor(actions),
    )
