"""Data sets kept on the training device.

Batches are gathered on the device, without workers or copies.
"""

import os
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from flame_mdm.batch import MotionBatch, padded_length, sent
from flame_mdm.data.crops import Clips, Draw
from flame_mdm.data.store import Store
from flame_mdm.representations import Representation

# With data.resident=auto, a data set is kept on the device if it takes at most 1 / SHARE of the
# free memory. The rest is for the model and its activations.
SHARE = 4
CHUNK = 1 << 16  # number of frames that are copied at once, so that copying takes little memory
# Number of batches whose crops are drawn together. This takes less host time than drawing them one
# by one, and it requires only one copy to a GPU.
PLANNED = 16


def free_memory(device: torch.device) -> int:
    """Returns the free memory of a device in bytes.

    For devices other than GPUs, this is the memory that is available in the system or the
    container.
    """
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = 1024 * next(
            int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")
        )
    except (OSError, StopIteration):
        free = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        limit, used = (
            Path(f"/sys/fs/cgroup/memory.{name}").read_text() for name in ("max", "current")
        )
        return min(free, int(limit) - int(used))
    except (OSError, ValueError):  # not in a container, or in a container without a limit
        return free


def resident_features(store: Store, representation: Representation, device: torch.device) -> Tensor:
    """Copies the frames of a store to a device and adds a row of zeros, which is used as padding.

    The features (N + 1, D) are already normalized, unless the representation adapts the features of
    cut clips. In this case, each batch is normalized after it is adapted.
    """
    features = torch.empty(len(store.features) + 1, store.features.shape[1], device=device)
    mean, std = store.mean.astype(np.float32), store.std.astype(np.float32)
    for begin in range(0, len(store.features), CHUNK):
        part = store.features[begin : begin + CHUNK]
        part = np.array(part) if adapts_cuts(representation) else (part - mean) / std
        features[begin : begin + len(part)] = torch.from_numpy(part)
    features[-1] = 0
    return features


def adapts_cuts(representation: Representation) -> bool:
    """Returns whether a representation adapts the features of cut clips in its method `rebase`."""
    return type(representation).rebase is not Representation.rebase


class ResidentLoader:
    """Loads the batches of a split by gathering their features on the device.

    The batches are bit-identical to the batches of the data loader.

    Args:
        clips: clips of the split.
        batches: for each batch, a list with the `Draw` of each clip.
        features: (N + 1, D), as returned by `resident_features`.
        multiple: each batch is padded to a multiple of this number of frames.
    """

    def __init__(
        self, clips: Clips, batches: Iterable[list[Draw]], features: Tensor, multiple: int
    ):
        self.clips, self.batches, self.features, self.multiple = clips, batches, features, multiple
        entries = clips.clips
        self.begin = np.array([clip.start for clip in entries], np.int64)
        self.actions = np.array(
            [-1 if clip.action is None else clip.action for clip in entries], np.int64
        )
        self.frames = torch.arange(clips.crop.longest(), device=features.device)
        self.mean, self.std = (
            torch.from_numpy(values).to(features.device) for values in (clips.mean, clips.std)
        )

    def __len__(self) -> int:
        # Training batches are endless and have no length.
        return len(self.batches)  # type: ignore[arg-type]

    def __iter__(self) -> Iterator[MotionBatch]:
        batches = iter(self.batches)
        while planned := list(islice(batches, PLANNED)):
            yield from self._gathered(planned)

    def _gathered(self, planned: list[list[Draw]]) -> Iterator[MotionBatch]:
        """Draws the crops for several batches at once and yields the batches."""
        rows = np.array([index for draws in planned for index, _ in draws])
        # All clips in a batch share the batch number of the first clip.
        numbers = [draws[0][1] for draws in planned for _ in draws]
        first, length, caption = self.clips.draw(rows, numbers)
        sizes = [len(draws) for draws in planned]
        padded = [
            padded_length(int(longest), self.multiple, len(self.frames))
            for longest in np.maximum.reduceat(length, np.cumsum([0, *sizes[:-1]]))
        ]

        begin, labels = self.begin[rows], self.actions[rows]
        values = np.stack([begin + first, begin + self.clips.frames[rows] - 1, length, labels])
        start, last, lengths, action = sent(torch.from_numpy(values), self.features.device)
        frames = self.frames[: max(padded)]
        mask = frames < lengths[:, None]
        # A sample that extends past the end of its clip repeats the last frame. After the end of
        # the sample, all entries are 0.
        rows_of_frames = torch.minimum(start[:, None] + frames, last[:, None]).masked_fill(
            ~mask, len(self.features) - 1
        )

        end = 0
        for size, width in zip(sizes, padded, strict=True):
            part, end = slice(end, end + size), end + size
            entries = [self.clips.clips[index] for index in rows[part].tolist()]
            captions = caption[part].tolist()
            has_text = all(clip.captions for clip in entries)
            yield MotionBatch(
                x=self._features(rows_of_frames[part, :width], mask[part, :width]),
                mask=mask[part, :width].contiguous(),
                ids=[clip.id for clip in entries],
                text=[clip.captions[n] for clip, n in zip(entries, captions, strict=True)]
                if has_text
                else None,
                action=None if (labels[part] < 0).any() else action[part],
            )

    def _features(self, rows: Tensor, mask: Tensor) -> Tensor:
        """Gathers rows (B, F) of `features` and returns normalized features (B, F, D)."""
        x = F.embedding(rows, self.features)
        if not adapts_cuts(self.clips.representation):
            return x
        x = (self.clips.representation.rebase(x) - self.mean) / self.std
        return x.masked_fill(~mask[..., None], 0)
