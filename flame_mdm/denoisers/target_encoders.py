"""Encoders for target conditions, which specify where joints should be at the end of a motion.

Source: Tevet et al. 2025, "CLoSD". A target (B, 8, 4) contains one slot per joint. Each slot
contains x, y, z, and a flag, which is 1 if the joint is requested and 0 if it is free.
"""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from flame_mdm.batch import Condition
from flame_mdm.errors import UserError

# Number of slots in a target: six joints, the position on the floor and the heading; see
# `flame_mdm.conditions.target`
SLOTS = 8


class TargetEncoder(nn.Module, ABC):
    """Embeds the target of a condition as vectors (B, features). Without a target, the embedding is 0.

    A target that requests no joints differs from a missing target, because its embedding contains
    the biases of the network.

    Example:
        >>> encoder = SingleTarget(features=16, layers=1)
        >>> encoder(Condition(torch.ones(2, 4), torch.ones(2, 0, 4), None, target=torch.zeros(2, 8, 4))).shape
        torch.Size([2, 16])
    """

    @abstractmethod
    def embed(self, target: Tensor) -> Tensor:
        """Embeds targets (B, 8, 4) as vectors (B, features)."""

    def forward(self, cond: Condition) -> Tensor:
        """Embeds the target of a condition. The embedding of a sample without a target is 0."""
        if cond.target is None:
            return cond.pooled.new_zeros(len(cond.pooled), 1)
        embedding = self.embed(cond.target)
        return embedding if cond.target_mask is None else embedding * cond.target_mask[:, None]


class SingleTarget(TargetEncoder):
    """Embeds the values of all slots with a single network."""

    def __init__(self, features: int, layers: int):
        super().__init__()
        self.network = perceptron(4 * SLOTS, features, layers)

    def embed(self, target: Tensor) -> Tensor:
        """Embeds targets (B, 8, 4) as vectors (B, features)."""
        return self.network(target.flatten(1))


class SplitTarget(TargetEncoder):
    """Embeds each slot with a separate network and concatenates the outputs."""

    def __init__(self, features: int, layers: int):
        super().__init__()
        if features % SLOTS:
            raise UserError(
                f"target_encoder=split requires a latent_dim that is a multiple of {SLOTS}, not "
                f"{features}"
            )
        self.networks = nn.ModuleList(
            perceptron(4, features // SLOTS, layers) for _ in range(SLOTS)
        )

    def embed(self, target: Tensor) -> Tensor:
        """Embeds targets (B, 8, 4) as vectors (B, features)."""
        return torch.cat(
            [network(target[:, slot]) for slot, network in enumerate(self.networks)], -1
        )


class MultiTarget(TargetEncoder):
    """Embeds each slot with a separate network and returns a weighted sum over the requested slots.

    As in the authors' code, the learned weights are divided by their sum over all slots. This sum
    may be near 0. `layers` has no effect.
    """

    def __init__(self, features: int, layers: int):
        super().__init__()
        self.networks = nn.ModuleList(perceptron(3, features, 1) for _ in range(SLOTS))
        self.weights = nn.Parameter(torch.randn(SLOTS))

    def embed(self, target: Tensor) -> Tensor:
        """Embeds targets (B, 8, 4) as vectors (B, features)."""
        position, requested = target[..., :3], target[..., 3:]
        embedded = torch.stack(
            [network(position[:, slot]) for slot, network in enumerate(self.networks)], 1
        )
        return ((self.weights / self.weights.sum())[:, None] * requested * embedded).sum(1)


TARGET_ENCODERS: dict[str, type[TargetEncoder]] = {
    "single": SingleTarget,
    "split": SplitTarget,
    "multi": MultiTarget,
}
"""Target encoders, by the names that the authors use."""


def perceptron(in_features: int, features: int, layers: int) -> nn.Sequential:
    """Returns a network with `layers` hidden layers of width `features`."""
    if layers < 1:
        raise UserError(f"denoiser.target_layers={layers}: must be at least 1")
    hidden = [layer for _ in range(layers) for layer in (nn.SiLU(), nn.Linear(features, features))]
    return nn.Sequential(nn.Linear(in_features, features), *hidden)
