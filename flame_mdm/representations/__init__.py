"""Motion representations, which encode motions as features and decode them to joint positions."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from flame_mdm.errors import UserError
from flame_mdm.representations.skeleton import Skeleton

Features = TypeVar("Features", np.ndarray, Tensor)


@dataclass(frozen=True)
class Frames:
    """All frames (N, D) of a data set. They can be read in parts and more than once."""

    # Returns arrays (F, D) of arbitrary lengths, in the same order each time
    arrays: Callable[[], Iterable[np.ndarray]]
    count: int

    def __len__(self) -> int:
        return self.count

    def split(self, size: int) -> Iterator[Tensor]:
        """Yields consecutive parts (size, D), like `Tensor.split`. The last part may be shorter."""
        pending: list[np.ndarray] = []
        for array in self.arrays():
            pending.append(array)
            while sum(map(len, pending)) >= size:
                joined = np.concatenate(pending)
                pending = [joined[size:].copy()]
                yield torch.from_numpy(joined[:size])
        if sum(map(len, pending)):
            yield torch.from_numpy(np.concatenate(pending))


class Representation(nn.Module, ABC):
    """Base class for representations, which convert motions to features and back.

    The mean and std are buffers, so that sampling does not require the data set.

    Args:
        name: name of the representation in stores and checkpoints. Features of representations with
            different names are never combined.
        features: D, the number of features per frame.
        fps: frames per second, 1 to 1000.
        skeleton: skeleton of the decoded joint positions.

    Raises:
        UserError: If `fps` is out of range.

    Example:
        >>> from flame_mdm.representations.skeleton import SMPL22
        >>> class Positions(Representation):  # joint positions as features
        ...     def encode(self, motion):
        ...         return motion.flatten(1).float()
        ...     def decode(self, features):
        ...         return features.unflatten(-1, (-1, 3))
        ...     def joint_features(self, joints):
        ...         return self.joint_mask(joints).repeat_interleave(3)
        >>> positions = Positions("positions", 66, 20.0, SMPL22)
        >>> motion = torch.randn(5, 22, 3)
        >>> torch.equal(positions.to_joints(positions.normalize(positions.encode(motion))), motion)
        True
    """

    #: (D,) mean of the features.
    mean: Tensor
    #: (D,) standard deviation of the features.
    std: Tensor
    #: Name of a longer representation that begins with these features, so that its features can be
    #: truncated to them.
    part_of: str = ""
    #: Whether the root is encoded as steps between frames, so that any window of frames is a valid
    #: motion.
    relative: bool = True
    #: Columns of the features by name.
    slices: Mapping[str, slice] = {}
    #: Columns of the pose, which exclude the steps of the root, velocities and contacts.
    pose: slice

    def __init__(self, name: str, features: int, fps: float, skeleton: Skeleton):
        super().__init__()
        if not isinstance(fps, int | float) or not 1 <= fps <= 1000:
            raise UserError(f"representation.fps={fps}: expected 1 to 1000 frames per second")
        self.name, self.features, self.fps, self.skeleton = name, features, fps, skeleton
        self.pose = slice(0, features)
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("std", torch.ones(features))

    @abstractmethod
    def encode(self, motion: Tensor) -> Tensor:
        """Encodes a raw motion as float32 features (F', D) in the data's units."""

    def encode_many(self, motions: Sequence[Tensor]) -> list[Tensor]:
        """Encodes several motions. Subclasses may encode them in one pass."""
        return [self.encode(motion) for motion in motions]

    @abstractmethod
    def decode(self, features: Tensor) -> Tensor:
        """Decodes features (..., F, D) to joint positions (..., F, J, 3).

        The features are in the data's units. The positions are in meters, with y up. The decoding
        is differentiable.
        """

    def rotations6d(self, features: Tensor) -> Tensor:
        """Extracts the 6D rotations (..., F, N, 6) from features (..., F, D).

        The features are in the data's units. By default, they contain no rotations (N = 0).
        """
        return features.new_zeros(*features.shape[:-1], 0, 6)

    def statistics(self, features: Tensor | Frames) -> tuple[Tensor, Tensor]:
        """Computes the mean and std (D,) of all training frames (N, D) for normalization.

        Without `slices`, features are not normalized: the mean is 0 and the std is 1.
        """
        if self.slices:
            return grouped_statistics(features, self.slices.values())
        return torch.zeros(self.features), torch.ones(self.features)

    @abstractmethod
    def joint_features(self, joints: Iterable[int]) -> Tensor:
        """Returns a bool mask (D,) that is True for the features of the given joints.

        Features of the root trajectory belong to joint 0.
        """

    def joint_mask(self, joints: Iterable[int]) -> Tensor:
        """Returns a bool mask (J,) that is True for the given joints."""
        mask = torch.zeros(len(self.skeleton), dtype=torch.bool)
        mask[list(joints)] = True
        return mask

    def contacts(self, features: Features) -> Features | None:
        """Returns the feature columns (..., F, N) with the floor contacts of `skeleton.feet`.

        The values range from about 0 to 1. The result is None if the features contain no contacts.
        """
        columns = self.slices.get("contacts")
        return None if columns is None else features[..., columns]

    def rebase(self, features: Features) -> Features:
        """Adapts the features (..., F, D) of cut clips so that they start like complete motions.

        By default, the features are returned unchanged.
        """
        return features

    def normalize(self, features: Tensor) -> Tensor:
        """Normalizes features (..., D) that are given in the data's units."""
        return (features - self.mean) / self.std

    def denormalize(self, x: Tensor) -> Tensor:
        """Converts normalized features (..., D) to the data's units."""
        return x * self.std + self.mean

    def to_joints(self, x: Tensor) -> Tensor:
        """Decodes normalized features (..., F, D) to joint positions (..., F, J, 3).

        The positions are in meters, with y up. The decoding is differentiable.
        """
        return self.decode(self.denormalize(x))


def check_finite(motion: Tensor, name: str = "motion") -> None:
    """Raises `UserError` if a raw motion (F, ...) contains NaN or infinite values."""
    if not motion.isfinite().all():
        frame = int((~motion.isfinite()).flatten(1).any(1).nonzero()[0, 0])
        raise UserError(
            f"{name}: frame {frame} contains NaN or infinite values. Exclude the motion"
        )


# Smallest standard deviation of a group of features that is not constant. Positions in KIT's units
# have rounding errors of 3e-5.
SMALLEST_STD = 1e-4


def grouped_statistics(features: Tensor | Frames, groups: Iterable[slice]) -> tuple[Tensor, Tensor]:
    """Returns the mean (D,) of each feature, and the std averaged over each group of features.

    `features` are frames (N, D). A group is constant if its std is below `SMALLEST_STD`. The std
    of a constant group is set to 1, so that rounding errors are not amplified.
    """
    mean, squares = moments(features)
    std = (squares / len(features)).sqrt()
    for columns in groups:
        average = std[columns].mean()
        std[columns] = average if average > SMALLEST_STD else 1.0
    return mean.float(), std.float()


def moments(features: Tensor | Frames) -> tuple[Tensor, Tensor]:
    """Returns the float64 mean (D,) and sum of squared deviations (D,) of frames (N, D)."""
    size, zero = 1 << 16, torch.zeros(())  # all frames of a data set would not fit in memory
    mean = sum((chunk.double().sum(0) for chunk in features.split(size)), zero) / len(features)
    return mean, sum(
        (chunk.double().sub_(mean).square_().sum(0) for chunk in features.split(size)), zero
    )
