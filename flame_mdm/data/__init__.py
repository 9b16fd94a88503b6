"""Data sets: reading published releases, packing them into stores, and serving training batches."""

import hashlib
import inspect
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Self

import numpy as np

Split = Literal["train", "val", "test"]


@dataclass
class Clip:
    """One motion that a data set yields to be written into a store.

    Attributes:
        id: unique name; a mirrored copy is named `M` + the name of its original.
        motion: input of the representation, at its frame rate; for joint-based representations the joint positions
            (F, J, 3) in meters, y up, in the joint order of its skeleton.
        captions: descriptions of the motion, each complete; empty for data sets with action labels only.
        split: mirrored copies and cuts of a take belong to the split of that take.
        source: the take the clip comes from; clips of one source are never in two splits.
        action: index into the data set's `actions`, or None.
        attributes: exact facts about the motion, if the data set knows them (side, count, direction, speed, tagged
            words of the captions ...); plain values that JSON can hold.
        encoded: if the release contains features, the name of the representation that `motion` (F, D) is in; the
            features are stored unchanged. If empty, `motion` is raw.
        window: (first, length): the clip is this cut of its motion. Consecutive clips with the identical array object
            share its frames in the store. Only for representations with one row per frame.
        reference: (F', J, 3) joints in meters at the frame rate of the recording, for protocols that compare at it.
    """

    id: str
    motion: np.ndarray
    captions: list[str]
    split: Split
    source: str
    action: int | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    encoded: str = ""
    window: tuple[int, int] | None = None
    reference: np.ndarray | None = None


PLACES = frozenset({"path", "amass", "body_models", "humanact12", "index", "splits", "workers"})
"""Arguments of sources that say where files are and how to read them. All others define the data."""


class MotionSource(ABC):
    """A data set in the form in which it is published."""

    name: str
    named_by_recipe: bool = False
    """Whether the name of the data set is `data.name` of the recipe, because the files are the user's own."""
    options: Mapping[str, Any]
    """Arguments that define the data (all but `PLACES`), as JSON values. They are saved in the store."""
    actions: tuple[str, ...] = ()
    """Names of the action labels, in the order of their numbers; empty for sets without labels."""
    captions_may_be_shared: bool = False
    """Whether the license allows checkpoints to contain captions."""
    published_split: bool = False
    """Whether the split is the one used in papers although it tests on clips seen in training or leaves no validation
    clips. Saved in the store and in every result."""
    workers: int = 0
    """Number of processes that read and encode; 0 = one per core, 1 = this process only."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Keeps the arguments of the constructor as `options`."""
        source = super().__new__(cls)
        signature = inspect.signature(cls.__init__)
        bound = signature.bind_partial(source, *args, **kwargs)
        bound.apply_defaults()
        variadic = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        options = {
            name: bound.arguments[name]
            for name, parameter in signature.parameters.items()
            if name in bound.arguments and name not in {"self", *PLACES} and parameter.kind not in variadic
        }
        source.options = json.loads(json.dumps(options, default=str))
        return source

    def excluded(self) -> dict[str, int]:
        """Returns the number of clips or labels left out, by reason; complete once `clips` is exhausted."""
        return {}

    def counts(self) -> Mapping[str, float]:
        """Returns the figures of the raw data under the names of `published.yaml`; saved once `clips` is exhausted."""
        return {}

    def findings(self) -> list[str]:
        """Returns lines to print about the motions, complete once `clips` is exhausted."""
        return []

    @abstractmethod
    def count(self) -> int:
        """Returns the number of clips that `clips` yields, without reading motions; used by the progress bar.

        Raises:
            FileNotFoundError: the raw data is not at the path in the recipe; the message says how to get it.
        """

    def check(self) -> list[str]:
        """Returns lines to print about the files that are present and missing; prepares nothing."""
        return [f"{self.name}: {self.count()} clips can be prepared"]

    def statistics(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns mean and std (D,) published with encoded features; None = computed from the training clips."""
        return None

    @abstractmethod
    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields all clips at `fps` frames per second, always in the same order.

        Raises:
            ValueError: a file is damaged; the message names it.
        """


def hashed_split(name: str, val: int, test: int) -> Split:
    """Holds out `val` and `test` percent of all names by a hash of the name, so that adding names moves no others."""
    share = int(hashlib.sha1(name.encode()).hexdigest()[:8], 16) % 100
    return "train" if share < 100 - val - test else "val" if share < 100 - test else "test"
