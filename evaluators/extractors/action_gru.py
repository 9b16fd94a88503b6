# pyright: standard
"""The action classifier for HumanAct12: a GRU over joint positions (Guo et al. 2020, "Action2Motion")."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

NUM_ACTIONS = 12


class ActionGRU(nn.Module):
    """Action classifier with two GRU layers over joint positions.

    The class is predicted from the state at the last real frame. The features and accuracies in all
    published HumanAct12 tables were computed with the released weights. The authors draw the
    initial state from a normal distribution on every call. In this implementation, the initial
    `state` (layers, B, hidden) is zero by default.
    """

    features = 30

    def __init__(
        self,
        num_joints: int = 24,
        hidden: int = 128,
        num_layers: int = 2,
        *,
        num_actions: int = NUM_ACTIONS,
    ):
        super().__init__()
        self.recurrent = nn.GRU(3 * num_joints, hidden, num_layers, batch_first=True)
        self.linear1 = nn.Linear(hidden, self.features)
        self.linear2 = nn.Linear(self.features, num_actions)

    def forward(self, joints: Tensor, mask: Tensor, state: Tensor | None = None) -> Tensor:
        """Computes features (B, 30), in (-1, 1), from joint positions (B, F, J, 3) and their mask (B, F).

        The positions are in meters, with y up.
        """
        joints = joints * joints.new_tensor([1.0, -1.0, -1.0])
        return self.published(joints - joints[:, :1, :1], mask, state)

    def published(self, x: Tensor, mask: Tensor, state: Tensor | None = None) -> Tensor:
        """Computes features (B, 30) from joint positions (y down) relative to the initial pelvis."""
        outputs, _ = self.recurrent(x.flatten(2), state)
        last = mask.sum(1) - 1
        return torch.tanh(self.linear1(outputs[torch.arange(len(last), device=last.device), last]))

    def logits(self, joints: Tensor, mask: Tensor, state: Tensor | None = None) -> Tensor:
        """Returns unnormalized log-probabilities (B, actions) for the same input as `forward`."""
        return self.linear2(self(joints, mask, state))

    def random_state(self, seeds: Sequence[int]) -> Tensor:
        """Draws initial states (layers, B, hidden) from a standard normal distribution.

        The authors' code does the same.
        """
        shape = (self.recurrent.num_layers, 1, self.recurrent.hidden_size)
        states = [
            torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds
        ]
        return torch.cat(states, 1).to(self.linear1.weight)
