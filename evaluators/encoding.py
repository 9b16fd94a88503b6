# pyright: standard
"""Encodes modified joint positions as features, without changing their height."""

from collections.abc import Sequence

import numpy as np
import torch

from flame_mdm.representations.humanml import HumanML

Joints = np.ndarray
"""Joint positions (F, J, 3) in meters, with y up."""


def encode(representation: HumanML, motions: Sequence[Joints]) -> list[np.ndarray]:
    """Encodes motions as float32 features (F, D), one row per frame, at their original height.

    The encoder of a representation requires an additional frame. It also places the lowest joint on
    the floor, which would hide floating and sinking. This function adds the frame and restores the
    height.
    """
    longer = [torch.from_numpy(np.concatenate([x, 2 * x[-1:] - x[-2:-1]])) for x in motions]
    encoded = []
    for joints, features in zip(motions, representation.encode_many(longer), strict=True):
        height, positions = representation.slices["root_height"], representation.slices["positions"]
        rise = float(joints[0, 0, 1]) * representation.units_per_metre - features[0, height]
        features[:, height] += rise
        features[:, positions.start + 1 : positions.stop : 3] += rise
        encoded.append(features.numpy())
    return encoded
