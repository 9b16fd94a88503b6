"""Motions as features: what a model sees, and the way back to joints."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from flame_mdm.representations.skeleton import Skeleton


class Representation(nn.Module, ABC):
    """Motion <-> features. Mean and std are buffers, so that sampling from a checkpoint needs no data set on disk."""

    mean: Tensor
    std: Tensor

    def __init__(self, name: str, features: int, fps: float, skeleton: Skeleton):
        """`name` stands in the store and in checkpoints: features of different names are never mixed."""
        super().__init__()
        if not isinstance(fps, int | float) or not 1 <= fps <= 1000:
            raise ValueError(f"representation.fps={fps}: frames per second have to be a number from 1 to 1000")
        self.name, self.features, self.fps, self.skeleton = name, features, fps, skeleton
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("std", torch.ones(features))

    @abstractmethod
    def encode(self, motion: Tensor) -> Tensor:
        """Raw motion -> features (F', D) in the data's units, float32, not normalized."""

    def encode_many(self, motions: Sequence[Tensor]) -> list[Tensor]:
        """Encodes several motions."""
        return [self.encode(motion) for motion in motions]

    @abstractmethod
    def decode(self, features: Tensor) -> Tensor:
        """Features (..., F, D) in the data's units -> joints (..., F, J, 3), metres, y up. Differentiable."""

    @abstractmethod
    def statistics(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std (D,) to normalize with, from all training frames (N, D)."""

    @abstractmethod
    def joint_features(self, joints: Iterable[int]) -> Tensor:
        """(D,) bool, True for the features that describe these joints; those of the root's way belong to joint 0."""

    def rebase(self, features: np.ndarray) -> np.ndarray:
        """Features (F, D) of a cut of a motion, made to start like a whole motion; here, nothing is to be done."""
        return features

    def normalize(self, features: Tensor) -> Tensor:
        """(..., D) in the data's units -> normalized."""
        return (features - self.mean) / self.std

    def denormalize(self, x: Tensor) -> Tensor:
        """(..., D) normalized -> the data's units."""
        return x * self.std + self.mean

    def to_joints(self, x: Tensor) -> Tensor:
        """(..., F, D) normalized -> joints (..., F, J, 3), metres, y up. Differentiable."""
        return self.decode(self.denormalize(x))
