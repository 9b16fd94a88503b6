"""Training and evaluation batches from a packed store.

Every batch depends only on the seed, the step and the rank. Therefore, no generator state is saved,
and a resumed run sees the same batches as an uninterrupted run.
"""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Sampler

from flame_mdm.batch import collate
from flame_mdm.data import MotionSource, Split, advice_on_splits
from flame_mdm.data.crops import Clips, Crop, Draw, Sample
from flame_mdm.data.resident import SHARE, ResidentLoader, free_memory, resident_features
from flame_mdm.data.store import Store, write_store
from flame_mdm.errors import UserError, say
from flame_mdm.representations import Representation

# Maximum number of frames in a sample. One hour at 20 frames per second has 72,000 frames.
MAX_FRAMES = 100_000
# Pattern for data set names. The name of the data set's folder starts with this name, so the
# pattern ensures that the folder is inside `root` and not hidden.
NAME = r"\w[\w .-]*"
Loader = DataLoader[Sample] | ResidentLoader


class TrainingBatches(Sampler[list[Draw]]):
    """An endless stream of batches, each with clips of similar lengths.

    Batch n depends only on n and the seed. For each pass over the data, the clips are shuffled and
    divided into groups of `BUCKETS` batches. Each group is sorted by length to reduce padding.
    Process `rank` of `world` takes every `world`-th batch.
    """

    BUCKETS = 16

    def __init__(
        self, lengths: np.ndarray, batch_size: int, *, seed: int, first: int, rank: int, world: int
    ):
        self.lengths, self.batch_size, self.seed = lengths, batch_size, seed
        self.first, self.rank, self.world = first, rank, world

    def __iter__(self) -> Iterator[list[Draw]]:
        per_pass = max(1, len(self.lengths) // self.batch_size)
        current, batches = -1, []
        for number in count(self.first * self.world + self.rank, self.world):
            if number // per_pass != current:
                current = number // per_pass
                batches = self.batches(current, per_pass)
            yield [(int(index), number) for index in batches[number % per_pass]]

    def batches(self, number: int, per_pass: int) -> list[np.ndarray]:
        """Returns the indices of the clips in each batch of one pass over the data."""
        generator = np.random.default_rng((self.seed, number))
        order = generator.permutation(len(self.lengths))
        order = np.resize(order, max(len(order), self.batch_size))[: per_pass * self.batch_size]
        stretch = self.batch_size * self.BUCKETS
        batches = []
        for begin in range(0, len(order), stretch):
            part = order[begin : begin + stretch]
            part = part[np.argsort(self.lengths[part], kind="stable")]
            batches += np.split(part, len(part) // self.batch_size)
        return [batches[i] for i in generator.permutation(len(batches))]


def evaluation_batches(
    lengths: np.ndarray, batch_size: int, *, rank: int, world: int
) -> list[list[Draw]]:
    """Returns the batches of this rank.

    Across all ranks, the batches contain each clip exactly once. The longest clips come first.
    """
    mine = np.argsort(-lengths, kind="stable")[rank::world]
    return [
        [(int(i), -1) for i in mine[b : b + batch_size]] for b in range(0, len(mine), batch_size)
    ]


class MotionDataModule(LightningDataModule):
    """Prepares a data set, unless it is already prepared, and provides its batches.

    Args:
        source: reader for the published data set.
        representation: representation that encodes the clips. It receives the statistics of the
            store.
        root: folder that contains all prepared data sets.
        name: name of the data set. The name of the data set's folder in `root` begins with this
            name.
        batch_size: clips per rank and step.
        num_workers: number of loading processes; 0 = load in the training process.
        crop: rule that determines the frames of a sample and the minimum length of a clip.
        seed: seed for the order of the clips, their crops and their captions.
        resident: whether the data set is kept on the training device. The same batches are then
            gathered on the device, without workers. "auto" = only if the data set takes up at most
            a quarter of the free memory.
        pad_multiple: batches are padded to a multiple of this number of frames, so that compiled
            networks process only a few shapes. No batch is padded beyond the maximum sample length
            of the crop rule.
    """

    def __init__(
        self,
        source: MotionSource,
        representation: Representation,
        *,
        root: str,
        name: str,
        batch_size: int,
        num_workers: int = 0,
        crop: Crop,
        seed: int = 0,
        resident: bool | Literal["auto"] = "auto",
        pad_multiple: int = 1,
    ):
        super().__init__()
        frames = (crop.min_frames, crop.longest()) if isinstance(crop, Crop) else (None,)
        is_crop = all(type(number) is int and 1 <= number <= MAX_FRAMES for number in frames)
        for key, value, is_valid, remedy in (
            ("batch_size", batch_size, batch_size >= 1, "use at least one clip per batch"),
            ("num_workers", num_workers, num_workers >= 0, "use 0 or more"),
            (
                "name",
                name,
                re.fullmatch(NAME, name),
                "use a name of letters, digits, _, - and ., such as my_motions",
            ),
            (
                "resident",
                resident,
                isinstance(resident, bool) or resident == "auto",
                "use true, false or auto",
            ),
            (
                "pad_multiple",
                pad_multiple,
                1 <= pad_multiple <= MAX_FRAMES,
                f"expected 1 to {MAX_FRAMES:,}",
            ),
            (
                "crop",
                crop,
                is_crop,
                f"use a rule in flame_mdm.data.crops, with 1 to {MAX_FRAMES:,} frames",
            ),
        ):
            if not is_valid:
                raise UserError(f"data.{key}={value!s:.80}: {remedy}")
        if source.named_by_recipe:
            source.name = name
        self.source, self.representation = source, representation
        self.folder = Path(root) / f"{name}-{representation.name}"
        self.batch_size, self.num_workers, self.seed = batch_size, num_workers, seed
        self.crop, self.resident, self.pad_multiple = crop, resident, pad_multiple
        self.device: torch.device | None = None
        self.features: Tensor | None = None
        self.prepare_data_per_node = False  # all machines share the folder

    def prepare_data(self) -> None:
        """Writes the store if it does not exist. Lightning calls this method on only one rank."""
        if (self.folder / "store.json").exists():
            say(*self.source.changed(self.folder / "store.json"))
        else:
            write_store(self.folder, self.source, self.representation)
            say(*self.source.failure_lines())

    @property
    def actions(self) -> Sequence[str]:
        """Names of the action labels.

        The names are read from the store if it exists, so that training does not require the raw
        data.
        """
        prepared = (self.folder / "store.json").exists()
        return self.open().info["actions"] if prepared else self.source.actions

    def open(self) -> Store:
        """Returns the prepared store and copies its statistics to the representation.

        Raises:
            FileNotFoundError: If the data set is not prepared.
            UserError: If the store is damaged, or was prepared with different options.
        """
        store = Store(self.folder)
        recipe = {
            "dataset": self.source.name,
            "representation": self.representation.name,
            "fps": self.representation.fps,
            "published_split": self.source.published_split,
            "version": self.source.version,
            **self.source.options,
        }
        prepared = {"version": 1} | store.info | store.info.get("source", {})
        if differing := [name for name in recipe if prepared.get(name) != recipe[name]]:
            there, here = (
                ", ".join(f"{name}={of.get(name)}" for name in differing)
                for of in (prepared, recipe)
            )
            advice = "Prepare it again with force=true, choose another data_root or data.name, or change the recipe"
            raise UserError(
                f"{self.folder}: prepared with {there}, but the recipe specifies {here}. {advice}"
            )
        self.representation.mean.copy_(torch.from_numpy(store.mean))
        self.representation.std.copy_(torch.from_numpy(store.std))
        return store

    def counts(self, store: Store) -> list[str]:
        """Reports, for each split, how many clips are long enough for the crop rule."""
        shortest = self.crop.min_frames
        used = Counter(clip.split for clip in store.clips if clip.length >= shortest)
        short = {split: total - used[split] for split, total in store.info["clips"].items()}
        counts, advice = [], []
        for split, n in short.items():
            of_all = f" of {used[split] + n} ({n} shorter than {shortest} frames)" if n else ""
            counts.append(f"{used[split]}{of_all} {split}")
            if n and not used[split]:
                advice.append(f"all {split} clips are too short. Lower data.crop.min_frames")
            elif not used[split]:
                advice.append(f"no {split} clips.{advice_on_splits(self.source)}")
        if not store.info["actions"] and not any(clip.captions for clip in store.clips):
            advice.append(
                "no captions. Add captions.csv and prepare with force=true, or train with condition=none"
            )
        return ["clips: " + ", ".join(counts), *(() if store.info["published_split"] else advice)]

    def captions(self) -> list[str]:
        """Returns all distinct captions of the store, sorted."""
        return sorted({caption for clip in self.open().clips for caption in clip.captions})

    def setup(self, stage: str) -> None:
        """Opens the store and its splits."""
        self.store = self.open()
        self.train, self.val, self.test = (self.clips(split) for split in ("train", "val", "test"))
        if not len(self.train):
            raise UserError(
                f"{self.folder}: no training clip has {self.crop.min_frames} frames or more"
            )
        self.features = None
        self.choose_device()

    def choose_device(self, more: int = 0) -> torch.device | None:
        """Returns the device on which the data set is kept, or None if it is not kept on a device.

        `more` is the size of the text encoder's cache, in bytes.
        """
        device = self.trainer.strategy.root_device if self.trainer else torch.device("cpu")
        free, size = free_memory(device), 4 * self.store.features.size + more
        if self.trainer and device.type == "cpu":
            free //= self.trainer.num_devices
        if self.resident is True and size > free:
            numbers = (
                f"{size / 2**30:.1f} GiB, but only {free / 2**30:.1f} GiB are free on {device}"
            )
            raise UserError(
                f"data.resident=true: {self.folder} and its captions take {numbers}. Set data.resident=auto"
            )
        automatic = (
            self.resident == "auto" and device.type in ("cpu", "cuda") and size <= free / SHARE
        )
        self.device = device if self.resident is True or automatic else None
        return self.device

    def clips(self, split: Split) -> Clips:
        """Returns the clips of a split as a data set that crops each clip when it is drawn.

        If the published split has no test clips, as in HumanAct12, the training clips are used for
        testing.
        """
        if (
            split == "test"
            and self.store.info["published_split"]
            and not self.store.info["clips"]["test"]
        ):
            split = "train"
        return Clips(
            self.store,
            split,
            representation=self.representation,
            crop=self.crop,
            seed=self.seed,
            advice=advice_on_splits(self.source),
        )

    def train_dataloader(self) -> Loader:
        """Returns an endless loader of training batches.

        In resumed runs, the loader starts at the trainer's current step.
        """
        trainer = self.trainer
        first = trainer.global_step * trainer.accumulate_grad_batches if trainer else 0
        rank, world = (trainer.global_rank, trainer.world_size) if trainer else (0, 1)
        return self._loader(
            self.train, self.training_batches(seed=self.seed, first=first, rank=rank, world=world)
        )

    def training_batches(self, **of_process: int) -> Sampler[list[Draw]]:
        """Returns an endless stream of batches for one rank.

        See `TrainingBatches` for the arguments.
        """
        return TrainingBatches(self.train.lengths, self.batch_size, **of_process)

    def val_dataloader(self) -> Loader:
        """Returns a loader that yields each validation clip exactly once across all ranks.

        If there are fewer clips than ranks, every rank gets all clips. A rank without a batch would
        skip the validation, and all other ranks would wait for this rank.
        """
        trainer = self.trainer
        shared = trainer is not None and len(self.val) >= trainer.world_size
        rank, world = (trainer.global_rank, trainer.world_size) if trainer and shared else (0, 1)
        return self._loader(
            self.val, evaluation_batches(self.val.lengths, self.batch_size, rank=rank, world=world)
        )

    def _loader(self, clips: Clips, batches: Iterable[list[Draw]]) -> Loader:
        if self.device is not None:
            if self.features is None:
                self.features = resident_features(self.store, self.representation, self.device)
            return ResidentLoader(clips, batches, self.features, self.pad_multiple)
        return DataLoader(
            clips,
            batch_sampler=batches,
            num_workers=self.num_workers,
            collate_fn=partial(collate, multiple=self.pad_multiple, most=self.crop.longest()),
            pin_memory=torch.cuda.is_available(),
            persistent_workers=self.num_workers > 0,
        )
