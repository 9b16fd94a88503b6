"""Clips of a split, and the samples that batches draw from them."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from flame_mdm.data import Split
from flame_mdm.data.crops import Crop
from flame_mdm.data.store import Store
from flame_mdm.representations import Representation
from flame_mdm.seeds import integers, key

Draw = tuple[int, int]  # (index of a clip, number of the batch that it is drawn for; -1 in evaluation)

Sample = tuple[str, Tensor, str | None, int | None]  # (id, x (F, D), caption, action), input of `collate`


class Clips(Dataset[Sample]):
    """The clips of a split that are long enough for the crop rule, cropped at every draw, then normalized."""

    def __init__(self, store: Store, split: Split, *, representation: Representation, crop: Crop, seed: int):
        self.store, self.representation, self.crop, self.seed = store, representation, crop, seed
        of_split = [clip for clip in store.clips if clip.split == split]
        self.clips = [clip for clip in of_split if clip.length >= crop.shortest()]
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
        """Returns the samples of a batch; the data loader calls this."""
        samples: list[Sample] = []
        indices = [index for index, _ in draws]
        for index, first, length, caption in zip(indices, *self.draw(indices, draws[0][1]), strict=True):
            clip = self.clips[index]
            frames = np.minimum(np.arange(length) + first, clip.length - 1)
            features = self.representation.rebase(self.store.motion(clip)[frames])
            x = torch.from_numpy((features - self.mean) / self.std)
            samples.append((clip.id, x, self.caption(index, caption), clip.action))
        return samples

    def draw(self, indices: Sequence[int], batch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns first frame, number of frames and number of the caption (B,) of clips in a batch.

        They are functions of (seed, batch, index); in evaluation (batch -1), they are always the same.
        """
        rows = np.asarray(indices)
        if batch < 0:
            return *self.crop.draw(self.frames[rows], None), self.evaluated[rows]
        below = integers(key("sample", self.seed, batch) + rows)
        return *self.crop.draw(self.frames[rows], below), below(self.captions[rows])

    @cached_property
    def evaluated(self) -> np.ndarray:
        """Number (clips,) of the caption of each clip in evaluation, chosen by the id of the clip."""
        draws = (key("caption", self.seed, -1, clip.id) % max(1, len(clip.captions)) for clip in self.clips)
        return np.fromiter(draws, np.int64, len(self.clips))

    def caption(self, index: int, number: int) -> str | None:
        """Returns a caption of a clip; None if the clip has none."""
        return self.clips[index].captions[number] if self.captions[index] else None
