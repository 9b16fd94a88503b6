"""Data sets: reading published releases, packing them into stores, and serving training batches."""

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
    """One motion that a data set yields to be written into a store."""

    id: str  # unique name; a mirrored copy is named `M` + the name of its original
    # Input of the representation, at its frame rate. Representations of joints take positions
    # (F, J, 3) in meters, y up, in the joint order of the skeleton.
    motion: np.ndarray
    # Descriptions of the motion, each complete; empty for data sets with action labels only
    captions: list[str]
    split: Split  # mirrored copies and cuts of a take belong to the split of that take
    source: str  # the take the clip comes from; clips of one source are never in two splits
    action: int | None = None  # index into the data set's `actions`, or None
    # Exact facts about the motion, such as side, count and direction, or tagged words, as JSON values.
    attributes: Mapping[str, Any] = field(default_factory=dict)
    # Name of a representation if the release contains its features: `motion` (F, D) is then
    # stored unchanged. Empty if `motion` is raw.
    encoded: str = ""
    # (first, length): the clip is this cut of its motion. Consecutive clips that hold the same
    # array object share its frames in the store. Only for representations with one row per frame.
    window: tuple[int, int] | None = None
    # Joints (F', J, 3) in meters at the frame rate of the recording, for protocols that compare
    # motions at that rate.
    reference: np.ndarray | None = None
    # License of this motion, an identifier such as "MIT". Empty if the data set has one license
    # for all motions.
    license: str = ""


class MotionSource(ABC):
    """A data set in the form in which it is published."""

    name: str
    # Whether the data set takes its name from `data.name` of the recipe: the files are the
    # user's.
    named_by_recipe: bool = False
    options: Mapping[str, Any] = {}
    """Arguments of the constructor that define the data, as JSON values. Paths and numbers of workers are
    not among them. They are saved in the store, and commands compare them with those in the recipe."""
    actions: tuple[str, ...] = ()  # names of the action labels, in the order of their numbers
    # All forms of the verbs in the captions. Sentences are split into actions at these verbs;
    # empty if they are not split.
    verbs: tuple[str, ...] = ()
    license: str = ""
    """License of all motions, a key of `licenses.yaml` such as "MIT"; empty if unknown, or if clips have their own."""
    # Whether the license allows checkpoints to contain captions.
    captions_may_be_shared: bool = False
    published_split: bool = False
    """Whether the papers' split is used, although it tests on training clips or has no validation clips.

    Saved in the store and in every result.
    """
    version: int = 1
    """Version of the code that reads the motions. It is part of the fingerprint, and stores of another version
    are not used."""
    failures: Sequence[str] = ()
    """Lines about motions that could not be read and are left out, complete once `clips` is exhausted. Commands
    then end with exit code 1, since the user should correct the files."""
    workers: int = 0  # processes that read and encode; 0 = one per core, 1 = this process only
    exclude: Collection[str] = ()  # names to leave out

    @cached_property
    def excluded(self) -> Counter[str]:
        """Number of clips or labels left out, by reason; complete once `clips` is exhausted. Saved in the store."""
        return Counter()

    def leave_out(self, reason: str, count: int = 1) -> None:
        """Counts clips that are left out."""
        if count:
            self.excluded[reason] += count

    def not_excluded(self, named: Mapping[str, Value], path: Path) -> dict[str, Value]:
        """Removes the names in `exclude` from a mapping and counts them.

        Raises `UserError` if `exclude` has a name that the mapping lacks.
        """
        if unknown := set(self.exclude) - named.keys():
            raise UserError(f"data.source.exclude: {path} has no {some(unknown)}")
        self.leave_out("motions by data.source.exclude", len(self.exclude))
        return {name: value for name, value in named.items() if name not in self.exclude}

    def counts(self) -> Mapping[str, float]:
        """Returns figures of the raw data under the names of `published.yaml`; saved once `clips`
        is exhausted.
        """
        return {}

    def findings(self) -> list[str]:
        """Returns lines to print about the motions, complete once `clips` is exhausted."""
        return []

    def changed(self, store: Path) -> list[str]:
        """Returns a line if files were added or changed since the file `store` was prepared from them."""
        return []

    def may_share_captions(self, license: str) -> bool:
        """Returns whether a checkpoint may contain the captions of a clip with this license; "" = the data set's."""
        return self.captions_may_be_shared

    def licenses(self) -> set[str]:
        """Returns the licenses of all motions, without reading motions; "" stands for an unknown license."""
        return {self.license}

    @abstractmethod
    def count(self) -> int:
        """Returns the number of clips that `clips` yields, without reading motions.

        Raises `FileNotFoundError`, which says how to get the raw data, if it is missing, and
        `UserError` if a file is damaged or an option does not fit the data.
        """

    def failure_lines(self) -> list[str]:
        """Returns the lines to print about `failures`."""
        return [f"error: {failure}" for failure in self.failures]

    def check(self, fps: float) -> list[str]:
        """Returns lines to print about the files that are present or missing, at `fps` frames per
        second.

        Prepares nothing.
        """
        return [f"{self.name}: {self.count()} clips can be prepared"]

    def suit(self, representation: "Representation") -> None:  # noqa: B027 (most sources yield one kind of motion)
        """Makes `clips` yield raw motions of a representation; raises `UserError` if the options do not fit it."""

    def statistics(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns mean and std (D,) published with encoded features; None = computed from the training clips."""
        return None

    @abstractmethod
    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields all clips at `fps` frames per second, always in the same order; raises the errors of `count`."""

    def check_fps(self, fps: float, published: float) -> None:
        """Raises `UserError` if `fps` is not the `published` frame rate of a data set that is
        never resampled.
        """
        if fps != published:
            raise UserError(
                f"{self.name} has {published:g} frames per second, not {fps:g}: set representation.fps"
            )


def required(path: Path, get_it: str) -> Path:
    """Returns `path`; raises `FileNotFoundError` with the advice `get_it` if nothing is there."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: not found; {get_it}")
    return path


def some(names: Iterable[str]) -> str:
    """Returns the first five of the sorted names, and how many others there are."""
    first = sorted(names)
    return ", ".join(first[:5]) + (f" and {len(first) - 5} more" if len(first) > 5 else "")


def name_hash(name: str) -> int:
    """Returns 160 bits that depend on the name alone, so that draws by name are equal on any
    machine.
    """
    return int(hashlib.sha1(name.encode()).hexdigest(), 16)


def hashed_split(name: str, val: int, test: int) -> Split:
    """Returns a split that depends on the name alone, so new names do not move other names.

    Args:
        name: name of a motion or of its source.
        val: percent of all names that are held out for validation.
        test: percent of all names that are held out for testing.
    """
    share = (name_hash(name) >> 128) % 100
    return "train" if share < 100 - val - test else "val" if share < 100 - test else "test"


def split_blocks(name: str, clips: int, size: int, *, val: float, test: float) -> dict[int, Split]:
    """Returns the split of each block of `size` consecutive clips, drawn by a hash of `name`.

    Neighboring clips may look alike, so that a block is never divided between splits. `val` and
    `test` are shares of the blocks; each gets at least one block.
    """
    count = math.ceil(clips / size)
    blocks = sorted(range(count), key=lambda block: name_hash(f"{name}_{block}"))
    tested, validated = (max(1, round(share * len(blocks))) for share in (test, val))
    counts: dict[Split, int] = {"test": tested, "val": validated, "train": len(blocks)}
    return dict(
        zip(blocks, (split for split, count in counts.items() for _ in range(count)), strict=False)
    )


def swap_sides(text: str) -> str:
    """Swaps left and right, clockwise and counterclockwise in a text."""
    pairs = {"left": "right", "right": "left", "clockwise": "counterclockwise"}
    pairs |= {"counterclockwise": "clockwise", "anticlockwise": "clockwise"}

    def swap(match: re.Match[str]) -> str:
        word = pairs[match[0].lower()]
        return word.capitalize() if match[0][0].isupper() else word

    return re.sub(rf"(?<![a-z])({'|'.join(pairs)})(?![a-z])", swap, text, flags=re.IGNORECASE)


def mirrored(clip: Clip, motion: np.ndarray, actions: Sequence[str]) -> Clip:
    """Returns the mirror image of a clip; `motion` is its mirrored motion.

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
