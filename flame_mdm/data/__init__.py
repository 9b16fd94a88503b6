"""Data sets: readers for published releases, stores of packed clips, and batches."""

import hashlib
import math
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

import numpy as np

from flame_mdm.errors import UserError

if TYPE_CHECKING:
    from flame_mdm.representations import Representation

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
Value = TypeVar("Value")


@dataclass
class Clip:
    """One motion of a data set, with the captions and labels that are written to the store."""

    # Unique name. The name of a mirrored copy is `M` + the name of its original.
    id: str
    # Raw motion that the representation encodes, at the frame rate of the representation.
    # Representations of joints encode positions (F, J, 3) in meters, with y up, in the joint order
    # of their skeleton.
    motion: np.ndarray
    # Descriptions of the entire motion. The list is empty for data sets that have only action
    # labels.
    captions: list[str]
    # Split. Mirrored copies and cuts of a take are in the same split as the take.
    split: Split
    # The take that the clip comes from. All clips from one source are in the same split.
    source: str
    # Index of the action label in the data set's `actions`, or None if the clip has no label
    action: int | None = None
    # Exact facts about the motion, such as its side, count and direction, as JSON values. The text
    # data sets also keep the tagged words of their captions here.
    attributes: Mapping[str, Any] = field(default_factory=dict)
    # Name of the representation if the release contains encoded features instead of raw motions.
    # `motion` (F, D) then consists of these features and is stored unchanged. The name is empty if
    # `motion` is raw.
    encoded: str = ""
    # First frame and length of the part of the motion that forms the clip, or None for the entire
    # motion. Consecutive clips with the same array object share its frames in the store. Windows
    # require a representation with one row per frame.
    window: tuple[int, int] | None = None
    # Joint positions (F', J, 3) in meters at the frame rate of the recording, for protocols that
    # compare motions at that rate.
    reference: np.ndarray | None = None
    # Identifier of the license of this motion, such as "MIT". It is empty if one license applies to
    # all motions of the data set.
    license: str = ""


class MotionSource(ABC):
    """Base class for readers of data sets in their published form."""

    name: str
    # Whether the data set takes its name from `data.name`, because the files are the user's own
    named_by_recipe: bool = False
    options: Mapping[str, Any] = {}
    """Constructor arguments that define the data, as JSON values.

    Paths and worker counts are left out. The arguments are saved in the store, and commands
    compare them with the recipe.
    """
    # Names of the action labels, in the order of their indices
    actions: tuple[str, ...] = ()
    # All forms of the verbs in the captions. Sentences are split into actions at these verbs.
    # Empty = sentences are not split.
    verbs: tuple[str, ...] = ()
    license: str = ""
    """License of all motions, given as a key in `licenses.yaml`, such as "MIT".

    It is empty if the license is unknown, or if clips have individual licenses.
    """
    # Whether the license allows checkpoints to contain captions
    captions_may_be_shared: bool = False
    published_split: bool = False
    """Whether the papers' split is used despite its flaws.

    Such a split tests on training clips, or has no validation clips. The value is saved in the
    store and in every result.
    """
    version: int = 1
    """Version of the code that reads the motions.

    The version is part of the fingerprint. Stores written by a different version are not used.
    """
    failures: Sequence[str] = ()
    """One line per motion that could not be read and was left out.

    The list is complete once `clips` is exhausted. Commands then exit with code 1, because the user
    should correct the files.
    """
    # Number of processes that read and encode motions; 0 = one per core, 1 = only this process
    workers: int = 0
    # Names of motions to leave out
    exclude: Collection[str] = ()

    @cached_property
    def excluded(self) -> Counter[str]:
        """The number of omitted clips or labels for each reason, as saved in the store.

        The numbers are complete once `clips` is exhausted.
        """
        return Counter()

    def leave_out(self, reason: str, count: int = 1) -> None:
        """Adds `count` to the number of clips that are left out for this reason."""
        if count:
            self.excluded[reason] += count

    def not_excluded(self, named: Mapping[str, Value], path: Path) -> dict[str, Value]:
        """Removes the names in `exclude` from a mapping, and counts the removed names.

        Raises:
            UserError: If `exclude` contains a name that is not in the mapping.
        """
        if unknown := set(self.exclude) - named.keys():
            raise UserError(f"data.source.exclude: {path} does not contain {some(unknown)}")
        self.leave_out("motions by data.source.exclude", len(self.exclude))
        return {name: value for name, value in named.items() if name not in self.exclude}

    def counts(self) -> Mapping[str, float]:
        """Returns statistics of the raw data, under the names used in `published.yaml`.

        The statistics are saved once `clips` is exhausted.
        """
        return {}

    def findings(self) -> list[str]:
        """Returns findings about the motions.

        The findings are complete once `clips` is exhausted.
        """
        return []

    def changed(self, store: Path) -> list[str]:
        """Returns messages about files that were added or changed after the store was prepared.

        Args:
            store: a file in the store. Data files with a later modification time count as changed.
        """
        return []

    def may_share_captions(self, license: str) -> bool:
        """Returns whether a checkpoint may contain the captions of a clip with this license.

        An empty string stands for the license of the data set.
        """
        return self.captions_may_be_shared

    def licenses(self) -> set[str]:
        """Returns the licenses of all motions. The motions are not read.

        An empty string stands for an unknown license.
        """
        return {self.license}

    @abstractmethod
    def count(self) -> int:
        """Returns the number of clips that `clips` yields. The motions are not read.

        Raises:
            FileNotFoundError: If the raw data is missing. The message explains how to obtain it.
            UserError: If a file is damaged, or if an option does not match the data.
        """

    def failure_lines(self) -> list[str]:
        """Returns `failures` as lines to print."""
        return [f"error: {failure}" for failure in self.failures]

    def check(self, fps: float) -> list[str]:
        """Reports which files exist and which are missing, without preparing the data.

        Args:
            fps: frames per second.
        """
        return [f"{self.name}: {self.count()} clips can be prepared"]

    def suit(self, representation: "Representation") -> None:  # noqa: B027 (most sources yield one kind of motion)
        """Configures the source so that `clips` yields raw motions for a representation.

        Raises:
            UserError: If the options do not match the representation.
        """

    def statistics(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns the mean and std (D,) that are published with encoded features.

        Returns None if the mean and std must be computed from the training clips.
        """
        return None

    @abstractmethod
    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields all clips at `fps` frames per second, always in the same order.

        Raises the same errors as `count`.
        """

    def check_fps(self, fps: float, published: float) -> None:
        """Checks the frame rate of a data set that is never resampled.

        Raises:
            UserError: If `fps` is not the `published` frame rate.
        """
        if fps != published:
            raise UserError(
                f"{self.name} has {published:g} frames per second, not {fps:g}. Set "
                f"representation.fps={published:g}"
            )


def advice_on_splits(source: MotionSource) -> str:
    """Returns advice on how to fill an empty split. The advice begins with a space.

    The advice is "" for published data sets, because their splits are fixed.
    """
    return " Add a `split` column to captions.csv" if source.named_by_recipe else ""


def required(path: Path, get_it: str) -> Path:
    """Returns `path` if it exists.

    Raises:
        FileNotFoundError: If `path` does not exist. The message ends with `get_it`, which explains
            how to obtain the file.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: not found; {get_it}")
    return path


def some(names: Iterable[str]) -> str:
    """Lists the first five of the sorted names, followed by the number of remaining names."""
    first = sorted(names)
    return ", ".join(first[:5]) + (f" and {len(first) - 5} more" if len(first) > 5 else "")


def name_hash(name: str) -> int:
    """Returns a 160-bit hash of the name, so that random draws are the same on every machine."""
    return int(hashlib.sha1(name.encode()).hexdigest(), 16)


def hashed_split(name: str, val: int, test: int) -> Split:
    """Returns a split that depends only on the name.

    Adding names therefore does not change the splits of other names.

    Args:
        name: name of a motion or of its source.
        val: percentage of names to hold out for validation.
        test: percentage of names to hold out for testing.
    """
    share = (name_hash(name) >> 128) % 100
    return "train" if share < 100 - val - test else "val" if share < 100 - test else "test"


def split_blocks(name: str, clips: int, size: int, *, val: float, test: float) -> dict[int, Split]:
    """Assigns each block of `size` consecutive clips to a split, based on a hash of `name`.

    Neighboring clips may be similar, so all clips of a block are in the same split. `val` and
    `test` are fractions of the blocks. Each split gets at least one block.
    """
    count = math.ceil(clips / size)
    blocks = sorted(range(count), key=lambda block: name_hash(f"{name}_{block}"))
    tested, validated = (max(1, round(share * len(blocks))) for share in (test, val))
    counts: dict[Split, int] = {"test": tested, "val": validated, "train": len(blocks)}
    return dict(
        zip(blocks, (split for split, count in counts.items() for _ in range(count)), strict=False)
    )


def swap_sides(text: str) -> str:
    """Swaps "left" with "right", and "clockwise" with "counterclockwise", in the text."""
    pairs = {"left": "right", "right": "left", "clockwise": "counterclockwise"}
    pairs |= {"counterclockwise": "clockwise", "anticlockwise": "clockwise"}

    def swap(match: re.Match[str]) -> str:
        word = pairs[match[0].lower()]
        return word.capitalize() if match[0][0].isupper() else word

    return re.sub(rf"(?<![a-z])({'|'.join(pairs)})(?![a-z])", swap, text, flags=re.IGNORECASE)


def mirrored(clip: Clip, motion: np.ndarray, actions: Sequence[str]) -> Clip:
    """Returns the mirror image of a clip, given its mirrored motion.

    Left and right are swapped in the captions, the action and the attributes.
    """
    action = None if clip.action is None else swap_sides(actions[clip.action])
    return replace(
        clip,
        id=f"M{clip.id}",
        motion=motion,
        captions=[swap_sides(caption) for caption in clip.captions],
        action=actions.index(action) if action in actions else clip.action,
        attributes={
            k: swap_sides(value) if isinstance(value, str) else value
            for k, value in clip.attributes.items()
        },
    )
