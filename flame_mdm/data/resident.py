"""Data sets kept on the training device.

Batches are gathered there, without workers and copies.
"""

import os
from collections.abc import Iterable, Iterator
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


def free_memory(device: torch.device) -> int:
    """Returns the free memory of a device in bytes.

    For devices other than GPUs, this is the memory that the system or the container can provide.
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
    """Returns the frames of a store on a device, (N + 1, D). The last row is zeros, for padding.

    Frames are normalized here. If the representation adapts cuts, frames are normalized later
    instead.
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
    """Returns whether a representation changes the features of a cut (see `rebase`)."""
    return type(representation).rebase is not Representation.rebase


class ResidentLoader:
    """Loads the batches of a split by gathering features on the device.

    The batches are bit-identical to the batches of the data loader.

    Args:
        clips: clips of the split.
        batches: draws of each batch.
        features: (N + 1, D), see `resident_features`.
        multiple: batches are padded to multiples of this number of frames.
    """

    def __init__(
        self, clips: Clips, batches: Iterable[list[Draw]], features: Tensor, multiple: int
    ):
        self.clips, self.batches, self.features, self.multiple = clips, batches, features, multiple
        self.begin = np.array([clip.start for clip in clips.clips], np.int64)
        self.actions = np.array(
            [-1 if clip.action is None else clip.action for clip in clips.clips], np.int64
        )
        self.frames = torch.arange(clips.crop.longest(), device=features.device)
        self.mean, self.std = (
            torch.from_numpy(values).to(features.device) for values in (clips.mean, clips.std)
        )

    def __len__(self) -> int:
        # Training batches are endless and have no length.
        return len(self.batches)  # type: ignore[arg-type]

    def __iter__(self) -> Iterator[MotionBatch]:
        return map(self._batch, self.batches)

    def _batch(self, draws: list[Draw]) -> MotionBatch:
        rows = np.array([index for index, _ in draws])
        first, length, caption = self.clips.draw(rows, draws[0][1])
        begin = self.begin[rows]
        values = np.stack(
            [begin + first, begin + self.clips.frames[rows] - 1, length, self.actions[rows]]
        )
        start, last, lengths, action = sent(torch.from_numpy(values), self.features.device)[
            ..., None
        ]
        frames = self.frames[: padded_length(int(length.max()), self.multiple, len(self.frames))]
        mask = frames < lengths
        rows_of_frames = torch.minimum(start + frames, last).masked_fill(
            ~mask, len(self.features) - 1
        )
        x = F.embedding(rows_of_frames, self.features)
        if adapts_cuts(self.clips.representation):
            x = ((self.clips.representation.rebase(x) - self.mean) / self.std).masked_fill(
                ~mask[..., None], 0
            )
        entries = [self.clips.clips[index] for index in rows]
        has_text = bool(self.clips.captions[rows].all())
        return MotionBatch(
            x=x,
            mask=mask,
            ids=[clip.id for clip in entries],
            text=[clip.captions[n] for clip, n in zip(entries, caption.tolist(), strict=True)]
            if has_text
            else None,
            action=None if (values[3] < 0).any() else action[:, 0],
        )
