"""Data sets: from what their owners hand out to packed stores and training batches."""

import hashlib
import inspect
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Self

import numpy as np

Split = Literal["train", "val", "test"]


@dataclass
class Clip:
    """One motion on its way from a data set into a store.

    Attributes:
        id: unique name; mirrored copies are named `M` + the name of their original.
        motion: what the representation encodes, at its frame rate; for joint-based representations the joint positions
            (F, J, 3) in metres, y up, in the joint order of its skeleton.
        captions: what is done, each a full description of the clip; empty for sets with action labels only.
        split: mirrored copies and cuts of a take stand in the split of that take.
        source: the take the clip comes from; clips of one source never stand in two splits.
        action: index into the data set's `actions`, or None.
        attributes: exact facts about the motion, where the set knows them (side, count, direction, speed, tagged words
            of the captions ...); plain values that JSON can hold.
        encoded: where the owners hand out features, the name of the representation that `motion` (F, D) is in; it is
            stored as it is. Empty: `motion` is raw.
        window: (first, length): the clip is this cut of its motion. Clips that follow one another with the very same
            array share its frames in the store. Only for representations that make one row a frame.
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


PLACES = frozenset({"path", "amass", "body_models", "humanact12", "index", "splits", "workers"})
"""Arguments of sources that tell where files are and how to read them. The others define the data."""


class MotionSource(ABC):
    """A data set as its owners hand it out."""

    name: str
    options: Mapping[str, Any]
    """Arguments that define the data, all but `PLACES`, as JSON values. The store keeps them."""
    actions: tuple[str, ...] = ()
    """Names of the action labels, in the order of their numbers; empty for sets without labels."""
    published: ClassVar[dict[str, int]] = {}
    """Figures of the set as its owners or the papers give them, to compare with what is found."""
    published_split: bool = False
    """The split is the one that papers use although clips are tested on that training has seen, or so that nothing is
    left to validate on; the store carries it, and so does every result."""

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
        """How many clips or labels were left out, by reason; known once `clips` is exhausted."""
        return {}

    def counts(self) -> dict[str, int]:
        """What is in the raw data under the names of `published`; the store keeps it, once `clips` is exhausted."""
        return {}

    @abstractmethod
    def count(self) -> int:
        """Number of clips that `clips` yields, known without reading motions, for the progress bar.

        Raises:
            FileNotFoundError: the raw data is not where the recipe says; the message says how to get it.
        """

    def check(self) -> list[str]:
        """What is there and what is missing, in lines to print; nothing is prepared."""
        return [f"{self.name}: {self.count()} clips can be prepared"]

    def statistics(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Mean and std (D,) that the owners hand out with encoded features; None = computed from the training clips."""
        return None

    @abstractmethod
    def clips(self, fps: float) -> Iterator[Clip]:
        """All clips at `fps` frames a second, always in the same order.

        Raises:
            ValueError: a file is damaged; the message names it.
        """


def hashed_split(name: str, val: int, test: int) -> Split:
    """Holds out `val` and `test` per cent of all names; by the name alone, so that more names do not move any."""
    share = int(hashlib.sha1(name.encode()).hexdigest()[:8], 16) % 100
    return "train" if share < 100 - val - test else "val" if share < 100 - test else "test"
