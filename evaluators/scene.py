# pyright: standard
"""The real motions that an audit perturbs, their captions, and wrong captions for them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch

from evaluators.near_misses import near_misses
from evaluators.protocol import DrawnClip
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.representations.humanml import HumanML
from flame_mdm.seeds import key

RANDOM, NEAR = "wrong captions", "near misses"
"""Kinds of wrong captions: captions of random other motions, and captions with one wrong attribute."""


class Text(NamedTuple):
    """A caption, its tagged words, and the requested attributes."""

    caption: str
    tokens: Sequence[str] | None
    requested: Mapping[str, Any]


def text_of(row: DrawnClip, caption: str) -> Text:
    """Returns a caption of a drawn clip, with its tagged words and the requested attributes."""
    return Text(caption, row.tokens(caption), row.requested)


@dataclass
class Scene:
    """Real motions from a split: drawn clips, their features (F, D), and the seed of all draws."""

    data: MotionDataModule
    rows: list[DrawnClip]
    features: list[np.ndarray]
    representation: HumanML
    seed: int

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def fps(self) -> float:
        """Frames per second of the motions."""
        return self.representation.fps

    @cached_property
    def joints(self) -> list[np.ndarray]:
        """Joint positions of each motion: float64 (F, J, 3) in meters, with y up."""
        return [
            self.representation.decode(torch.from_numpy(x)).double().numpy() for x in self.features
        ]

    @property
    def actions(self) -> list[int]:
        """Action label of each motion, or 0 if the data has no labels."""
        return [row.clip.action or 0 for row in self.rows]

    def draws(self, *parts: str | int) -> np.random.Generator:
        """Returns a random generator whose state depends only on the seed and the parts."""
        return np.random.default_rng(key("audit", self.seed, *parts))

    @cached_property
    def wrong(self) -> dict[str, list[Text | None]]:
        """Wrong texts, keyed by kind of error: one per motion, or None if the motion has none.

        The kinds are `RANDOM` and `NEAR`. If there are near misses in several attributes, there is
        also a kind "near misses: ATTRIBUTE" for each of these attributes.
        """
        texts = {
            caption: text_of(row, caption) for row in self.rows for caption in row.clip.captions
        }
        contradicting = near_misses([row.clip for row in self.rows])
        attributes = sorted({name for misses in contradicting for name in misses})
        kinds = [RANDOM, NEAR]
        if len(attributes) > 1:
            kinds += [f"{NEAR}: {name}" for name in attributes]

        wrong: dict[str, list[Text | None]] = {}
        for kind in kinds:
            wrong[kind] = []
            for row, misses in zip(self.rows, contradicting, strict=True):
                draws = self.draws(kind, row.id)
                options = misses.get(kind.partition(": ")[2], [])
                if kind == NEAR and misses:
                    options = misses[sorted(misses)[draws.integers(len(misses))]]
                elif kind == RANDOM:
                    options = [caption for caption in texts if caption not in row.clip.captions]
                wrong[kind].append(
                    texts[options[draws.integers(len(options))]] if options else None
                )
        return {kind: chosen for kind, chosen in wrong.items() if any(chosen)}
